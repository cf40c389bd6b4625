"""A capture around a corner as a YAML file: what is hidden, the wall, the scan, the bins and how much work to spend.

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

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torchtransient.axes import FrequencyAxis, TimeAxis
from torchtransient.capture import Scan, Wall
from torchtransient.capture.scan import GRID_KINDS
from torchtransient.checks import short_errors, shown
from torchtransient.errors import SceneError, TorchTransientError
from torchtransient.files.yaml_files import Section, as_number, file_beside, read_yaml
from torchtransient.nlos import defaults
from torchtransient.nlos.described_shapes import albedo_of, described_shapes
from torchtransient.nlos.mesh_file import mesh_of_npz
from torchtransient.scenes import bounds
from torchtransient.sensing import Device

ENTRIES = (
    "name", "hidden", "wall", "scan", "time_axis", "frequencies", "spp", "bounces", "sensor", "seed", "variant",
)  # fmt: skip
_PLANE = ("width", "height", "center", "normal", "up", "albedo")
_SCAN = (
    "kind", "size", "laser", "sensor_origin", "laser_origin", "laser_grid", "cell_centers", "extent",
    "first_and_last_leg",
)  # fmt: skip


@dataclass(frozen=True)
class CaptureDescription:
    """What is to be simulated.

    ``hidden``: shapes by name, Mitsuba dictionaries. ``scan``: with the wall. ``axis``: the bins, for phasors None.
    ``frequencies``: of a phasor capture, else None. ``bounces``: the numbers of bounces that count, the laser's spot
    being the first; None for all. ``sensor``: what the light is measured with, or None. ``entries``: the file.
    """

    name: str
    hidden: Mapping[str, Any]
    scan: Scan
    axis: TimeAxis | None
    frequencies: FrequencyAxis | None = None
    spp: int = defaults.SPP
    bounces: tuple[int, ...] | None = defaults.BOUNCES
    sensor: Device | None = None
    seed: int = defaults.SEED
    variant: str | None = None
    entries: Mapping[str, Any] = field(default_factory=dict)


def read_description(source: str | Path) -> CaptureDescription:
    """Read and check a description: the path of a YAML file, or YAML text. Nothing is executed.

    Names of files are looked up from the YAML file's folder. Raises SceneError for unknown, missing and wrong entries,
    StorageError for files that cannot be read, and the errors of Scan, Wall, TimeAxis and Device.
    """
    with short_errors("capture description"):
        return _description(source)


def _description(source: str | Path) -> CaptureDescription:
    data, folder = read_yaml(source, "capture description")
    section = Section(data, "capture description", ENTRIES)
    hidden = described_shapes(section.get("hidden"), folder)
    scan = scan_of(section.get("scan"), wall_of(section.get("wall", {}), folder))
    frequencies = _frequencies(section)
    if frequencies is not None and "time_axis" in section:
        raise SceneError("capture description: time_axis and frequencies exclude each other; give one.")
    return CaptureDescription(
        name=section.text("name", _name(source)),
        hidden=hidden,
        scan=scan,
        axis=None if frequencies is not None else _axis(section.get("time_axis", {}), scan, hidden),
        frequencies=frequencies,
        spp=section.whole("spp", defaults.SPP),
        bounces=_bounces(section),
        sensor=_sensor(section.get("sensor", None), folder),
        seed=section.whole("seed", defaults.SEED, least=0),
        variant=section.text("variant", None),
        entries=data,
    )


def _name(source: str | Path) -> str:
    return "capture" if isinstance(source, str) and "\n" in source else Path(source).stem


def wall_of(data: Any, folder: Path) -> Wall:
    """The relay wall of an entry 'wall'. Raises SceneError."""
    if isinstance(data, Mapping) and "file" in data:
        section = Section(data, "wall", ("file", "up", "albedo"))
        path = file_beside(section.text("file"), (folder,), "wall")
        if path.suffix.lower() != ".npz":
            raise SceneError(f"wall: expected an .npz file with vertices and faces, got '{path.name}'.")
        vertices, faces = mesh_of_npz(path, "wall")
        return Wall.mesh(vertices, faces, **_given(section, {"up": (3,)}), albedo=albedo_of(section))
    section = Section(data, "wall", _PLANE)
    sizes = {name: section.number(name) for name in ("width", "height") if name in section}
    places = _given(section, {"center": (3,), "normal": (3,), "up": (3,)})
    return Wall.plane(**sizes, **places, albedo=albedo_of(section))


def scan_of(data: Any, wall: Wall) -> Scan:
    """The scan of an entry 'scan'. Raises SceneError."""
    section = Section(data, "scan", _SCAN)
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
    seconds = isinstance(data, Mapping) and any(str(name).endswith("_s") for name in data)
    start, width = ("start_s", "bin_width_s") if seconds else ("start_opl", "bin_width_opl")
    section = Section(data, "time_axis", (start, width, "num_bins"))
    whole = start in section and "num_bins" in section
    if seconds:
        if not whole:
            raise SceneError("time_axis: expected start_s, bin_width_s and num_bins, or lengths (start_opl, ...).")
        return TimeAxis.from_seconds(section.number(start), section.number(width), section.whole("num_bins"))
    size = section.number(width, defaults.BIN_WIDTH_OPL)
    if whole:
        return TimeAxis(section.number(start), size, section.whole("num_bins"))
    if start in section or "num_bins" in section:
        raise SceneError("time_axis: expected start_opl and num_bins together, or neither, got one of them.")
    try:
        return scan.default_axis(bounds(dict(hidden)), size)
    except SceneError as error:
        raise SceneError(f"time_axis: bins can be found for shapes alone whose size is known here; {error}") from error


def _frequencies(section: Section) -> FrequencyAxis | None:
    given = section.get("frequencies", None)
    if given is None:
        return None
    if isinstance(given, list):
        return FrequencyAxis(tuple(as_number(value, "frequencies") for value in given))
    part = Section(given, "frequencies", ("first", "step", "count", "start_opl"))
    return FrequencyAxis.uniform(
        part.number("first"), part.number("step"), part.whole("count"), start_opl=part.number("start_opl", 0.0)
    )


def _bounces(section: Section) -> tuple[int, ...] | None:
    given = section.get("bounces", list(defaults.BOUNCES))
    if given == "all":
        return None
    wanted = given if isinstance(given, list) else [given]
    numbers = [as_number(value, "bounces") for value in wanted]
    if not numbers or any(number != round(number) or number < 1 for number in numbers):
        raise SceneError(
            f"bounces: expected whole numbers of at least 1, [3] for instance, or 'all', got {shown(given)}."
        )
    return tuple(sorted({int(number) for number in numbers}))


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
