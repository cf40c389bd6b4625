"""Scene dictionaries of captures: hidden things, relay wall, laser, sensor, integrator."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchtransient.array_files.array_file import read_some
from torchtransient.capture import Scan
from torchtransient.checks import as_whole, checked_mesh, shown
from torchtransient.errors import SceneError, StorageError, UnitError
from torchtransient.scene.edits import BuildOptions
from torchtransient.scene.load import load
from torchtransient.scene.variant import active_variant
from torchtransient.units import seconds_to_opl

# Samples of each sensor point, or of each pair of an exhaustive scan.
DEFAULT_SPP = 4096
# Bins of detectors with a resolution of some tens of picoseconds, as lengths of optical path in metres.
DEFAULT_BIN_WIDTH_OPL = seconds_to_opl(16e-12)
# Light around one corner.
DEFAULT_BOUNCES = (3,)
# Joules.
DEFAULT_ENERGY = 1.0
DEFAULT_SEED = 0


# Plugins of Mitsuba by what names of files end with; .npz is read here.
_PLUGINS = {".obj": "obj", ".ply": "ply", ".serialized": "serialized"}
_MESH_FILES = (*_PLUGINS, ".npz")


def mesh_file(path: Path, where: str) -> dict[str, Any]:
    """Return a mesh file as a shape of a scene dictionary, without a material.

    Its triangles are flat, as triangles of arrays are: normals in the file do not count, and none are interpolated.
    (Give ``{"type": "obj", "filename": ...}`` for Mitsuba's own reading.)

    Args:
        path: mesh file, .obj, .ply, .serialized, or .npz with ``vertices`` (V, 3) and ``faces`` (F, 3), metres.
        where: begins the message.

    Raises:
        SceneError: for other files and missing ones.
        StorageError: for files that cannot be read.
    """
    suffix = path.suffix.lower()
    if suffix == ".xml":
        raise SceneError(
            f"{where}: '{path}' is a complete scene; leave scan out to simulate it: tt.nlos.simulate(path)."
        )
    if suffix not in _MESH_FILES:
        raise SceneError(f"{where}: expected a mesh file ({', '.join(_MESH_FILES)}), got {str(path)!r}.")
    if not path.is_file():
        raise SceneError(f"{where}: no file {str(path)!r}, seen from {Path.cwd()}. Give the path of a mesh.")
    if suffix == ".npz":
        return mesh_shape(*mesh_of_npz(path, where), where)
    return {"type": _PLUGINS[suffix], "filename": str(path), "face_normals": True}


def mesh_of_npz(path: Path, where: str) -> tuple[Any, Any]:
    """Read `vertices` and `faces` of an .npz file.

    Args:
        path: path of the file.
        where: begins the message.

    Raises:
        StorageError: where they cannot be read.
    """
    kind = "an archive of 'vertices' and 'faces' in NumPy's .npz"
    found = read_some(path, where, ("vertices", "faces").__contains__, kind)
    if len(found) < 2:
        had = " alone".join([*found, ""]) or "neither"
        raise StorageError(f"{where}: expected 'vertices' and 'faces' in '{path}', got {had}.")
    return found["vertices"], found["faces"]


def mesh_shape(vertices: Any, faces: Any, where: str) -> dict[str, Any]:
    """Return a mesh of arrays as a shape of a scene dictionary, without a material.

    Args:
        vertices: (V, 3), metres.
        faces: (F, 3).
        where: begins the message.

    Raises:
        ShapeError, UnitError: as `checked_mesh`.
    """
    points, triangles = checked_mesh(where, vertices, faces)
    return {"type": "mesh_arrays", "vertices": points, "faces": triangles}


# Names of a capture's own nodes: those of hidden things must be others.
WALL, SENSOR, LASER = "wall", "sensor", "laser"
_INTEGRATOR = "integrator"
ALL_BOUNCES = "all"
# What single precision holds.
_MOST_ENERGY = 1e30
# Plugins of emitters, Mitsuba's and ours.
_LIGHTS = (
    "area", "angulararea", "directionalarea", "point", "spot", "projector", "laser_beam", "directional", "constant",
    "envmap", "sunsky", "timed_sunsky",
)  # fmt: skip


def capture_scene(
    hidden: Any, scan: Scan, *, bounces: Sequence[int] | str = DEFAULT_BOUNCES, energy: Any = DEFAULT_ENERGY
) -> dict[str, Any]:
    """Make the scene dictionary of a capture; its film has one pixel for each sensor point and no time axis of its own
    yet.

    The scan's wall is the node ``wall``, with the sensor ``wall.sensor``. Hidden nodes keep their names.

    Args:
        hidden: a Mitsuba shape dictionary, a dictionary of such, a mesh as (vertices (V, 3), faces (F, 3)) or as an
            object with ``vertices`` and ``faces``, or the name of a mesh file; metres.
        scan: scan that knows its wall.
        bounces: numbers of bounces that count, without gaps, or "all"; 3 is light around one corner.
        energy: joules of the laser, a number or a Mitsuba spectrum dictionary.

    Raises:
        SceneError: for other objects than shapes, for shapes that emit light, for names that the capture needs itself,
            and for a scan without a wall.
        UnitError: for an energy below zero.
    """
    if scan.wall is None:
        raise SceneError(
            "capture: expected a scan that knows its wall: Scan.grid(wall, ...) or Scan.points(..., wall=...)."
        )
    _check_energy(energy)
    first, last = _range(bounces)
    shapes = shapes_of(hidden)
    taken = sorted({WALL, LASER, _INTEGRATOR} & set(shapes))
    if taken:
        raise SceneError(
            f"capture: the names {', '.join(taken)} belong to the capture itself; rename the hidden nodes."
        )
    rows, columns = film_size(scan)
    film: dict[str, Any] = {
        "type": "transient_hdr_film", "width": columns, "height": rows, "rfilter": {"type": "box"}, "temporal_bins": 1,
    }  # fmt: skip
    sensor: dict[str, Any] = {
        "type": "nlos_capture_meter",
        "sensor_origin": _numbers(scan.sensor_origin).tolist(),
        "laser_origin": _numbers(scan.laser_origin).tolist(),
        "points": _numbers(scan.sensor_points).reshape(-1, 3),
        "film": film,
    }
    if scan.kind != "confocal":
        sensor["laser_points"] = _numbers(scan.laser_points).reshape(-1, 3)
    if scan.kind == "exhaustive":
        laser_rows, laser_columns = laser_size(scan)
        film |= {"exhaustive_scan": True, "laser_scan_height": laser_rows, "laser_scan_width": laser_columns}
    integrator = {
        "type": "transient_nlos_path",
        "capture_type": scan.kind,
        "max_depth": last,
        "min_bounces": first,
        "rr_depth": max(5, last),
        "account_first_and_last_bounces": scan.first_and_last_leg,
        "nlos_laser_sampling": True,
        "nlos_hidden_geometry_sampling": True,
    }
    return {
        "type": "scene",
        _INTEGRATOR: integrator,
        LASER: {"type": "laser_beam", "energy": energy},
        WALL: dict(scan.wall) | {SENSOR: sensor},
        **shapes,
    }


def shapes_of(hidden: Any) -> dict[str, Any]:
    """Return hidden things as a dictionary of Mitsuba shapes (and nodes that they refer to) by name.

    Args:
        hidden: hidden shapes, in any form that :func:`capture_scene` takes.

    Raises:
        SceneError: for other objects.
    """
    if isinstance(hidden, (str, Path)):
        return {"hidden": mesh_file(Path(hidden), "hidden")}
    if isinstance(hidden, Mapping):
        if hidden.get("type") == "scene" or "type" not in hidden:
            shapes = {name: node for name, node in hidden.items() if name != "type"}
            _check_shapes(shapes)
            return shapes
        return {"hidden": dict(hidden)}
    if isinstance(hidden, (tuple, list)) and len(hidden) == 2:
        return {"hidden": mesh_shape(hidden[0], hidden[1], "hidden")}
    if hasattr(hidden, "vertices") and hasattr(hidden, "faces"):
        return {"hidden": mesh_shape(hidden.vertices, hidden.faces, "hidden")}
    raise SceneError(
        "hidden: expected a Mitsuba shape dictionary, a dictionary of them, (vertices, faces), an object with vertices "
        f"and faces, or a mesh file, got {type(hidden).__name__}."
    )


def film_size(scan: Scan) -> tuple[int, int]:
    """Return (rows, columns) of the film: a list of points is one row.

    Args:
        scan: scan of the capture.
    """
    return _rows_and_columns(scan.sensor_shape)


def laser_size(scan: Scan) -> tuple[int, int]:
    """Return (rows, columns) of the laser's positions; (1, 1) for a single spot.

    Args:
        scan: scan of the capture.
    """
    return _rows_and_columns(scan.laser_shape)


def _rows_and_columns(shape: tuple[int, ...]) -> tuple[int, int]:
    rows, columns = (1, 1, *shape)[-2:]
    return rows, columns


def _check_shapes(shapes: Mapping[str, Any]) -> None:
    if not shapes:
        raise SceneError("hidden: expected at least one shape, got an empty dictionary.")
    for name, node in shapes.items():
        if not isinstance(node, Mapping) or "type" not in node:
            raise SceneError(f"hidden: expected {name!r} as a dictionary with a type, got {shown(node)}.")
        kind = str(node["type"])
        if name in ("sensor", "integrator") or kind.startswith("transient_") or kind.endswith("_capture_meter"):
            raise SceneError(
                f"hidden: {name!r} ({kind}) is no hidden thing: the capture brings sensor, laser and integrator."
            )
        _check_dark(node, name)


def _check_dark(node: Mapping[str, Any], where: str) -> None:
    """Raise SceneError for light among hidden things."""
    if str(node.get("type")) in _LIGHTS:
        raise SceneError(
            f"hidden: {where!r} ({node['type']}) emits light; expected shapes alone beside the laser. Leave it out."
        )
    for name, part in node.items():
        if isinstance(part, Mapping):
            _check_dark(part, f"{where}.{name}")


def _check_energy(energy: Any) -> None:
    """Raise UnitError for numbers that no laser brings."""
    if not isinstance(energy, Mapping) and not 0 <= energy < _MOST_ENERGY:
        raise UnitError(f"energy: expected joules of at least 0, got {shown(energy)} (of {_MOST_ENERGY:g} at most).")


def _range(bounces: Sequence[int] | str) -> tuple[int, int]:
    """The first and the last number that counts; -1 for no limit."""
    if isinstance(bounces, str) and bounces == ALL_BOUNCES:
        return 0, -1
    given = [bounces] if np.ndim(bounces) == 0 else list(bounces)
    numbers = sorted(n for n in map(as_whole, given) if n is not None)
    if not numbers or numbers != list(range(numbers[0], numbers[0] + len(given))) or numbers[0] < 2:
        raise SceneError(
            "bounces: expected whole numbers of at least 2 without gaps, such as (3,) or (3, 4, 5), or 'all', "
            f"got {shown(bounces)}. The laser's spot is the first bounce, so light around one corner has 3."
        )
    return numbers[0], numbers[-1]


def _numbers(points: torch.Tensor) -> np.ndarray:
    return points.detach().cpu().numpy()


def hidden_bounds(hidden: Any, variant: str | None = None) -> np.ndarray:
    """Return the box around hidden things, which are built for it.

    Args:
        hidden: hidden shapes, in any form that :func:`capture_scene` takes.
        variant: Mitsuba variant, None for the active one.

    Returns:
        (2, 3), lowest and highest coordinates, metres.
    """
    scene = load({"type": "scene", **shapes_of(hidden)}, variant=variant)
    with active_variant(scene.variant):
        box = scene.built(BuildOptions()).scene.bbox()
        return np.array([box.min, box.max], dtype=np.float64).reshape(2, 3)
