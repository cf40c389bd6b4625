"""Cuts through a transient: space against time, and a sheet of moments."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from torch import Tensor

from torchtransient import checks
from torchtransient.axes import TimeAxis
from torchtransient.checks import several
from torchtransient.errors import ArgumentError, ShapeError
from torchtransient.units import opl_to_seconds
from torchtransient.vis.files import figure_type, picture_figure, save_figure
from torchtransient.vis.overview import moments_of_arrival
from torchtransient.vis.sources import Source, images_of, pixel_of, transient_of
from torchtransient.vis.stamps import moment
from torchtransient.vis.tone_mapping import exposure_of, tone_map

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def streak(
    source: Source,
    path: str | Path | None = None,
    *,
    row: int | None = None,
    column: int | None = None,
    axis: TimeAxis | None = None,
    exposure: float | None = None,
    curve: str = "log",
) -> Figure:
    """A matplotlib figure as a streak camera sees it: one row (or one column) of pixels over time, time downwards.

    Give `row` or `column` (None: the middle row). `source` and `axis` as in `frames`; `exposure` and `curve` as in
    `tone_map`, whose "log" shows the front and what follows it. Writes the figure when `path` is given. Raises
    ShapeError for a line outside of the image, or both given; UnitError; StorageError.
    """
    cube, axis = transient_of(source, axis, "streak")
    if row is not None and column is not None:
        raise ArgumentError("streak: expected row or column, got both.")
    number, what = (column, "column") if column is not None else (row, "row")
    count = cube.shape[3] if what == "column" else cube.shape[2]
    number = count // 2 if number is None else number
    place = checks.as_whole(number)
    if place is None or not -count <= place < count:
        raise ShapeError(
            f"streak: {what} {checks.shown(number)} lies outside of an image of {cube.shape[2]} x {cube.shape[3]}."
        )
    number = place % count
    line: Tensor = cube[:, :, :, number] if what == "column" else cube[:, :, number]
    shown = tone_map(line, exposure_of(line, 0.999) if exposure is None else exposure, curve).numpy()
    figure = figure_type()(figsize=(6.2, 5.2), layout="constrained")
    panel = figure.subplots()
    pixels = line.shape[2]
    start, end = (0.0, float(cube.shape[1])) if axis is None else (axis.start_opl, axis.end_opl)
    panel.imshow(shown, aspect="auto", interpolation="nearest", extent=(-0.5, pixels - 0.5, end, start))
    panel.set_xlabel("row of the image" if what == "column" else "column of the image")
    panel.set_ylabel("bin" if axis is None else "optical path length (m)")
    if axis is not None:
        other = panel.secondary_yaxis("right", functions=(_to_nanoseconds, _to_metres))
        other.set_ylabel("time (ns)")
    scale = ", logarithmic" if curve == "log" else ""
    panel.set_title(f"light along {what} {number}{scale}", fontsize=10)
    return save_figure(figure, path, "streak")


def frame_grid(
    source: Source,
    path: str | Path | None = None,
    *,
    axis: TimeAxis | None = None,
    bins: Sequence[int] | None = None,
    count: int = 12,
    columns: int = 4,
    exposure: float | None = None,
    curve: str = "srgb",
    title: str = "",
) -> Figure:
    """A matplotlib figure of moments, each with its time.

    `bins` names them; None takes `count` moments between which equal shares of the light arrive. `exposure` None lets
    every frame have its own, since late light is far weaker than early light; give a number to compare frames.
    `source`, `axis` and `curve` as in `frames`. Writes the figure when `path` is given. Raises ShapeError for a bin
    outside of the axis or no bins, UnitError and StorageError.
    """
    cube, axis, word = images_of(source, axis, "frame_grid")
    total = cube.shape[1]
    columns, number = (
        checks.count(f"frame_grid: {name}", value, 1, ShapeError)
        for name, value in (("columns", columns), ("count", count))
    )
    if bins is None:
        shares = tuple(float(s) for s in (np.arange(number) + 0.5) / number)
        bins = moments_of_arrival(cube.nan_to_num(posinf=0.0, neginf=0.0), shares)
    bins = several("frame_grid: bins", bins, "numbers of bins")
    if not bins:
        raise ShapeError("frame_grid: expected some bins, got none.")
    for index in bins:
        if (place := checks.as_whole(index)) is None or not 0 <= place < total:
            raise ShapeError(f"frame_grid: bin {checks.shown(index)} lies outside of {total} bins.")
    bins = [int(index) for index in bins]
    figure, panels = picture_figure(cube.shape[2], cube.shape[3], panels=len(bins), side=2.4, columns=columns)
    for panel, index in zip(panels, bins, strict=False):
        panel.imshow(tone_map(cube[:, index], exposure, curve).numpy(), interpolation="nearest")
        panel.set_title(moment(axis, index, total, word).replace("   ", " = "), fontsize=8)
    if title:
        figure.suptitle(title, fontsize=11)
    return save_figure(figure, path, "frame_grid")


def histogram(
    source: Source,
    path: str | Path | None = None,
    *,
    pixels: Sequence[tuple[int, int]],
    axis: TimeAxis | None = None,
    log: bool = False,
    title: str = "",
) -> Figure:
    """A matplotlib figure of what some pixels (row, column) see over time, a panel each.

    Three channels are red, green and blue lines, one is black, others go from violet to yellow; `log` takes a
    logarithmic scale. `source` and `axis` as in `frames`, with any number of channels. Writes the figure when `path` is
    given. Raises ShapeError without pixels, or for one outside of the image, and StorageError.
    """
    cube, axis, word = images_of(source, axis, "histogram", any_channels=True)
    height, width = cube.shape[2:]
    pixels = several("histogram", pixels, "pixels (row, column)")
    if not pixels:
        raise ShapeError("histogram: expected at least one pixel (row, column), got none.")
    pixels = [pixel_of(pixel, (height, width), "histogram") for pixel in pixels]
    figure = figure_type()(figsize=(7.0, 0.5 + 2.1 * len(pixels)), layout="constrained")
    panels = figure.subplots(len(pixels), 1, sharex=True, squeeze=False)[:, 0]
    edges = np.arange(cube.shape[1] + 1) if axis is None else axis.edges_opl.numpy()
    for panel, (row, column) in zip(panels, pixels, strict=True):
        curves = cube[:, :, row, column].numpy()
        colours = _line_colours(len(curves))
        # On a logarithmic scale an empty bin is a gap, not a line down to the frame.
        shown = np.where(curves > 0, curves, np.nan) if log and bool((curves > 0).any()) else curves
        for curve, colour in zip(shown, colours, strict=True):
            panel.stairs(curve, edges, baseline=None if log else 0, color=colour, linewidth=1.0)
        panel.set_title(f"row {row}, column {column}", fontsize=9, loc="left")
        panel.set_ylabel(f"radiance in a {word}")
        if log and bool((curves > 0).any()):
            panel.set_yscale("log")
        panel.margins(x=0)
        panel.grid(True, color="0.9", linewidth=0.6)
    panels[-1].set_xlabel(word if axis is None else "optical path length (m)")
    if axis is not None:
        top = panels[0].secondary_xaxis("top", functions=(_to_nanoseconds, _to_metres))
        top.set_xlabel("time (ns)")
        panels[0].set_title(f"row {pixels[0][0]}, column {pixels[0][1]}", fontsize=9, loc="left", pad=6)
    if title:
        figure.suptitle(title, fontsize=11)
    return save_figure(figure, path, "histogram")


def _line_colours(count: int) -> Any:
    import matplotlib

    if count in (1, 3):
        return ("tab:red", "tab:green", "tab:blue") if count == 3 else ("black",)
    return matplotlib.colormaps["viridis"](np.linspace(0, 0.9, count))


def _to_nanoseconds(opl: Any) -> Any:
    return np.asarray(opl) * (1e9 * opl_to_seconds(1.0))


def _to_metres(time_ns: Any) -> Any:
    return np.asarray(time_ns) / (1e9 * opl_to_seconds(1.0))
