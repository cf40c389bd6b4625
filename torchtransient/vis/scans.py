"""Pictures of scans and captures: their layout in space with hidden shapes, and transients over the wall."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchtransient.axes import TimeAxis
from torchtransient.capture import Capture, Scan, Wall
from torchtransient.checks import checked_mesh, transform
from torchtransient.errors import ArgumentError, SceneError, ShapeError
from torchtransient.vis.files import figure_type, save_figure
from torchtransient.vis.sources import middle_spot, of_one_spot

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

_COLOURS = {1: ("black",), 3: ("tab:red", "tab:green", "tab:blue")}
# Mitsuba's square and cube.
_SQUARE = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
_CUBE = np.array([[x, y, z] for z in (-1.0, 1.0) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
_CUBE_FACES = np.array([[0, 1, 2, 3], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]])
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

    Returns:
        The matplotlib figure.

    Raises:
        ArgumentError: for another style.
        ShapeError: for a batch, other numbers of channels, no transient.
        StorageError: when the figure cannot be written.
    """
    cube, axis, scan = of_one_spot(capture, laser, "transients_grid")
    style = ("curves" if cube.ndim == 4 else "image") if style is None else style
    if style == "image":
        figure = _image(cube, axis)
    elif style != "curves":
        raise ArgumentError(f"transients_grid: expected style 'curves' or 'image', got {style!r}.")
    elif cube.ndim != 4:
        raise ShapeError(
            f"transients_grid: expected a grid of sensor points for curves, got a list of {scan.pairs}; style='image' "
            "draws lists."
        )
    else:
        figure = _curves(cube, axis, _chosen(cube.shape[2], rows), _chosen(cube.shape[3], columns))
    spot = ""
    if capture.scan.kind == "exhaustive":
        spot = f", spot {middle_spot(capture.scan) if laser is None else laser}"
    figure.suptitle(f"{capture.scan.kind} scan{spot}", fontsize=10)
    return save_figure(figure, path, "transients_grid")


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
        hidden: hidden shapes as ``tt.nlos.simulate`` takes them, drawn transparent: shapes by name, one shape,
            (vertices, faces) or an object with both; meshes as arrays, rectangles, cubes, disks, spheres and cylinders.
        title: text above the figure.

    Returns:
        The matplotlib figure.

    Raises:
        SceneError: for other shapes and mesh files.
        ShapeError, UnitError: for meshes and transforms that are none.
        StorageError: when the figure cannot be written.
    """
    scan = scan.scan if isinstance(scan, Capture) else scan
    shapes = _hidden_polygons(hidden)
    figure = figure_type()(figsize=(7.0, 6.0), layout="constrained")
    panel = figure.add_subplot(projection="3d")
    drawn = [scan.sensor_points, scan.laser_points, scan.sensor_origin, scan.laser_origin]
    corners = [tensor.detach().cpu().numpy().reshape(-1, 3) for tensor in drawn]
    if scan.wall is not None:
        surface = Wall.of(scan.wall)
        faces = _SQUARE[:, :1] * surface.half_u + _SQUARE[:, 1:2] * surface.half_v + surface.center
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


def _hidden_polygons(hidden: Any) -> list[list[Array]]:
    """Return the corners (N, 3) of the faces of each hidden shape, metres.

    Nodes that a shape refers to are left out.
    """
    if hidden is None:
        return []
    if isinstance(hidden, Mapping):
        shapes = {"hidden": hidden} if hidden.get("type", "scene") != "scene" else hidden
        used = set(_references(shapes))
        return [_of_shape(name, node) for name, node in shapes.items() if name not in {"type", *used}]
    if isinstance(hidden, str | PathLike):
        raise SceneError(f"scan_layout: mesh files are not drawn, got {str(hidden)!r}. Give its (vertices, faces).")
    vertices, faces = hidden if isinstance(hidden, tuple | list) else (hidden.vertices, hidden.faces)
    return [_mesh({"vertices": vertices, "faces": faces})]


def _of_shape(name: str, shape: Mapping[str, Any]) -> list[Array]:
    if shape["type"] not in DRAWN:
        raise SceneError(
            f"scan_layout: hidden {name!r}: shapes that are drawn are {', '.join(DRAWN)}, got {shape['type']!r}. "
            "Leave it out."
        )
    matrix = transform(f"scan_layout: hidden {name!r}: to_world", shape.get("to_world", np.eye(4)))
    return [points @ matrix[:3, :3].T + matrix[:3, 3] for points in DRAWN[shape["type"]](shape)]


def _references(nodes: Mapping[str, Any]) -> Iterator[str]:
    """Yield names that nodes refer to."""
    for node in nodes.values():
        if isinstance(node, Mapping):
            if node.get("type") == "ref":
                yield str(node.get("id"))
            yield from _references(node)


# -------------------------------------------------------------------------------------- faces of each shape, unplaced


def _mesh(shape: Mapping[str, Any]) -> list[Array]:
    points, triangles = checked_mesh("scan_layout: hidden", shape["vertices"], shape["faces"])
    return list(points[triangles])


def _circle(points: int) -> Array:
    angle = np.linspace(0, 2 * np.pi, points)
    return np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)


def _sphere(shape: Mapping[str, Any]) -> list[Array]:
    up = np.linspace(0, np.pi, _ROWS + 1)[:, None, None]
    around = np.sin(up) * _circle(_SIDES + 1) + np.cos(up) * np.array([0.0, 0.0, 1.0])
    return _cells(np.asarray(shape.get("center", (0.0, 0.0, 0.0))) + shape.get("radius", 1.0) * around)


def _cylinder(shape: Mapping[str, Any]) -> list[Array]:
    begin, end = (np.array(shape.get(*place), float) for place in (("p0", (0, 0, 0)), ("p1", (0, 0, 1))))
    axis = end - begin
    aside = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    aside /= np.linalg.norm(aside)
    turned = np.stack([aside, np.cross(axis, aside) / np.linalg.norm(axis), axis])
    circle = shape.get("radius", 1.0) * _circle(_SIDES + 1) @ turned
    return _cells(np.stack([begin + circle, end + circle]))


def _cells(grid: Array) -> list[Array]:
    """Return the quadrilaterals (4, 3) of a grid of points (M, N, 3)."""
    corners = np.stack([grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]], 2)
    return list(corners.reshape(-1, 4, 3))


# Shapes that are drawn, by Mitsuba's name.
DRAWN: dict[str, Callable[[Mapping[str, Any]], list[Array]]] = {
    "mesh_arrays": _mesh, "rectangle": lambda shape: [_SQUARE], "cube": lambda shape: list(_CUBE[_CUBE_FACES]),
    "disk": lambda shape: [_circle(_SIDES + 1)[:-1]], "sphere": _sphere, "cylinder": _cylinder,
}  # fmt: skip
