"""Pictures of captures around a corner. The wall stands as the sensor points lie: columns along u to the right, rows
along v upwards.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchtransient import checks
from torchtransient.axes import TimeAxis
from torchtransient.capture import Capture, Scan, Wall
from torchtransient.capture.capture import computed
from torchtransient.checks import is_one_of, shown
from torchtransient.errors import ArgumentError, SceneError, ShapeError
from torchtransient.vis.arrival import checked_limits, peak_time_picture
from torchtransient.vis.files import figure_type, save_figure
from torchtransient.vis.hidden_shapes import SQUARE, hidden_polygons
from torchtransient.vis.video import Frames, FrameSettings, frames
from torchtransient.vis.video_file import check_video, write_video

if TYPE_CHECKING:
    from matplotlib.figure import Figure

STYLES = ("curves", "image")
_COLOURS = {1: ("black",), 3: ("tab:red", "tab:green", "tab:blue")}


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
    """A matplotlib figure of the transients of a capture, point by point.

    `style` "curves" draws a small histogram for each of up to `rows` x `columns` sensor points, evenly chosen, where
    they stand on the wall, on one scale, under their (row, column); "image" a picture of all points (downwards) against
    time, of which the channels are added up. None: curves of a grid, an image of a list of points. `laser` chooses the
    spot of an exhaustive capture, by its index (None: the middle one). `limits` in metres cut the time axis. Writes the
    figure when `path` is given. Raises ShapeError for a batch, more than 3 channels or no transient, UnitError for
    limits without a bin, ArgumentError for an unknown style, StorageError.
    """
    cube, axis, scan = _one_spot(capture, laser, "transients_grid")
    if limits is not None:
        part = Capture(cube, axis, scan).crop(*checked_limits(limits))
        cube, axis = _transient(part, "transients_grid")
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


def wall_frames(
    capture: Capture, *, laser: int | tuple[int, ...] | None = None, **settings: Unpack[FrameSettings]
) -> Frames:
    """The wall as the light arrives on it, a bin a frame: `frames` of the sensor grid, y up.

    `laser` as in `transients_grid`; `settings` (exposure, curve, accumulate, stamp, scale, every) are those of
    `frames`. Raises ShapeError for captures without a grid of sensor points.
    """
    cube, axis = _grid(capture, laser, "wall_frames")
    return frames(cube, axis=axis, **settings)


def wall_video(
    capture: Capture, path: str | Path, *, fps: float = 25.0, progress: bool = False, **settings: Any
) -> Path:
    """Write `wall_frames` as `.mp4` or `.gif`; returns the path. `settings` are those of `wall_frames`.

    Raises StorageError for another ending or folder before any frame is made, and as `wall_frames`.
    """
    check_video(path)
    shown = wall_frames(capture, **settings)
    return write_video(path, shown, len(shown), fps=fps, progress=progress)


def peak_time_map(
    capture: Capture,
    path: str | Path | None = None,
    *,
    laser: int | tuple[int, ...] | None = None,
    limits: tuple[float, float] | None = None,
    title: str = "",
) -> Figure:
    """A matplotlib figure of the wall with the time of the most light at each sensor point, y up.

    `laser` as in `transients_grid`; `limits` in metres as in `peak_time_picture`. Errors as both.
    """
    cube, axis = _grid(capture, laser, "peak_time_map")
    return peak_time_picture(cube, path, axis=axis, limits=limits, title=title or _title(capture, laser))


def scan_layout(
    scan: Scan | Capture,
    path: str | Path | None = None,
    *,
    hidden: Any = None,
    title: str = "",
) -> Figure:
    """A matplotlib figure of a scan in space: wall, sensor points, laser spots and both origins; lengths in metres.

    `hidden`: as in `tt.nlos.simulate`, drawn transparent: shapes by name, one shape, (vertices, faces) or an object
    with both, of meshes as arrays, rectangles, cubes, disks, spheres and cylinders. Writes the figure when `path` is
    given. Raises ArgumentError for what is no scan, SceneError for other shapes and mesh files, StorageError.
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


# ------------------------------------------------------------------------------------------------------------- parts


def _transient(capture: Capture, who: str) -> tuple[Tensor, TimeAxis]:
    """(C, T, ...) on the CPU without gradients, S0 of polarized captures."""
    if not isinstance(capture, Capture):
        raise ArgumentError(f"{who}: expected a Capture, which knows its scan and axis, got {type(capture).__name__}.")
    if capture.transient is None or capture.axis is None:
        raise ShapeError(f"{who}: expected a capture with a transient, got phasors alone.")
    cube = computed(capture.transient.detach().cpu())
    rank = len(capture.scan.shape) + 2
    if capture.polarized:
        cube = cube.select(cube.ndim - rank - 1, 0)
    if cube.ndim != rank:
        raise ShapeError(f"{who}: expected one capture, got a batch {tuple(cube.shape)}; choose one of it.")
    return cube, capture.axis


def _one_spot(capture: Capture, laser: Any, who: str) -> tuple[Tensor, TimeAxis, Scan]:
    """Of one laser spot: (C, T, Sy, Sx) or (C, T, N)."""
    _transient(capture, who)  # says what is wrong before a part is taken
    if capture.scan.kind == "exhaustive":
        capture = capture.single(_middle(capture.scan) if laser is None else laser)
    elif laser is not None:
        raise ShapeError(f"{who}: laser= chooses a spot of an exhaustive capture, got a {capture.scan.kind} one.")
    cube, axis = _transient(capture, who)
    if cube.shape[0] not in _COLOURS:
        raise ShapeError(f"{who}: expected one channel or three, got {cube.shape[0]}; choose some.")
    return cube, axis, capture.scan


def _grid(capture: Capture, laser: Any, who: str) -> tuple[Tensor, TimeAxis]:
    """(C, T, Sy, Sx) with the highest row first, as pictures have it."""
    cube, axis, scan = _one_spot(capture, laser, who)
    if cube.ndim != 4:
        raise ShapeError(
            f"{who}: expected a grid of sensor points, got a list of {scan.pairs}; transients_grid(style='image') "
            "draws lists."
        )
    return cube.flip(2), axis


def _middle(scan: Scan) -> tuple[int, ...]:
    return tuple(n // 2 for n in scan.laser_shape)


def _title(capture: Capture, laser: Any) -> str:
    spot = ""
    if capture.scan.kind == "exhaustive":
        spot = f", spot {_middle(capture.scan) if laser is None else laser}"
    return f"{capture.scan.kind} scan{spot}"


def _chosen(available: int, wanted: int) -> list[int]:
    """Indices of `wanted` places in the middles of equal parts, all of them where there are no more."""
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
    """All points against time, the brightest bin white."""
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


def _draw_faces(panel: Any, polygons: list[NDArray[np.float64]], colour: str, alpha: float) -> None:
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    # The edges of fine meshes would be all that is seen.
    edge = colour if len(polygons) <= 64 else "none"
    panel.add_collection3d(
        Poly3DCollection(polygons, facecolor=colour, edgecolor=edge, linewidth=0.5, alpha=alpha), autolim=False
    )


def _equal_box(panel: Any, points: NDArray[np.float64]) -> None:
    """One scale for the three axes."""
    low, high = points.min(0), points.max(0)
    size = np.maximum(high - low, 0.05 * float((high - low).max() or 1.0))
    middle = (low + high) / 2
    for set_limits, center, length in zip((panel.set_xlim, panel.set_ylim, panel.set_zlim), middle, size, strict=True):
        set_limits(center - 0.55 * length, center + 0.55 * length)
    panel.set_box_aspect(size)
