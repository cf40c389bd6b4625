"""``tt.load`` and ``tt.Scene``: a scene that can be pickled, copied and built in any differentiable variant."""

from __future__ import annotations

import json
import os
import pickle
import signal
import subprocess
import sys
from collections import OrderedDict
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from torchtransient.checks import flag, mapping
from torchtransient.errors import ArgumentError, GradientError, SceneError, TorchTransientError
from torchtransient.plugins import kind_of, modules_of_others, register_module
from torchtransient.plugins.guards import ensure_restored
from torchtransient.scene.build import BuiltScene, build
from torchtransient.scene.description import SceneDescription, describe_dict, describe_xml, same_description
from torchtransient.scene.edits import BuildOptions
from torchtransient.scene.motions import body_motions
from torchtransient.scene.nodes import children, is_film
from torchtransient.scene.objects import LoadedScene, transient_dictionary
from torchtransient.scene.opaque import opaque
from torchtransient.scene.parameters import ParameterTable, parameter_table, unknown_key
from torchtransient.scene.save import WAY_OUT, check_same, replaced_files, write_scene
from torchtransient.scene.values import SlotTable
from torchtransient.scene.variant import active_variant, named_errors, resolve_variant

# Built scenes kept per description: one for every combination of time axis, depth and substituted plugins in use.
_MAX_BUILDS = 8


class Scene:
    """Description of a scene, and the Mitsuba scenes that are built from it at the first use. Made by :func:`load`.

    Pickles hold the description alone; copies share everything, since instances are immutable. A scene with loaded
    objects of Mitsuba (:func:`load`) stays in their variant and process.

    Args:
        description: source of the scene.
        variant: name of a variant, None to settle it at the first use.
    """

    def __init__(self, description: SceneDescription, variant: str | None):
        self._description = description
        # Loaded objects fix the variant, and are shared with their owners.
        self.is_shared = bool(description.objects)
        description.check_variant(variant)
        self._requested_variant = description.objects[0].variant if self.is_shared else variant
        self._variant: str | None = None
        self._builds: OrderedDict[BuildOptions, BuiltScene] = OrderedDict()
        # Not in the built scenes: objects that refer to themselves are freed late.
        self._slots: dict[BuildOptions, dict[tuple[str, ...], SlotTable]] = {}
        # Slots of the values that a built scene holds: set by the engine, which brings its own at every run.
        self.installed: dict[BuildOptions, SlotTable] = {}
        self._table: ParameterTable | None = None
        # Options of the table: a shared scene may be built with some alone.
        self._table_options = BuildOptions(real_bitmaps=True)
        # Recorded calls by options and keys. The engine fills them; they go with the built scene.
        self.recordings: dict[BuildOptions, dict[tuple[str, ...], Any]] = {}
        # Bounds on the depth for derivatives by options and sensors. `depth_bound` fills them.
        self.depth_bounds: dict[tuple[BuildOptions, tuple[int, ...]], Any] = {}
        # Subjects of warnings that were given: each is given once for a scene.
        self.warned: set[str] = set()

    @property
    def variant(self) -> str:
        """Variant that the scene is built in, settled at the first use."""
        if self._variant is None:
            self._variant = resolve_variant(self._requested_variant)
        return self._variant

    @opaque
    def parameters(self) -> ParameterTable:
        """Return every parameter with its value, shape, and whether and why it is differentiable.

        Returns:
            A mapping from keys to :class:`ParameterInfo`; printed, it is a table.

        Raises:
            SceneError: for a scene that cannot be built.
        """
        if self.is_shared:  # values may have changed
            self._table = None
            return self._parameters(self._table_options)
        return self.known_parameters()

    def known_parameters(self) -> ParameterTable:
        """Return the table of :meth:`parameters` with the values at the first request, which are not read again."""
        return self._parameters(BuildOptions(real_bitmaps=True))

    def _parameters(self, options: BuildOptions) -> ParameterTable:
        found = self._table
        if found is None:
            with active_variant(self.variant):
                found = self._table = parameter_table(self.built(options))
                self._table_options = options
        return found

    @opaque
    def save(self, path: str | os.PathLike[str], values: Mapping[str, Any] | None = None) -> Path:
        """Write the scene as an XML file, with ``values`` in place of the described ones.

        Meshes, bitmaps and volumes that the XML cannot hold, and files that the scene names, are written to the folder
        ``NAME_files`` beside it, which is replaced. ``tt.load`` and, after ``import torchtransient``, ``mi.load_file``
        read the file. It is read back in the scene's variant before it takes its place, and every parameter is
        compared.

        Args:
            path: name of an XML file in an existing folder.
            values: values by key, in the shapes that :meth:`parameters` lists, such as ``renderer.values``.

        Returns:
            The path.

        Raises:
            SceneError: for numbers of a spectral model, arrays of plugins that read no file and loaded objects, which
                XML cannot hold, for unknown keys and for other paths. Nothing is written then.
            ArgumentError: if ``values`` is no mapping.
            ShapeError, UnitError, GradientError: for values, as a renderer raises them.
        """
        given = {} if values is None else dict(mapping("scene.save: values", values, "{key: value}"))
        description = self._description
        description.check_described("scene.save")
        assert not isinstance(description, LoadedScene)  # refused above
        with replaced_files(path) as (target, draft, folder), active_variant(self.variant):
            options = self._save_options(given)
            slots = self.slots(given, options)
            try:
                written = write_scene(description, self.variant, slots, given, draft, folder)
            finally:
                ensure_restored(lambda: self.restore(options, slots))
            again = load(draft, variant=self.variant)
            try:
                built = again.built(again._save_options(given))
            except TorchTransientError as error:
                raise SceneError(f"scene.save: what was written does not load. {WAY_OUT} {error}") from error
            check_same(built, written)
        return target

    def _save_options(self, keys: Iterable[str]) -> BuildOptions:
        options, keys = BuildOptions(real_bitmaps=True), tuple(keys)
        return self.options_for(keys, options) if keys else options

    def same_description(self, other: Scene) -> bool:
        """Return whether two scenes have one description, in any variants.

        Args:
            other: the other scene.

        Returns:
            True for equal values, and files looked up in the same places.
        """
        return same_description(self._description, other._description)

    @opaque
    def moving(self, motions: Mapping[str, Any]) -> Scene:
        """Return a scene whose bodies have velocities, which films of rates measure (``rates=``, ``chirps=``).

        All poses stay those of one instant. The velocities of ``"fan"`` are parameters: ``fan.velocity.linear``,
        ``.angular`` and ``.center``.

        Args:
            motions: a :class:`torchtransient.Motion` by the name of a shape, an instance, a near light, a sensor or a
                medium. They take the place of described ones.

        Returns:
            A scene of the same description otherwise, in the same variant.

        Raises:
            ArgumentError: unless ``motions`` maps names to motions.
            GradientError: for motions with gradients: velocities are parameters of the scene.
            SceneError: for names that the scene does not have, and for scenes of loaded objects.
        """
        self._description.check_described("scene.moving")
        assert not isinstance(self._description, LoadedScene)  # refused above
        given = body_motions(mapping("scene.moving", motions, "{name: tt.Motion(...)}"))
        motions_by_name = {motion.of: motion for motion in (*self._description.motions, *given)}
        placed = tuple(motions_by_name[name] for name in sorted(motions_by_name))
        other = Scene(replace(self._description, motions=placed), self._requested_variant)
        other._variant = self._variant
        with active_variant(other.variant):
            other.built(BuildOptions(real_bitmaps=True))  # a wrong name is told here
        return other

    # ------------------------------------------------------------------------------------------------- built scenes

    def built(self, options: BuildOptions) -> BuiltScene:
        """Return the Mitsuba scene for some options, with the described values.

        Called inside ``active_variant(scene.variant)``.

        Args:
            options: options of the build.

        Raises:
            SceneError: for a scene that Mitsuba or this library refuses.
        """
        installed = self.installed.get(options)
        if installed is not None:
            self.restore(options, installed)
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

    def drop(self, options: BuildOptions) -> None:
        """Forget the scene that was built with ``options``; the next use builds it anew.

        Args:
            options: options of the build.
        """
        self._builds.pop(options, None)
        self.installed.pop(options, None)
        self._slots.pop(options, None)
        self.recordings.pop(options, None)

    def findings(self, options: BuildOptions) -> dict[str, str]:
        """Return messages about unphysical values of the description, by key, for a scene built with ``options``.

        Called inside ``active_variant(scene.variant)``.

        Args:
            options: options of the build.

        Returns:
            Messages by key, empty where all values are physical.
        """
        found = self.built(options).findings()
        if found and options.merge:
            # Merged shapes have lost their names: those of the build that `parameters()` reads.
            found = self.built(BuildOptions(real_bitmaps=True)).findings()
        return found

    def options_for(self, keys: Iterable[str], options: BuildOptions) -> BuildOptions:
        """Return the options of a build in which each key is an independent, differentiable parameter.

        Args:
            keys: keys of :meth:`parameters`.
            options: options that the others are added to.

        Returns:
            Options with differentiable twins of plugins, and without merged shapes where there are keys.

        Raises:
            SceneError: for unknown keys.
            GradientError: for keys without a derivative.
        """
        keys = tuple(keys)
        if not keys:
            # Meshes of a few faces are looked through one by one.
            return replace(options, merge=options.connections is None)
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
        """Return the places of values in the built scene.

        Called inside ``active_variant(scene.variant)``. The scene holds described values or those of the last run with
        these keys.

        Args:
            keys: keys of the values.
            options: options of the build.
        """
        wanted = tuple(keys)
        if self.is_shared:  # the scene goes back to the values that it holds now
            return SlotTable(self.built(options), wanted)
        found = self._slots.get(options, {}).get(wanted)
        if found is None or self.installed.get(options) is not found:
            built = self.built(options)
            # Building may have dropped other scenes, or the tables of this one.
            tables = self._slots.setdefault(options, {})
            if wanted not in tables:
                tables[wanted] = SlotTable(built, wanted)
            found = tables[wanted]
        self._builds.move_to_end(options)
        return found

    def restore(self, options: BuildOptions, slots: SlotTable) -> None:
        """Put the described values back into a built scene, and with them end its graph of derivatives.

        Args:
            options: options of the build, which is dropped if a value cannot be put back.
            slots: slots of the values that the scene holds.
        """
        try:
            slots.restore()
        except BaseException:
            self.drop(options)
            raise
        self.installed.pop(options, None)

    # --------------------------------------------------------------------------------------------- pickles and copies

    def apart(self) -> Scene:
        """Return a scene of the same description that shares nothing that was built; a shared scene returns itself."""
        if self.is_shared:
            return self
        other = Scene(self._description, self._requested_variant)
        other._variant = self._variant
        return other

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
        names = [motion.of for motion in getattr(self._description, "motions", ())]
        moving = f", moving={names}" if names else ""
        return f"tt.Scene({self._description.name!r}, variant={self._variant or self._requested_variant!r}{moving})"


@opaque
def load(
    scene: str | os.PathLike[str] | Mapping[str, Any] | Scene | Any,
    variant: str | None = None,
    *,
    trusted: bool = True,
    **xml_parameters: Any,
) -> Scene:
    """Describe a scene: the path of a Mitsuba XML file, a scene dictionary, another :class:`Scene` or a ``mi.Scene``.

    Nothing is built yet and no variant is switched: that happens at the first use, inside the call, and the variant
    that was active before is put back (when none was active, the scene's variant stays active). Scenes written for
    mitransient 1.x load unchanged. Children of an XML scene without an id are named after their kind: ``sensor``,
    ``shape_0``, ``shape_1``.

    Dictionaries hold transforms as (4, 4) arrays or nested lists, or as Mitsuba transforms. Colours, vectors, bitmaps
    and tensors of Mitsuba, volume grids and loaded meshes (positions, normals, texture coordinates, a diffuse surface
    of one colour) are accepted too, and described. Other objects of Mitsuba inside a dictionary, and a whole
    ``mi.Scene``, are used as they are: they keep their plugins, film, integrator and variant, later changes of them
    count, and pickling, plans and other variants are refused. Of a ``mi.Scene`` for steady pictures, cameras with an
    ``hdrfilm``, and ``path``, ``volpath`` and ``volpathmis``, are described as they are now, so that they can have a
    time axis.

    Args:
        scene: the scene.
        variant: a differentiable variant such as ``llvm_ad_rgb``, ``llvm_ad_mono``, ``cuda_ad_spectral``; None for the
            active one if it is differentiable and ``llvm_ad_rgb`` otherwise, settled at the first use.
        trusted: False for scenes of strangers. They are built, and a few pixels of each sensor are rendered with one
            sample, in a process of its own first (some seconds; 120 s at most), so that a damaged or malicious file
            ends that process and not this one. Files that change afterwards, gradients, and other samples are not
            covered, and the process is no sandbox: what the scene reads it may read. See ``docs/stability.md``.
        xml_parameters: values of the ``$name`` parameters of an XML file.

    Returns:
        The scene, not built yet.

    Raises:
        SceneError: for a missing or malformed file, for entries that cannot be described, and, with ``trusted=False``,
            for a scene that cannot be rendered, with the name of the signal that ended its process. Faults inside the
            scene (unknown plugins, unknown or unused parameters) are reported when the scene is built, with file and
            line where Mitsuba knows them.
        VariantError: for a variant that cannot be used.
        ArgumentError: for other objects.
    """
    if variant is not None:
        resolve_variant(variant)
    loaded = _described(scene, variant, xml_parameters)
    if not flag("tt.load: trusted", trusted):
        _probe(loaded)
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
        tree = transient_dictionary(scene)
        return Scene(LoadedScene(scene) if tree is None else describe_dict(tree), variant)
    raise ArgumentError(
        f"tt.load: expected a path, a dictionary, a tt.Scene or a mi.Scene, got {type(scene).__name__}. Other objects "
        "of Mitsuba are taken inside a dictionary: {'type': 'scene', 'shape': mesh, ...}."
    )


# ---------------------------------------------------------------------------------------------- scenes of strangers

# Longest time for a scene to be loaded, compiled and rendered, a few pixels of it, the start of the process included.
SECONDS = 120.0
# Rows and columns of a film that are rendered, around its middle.
PIXELS = 4
_MARK = "torchtransient probe: "
# By its name: a module that is run is another one than the same module imported.
_CHILD = "from torchtransient.scene.load import probe_child; probe_child()"


def _probe(scene: Scene) -> None:
    """Build ``scene`` and render a few pixels of each of its sensors in a process of its own.

    Raises ``SceneError`` for an error there, for a process that is ended by a signal, and for one that takes too long.
    """
    scene._description.check_described("tt.load(..., trusted=False)")
    name = scene._description.name
    others = [(entry.module, entry.plugins) for entry in modules_of_others()]
    sent = pickle.dumps((scene, scene.variant, others))
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(path or os.getcwd() for path in sys.path)}
    process = subprocess.Popen(
        [sys.executable, "-c", _CHILD], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
        env=environment, start_new_session=True,
    )  # fmt: skip
    try:
        out, _ = process.communicate(sent, timeout=SECONDS)
    except subprocess.TimeoutExpired:
        raise SceneError(
            f"{name}: expected a scene that is loaded and rendered, a few pixels of it, within {SECONDS:g} s, got no "
            "answer in a process of its own. It was not loaded here."
        ) from None
    finally:
        if process.poll() is None:
            process.kill()
            process.communicate()
    if process.returncode < 0:
        raise SceneError(
            f"{name}: expected a scene that can be rendered, got {_signal(-process.returncode)}, which ended the "
            "process in which it was tried. It was not loaded here; a file of it is damaged, or made to do this."
        )
    answers = [line for line in out.decode("utf-8", "replace").splitlines() if line.startswith(_MARK)]
    if not answers:
        raise SceneError(f"{name}: the process in which the scene was tried ended with code {process.returncode}.")
    error = json.loads(answers[-1].removeprefix(_MARK))
    if error is not None:
        raise SceneError(error)


def _signal(number: int) -> str:
    try:
        return f"the signal {signal.Signals(number).name}"
    except ValueError:
        return f"the signal {number}"


def probe_child() -> None:
    """Render the pickled scene on standard input, print its error as JSON, null for none, and end the process."""
    error: str | None = None
    try:
        scene, variant, others = pickle.load(sys.stdin.buffer)
        for module, registered in others:
            register_module(module, registered)
        _render_pixels(scene, variant)
    except TorchTransientError as raised:
        error = str(raised)
    except Exception as raised:  # noqa: BLE001  any error is the answer
        text = " ".join(str(raised).split())[:400]
        error = f"the scene cannot be rendered, {type(raised).__name__}: {text}"
    sys.stdout.write(f"\n{_MARK}{json.dumps(error)}\n")
    sys.stdout.flush()
    os._exit(0)


def _render_pixels(scene: Scene, variant: str) -> None:
    import drjit as dr
    import mitsuba as mi

    with active_variant(variant), named_errors():
        built = build(_Cropped(scene._description), variant, BuildOptions()).scene  # type: ignore[arg-type]
        if not built.sensors():
            raise SceneError(f"{scene!r} has no sensor; add one.")
        for number in range(len(built.sensors())):
            dr.eval(mi.render(built, sensor=number, spp=1, seed=0))
        dr.sync_thread()


def cropped(scene: Scene, pixels: int) -> Scene:
    """Return a scene with films cropped to at most ``pixels`` along each side, about their middle.

    Films of sensors that place each pixel themselves, and loaded ones, keep their size.

    Args:
        scene: the scene.
        pixels: largest number of pixels along a side.
    """
    return Scene(_Cropped(scene._description, pixels), scene.variant)  # type: ignore[arg-type]


class _Cropped:
    """Description whose films show the middle of what they showed.

    Args:
        description: whole description.
        pixels: largest number of pixels along a side.
    """

    def __init__(self, description: Any, pixels: int = PIXELS):
        self._whole, self._pixels = description, pixels

    def __getattr__(self, name: str) -> Any:
        return getattr(self._whole, name)

    def parse(self, config: Any) -> Any:
        """Return Mitsuba's parser state, with cropped films but for sensors that place each pixel themselves."""
        state = self._whole.parse(config)
        by_id = state.id_to_index
        for node in state.nodes:
            below = [state.nodes[index] for _, index in children(state, node, by_id)]
            if kind_of(node.props.plugin_name()) != "sensor":
                for film in below:
                    if is_film(film):
                        _crop(film.props, self._pixels)
        return state


def _crop(props: Any, pixels: int) -> None:
    if props.get("exhaustive_scan", False) is not False:
        return
    for side, along in (("width", "x"), ("height", "y")):
        whole = props.get(side, 768 if side == "width" else 576)
        there, first = props.get(f"crop_{side}", whole), props.get(f"crop_offset_{along}", 0)
        numbers = [value for value in (whole, there, first) if isinstance(value, int) and value is not True]
        if len(numbers) == 3 and first >= 0 and pixels < there <= whole - first:  # others are refused as they are
            props[side] = whole
            props[f"crop_{side}"], props[f"crop_offset_{along}"] = pixels, first + (there - pixels) // 2
