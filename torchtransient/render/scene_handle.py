"""``tt.load`` and ``tt.Scene``: a scene that can be pickled, copied and rebuilt in any differentiable variant."""

from __future__ import annotations

import os
from collections import OrderedDict
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

from torchtransient.errors import GradientError, SceneError
from torchtransient.render.build import BuildOptions, BuiltScene, build
from torchtransient.render.description import Description, describe_dict, describe_xml, same_description
from torchtransient.render.opaque import opaque
from torchtransient.render.parameters import ParameterTable, SlotTable, parameter_table, unknown_key
from torchtransient.render.recordings import Recordings
from torchtransient.render.variant import active_variant, engine_lock, resolve_variant

# Built scenes kept per description: one for every combination of time axis, depth and substituted plugins in use.
_MAX_BUILDS = 8


class Scene:
    """A scene's description, and the Mitsuba scenes built from it when they are needed.

    Made by :func:`load`. Pickling and copying take the description alone; the Mitsuba scene is built on first use,
    under the scene's variant. Instances are immutable, so copies share everything. Not supported: Mitsuba objects
    inside a description (they belong to one variant of one process).
    """

    def __init__(self, description: Description, variant: str | None):
        self._description = description
        self._requested_variant = variant
        self._variant: str | None = None
        self._builds: OrderedDict[BuildOptions, BuiltScene] = OrderedDict()
        # Not in the built scenes: what refers to itself is freed late.
        self._slots: dict[BuildOptions, dict[tuple[str, ...], SlotTable]] = {}
        # Built scenes that still hold the values of the last run: the next one most likely brings its own.
        self._unsettled: dict[BuildOptions, SlotTable] = {}
        self._recordings: dict[BuildOptions, dict[tuple[str, ...], Recordings]] = {}
        self._table: ParameterTable | None = None
        # Which unphysical things were said already (`render.physics`).
        self.told: set[str] = set()

    @property
    def variant(self) -> str:
        """The variant that this scene is built in; settled at the first use."""
        if self._variant is None:
            self._variant = resolve_variant(self._requested_variant)
        return self._variant

    @opaque
    def parameters(self) -> ParameterTable:
        """Every parameter key with its value, shape, and whether and why it is differentiable. Printing it gives
        a table.
        """
        return self._parameters(BuildOptions(real_bitmaps=True))

    def _parameters(self, options: BuildOptions) -> ParameterTable:
        with engine_lock:
            if self._table is None:
                with active_variant(self.variant):
                    self._table = parameter_table(self.built(options))
            return self._table

    def built(self, options: BuildOptions) -> BuiltScene:
        """The Mitsuba scene for some options, with the described values. Must be called inside
        ``active_variant(scene.variant)``.
        """
        self._settle(options)
        return self._build(options)

    def _build(self, options: BuildOptions) -> BuiltScene:
        found = self._builds.get(options)
        if found is None:
            found = build(self._description, self.variant, options)
            self._builds[options] = found
            while len(self._builds) > _MAX_BUILDS:
                self.drop(next(iter(self._builds)))
        self._builds.move_to_end(options)
        return found

    def findings(self, options: BuildOptions) -> dict[str, str]:
        """What is unphysical in the description, by key. Must be called inside ``active_variant(scene.variant)``."""
        found = self.built(options).findings()
        if found and options.merge:
            # Merged shapes have lost their names: those of the build that `parameters()` reads.
            found = self.built(BuildOptions(real_bitmaps=True)).findings()
        return found

    def drop(self, options: BuildOptions) -> None:
        """Forget one built scene; the next use builds it anew."""
        self._builds.pop(options, None)
        self._unsettled.pop(options, None)
        self._slots.pop(options, None)
        self._recordings.pop(options, None)

    def options_for(self, keys: Iterable[str], options: BuildOptions) -> BuildOptions:
        """The options under which every one of ``keys`` is an independent, differentiable parameter.

        Raises ``SceneError`` for unknown keys and ``GradientError`` for keys without a derivative.
        """
        keys = tuple(keys)
        if not keys:
            return replace(options, merge=True)
        # The build that most keys need anyway, so that looking them up costs nothing.
        table = self._parameters(replace(options, real_bitmaps=True, merge=False))
        substitute = set(options.substitute)
        for key in keys:
            info = table.get(key)
            if info is None:
                raise SceneError(unknown_key(key, list(table)))
            if not info.differentiable:
                raise GradientError(f"parameter {key!r} has no derivative: {info.reason}.")
            substitute |= info.substitute
        return replace(options, substitute=frozenset(substitute), real_bitmaps=True, merge=False)

    def slots(self, keys: Iterable[str], options: BuildOptions) -> SlotTable:
        """How torch values for ``keys`` enter the built scene, which holds the described values or those of the last
        run with these keys. Must be called inside ``active_variant(scene.variant)``.
        """
        wanted = tuple(keys)
        found = self._slots.setdefault(options, {}).get(wanted)
        if found is not None and self._unsettled.get(options) is found:
            del self._unsettled[options]
            self._builds.move_to_end(options)
            return found
        built = self.built(options)
        # Whoever built it may have dropped others, or this one's tables.
        tables = self._slots.setdefault(options, {})
        if wanted not in tables:
            tables[wanted] = SlotTable(built, wanted)
        return tables[wanted]

    def leave(self, options: BuildOptions, slots: SlotTable, attached: bool) -> None:
        """End of a run: the described values are put back when the built scene is asked for by anyone but a run with
        the same keys, and at once where values are ``attached``, so that no graph outlives a run.
        """
        if slots.originals and self._builds.get(options) is slots.built:
            self._unsettled[options] = slots
            if attached:
                self._settle(options)

    def _settle(self, options: BuildOptions) -> None:
        slots = self._unsettled.pop(options, None)
        if slots is not None:
            try:
                slots.restore()
            except BaseException:
                self.drop(options)
                raise

    def recordings(self, keys: Iterable[str], options: BuildOptions) -> Recordings:
        """The recorded calls of the built scene with values for ``keys``."""
        return self._recordings.setdefault(options, {}).setdefault(tuple(keys), Recordings())

    def same_description(self, other: Scene) -> bool:
        """Whether both describe one scene, in whichever variants."""
        return same_description(self._description, other._description)

    def __getstate__(self) -> dict[str, Any]:
        return {"description": self._description, "variant": self._requested_variant, "settled": self._variant}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(state["description"], state["variant"])  # type: ignore[misc]
        self._variant = state["settled"]

    def __copy__(self) -> Scene:
        return self

    def __deepcopy__(self, memo: dict[int, Any]) -> Scene:
        return self

    def __repr__(self) -> str:
        return f"tt.Scene({self._description.name!r}, variant={self._variant or self._requested_variant!r})"


@opaque
def load(
    scene: str | os.PathLike[str] | Mapping[str, Any] | Scene, variant: str | None = None, **xml_parameters: Any
) -> Scene:
    """Describe a scene: the path of a Mitsuba XML file, a scene dictionary, or another :class:`Scene`.

    ``variant``: a differentiable variant such as ``llvm_ad_rgb``, ``llvm_ad_mono``, ``cuda_ad_spectral``; None takes
    the active one if it is differentiable and ``llvm_ad_rgb`` otherwise, settled at the first use.
    ``xml_parameters`` fill the ``$name`` parameters of an XML file.

    Nothing is built yet and no variant is switched: that happens at the first use, inside the call, and the variant
    that was active before is put back (when none was active, the scene's variant stays active). Dictionaries hold
    transforms as (4, 4) arrays or nested lists, or as Mitsuba transforms; colours, vectors, bitmaps and tensors of
    Mitsuba are taken too. Scenes written for mitransient 1.x load unchanged. Children of an XML scene without an id
    are named after their kind: ``sensor``, ``shape_0``, ``shape_1``.

    Raises ``SceneError`` for a missing or malformed file and for entries that cannot be described; faults inside the
    scene (unknown plugins, unknown or unused parameters) are reported when the scene is built, with file and line
    where Mitsuba knows them. Raises ``VariantError`` for a variant that cannot be used.
    """
    if variant is not None:
        resolve_variant(variant)
    if isinstance(scene, (str, os.PathLike)):
        return Scene(describe_xml(scene, xml_parameters), variant)
    if xml_parameters:
        names = ", ".join(sorted(xml_parameters))
        raise SceneError(
            f"tt.load: $parameters of XML files ({names}) are for these alone, got {type(scene).__name__}."
        )
    if isinstance(scene, Scene):
        return scene if variant is None or variant == scene.variant else Scene(scene._description, variant)
    if isinstance(scene, Mapping):
        return Scene(describe_dict(scene), variant)
    raise SceneError(f"tt.load: expected a path, a dictionary or a tt.Scene, got {type(scene).__name__}.")
