"""A data set at a glance: a picture, labels and the light over time of some samples."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from torchtransient.errors import ShapeError
from torchtransient.vis.files import figure_type, save_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Sizes of one sample's pictures on paper, inches.
_PICTURE, _CURVE, _TITLE = 1.35, 0.45, 0.2
# Letters of a title that fit above a picture.
_LETTERS = 30


@dataclass(frozen=True)
class Cell:
    """One sample. ``title``: a line, cut off where it would run into the next one. ``images``: images by name, (H, W,
    3) in [0, 1] as they are shown, or (H, W) of numbers, which share one scale in a sheet. ``curve``: light over the
    bins, (T,), or None.
    """

    title: str
    images: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    curve: NDArray[Any] | None = None


def contact_sheet(
    cells: Sequence[Cell],
    path: str | Path | None = None,
    *,
    times: NDArray[Any] | None = None,
    title: str = "",
) -> Figure:
    """Draw samples beside each other, in a sheet about as high as wide.

    Args:
        cells: the samples, all with the same images.
        path: file to write the figure to.
        times: edges (T + 1,) of the bins of the curves, metres of optical path.
        title: text above the sheet.

    Returns:
        The matplotlib figure.

    Raises:
        ShapeError: without samples.
        StorageError: when the figure cannot be written.
    """
    if not cells:
        raise ShapeError("contact_sheet: expected at least one sample, got none.")
    names = list(cells[0].images)
    curves = any(cell.curve is not None for cell in cells)
    cell = (len(names) * _PICTURE + 0.15, _PICTURE + _TITLE + (_CURVE if curves else 0.0))
    across = max(1, min(len(cells), round(math.sqrt(len(cells) * cell[1] / cell[0]))))
    down = -(-len(cells) // across)
    width, height = across * cell[0], down * cell[1]
    top = 0.2 if title else 0.0
    figure = figure_type()(figsize=(width, height + top + 0.3), layout=None)
    scales = {name: _scale([cell.images[name] for cell in cells]) for name in names}
    for number, sample in enumerate(cells):
        row, column = divmod(number, across)
        left = column * cell[0] + 0.05
        low = 0.25 + height - (row + 1) * cell[1]
        for place, name in enumerate(names):
            size = _PICTURE * 0.97
            box = (left + place * _PICTURE, low + (_CURVE if curves else 0.0), size, size)
            axes = figure.add_axes(_share(box, figure))
            axes.imshow(sample.images[name], interpolation="nearest", **scales[name])
            axes.set_axis_off()
            if number < across and len(names) > 1:
                axes.text(0.03, 0.03, name, transform=axes.transAxes, fontsize=6, color="white", va="bottom")
            if place == 0:
                axes.set_title(_cut(sample.title, len(names)), fontsize=6, loc="left", pad=2)
        if sample.curve is not None:
            box = (left, low + 0.06, len(names) * _PICTURE - 0.05, _CURVE - 0.12)
            _draw_curve(figure.add_axes(_share(box, figure)), sample.curve, times)
    if times is not None and curves:
        words = f"square root of the light over time, {times[0]:.3g} m to {times[-1]:.3g} m of optical path"
        figure.text(0.01, 0.03 / (height + top), words, fontsize=6, va="bottom")
    if title:
        figure.text(0.01, 1 - 0.05 / (height + top + 0.3), title, fontsize=7, va="top")
    return save_figure(figure, path, "contact_sheet", dpi=160)


def _cut(title: str, pictures: int) -> str:
    most = _LETTERS * pictures
    return title if len(title) <= most else title[: most - 3] + "..."


def _share(box: tuple[float, float, float, float], figure: Any) -> tuple[float, float, float, float]:
    """Return inches from the lower left as shares of the figure."""
    width, height = figure.get_size_inches()
    return box[0] / width, box[1] / height, box[2] / width, box[3] / height


def _scale(images: Sequence[NDArray[Any]]) -> dict[str, Any]:
    if images[0].ndim == 3:
        return {}
    finite = np.concatenate([np.asarray(image)[np.isfinite(image)].ravel() for image in images])
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)
    from matplotlib import colormaps

    # What is no number, a pixel that meets nothing, is no hole in the paper.
    return {"cmap": colormaps["viridis"].with_extremes(bad="0.15"), "vmin": low, "vmax": max(high, low + 1e-12)}


def _draw_curve(axes: Any, curve: NDArray[Any], times: NDArray[Any] | None) -> None:
    edges = np.arange(len(curve) + 1.0) if times is None else np.asarray(times)
    # The square root: what comes after the first reflection is weak.
    axes.stairs(np.sqrt(np.abs(curve)), edges, fill=True, color="#444444", linewidth=0)
    axes.set_xlim(edges[0], edges[-1])
    axes.set_ylim(bottom=0)
    axes.set_xticks([])
    axes.set_yticks([])
    for side in ("top", "right", "left"):
        axes.spines[side].set_visible(False)
    axes.spines["bottom"].set_linewidth(0.4)
