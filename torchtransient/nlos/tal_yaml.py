"""Scene files of y-tal's renderer (`tal render`, versions 0.20 and 0.21), read as arguments of ``simulate``."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from torchtransient.axes import FrequencyAxis, TimeAxis
from torchtransient.capture import Scan, Wall
from torchtransient.capture.scan import GRID_KINDS
from torchtransient.checks import shown, some_of
from torchtransient.errors import SceneError
from torchtransient.files.yaml_files import Section, as_number, file_beside
from torchtransient.nlos.scene import ALL_BOUNCES
from torchtransient.plugins.films.transform_bins import transform_bins
from torchtransient.scenes.transforms import rotate, scale, translate

_VALUES = ("float", "integer", "boolean", "string", "rgb", "spectrum")
_PLUGINS = ("bsdf", "texture")


def _material(data: Any, where: str) -> dict[str, Any]:
    """Return the BSDF of an entry `material`: `id: white`, `id: copper` with `alpha`, or `id: custom` with XML as
    `text`.
    """
    identity = data.get("id") if isinstance(data, Mapping) else None
    if identity == "white":
        Section(data, where, ("id",))
        return {"type": "diffuse", "reflectance": {"type": "rgb", "value": [1.0, 1.0, 1.0]}}
    if identity == "copper":
        alpha = Section(data, where, ("id", "alpha")).number("alpha")
        return {"type": "roughconductor", "material": "Cu", "distribution": "beckmann", "alpha": alpha}
    if identity == "custom":
        return _of_xml(Section(data, where, ("id", "text")).text("text"), where)
    raise SceneError(f"{where}: expected id: white, copper or custom, got {identity!r}.")


def _of_xml(text: str, where: str) -> dict[str, Any]:
    if "<!" in text.replace("<!--", ""):
        # No entity is defined in a material: one that is would be unfolded while it is read.
        raise SceneError(f"{where}: expected the XML of one <bsdf>, got a declaration '<!...'.")
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise SceneError(f"{where}: expected the XML of one <bsdf>, got what cannot be read: {error}.") from error
    if root.tag != "bsdf":
        raise SceneError(f"{where}: expected the XML of one <bsdf>, got <{root.tag}>.")
    return _plugin(root, where)


def _plugin(element: ElementTree.Element, where: str) -> dict[str, Any]:
    if "type" not in element.attrib:
        raise SceneError(f"{where}: <{element.tag}> has no type.")
    plugin: dict[str, Any] = {"type": element.attrib["type"]}
    for number, child in enumerate(element):
        name = child.attrib.get("name", f"{child.tag}_{number}")
        if child.tag in _PLUGINS:
            plugin[name] = _plugin(child, where)
        elif child.tag in _VALUES and "name" in child.attrib and "value" in child.attrib:
            plugin[name] = _value(child.tag, child.attrib["value"], f"{where}: {name}")
        else:
            raise SceneError(
                f"{where}: <{child.tag}> in a material is not supported; expected {', '.join(_PLUGINS)} and values "
                f"({', '.join(_VALUES)}) with a name and a value."
            )
    return plugin


def _value(kind: str, text: str, where: str) -> Any:
    if kind == "string":
        return text
    if kind == "boolean":
        if text not in ("true", "false"):
            raise SceneError(f"{where}: expected true or false, got {text!r}.")
        return text == "true"
    if kind == "rgb":
        numbers = [as_number(word, where) for word in text.replace(",", " ").split()]
        if len(numbers) not in (1, 3):
            raise SceneError(f"{where}: expected one or three numbers, got {text!r}.")
        return {"type": "rgb", "value": numbers * (3 // len(numbers))}
    if kind == "spectrum":
        return _spectrum(text, where)
    number = as_number(text, where)
    return int(number) if kind == "integer" else number


def _spectrum(text: str, where: str) -> Any:
    """Return one number, or pairs of wavelengths in nm and values ("400:1, 700:2") as a Mitsuba dictionary."""
    words = text.replace(",", " ").split()
    if len(words) == 1 and ":" not in words[0]:
        return as_number(words[0], where)
    pairs = [word.split(":") for word in words]
    if len(pairs) < 2 or any(len(pair) != 2 for pair in pairs):
        raise SceneError(f"{where}: expected one number or 'wavelength:value, ...', got {text!r}.")
    return {"type": "spectrum", "value": [(as_number(a, where), as_number(b, where)) for a, b in pairs]}


# Bounces of light that goes from spot to scan point, and around one corner.
_WALL_TO_WALL, _AROUND_A_CORNER = 2, 3
_KNOWN = (
    "name", "mitsuba_variant", "integrator_max_depth", "integrator_filter_bounces", "integrator_discard_direct_paths",
    "integrator_nlos_laser_sampling", "integrator_nlos_hidden_geometry_sampling",
    "integrator_nlos_hidden_geometry_sampling_do_rroulette",
    "integrator_nlos_hidden_geometry_sampling_includes_relay_wall", "sample_count",
    "integrator_force_equal_illumination_scanning", "integrator_illumination_scan_fov", "simultaneous_scan",
    "account_first_and_last_bounces", "num_bins", "bin_width_opl", "start_opl", "auto_detect_bins", "histogram_mode",
    "wl_mean", "wl_sigma", "scan_type", "sensor_x", "sensor_y", "sensor_z", "laser_x", "laser_y", "laser_z",
    "sensor_width", "sensor_height", "laser_lookat_x", "laser_lookat_y", "laser_width", "laser_height",
    "laser_aperture_start_x", "laser_aperture_start_y", "laser_aperture_end_x", "laser_aperture_end_y",
    "laser_emission_mode", "laser_emission", "geometry", "relay_wall",
)  # fmt: skip
_GEOMETRY = (
    "name", "description", "mesh", "displacement_x", "displacement_y", "displacement_z", "rot_degrees_x",
    "rot_degrees_y", "rot_degrees_z", "scale_x", "scale_y", "scale_z", "material",
)  # fmt: skip
_ANALYTIC = ("rectangle", "sphere")


def tal_arguments(data: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Return the contents of a scene file of y-tal as arguments of ``simulate``. Nothing is executed.

    Entries that are missing or null have y-tal's defaults. Mesh files are looked up from the file's folder, the folder
    above it (where `tal render FOLDER` is called) and the current one. The relay wall may be turned, which y-tal does
    not support. Rows of the scan are along y (y-tal's arrays have x first).

    Args:
        data: entries of the file.
        folder: folder of the file.

    Raises:
        SceneError: for unknown entries, wrong values, and settings that are not supported: a laser that is not sampled
            as a spot, bins that are found automatically, spots laid out by a field of view, walls that are no
            rectangle.
    """
    section = Section(data, "y-tal scene", _KNOWN)
    _check_supported(section)
    wall, hidden = _geometry(section, (folder, folder.parent, Path.cwd()))
    axis = TimeAxis(
        section.number("start_opl", 0.0), section.number("bin_width_opl", 0.003), section.whole("num_bins", 4096)
    )
    frequencies = _frequencies(section, axis)
    return {
        "hidden": hidden,
        "scan": _scan(section, wall),
        "time_axis": None if frequencies is not None else axis,
        "frequencies": frequencies,
        "spp": section.whole("sample_count", 1_000_000),
        "bounces": _bounces(
            section.whole("integrator_max_depth", -1, least=-1),
            section.whole("integrator_filter_bounces", -1, least=-1),
            section.flag("integrator_discard_direct_paths", False),
        ),
        "energy": _emission(section),
        "variant": section.text("mitsuba_variant", None),
    }


def _bounces(max_depth: int, filter_bounces: int, discard_direct_paths: bool) -> Sequence[int] | str:
    """Return the bounces that mitransient 1.x counts with laser sampling; -1 is no limit, no filter.

    A flat wall does not light itself, so that light of two bounces is none without a limit.
    """
    first = _AROUND_A_CORNER if discard_direct_paths else _WALL_TO_WALL
    last = max_depth
    if filter_bounces != -1:
        wanted = filter_bounces + 1
        first, last = max(first, wanted), wanted if max_depth == -1 else min(max_depth, wanted)
    if last == -1:
        return ALL_BOUNCES
    if last < first:
        raise SceneError(
            f"y-tal scene: integrator_max_depth: {max_depth}, integrator_filter_bounces: {filter_bounces} and "
            f"integrator_discard_direct_paths: {str(discard_direct_paths).lower()} leave no light. filter_bounces: 2 "
            "with max_depth: -1 is light around one corner, of three bounces."
        )
    return tuple(range(first, last + 1))


def _check_supported(section: Section) -> None:
    section.text("name", "")
    # Settings of y-tal's estimator, which change noise alone, and of some scans alone.
    for name in (
        "integrator_nlos_hidden_geometry_sampling", "integrator_nlos_hidden_geometry_sampling_do_rroulette",
        "integrator_nlos_hidden_geometry_sampling_includes_relay_wall", "simultaneous_scan",
    ):  # fmt: skip
        section.flag(name, True)
    if not section.flag("integrator_nlos_laser_sampling", True):
        raise SceneError("y-tal scene: integrator_nlos_laser_sampling: false is not supported. Leave the entry out.")
    if section.flag("auto_detect_bins", False):
        raise SceneError("y-tal scene: auto_detect_bins: true is not supported. Give start_opl and num_bins.")


def _frequencies(section: Section, axis: TimeAxis) -> FrequencyAxis | None:
    if section.choice("histogram_mode", ("time", "frequency"), "time") == "time":
        return None
    mean, sigma = section.number("wl_mean"), section.number("wl_sigma")
    found = transform_bins(mean, sigma, axis.num_bins, axis.bin_width_opl)
    return FrequencyAxis(tuple(found.tolist()), axis.start_opl)


def _emission(section: Section) -> Any:
    """Return the irradiance of the projector, a number or a spectrum of Mitsuba."""
    mode = section.choice("laser_emission_mode", ("mono", "rgb", "spectrum"), "rgb")
    given, where = section.get("laser_emission", "1.0, 1.0, 1.0"), "y-tal scene: laser_emission"
    if mode == "spectrum":
        return _spectrum(str(given), where)
    words = given if isinstance(given, list) else str(given).replace(",", " ").split()
    numbers = [as_number(word, where) for word in words]
    wanted = 3 if mode == "rgb" else 1
    if mode == "mono" and "laser_emission" not in section:
        return 1.0
    if len(numbers) != wanted:
        raise SceneError(f"{where}: expected {wanted} numbers for laser_emission_mode: {mode}, got {given!r}.")
    return {"type": "rgb", "value": numbers} if len(set(numbers)) > 1 else numbers[0]


# ---------------------------------------------------------------------------------------------------------- geometry


def _geometry(section: Section, folders: Sequence[Path]) -> tuple[Wall, dict[str, Any]]:
    given = section.get("geometry")
    if not isinstance(given, list) or not given:
        raise SceneError(f"y-tal scene: geometry: expected a list of things with a name and a mesh, got {given!r}.")
    parts = [Section(part, f"y-tal scene: geometry {number}", _GEOMETRY) for number, part in enumerate(given)]
    names = [part.text("name") for part in parts]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise SceneError(f"y-tal scene: geometry: {some_of(twice)} stands there more than once; names must differ.")
    wall_name = section.text("relay_wall")
    if wall_name not in names:
        raise SceneError(f"y-tal scene: relay_wall: expected one of {some_of(names)}, got {shown(wall_name)}.")
    shapes = {name: _shape(part, name, folders) for name, part in zip(names, parts, strict=True)}
    wall = shapes.pop(wall_name)
    if wall["type"] != "rectangle":
        raise SceneError(f"y-tal scene: expected a rectangle as relay wall, got {wall_name!r} of type {wall['type']}.")
    if not shapes:
        raise SceneError("y-tal scene: geometry: expected a hidden shape beside the relay wall, got none.")
    return Wall.of(wall), shapes


def _shape(part: Section, name: str, folders: Sequence[Path]) -> dict[str, Any]:
    where = f"y-tal scene: geometry {name!r}"
    part.where = where
    kind = part.get("mesh").get("type") if isinstance(part.get("mesh"), Mapping) else None
    if kind not in ("obj", *_ANALYTIC):
        raise SceneError(f"{where}: mesh: expected type obj, rectangle or sphere, got {kind!r}.")
    shape: dict[str, Any] = {"type": kind}
    mesh = Section(part.get("mesh"), f"{where}: mesh", ("type", "filename") if kind == "obj" else ("type",))
    if kind == "obj":
        shape["filename"] = str(file_beside(mesh.text("filename"), folders, f"{where}: mesh"))
    shape["to_world"] = _placed(part)
    shape["bsdf"] = _material(part.get("material"), f"{where}: material")
    return shape


def _placed(part: Section) -> Any:
    """Scaled, turned about x, y and z in this order, then moved."""
    matrix = scale([part.number(f"scale_{axis}", 1.0) for axis in "xyz"])
    for axis, direction in zip("xyz", ([1, 0, 0], [0, 1, 0], [0, 0, 1]), strict=True):
        matrix = rotate(direction, part.number(f"rot_degrees_{axis}", 0.0)) @ matrix
    return translate([part.number(f"displacement_{axis}", 0.0) for axis in "xyz"]) @ matrix


# -------------------------------------------------------------------------------------------------------------- scan


def _scan(section: Section, wall: Wall) -> Scan:
    kind = section.choice("scan_type", GRID_KINDS, "single")
    size = section.whole("sensor_width", 256), section.whole("sensor_height", 256)
    places = (("x", -0.5), ("y", 0.0), ("z", 0.25))
    origins: dict[str, Any] = {
        f"{who}_origin": [section.number(f"{who}_{axis}", default) for axis, default in places]
        for who in ("sensor", "laser")
    }
    legs = section.flag("account_first_and_last_bounces", False)
    if kind == "single":
        laser = _looked_at(section, "x", size[0]), _looked_at(section, "y", size[1])
        return Scan.grid(wall, size, kind=kind, laser=laser, first_and_last_leg=legs, **origins)
    names = (("start_x", 0.0), ("start_y", 0.0), ("end_x", 1.0), ("end_y", 1.0))
    aperture = tuple(float(section.number(f"laser_aperture_{name}", default)) for name, default in names)
    given = "laser_width" in section or "laser_height" in section
    laser_size = (section.whole("laser_width", 32), section.whole("laser_height", 32)) if given else None
    if kind == "confocal" or _equal_grids(section):
        if aperture != (0.0, 0.0, 1.0, 1.0) or (laser_size and laser_size != size):
            raise SceneError(
                f"y-tal scene: a {kind} scan lights its own sensor points here, {size[0]} x {size[1]} of the whole "
                f"wall; expected laser_width and laser_height to be the same and no laser_aperture, got {laser_size} "
                f"over {aperture}. Leave them out, or give an exhaustive scan with simultaneous_scan: false."
            )
        return Scan.grid(wall, size, kind=kind, first_and_last_leg=legs, **origins)
    sensor_points, _ = wall.grid(size)
    laser_points, _ = wall.grid(laser_size or (32, 32), aperture)
    return Scan.points(
        torch.from_numpy(sensor_points), kind=kind, laser_points=torch.from_numpy(laser_points), wall=wall,
        first_and_last_leg=legs, **origins,
    )  # fmt: skip


def _looked_at(section: Section, axis: str, pixels: int) -> float:
    """Coordinate of the spot on the wall; given in sensor points, which may have decimals, null for the middle."""
    name = f"laser_lookat_{axis}"
    value = section.number(name, pixels / 2)
    if not 0 < value <= pixels:
        raise SceneError(
            f"y-tal scene: {name}: expected a number above 0 up to {pixels}, got {value:g} (y-tal takes 0 for null)."
        )
    return float(value / pixels)


def _equal_grids(section: Section) -> bool:
    """Return True where an exhaustive scan lights its sensor points, as mitransient does in one launch."""
    if not section.flag("simultaneous_scan", True):
        return False
    if not section.flag("integrator_force_equal_illumination_scanning", True):
        raise SceneError(
            "y-tal scene: integrator_force_equal_illumination_scanning: false with simultaneous_scan lays spots out by "
            "the field of view of the laser, which is not supported. Give simultaneous_scan: false for a grid of "
            "laser_width x laser_height spots over laser_aperture."
        )
    return True
