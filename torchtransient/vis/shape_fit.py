"""A fit of a hidden shape on one page: the shape as the wall sees it and from above, transients, loss and errors."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from torchtransient.axes import TimeAxis
from torchtransient.capture import Scan, Wall
from torchtransient.checks import Numbers, checked_mesh, mapping, numbers, of_class, shown
from torchtransient.errors import SceneError, ShapeError
from torchtransient.vis.files import figure_type, save_figure
from torchtransient.vis.sources import real_tensor

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Of meshes in their order; what is measured has none.
COLOURS = ("0.55", "tab:blue", "tab:orange", "tab:purple")
LAST_COLOUR, OTHER_COLOUR = "tab:green", "0.75"
# Bins that are drawn of a transient: finer ones are added up.
MOST_BINS = 128


def plot_shape_fit(
    scan: Scan,
    meshes: Mapping[str, Tensor],
    faces: Tensor,
    *,
    transients: Mapping[str, Tensor],
    axis: TimeAxis,
    losses: Numbers,
    errors: Mapping[str, Numbers],
    path: str | Path | None = None,
) -> Figure:
    """A matplotlib figure of a fit. Lengths in metres.

    `meshes`: name -> vertices (V, 3), the start first and the truth last, all with `faces` (F, 3). They are drawn as
    the wall sees them, over the points of `scan` (which knows its wall, and has a grid), and from above. `transients`:
    name -> (T, H, W) over `axis`, drawn at three points of the grid's diagonal; those called as a mesh have its
    colour. `losses`: one for each step; `errors`: name with unit -> numbers, drawn on logarithmic axes. Writes the
    figure when `path` is given. Raises ShapeError, SceneError for a scan without a wall, StorageError.
    """
    of_class("plot_shape_fit: scan", scan, Scan, "; Scan.grid makes one")
    of_class("plot_shape_fit: axis", axis, TimeAxis)
    if scan.wall is None or len(scan.sensor_shape) != 2:
        raise SceneError(
            "plot_shape_fit: expected a scan with a grid of sensor points and a wall. Scan.grid makes one."
        )
    given = mapping("plot_shape_fit: meshes", meshes, "{name: vertices}")
    loss, curves = _row("losses", losses), mapping("plot_shape_fit: errors", errors, "{name: numbers}")
    if not given or not len(loss):
        raise ShapeError(f"plot_shape_fit: expected a mesh and a step, got {len(given)} and {len(loss)}.")
    shapes = {name: checked_mesh(f"plot_shape_fit: {name!r}", mesh, faces) for name, mesh in given.items()}
    transients = {
        name: real_tensor(cube, f"plot_shape_fit: {name!r}")
        for name, cube in mapping("plot_shape_fit: transients", transients, "{name: transient}").items()
    }
    for name, cube in transients.items():
        if tuple(cube.shape) != (axis.num_bins, *scan.sensor_shape):
            raise ShapeError(
                f"plot_shape_fit: expected {name!r} as (T, H, W) = {(axis.num_bins, *scan.sensor_shape)}, got "
                f"{tuple(cube.shape)}."
            )
    colours = dict(zip(shapes, COLOURS, strict=False)) | {list(shapes)[-1]: LAST_COLOUR}
    figure = figure_type()(figsize=(11.0, 7.4), layout="constrained")
    upper, lower = figure.subfigures(2, 1, squeeze=False, height_ratios=(1.25, 1.0)).flat
    front, above = upper.subplots(1, 2)
    _draw_views(front, above, scan, shapes, colours)
    panels = lower.subplots(1, 4, width_ratios=(1.0, 1.0, 1.0, 1.2))
    _draw_transients(panels[:3], transients, axis, colours)
    _draw_curves(panels[3], loss, {name: _row(f"errors of {name!r}", curve) for name, curve in curves.items()})
    return save_figure(figure, path, "plot_shape_fit")


def _draw_views(
    front: Any, above: Any, scan: Scan, meshes: Mapping[str, tuple[Any, Any]], colours: Mapping[str, str]
) -> None:
    """The wall's view, along its axes u and v, and that from above, along u and the wall's normal."""
    wall = Wall.of(scan.wall)
    u, v = (np.asarray(axis) / np.linalg.norm(axis) for axis in (wall.half_u, wall.half_v))
    frame = np.stack([u, v, np.asarray(wall.normal)], axis=1)

    def local(points: Any) -> Any:
        return (np.asarray(points) - np.asarray(wall.center)) @ frame

    points = local(_numbers(scan.sensor_points).reshape(-1, 3))
    for panel, (i, j) in ((front, (0, 1)), (above, (0, 2))):
        panel.scatter(points[:, i], points[:, j], s=1.5, color="0.8", linewidths=0)
        # The truth first and broad, so that what was found shows on it.
        for n, name in enumerate(sorted(meshes, key=list(meshes)[-1].__ne__)):
            vertices, faces = meshes[name]
            _draw_mesh(panel, local(vertices)[:, [i, j]], faces, (colours[name], 1.3 if n else 3.5), name)
        panel.set_aspect("equal")
        panel.set_xlabel("along the wall (m)")
    front.set_ylabel("up (m)")
    front.set_title("seen from the wall", fontsize=10)
    front.legend(fontsize=8, frameon=False, loc="upper left")
    above.set_ylabel("distance from the wall (m)")
    above.set_title("seen from above", fontsize=10)


def _draw_mesh(panel: Any, points: Any, faces: Any, style: tuple[str, float], label: str) -> None:
    """Triangles (F, 3) of points (V, 2), transparent, and the edges that belong to one of them alone."""
    from matplotlib.collections import LineCollection, PolyCollection

    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    unique, count = np.unique(edges, axis=0, return_counts=True)
    colour, width = style
    rims = unique[count == 1] if (count == 1).any() else unique
    panel.add_collection(PolyCollection(list(points[faces]), facecolor=colour, edgecolor="none", alpha=0.15))
    panel.add_collection(LineCollection(list(points[rims]), color=colour, linewidth=width, label=label))
    panel.autoscale_view()


def _draw_transients(panels: Any, transients: Mapping[str, Tensor], axis: TimeAxis, colours: Mapping[str, str]) -> None:
    together = -(-axis.num_bins // MOST_BINS)
    whole = axis.num_bins // together * together
    edges = _numbers(axis.edges_opl)[: whole + 1 : together]
    for n, panel in enumerate(panels):
        for name, cube in transients.items():
            row, column = (int((2 * n + 1) * size / 6) for size in cube.shape[1:])
            values = _numbers(cube[:whole, row, column]).reshape(-1, together).sum(1)
            panel.stairs(values, edges, color=colours.get(name, OTHER_COLOUR), linewidth=1.1, label=name)
        panel.set_title(f"point {column}, {row}", fontsize=9)
        panel.set_xlabel("optical path length (m)", fontsize=8)
        panel.tick_params(labelsize=7)
        panel.margins(x=0)
    panels[0].set_ylabel("counts", fontsize=8)
    panels[0].legend(fontsize=7, frameon=False)


def _draw_curves(panel: Any, losses: Numbers, errors: Mapping[str, Numbers]) -> None:
    for n, (name, values) in enumerate(errors.items()):
        panel.plot(values, color=f"C{n}", linewidth=1.2, label=name)
    panel.set_yscale("log")
    panel.set_xlabel("step", fontsize=8)
    panel.tick_params(labelsize=7, which="both")
    panel.grid(True, color="0.9", linewidth=0.6)
    twin = panel.twinx()
    twin.plot(losses, color="0.6", linewidth=0.8, linestyle="--", label="loss")
    twin.set_yscale("log")
    twin.tick_params(labelsize=7, colors="0.6", which="both")
    lines = [*panel.get_lines(), *twin.get_lines()]
    panel.legend(lines, [line.get_label() for line in lines], fontsize=7, frameon=False)
    panel.set_title("errors, and the loss (dashed)", fontsize=9)


def _row(what: str, given: Any) -> NDArray[np.float64]:
    row = numbers(f"plot_shape_fit: {what}", given)
    if row.ndim != 1:
        raise ShapeError(f"plot_shape_fit: expected {what} as a row of numbers, got {shown(given)}.")
    return row


def _numbers(values: Any) -> Any:
    return values.detach().cpu().numpy() if isinstance(values, Tensor) else np.asarray(values)
