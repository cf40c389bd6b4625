"""Captures in YAML, y-tal and XML files, read as the arguments of :func:`~torchtransient.nlos.simulation.simulate`.

    hidden:
      letter: {scene: nlos_letter, letter: K, depth: 1.0}      # things by name: `described_shapes`
      ball: {shape: sphere, scale: 0.2, translate: [0.4, 0, 0.8], albedo: 0.7}
    wall: {width: 2.0, height: 2.0, albedo: 0.5}               # metres; or file: wall.npz with vertices and faces
    scan: {kind: confocal, size: [32, 32]}                     # as Scan.grid
    time_axis: {bin_width_opl: 0.01}                           # metres; what is missing is found, 16 ps wide
    spp: 4096                                                  # samples a sensor point
    bounces: [3]                                               # which numbers of bounces count, or `all`
    sensor: device.yaml                                        # a device of tt.sensing, or its entries
    seed: 0
    variant: llvm_ad_mono

Only `hidden` and `scan` must be there.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from torchtransient import scenes
from torchtransient.array_files.array_file import path_of
from torchtransient.axes import FrequencyAxis, TimeAxis
from torchtransient.capture import Scan, Wall
from torchtransient.capture.scan import GRID_KINDS
from torchtransient.checks import short_errors, shown
from torchtransient.errors import SceneError, TorchTransientError
from torchtransient.files.yaml_files import Section, as_number, file_beside, read_yaml
from torchtransient.nlos.scene import (
    ALL_BOUNCES,
    DEFAULT_BIN_WIDTH_OPL,
    DEFAULT_BOUNCES,
    DEFAULT_SEED,
    DEFAULT_SPP,
    mesh_file,
    mesh_of_npz,
    mesh_shape,
)
from torchtransient.nlos.tal_yaml import tal_arguments
from torchtransient.scene.load import load
from torchtransient.scenes import bounds
from torchtransient.scenes.parts import diffuse
from torchtransient.scenes.transforms import Matrix, rotate, scale, translate
from torchtransient.sensing import Device

# Functions of `tt.scenes` that return hidden shapes.
SCENES: dict[str, Callable[..., dict[str, Any]]] = {
    name: getattr(scenes, name)
    for name in ("nlos_z", "nlos_letter", "nlos_plates", "nlos_corner", "nlos_mannequin", "nlos_room")
}
SHAPES = ("rectangle", "disk", "cube", "sphere")
_KINDS = ("scene", "file", "shape", "vertices")
_PLACEMENT = ("scale", "rotate", "translate", "to_world")
_SURFACE = ("albedo", "bsdf", "flip_normals")


def described_shapes(data: Any, folder: Path) -> dict[str, Any]:
    """Return the entry `hidden` of a description as Mitsuba shapes: things by name, each with one of

    - `scene`: a function of `tt.scenes` (`nlos_letter`, ...) and its arguments; its shapes are called after both;
    - `file`: a mesh (:func:`.scene.mesh_file`);
    - `shape`: rectangle, disk, cube or sphere, as Mitsuba defines them;
    - `vertices` and `faces`: lists of rows;

    and, but for scenes, `albedo` (a number or a list of three, 0.5) or `bsdf` (a dictionary of Mitsuba), `flip_normals`
    and a place: `scale` (a number or three), then `rotate` ([[x, y, z], degrees], or a list of those, the first one
    first), then `translate`; or `to_world`, a matrix of 4 x 4.

    Args:
        data: the entry.
        folder: folder in which file names are looked up.

    Raises:
        SceneError: for other entries.
        StorageError: for mesh files that cannot be read.
    """
    if not isinstance(data, Mapping) or not data:
        raise SceneError(
            f"hidden: expected things by name, 'letter: {{scene: nlos_letter}}' for instance, got {shown(data)}."
        )
    shapes: dict[str, Any] = {}
    for name, entry in data.items():
        where = f"hidden: {name}"
        given = [kind for kind in _KINDS if isinstance(entry, Mapping) and kind in entry]
        if not isinstance(name, str) or not name or "." in name or len(given) != 1:
            raise SceneError(
                f"{where}: expected a name without dots, and one of {', '.join(_KINDS)}, got {given or shown(entry)}."
            )
        if given == ["scene"]:
            shapes.update(_shapes_of_scene(name, entry, where))
        else:
            shapes[name] = _shape(entry, given[0], where, folder)
    return shapes


def _shapes_of_scene(name: str, entry: Mapping[str, Any], where: str) -> dict[str, Any]:
    chosen = Section(entry, where, entry).choice("scene", tuple(SCENES))
    function = SCENES[chosen]
    known = ("scene", *inspect.signature(function).parameters)
    arguments = dict(Section(entry, f"{where}: {chosen}", known).data)
    del arguments["scene"]
    if isinstance(arguments.get("albedo"), list):
        arguments["albedo"] = tuple(arguments["albedo"])
    try:
        made = function(**arguments)
    except TorchTransientError as error:
        raise type(error)(f"{where}: {error}") from error
    # A scene of one shape is called as it is here; parts of larger ones say which.
    return {name if len(made) == 1 else f"{name}_{part}": shape for part, shape in made.items()}


def _shape(entry: Mapping[str, Any], kind: str, where: str, folder: Path) -> dict[str, Any]:
    own = ("vertices", "faces") if kind == "vertices" else (kind,)
    section = Section(entry, where, (*own, *_SURFACE, *_PLACEMENT))
    if kind == "shape":
        shape: dict[str, Any] = {"type": section.choice("shape", SHAPES)}
    elif kind == "vertices":
        shape = mesh_shape(section.get("vertices"), section.get("faces"), where)
    else:
        shape = mesh_file(file_beside(section.text("file"), (folder,), where), where)
    place = _place(section)
    if place is not None:
        shape["to_world"] = place
    if section.flag("flip_normals", False):
        shape["flip_normals"] = True
    bsdf = section.get("bsdf", None)
    if bsdf is not None and "albedo" in section:
        raise SceneError(f"{where}: albedo and bsdf exclude each other; give one.")
    if bsdf is not None and not (isinstance(bsdf, Mapping) and isinstance(bsdf.get("type"), str)):
        raise SceneError(f"{where}: bsdf: expected a dictionary of Mitsuba with a type, got {shown(bsdf)}.")
    shape["bsdf"] = diffuse(_albedo(section)) if bsdf is None else dict(bsdf)
    return shape


def _albedo(section: Section, default: float = 0.5) -> Any:
    """Return the entry `albedo`: a number, or three as a tuple."""
    if isinstance(section.get("albedo", default), list):
        return tuple(section.numbers("albedo", (3,)))
    return section.number("albedo", default)


def _place(section: Section) -> Matrix | None:
    if "to_world" in section:
        if any(name in section for name in ("scale", "rotate", "translate")):
            raise SceneError(f"{section.where}: to_world excludes scale, rotate and translate.")
        rows = section.get("to_world")
        if not isinstance(rows, list) or len(rows) != 4:
            raise SceneError(f"{section.where}: to_world: expected four rows of four numbers, got {shown(rows)}.")
        return np.array([Section({"row": row}, section.where, ("row",)).numbers("row", (4,)) for row in rows])
    steps = []
    if "scale" in section:
        size = section.get("scale")
        steps.append(scale(section.numbers("scale", (3,)) if isinstance(size, list) else section.number("scale")))
    steps += _turns(section)
    if "translate" in section:
        steps.append(translate(section.numbers("translate", (3,))))
    return functools.reduce(lambda before, step: step @ before, steps) if steps else None


def _turns(section: Section) -> list[Matrix]:
    given = section.get("rotate", [])
    pairs = [given] if _is_pair(given) else given
    if not isinstance(pairs, list) or not all(map(_is_pair, pairs)):
        raise SceneError(
            f"{section.where}: rotate: expected [[x, y, z], degrees] or a list of those, got {shown(given)}."
        )
    turns = []
    for pair in pairs:
        part = Section({"axis": pair[0], "degrees": pair[1]}, f"{section.where}: rotate", ("axis", "degrees"))
        turns.append(rotate(part.numbers("axis", (3,)), part.number("degrees")))
    return turns


def _is_pair(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 2 and isinstance(value[0], list) and not isinstance(value[1], list)


_ENTRIES = (
    "name", "hidden", "wall", "scan", "time_axis", "frequencies", "spp", "bounces", "sensor", "seed", "variant",
)  # fmt: skip
_PLANE_ENTRIES = ("width", "height", "center", "normal", "up", "albedo")
_SCAN_ENTRIES = (
    "kind", "size", "laser", "sensor_origin", "laser_origin", "laser_grid", "cell_centers", "extent",
    "first_and_last_leg",
)  # fmt: skip


def _of_description(data: Mapping[str, Any], folder: Path, name: str) -> dict[str, Any]:
    if "hidden" not in data:
        raise SceneError(
            f"{name}: expected an entry 'hidden' (or 'geometry' of y-tal), got {', '.join(map(str, data))}."
        )
    section = Section(data, "capture description", _ENTRIES)
    section.text("name", "")
    hidden = described_shapes(section.get("hidden"), folder)
    scan = scan_of(section.get("scan"), wall_of(section.get("wall", {}), folder))
    listed = section.get("frequencies", None)
    listed = [listed] if isinstance(listed, int | float | str) else listed
    frequencies = None if listed is None else FrequencyAxis(tuple(as_number(one, "frequencies") for one in listed))
    if frequencies is not None and "time_axis" in section:
        raise SceneError("capture description: time_axis and frequencies exclude each other; give one.")
    return {
        "hidden": hidden,
        "scan": scan,
        "time_axis": None if frequencies is not None else _axis(section.get("time_axis", {}), scan, hidden),
        "frequencies": frequencies,
        "spp": section.whole("spp", DEFAULT_SPP),
        "bounces": _bounces(section),
        "sensor": _sensor(section.get("sensor", None), folder),
        "seed": section.whole("seed", DEFAULT_SEED, least=0),
        "variant": section.text("variant", None),
    }


def wall_of(data: Any, folder: Path) -> Wall:
    """Return the relay wall of an entry 'wall'.

    Args:
        data: the entry.
        folder: folder in which file names are looked up.

    Raises:
        SceneError: for other entries.
    """
    if isinstance(data, Mapping) and "file" in data:
        section = Section(data, "wall", ("file", "up", "albedo"))
        path = file_beside(section.text("file"), (folder,), "wall")
        if path.suffix.lower() != ".npz":
            raise SceneError(f"wall: expected an .npz file with vertices and faces, got '{path.name}'.")
        vertices, faces = mesh_of_npz(path, "wall")
        return Wall.mesh(vertices, faces, **_given(section, {"up": (3,)}), albedo=_albedo(section))
    section = Section(data, "wall", _PLANE_ENTRIES)
    sizes = {name: section.number(name) for name in ("width", "height") if name in section}
    places = _given(section, {"center": (3,), "normal": (3,), "up": (3,)})
    return Wall.plane(**sizes, **places, albedo=_albedo(section))


def scan_of(data: Any, wall: Wall) -> Scan:
    """Return the scan of an entry 'scan'.

    Args:
        data: the entry.
        wall: wall that is scanned.

    Raises:
        SceneError: for other entries.
    """
    section = Section(data, "scan", _SCAN_ENTRIES)
    kind = section.choice("kind", GRID_KINDS)
    lists = {"laser": (2, 3), "sensor_origin": (3,), "laser_origin": (3,), "extent": (4,)}
    sizes = {name: _size(section, name) for name in ("size", "laser_grid") if name in section}
    if "size" not in sizes:
        raise SceneError("scan: expected an entry 'size', the number of sensor points [x, y], which is missing.")
    return Scan.grid(
        wall, sizes.pop("size"), kind=kind, **sizes, **_given(section, lists),
        cell_centers=section.flag("cell_centers", True), first_and_last_leg=section.flag("first_and_last_leg", False),
    )  # fmt: skip


def _size(section: Section, name: str) -> tuple[int, int]:
    given = section.get(name)
    pair = given if isinstance(given, list) else [given, given]
    if len(pair) != 2:
        raise SceneError(f"scan: {name}: expected one number or [x, y], got {shown(given)}.")
    parts = Section({"x": pair[0], "y": pair[1]}, f"scan: {name}", ("x", "y"))
    return parts.whole("x"), parts.whole("y")


def _given(section: Section, counts: Mapping[str, tuple[int, ...]]) -> dict[str, Any]:
    return {name: section.numbers(name, allowed) for name, allowed in counts.items() if name in section}


def _axis(data: Any, scan: Scan, hidden: Mapping[str, Any]) -> TimeAxis:
    section = Section(data, "time_axis", ("start_opl", "bin_width_opl", "num_bins"))
    width = section.number("bin_width_opl", DEFAULT_BIN_WIDTH_OPL)
    if "start_opl" in section and "num_bins" in section:
        return TimeAxis(section.number("start_opl"), width, section.whole("num_bins"))
    if "start_opl" in section or "num_bins" in section:
        raise SceneError("time_axis: expected start_opl and num_bins together, or neither, got one of them.")
    try:
        return scan.default_axis(bounds(dict(hidden)), width)
    except SceneError as error:
        raise SceneError(f"time_axis: bins can be found for shapes alone whose size is known here; {error}") from error


def _bounces(section: Section) -> tuple[int, ...] | str:
    given = section.get("bounces", list(DEFAULT_BOUNCES))
    if given == ALL_BOUNCES:
        return ALL_BOUNCES
    several = given if isinstance(given, list) else [given]
    return tuple(sorted({Section({"a number": n}, "bounces", ("a number",)).whole("a number") for n in several}))


def _sensor(given: Any, folder: Path) -> Device | None:
    if given is None:
        return None
    if not isinstance(given, Mapping | str):
        raise SceneError(f"sensor: expected the file of a device or its entries, got {shown(given)}.")
    if isinstance(given, str):
        path = file_beside(given, (folder,), "sensor")
    try:
        if isinstance(given, Mapping):
            return Device.from_dict(given)
        return Device.from_json(path) if path.suffix.lower() == ".json" else Device.from_yaml(path)
    except TorchTransientError as error:
        raise type(error)(f"sensor: {error}") from error


def read_setup(path: str | Path, **xml_parameters: Any) -> dict[str, Any]:
    """Read a file as the arguments of ``simulate``: ``simulate(**read_setup("capture.yaml"))``.

    Of y-tal's settings, ``filter_bounces: b`` means light of b + 1 bounces, as mitransient 1.x computes, ``max_depth``
    the largest number of bounces, and ``discard_direct_paths`` leaves out light of less than 3. The laser brings
    ``laser_emission`` in joules; y-tal's scale, that of a projector of a certain distance and field of view, is another
    by one factor for all points.

    Args:
        path: a YAML file of this library (``docs/nlos.md``, "As a file"), a scene file of y-tal's renderer or its
            folder (:mod:`.tal_yaml`), which are told apart by their entries, or an XML file of Mitsuba or mitransient
            with the integrator ``transient_nlos_path``.
        xml_parameters: fill the ``$parameters`` of an XML file.

    Raises:
        StorageError: for files that cannot be read.
        SceneError: for their contents.
    """
    with short_errors("read_setup"):
        return _setup(path, xml_parameters)


def _setup(path: str | Path, xml_parameters: Mapping[str, Any]) -> dict[str, Any]:
    source = path_of(path, "read_setup")
    if source.suffix.lower() == ".xml":
        return {"hidden": load(source, **xml_parameters)}
    if xml_parameters:
        given = ", ".join(xml_parameters)
        raise SceneError(f"{source.name}: parameters fill the $NAMES of XML files alone, got {given}; leave them out.")
    if not source.is_dir() and source.suffix.lower() not in (".yaml", ".yml"):
        raise SceneError(
            f"expected a capture as YAML (.yaml, .yml), the folder of a y-tal scene, or Mitsuba's XML, got '{source}'."
        )
    entries, folder = read_yaml(source, "capture")
    if "geometry" in entries or "relay_wall" in entries:
        return tal_arguments(entries, folder)
    return _of_description(entries, folder, source.name)
