"""Pictures of scans and captures: their layout in space with hidden shapes, and transients over the wall."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchtransient import checks
from torchtransient.axes import TimeAxis
from torchtransient.capture import Capture, Scan, Wall
from torchtransient.capture.wall import triple
from torchtransient.checks import checked_mesh, is_one_of, positive, shown, transform
from torchtransient.errors import ArgumentError, SceneError, ShapeError
from torchtransient.vis.files import figure_type, save_figure
from torchtransient.vis.pictures import checked_limits
from torchtransient.vis.sources import middle_spot, of_one_spot

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

STYLES = ("curves", "image")
_COLOURS = {1: ("black",), 3: ("tab:red", "tab:green", "tab:blue")}
# Mitsuba's square and cube.
SQUARE = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
_CUBE = np.array([[x, y, z] for z in (-1.0, 1.0) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
_CUBE_FACES = ((0, 1, 2, 3), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7))
# Sides of a circle, and rows of a sphere.
_SIDES, _ROWS = 32, 16


def transients_grid(
    capture: Capture,
    path: str | Path | None = None,
    *,
    style: str | None = None,
    rows: int = 5,
    columns: int = 5,
    laser: int | tuple[int, ...] | None = None,
    limits: tuple[float, float] | None = None,
    title: str = "",
) -> Figure:
    """Draw the transients of a capture, point by point.

    Args:
        capture: one capture of one channel or three.
        path: file to write the figure to.
        style: "curves" draws a histogram for each of up to ``rows`` x ``columns`` sensor points, evenly chosen, where
            they stand on the wall, under their (row, column); "image" all points downwards against time. None: curves
            of a grid, an image of a list.
        rows, columns: most histograms beside each other.
        laser: index of the spot of an exhaustive capture; None for the middle one.
        limits: ends of the time axis, metres.
        title: text above the figure.

    Returns:
        The matplotlib figure.

    Raises:
        ArgumentError: for another object or style.
        ShapeError: for a batch, other numbers of channels, no transient.
        UnitError: for limits without a bin.
        StorageError: when the figure cannot be written.
    """
    cube, axis, scan = of_one_spot(capture, laser, "transients_grid")
    if limits is not None:
        part = Capture(cube, axis, scan).crop(*checked_limits(limits))
        cube, axis, _ = of_one_spot(part, None, "transients_grid")
    style = ("curves" if cube.ndim == 4 else "image") if style is None else style
    if not is_one_of(style, STYLES):
        raise ArgumentError(f"transients_grid: expected style 'curves' or 'image', got {shown(style)}.")
    if style == "curves" and cube.ndim != 4:
        raise ShapeError(
            f"transients_grid: expected a grid of sensor points for curves, got a list of {scan.pairs}; style='image' "
            "draws lists."
        )
    if style == "image":
        figure = _image(cube, axis)
    else:
        try:
            rows, columns = checks.count("rows", rows), checks.count("columns", columns)
        except SceneError:
            raise ShapeError(
                f"transients_grid: expected at least one row and column, got {shown(rows)} and {shown(columns)}."
            ) from None
        figure = _curves(cube, axis, _chosen(cube.shape[2], rows), _chosen(cube.shape[3], columns))
    figure.suptitle(title or _title(capture, laser), fontsize=10)
    return save_figure(figure, path, "transients_grid")


def _title(capture: Capture, laser: Any) -> str:
    spot = ""
    if capture.scan.kind == "exhaustive":
        spot = f", spot {middle_spot(capture.scan) if laser is None else laser}"
    return f"{capture.scan.kind} scan{spot}"


def _chosen(available: int, wanted: int) -> list[int]:
    """Return indices of `wanted` places in the middles of equal parts, all of them where there are no more."""
    count = min(available, wanted)
    return [int((k + 0.5) * available / count) for k in range(count)]


def _curves(cube: Tensor, axis: TimeAxis, rows: list[int], columns: list[int]) -> Figure:
    figure = figure_type()(figsize=(1.0 + 1.9 * len(columns), 0.8 + 1.3 * len(rows)), layout="constrained")
    panels = figure.subplots(len(rows), len(columns), sharex=True, sharey=True, squeeze=False)
    edges = axis.edges_opl.numpy()
    for line, row in zip(panels, reversed(rows), strict=True):
        for panel, column in zip(line, columns, strict=True):
            for values, colour in zip(cube[:, :, row, column].numpy(), _COLOURS[cube.shape[0]], strict=True):
                panel.stairs(values, edges, color=colour, linewidth=0.9)
            panel.set_title(f"({row}, {column})", fontsize=7, pad=2)
            panel.margins(x=0)
            panel.tick_params(labelsize=7)
    figure.supxlabel("optical path length (m)", fontsize=9)
    figure.supylabel("radiance in a bin", fontsize=9)
    return figure


def _image(cube: Tensor, axis: TimeAxis) -> Figure:
    """Draw all points against time, the brightest bin white."""
    lines = cube.sum(0).flatten(1).T
    figure = figure_type()(figsize=(8.0, 4.5), layout="constrained")
    panel = figure.subplots()
    extent = (axis.start_opl, axis.end_opl, len(lines) - 0.5, -0.5)
    finite = torch.nan_to_num(lines, nan=0.0, posinf=0.0, neginf=0.0)
    image = panel.imshow(
        lines.numpy(), aspect="auto", extent=extent, cmap="inferno", vmin=0.0, vmax=float(finite.max()) or 1.0,
        interpolation="nearest",
    )  # fmt: skip
    figure.colorbar(image, ax=panel, label="radiance in a bin")
    panel.set_xlabel("optical path length (m)")
    panel.set_ylabel("sensor point, row by row" if cube.ndim == 4 else "sensor point")
    return figure


# ---------------------------------------------------------------------------------------------- layout in space


def scan_layout(
    scan: Scan | Capture,
    path: str | Path | None = None,
    *,
    hidden: Any = None,
    title: str = "",
) -> Figure:
    """Draw a scan in space: wall, sensor points, laser spots and both origins; lengths in metres.

    Args:
        scan: a Scan, or a Capture with its own.
        path: file to write the figure to.
        hidden: as in ``tt.nlos.simulate``, drawn transparent: shapes by name, one shape, (vertices, faces) or an object
            with both; meshes as arrays, rectangles, cubes, disks, spheres and cylinders.
        title: text above the figure.

    Returns:
        The matplotlib figure.

    Raises:
        ShapeError: for anything that is no scan.
        SceneError: for other shapes and mesh files.
        StorageError: when the figure cannot be written.
    """
    scan = scan.scan if isinstance(scan, Capture) else scan
    if not isinstance(scan, Scan):
        raise ShapeError(f"scan_layout: expected a Scan or a Capture, got {shown(scan)}; Scan.grid makes one.")
    shapes = hidden_polygons(hidden, "scan_layout")
    figure = figure_type()(figsize=(7.0, 6.0), layout="constrained")
    panel = figure.add_subplot(projection="3d")
    drawn = [scan.sensor_points, scan.laser_points, scan.sensor_origin, scan.laser_origin]
    corners = [tensor.detach().cpu().numpy().reshape(-1, 3) for tensor in drawn]
    if scan.wall is not None:
        surface = Wall.of(scan.wall)
        faces = SQUARE[:, :1] * surface.half_u + SQUARE[:, 1:2] * surface.half_v + surface.center
        polygons = [faces] if surface.vertices is None else list(surface.vertices[surface.faces])
        corners.append(np.concatenate(polygons))
        _draw_faces(panel, polygons, "0.5", 0.2)
    for faces_of_shape in shapes:
        corners.append(np.concatenate(faces_of_shape))
        _draw_faces(panel, faces_of_shape, "tab:orange", 0.25)
    sensor, laser, sensor_origin, laser_origin = corners[:4]
    count = "confocal" if scan.kind == "confocal" else f"{len(sensor)}"
    panel.scatter(*sensor.T, s=8, color="tab:blue", label=f"sensor points ({count})", depthshade=False)
    if scan.kind != "confocal":
        panel.scatter(
            *laser.T, s=26, color="tab:red", marker="x", label=f"laser spots ({len(laser)})", depthshade=False
        )
    panel.scatter(*sensor_origin.T, s=60, color="tab:blue", marker="^", label="sensor", depthshade=False)
    panel.scatter(*laser_origin.T, s=60, color="tab:red", marker="v", label="laser", depthshade=False)
    spot = laser[len(laser) // 2]
    panel.plot(*np.stack([laser_origin[0], spot]).T, color="tab:red", linewidth=1)
    _equal_box(panel, np.concatenate(corners))
    panel.set_xlabel("x (m)")
    panel.set_ylabel("y (m)")
    panel.set_zlabel("z (m)")
    # From behind the wall's shoulder, y up as on the wall.
    panel.view_init(elev=20, azim=-60, vertical_axis="y")
    panel.legend(loc="upper left", fontsize=8)
    panel.set_title(title or repr(scan), fontsize=9)
    return save_figure(figure, path, "scan_layout")


def _draw_faces(panel: Any, polygons: list[NDArray[np.float64]], colour: str, alpha: float) -> None:
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    # The edges of fine meshes would be all that is seen.
    edge = colour if len(polygons) <= 64 else "none"
    panel.add_collection3d(
        Poly3DCollection(polygons, facecolor=colour, edgecolor=edge, linewidth=0.5, alpha=alpha), autolim=False
    )


def _equal_box(panel: Any, points: NDArray[np.float64]) -> None:
    """Set one scale for the three axes."""
    low, high = points.min(0), points.max(0)
    size = np.maximum(high - low, 0.05 * float((high - low).max() or 1.0))
    middle = (low + high) / 2
    for set_limits, center, length in zip((panel.set_xlim, panel.set_ylim, panel.set_zlim), middle, size, strict=True):
        set_limits(center - 0.55 * length, center + 0.55 * length)
    panel.set_box_aspect(size)


# ---------------------------------------------------------------------------------------- hidden shapes as polygons


def hidden_polygons(hidden: Any, who: str) -> list[list[Array]]:
    """Return the corners (N, 3) of the faces of each hidden shape, metres.

    Args:
        hidden: shapes of Mitsuba by name, a single one, (vertices (V, 3), faces (F, 3)), an object with both, or None.
            Nodes that a shape refers to are left out.
        who: beginning of messages.

    Raises:
        SceneError: for other shapes than :data:`DRAWN`, mesh files among them.
        ShapeError, UnitError: for meshes and transforms that are none.
    """
    if hidden is None:
        return []
    if isinstance(hidden, Mapping):
        if "type" in hidden and hidden["type"] != "scene":
            return [_of_shape("hidden", hidden, who)]
        shapes = {name: node for name, node in hidden.items() if name != "type"}
        used = set(_references(shapes))
        return [_of_shape(name, node, who) for name, node in shapes.items() if name not in used]
    if isinstance(hidden, (tuple, list)) and len(hidden) == 2:
        vertices, faces = hidden
        return [_of_mesh(vertices, faces, f"{who}: hidden")]
    if hasattr(hidden, "vertices") and hasattr(hidden, "faces"):
        return [_of_mesh(hidden.vertices, hidden.faces, f"{who}: hidden")]
    if isinstance(hidden, (str, PathLike)):
        raise SceneError(f"{who}: mesh files are not drawn, got {str(hidden)!r}. Give its (vertices, faces).")
    raise SceneError(
        f"{who}: expected hidden as shapes by name, a shape, (vertices, faces) or an object with both, got "
        f"{shown(hidden)}."
    )


def _of_shape(name: str, shape: Any, who: str) -> list[Array]:
    where = f"{who}: hidden {name!r}"
    if not isinstance(shape, Mapping) or "type" not in shape:
        raise SceneError(f"{where}: expected a dictionary with a type, got {shown(shape)}.")
    kind = shape["type"]
    if kind not in DRAWN:
        raise SceneError(f"{where}: shapes that are drawn are {', '.join(DRAWN)}, got {kind!r}. Leave it out.")
    matrix = transform(f"{where}: to_world", shape.get("to_world", np.eye(4)))
    return [points @ matrix[:3, :3].T + matrix[:3, 3] for points in DRAWN[kind](shape, where)]


def _references(nodes: Any) -> Iterator[str]:
    """Yield names that nodes refer to."""
    for node in nodes.values():
        if isinstance(node, Mapping):
            if node.get("type") == "ref":
                yield str(node.get("id"))
            yield from _references(node)


# -------------------------------------------------------------------------------------- faces of each shape, unplaced


def _of_mesh(vertices: Any, faces: Any, where: str) -> list[Array]:
    points, triangles = checked_mesh(where, vertices, faces)
    return list(points[triangles])


def _mesh(shape: Mapping[str, Any], where: str) -> Sequence[Array]:
    return _of_mesh(shape.get("vertices"), shape.get("faces"), where)


def _square(shape: Mapping[str, Any], where: str) -> Sequence[Array]:
    return [SQUARE]


def _cube(shape: Mapping[str, Any], where: str) -> Sequence[Array]:
    return list(_CUBE[np.array(_CUBE_FACES)])


def _circle(shape: Mapping[str, Any], where: str) -> Sequence[Array]:
    angle = np.arange(_SIDES) * 2 * np.pi / _SIDES
    return [np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)]


def _sphere(shape: Mapping[str, Any], where: str) -> Sequence[Array]:
    center = triple(f"{where}: center", shape.get("center", (0.0, 0.0, 0.0)))
    radius = positive(f"{where}: radius", shape.get("radius", 1.0))
    up, around = np.linspace(0, np.pi, _ROWS + 1)[:, None], np.linspace(0, 2 * np.pi, _SIDES + 1)[None]
    x, y, z = np.sin(up) * np.cos(around), np.sin(up) * np.sin(around), np.cos(up) + 0 * around
    return _cells(center + radius * np.stack([x, y, z], -1))


def _cylinder(shape: Mapping[str, Any], where: str) -> Sequence[Array]:
    begin = triple(f"{where}: p0", shape.get("p0", (0.0, 0.0, 0.0)))
    end = triple(f"{where}: p1", shape.get("p1", (0.0, 0.0, 1.0)))
    radius = positive(f"{where}: radius", shape.get("radius", 1.0))
    axis = end - begin
    aside = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    aside /= np.linalg.norm(aside) or 1.0
    other = np.cross(axis, aside) / (np.linalg.norm(axis) or 1.0)
    angle = np.linspace(0, 2 * np.pi, _SIDES + 1)[:, None]
    circle = radius * (np.cos(angle) * aside + np.sin(angle) * other)
    return _cells(np.stack([begin + circle, end + circle]))


def _cells(grid: Array) -> list[Array]:
    """Return the quadrilaterals (4, 3) of a grid of points (M, N, 3)."""
    corners = np.stack([grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]], 2)
    return list(corners.reshape(-1, 4, 3))


# Shapes that are drawn, by Mitsuba's name.
DRAWN: dict[str, Callable[[Mapping[str, Any], str], Sequence[Array]]] = {
    "mesh_arrays": _mesh, "rectangle": _square, "cube": _cube, "disk": _circle, "sphere": _sphere,
    "cylinder": _cylinder,
}  # fmt: skip
