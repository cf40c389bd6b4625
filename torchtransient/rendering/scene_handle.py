"""``tt.load`` and ``tt.Scene``: a scene that can be pickled, copied and rebuilt in any differentiable variant."""

from __future__ import annotations

import os
from collections import OrderedDict
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchtransient.checks import flag, shown
from torchtransient.errors import ArgumentError, GradientError, SceneError
from torchtransient.rendering.build import BuiltScene, build
from torchtransient.rendering.build_options import BuildOptions
from torchtransient.rendering.description import Description, describe_dict, describe_xml, same_description
from torchtransient.rendering.opaque import opaque
from torchtransient.rendering.parameters import ParameterTable, SlotTable, parameter_table, unknown_key
from torchtransient.rendering.probe import probe
from torchtransient.rendering.ready_scenes import described_for_time
from torchtransient.rendering.recordings import Recordings
from torchtransient.rendering.saving.save import save_scene
from torchtransient.rendering.taken import ReadyScene
from torchtransient.rendering.variant import active_variant, resolve_variant

if TYPE_CHECKING:
    from torchtransient.rendering.depth_bound import DepthBound

# Built scenes kept per description: one for every combination of time axis, depth and substituted plugins in use.
_MAX_BUILDS = 8


class Scene:
    """A scene's description, and the Mitsuba scenes built from it when they are needed.

    Made by :func:`load`. Pickling and copying take the description alone; the Mitsuba scene is built on first use,
    under the scene's variant. Instances are immutable, so copies share everything. A scene that holds Mitsuba objects
    as they were taken (:func:`load`) stays in their variant and process.
    """

    def __init__(self, description: Description, variant: str | None):
        self._description = description
        # Objects that were taken as they are fix the variant, and are shared by all that is built of them.
        self.is_shared = bool(description.taken)
        description.check_variant(variant)
        self._requested_variant = description.taken[0].variant if self.is_shared else variant
        self._variant: str | None = None
        self._builds: OrderedDict[BuildOptions, BuiltScene] = OrderedDict()
        # Not in the built scenes: what refers to itself is freed late.
        self._slots: dict[BuildOptions, dict[tuple[str, ...], SlotTable]] = {}
        # Built scenes that still hold the values of the last run: the next one most likely brings its own.
        self._unsettled: dict[BuildOptions, SlotTable] = {}
        self._recordings: dict[BuildOptions, dict[tuple[str, ...], Recordings]] = {}
        self._table: ParameterTable | None = None
        # Those that the table was made with: a scene that is taken may be built with some alone.
        self._table_options = BuildOptions(real_bitmaps=True)
        # Bounds on the depth for derivatives, by options and sensors (`rendering.depth_bound`).
        self.depth_bounds: dict[tuple[BuildOptions, tuple[int, ...]], DepthBound | None] = {}
        # Which unphysical things were said already (`rendering.physics`).
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
        if self.is_shared:  # values may have changed
            self._table = None
            return self._parameters(self._table_options)
        return self.known_parameters()

    def known_parameters(self) -> ParameterTable:
        """The same, with the values that were there when it was asked for first."""
        return self._parameters(BuildOptions(real_bitmaps=True))

    def _parameters(self, options: BuildOptions) -> ParameterTable:
        found = self._table
        if found is None:
            with active_variant(self.variant):
                found = self._table = parameter_table(self.built(options))
                self._table_options = options
        return found

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
        if self.is_shared:  # what the scene goes back to is what it holds now
            return SlotTable(self.built(options), wanted)
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
        if not slots.originals:
            return
        if self._builds.get(options) is not slots.built:
            if attached:  # its restoring was cut off by an interrupt (`_settle`); others may hold it still
                slots.restore()
            return
        self._unsettled[options] = slots
        if attached or self.is_shared:
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

    @opaque
    def save(self, path: str | os.PathLike[str], values: Mapping[str, Any] | None = None) -> Path:
        """Write the scene as an XML file, with ``values`` in place of those that are described.

        ``values``: by key, in the shapes that :meth:`parameters` lists, as a renderer's ``values``. Meshes, bitmaps and
        volumes that the XML cannot hold, and files that the scene names, are in the folder ``NAME_files`` beside it,
        which is replaced. ``tt.load`` and, after ``import torchtransient``, ``mi.load_file`` read it. It is read back
        in the scene's variant before it takes its place, and every parameter is compared.

        Returns the path. Raises ``SceneError`` for what cannot be said in XML (numbers of a spectral model, arrays of
        plugins that read no file, objects that were taken as they are), for unknown keys and for a path that is no XML
        file in a folder that is there; ``ShapeError`` and ``GradientError`` for values as a renderer does. Nothing is
        written then.
        """
        if values is not None and not isinstance(values, Mapping):
            raise ArgumentError(f"scene.save: expected values by key, got {shown(values)}.")
        return save_scene(self, path, dict(values or {}), load)

    def same_description(self, other: Scene) -> bool:
        """Whether both describe one scene, in whichever variants."""
        return same_description(self._description, other._description)

    def __getstate__(self) -> dict[str, Any]:
        self._description.check_described("tt.Scene: pickling")
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
    scene: str | os.PathLike[str] | Mapping[str, Any] | Scene | Any,
    variant: str | None = None,
    *,
    trusted: bool = True,
    **xml_parameters: Any,
) -> Scene:
    """Describe a scene: the path of a Mitsuba XML file, a scene dictionary, another :class:`Scene` or a ``mi.Scene``.

    ``variant``: a differentiable variant such as ``llvm_ad_rgb``, ``llvm_ad_mono``, ``cuda_ad_spectral``; None takes
    the active one if it is differentiable and ``llvm_ad_rgb`` otherwise, settled at the first use.
    ``xml_parameters`` fill the ``$name`` parameters of an XML file.

    Nothing is built yet and no variant is switched: that happens at the first use, inside the call, and the variant
    that was active before is put back (when none was active, the scene's variant stays active). Dictionaries hold
    transforms as (4, 4) arrays or nested lists, or as Mitsuba transforms; colours, vectors, bitmaps and tensors of
    Mitsuba are taken too, and volume grids and meshes that are loaded (positions, normals, texture coordinates, a
    diffuse surface of one colour), all of which are described from then on. Other objects of Mitsuba inside a
    dictionary, and a whole ``mi.Scene``, are taken as they are: they keep their plugins, film, integrator and variant,
    later changes of them count, and pickling, plans and other variants are refused. Of a ``mi.Scene`` for steady
    pictures, cameras with an ``hdrfilm``, and ``path``, ``volpath`` and ``volpathmis``, are described as they are now,
    so that they take a time axis. Scenes written for mitransient 1.x load unchanged. Children of an XML scene without
    an id are named after their kind: ``sensor``, ``shape_0``, ``shape_1``.

    ``trusted``: False for scenes of strangers: they are built, and a few pixels of each sensor are rendered with one
    sample, in a process of its own first (some seconds; 120 s at most), so that a damaged file, or one that is made to,
    ends that process and not this one. What is found is a ``SceneError``, which names the signal. Files that change
    afterwards, gradients, and other samples than those are not covered, and the process is no sandbox: what the scene
    reads it may read. See ``docs/stability.md``.

    Raises ``SceneError`` for a missing or malformed file and for entries that cannot be described; faults inside the
    scene (unknown plugins, unknown or unused parameters) are reported when the scene is built, with file and line
    where Mitsuba knows them. Raises ``VariantError`` for a variant that cannot be used.
    """
    if variant is not None:
        resolve_variant(variant)
    loaded = _described(scene, variant, xml_parameters)
    if not flag("tt.load: trusted", trusted):
        probe(loaded)
    return loaded


def _described(scene: Any, variant: str | None, xml_parameters: Mapping[str, Any]) -> Scene:
    if isinstance(scene, (str, os.PathLike)):
        return Scene(describe_xml(scene, xml_parameters), variant)
    if xml_parameters:
        names = ", ".join(sorted(xml_parameters))
        raise ArgumentError(
            f"tt.load: $parameters of XML files ({names}) are for these alone, got {type(scene).__name__}."
            " Options of a render belong to TransientRenderer and tt.render, max_depth to the scene's integrator too."
        )
    if isinstance(scene, Scene):
        return scene if variant is None or variant == scene.variant else Scene(scene._description, variant)
    if isinstance(scene, Mapping) and hasattr(scene, "hierarchy"):
        raise ArgumentError(
            "tt.load: expected a path, a dictionary, a tt.Scene or a mi.Scene, got the SceneParameters of one. Pass "
            "the scene itself; tt.wrap takes its parameters."
        )
    if isinstance(scene, Mapping):
        return Scene(describe_dict(scene), variant)
    if getattr(scene, "class_name", str)() == "Scene":
        return Scene(described_for_time(scene) or ReadyScene(scene), variant)
    raise ArgumentError(
        f"tt.load: expected a path, a dictionary, a tt.Scene or a mi.Scene, got {type(scene).__name__}. Other objects "
        "of Mitsuba are taken inside a dictionary: {'type': 'scene', 'shape': mesh, ...}."
    )
