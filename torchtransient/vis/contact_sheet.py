"""A data set at a glance: a picture, labels and the light over time of some samples."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from torchtransient.checks import count, mapping, numbers, of_class, several, shown
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
    """One sample. ``title``: a line, cut off where it would run into the next one. ``images``: by name, (H, W, 3) in
    [0, 1] as they are shown, or (H, W) of numbers, which share one scale in a sheet. ``curve``: light over the bins,
    (T,), or None.
    """

    title: str
    images: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    curve: NDArray[Any] | None = None

    def __post_init__(self) -> None:
        of_class("Cell: title", self.title, str)
        for name, image in mapping("Cell: images", self.images, "{name: image}").items():
            size = _plain_size(image)
            if len(size) != 2 and (len(size) != 3 or size[2] != 3):
                raise ShapeError(f"Cell: expected the image {name!r} as (H, W, 3) or (H, W), got {shown(image)}.")
        if self.curve is not None and numbers("Cell: curve", self.curve).ndim != 1:
            raise ShapeError(f"Cell: expected curve as (T,), got {shown(self.curve)}.")


def contact_sheet(
    cells: Sequence[Cell],
    path: str | Path | None = None,
    *,
    columns: int | None = None,
    times: NDArray[Any] | None = None,
    title: str = "",
) -> Figure:
    """Draw samples beside each other.

    Args:
        cells: the samples, all with the same images.
        path: file to write the figure to.
        columns: samples in a row; None for a sheet about as high as wide.
        times: (T + 1,) edges of the bins of the curves, metres of optical path.
        title: text above the sheet.

    Returns:
        The matplotlib figure.

    Raises:
        ShapeError: without samples, for different images, and times that do not fit.
        StorageError: when the figure cannot be written.
    """
    cells = several("contact_sheet", cells, "samples, each a Cell", Cell)
    if not cells:
        raise ShapeError("contact_sheet: expected at least one sample, got none.")
    names = list(cells[0].images)
    for cell_ in cells:
        if set(cell_.images) != set(names):
            raise ShapeError(
                f"contact_sheet: expected the images {', '.join(names) or 'none'} of every sample, as the first has "
                f"them, got {', '.join(cell_.images) or 'none'}."
            )
    times = _checked_times(times, cells)
    curves = any(cell.curve is not None for cell in cells)
    cell = (len(names) * _PICTURE + 0.15, _PICTURE + _TITLE + (_CURVE if curves else 0.0))
    # About as high as it is wide.
    given = None if columns is None else count("contact_sheet: columns", columns, 1, ShapeError)
    across = given or max(1, min(len(cells), round(math.sqrt(len(cells) * cell[1] / cell[0]))))
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


def _checked_times(times: Any, cells: Sequence[Cell]) -> NDArray[np.float64] | None:
    if times is None:
        return None
    edges = numbers("contact_sheet: times", times)
    bins = {len(cell.curve) for cell in cells if cell.curve is not None}
    if edges.ndim != 1 or len(edges) < 2 or any(len(edges) != count + 1 for count in bins):
        wanted = " and ".join(str(count) for count in sorted(bins)) or "some"
        raise ShapeError(f"contact_sheet: expected times as the edges of {wanted} bins, got {shown(times)}.")
    return edges


def _plain_size(image: Any) -> tuple[int, ...]:
    """Return the shape of an image; (0,) for anything but an array of numbers."""
    plain = np.asarray(image) if hasattr(image, "__array__") else np.asarray(None)
    return plain.shape if plain.dtype.kind in "biuf" else (0,)


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
