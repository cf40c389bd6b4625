"""When light arrives, as one picture: time of the peak, and colours for time."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchtransient import checks
from torchtransient.axes import TimeAxis
from torchtransient.checks import is_one_of
from torchtransient.errors import ArgumentError, ShapeError, UnitError
from torchtransient.units import opl_to_seconds
from torchtransient.vis import colour_maps
from torchtransient.vis.files import Image, picture_figure, save_figure, save_image, to_bytes
from torchtransient.vis.overview import light_curve, peak_time
from torchtransient.vis.sources import Source, axis_of, transient_of
from torchtransient.vis.tone_mapping import BROKEN, checked_positive, exposure_of, tone_map

if TYPE_CHECKING:
    from matplotlib.figure import Figure

STYLES = ("peak", "fusion")


def peak_time_picture(
    source: Source,
    path: str | Path | None = None,
    *,
    axis: TimeAxis | None = None,
    limits: tuple[float, float] | None = None,
    title: str = "",
) -> Figure:
    """A matplotlib figure of the `peak_time` of every pixel, with a colour bar in metres and in nanoseconds.

    `source` and `axis` as in `frames`; `limits` are the ends of the scale in metres (None: where 1 % and 99 % of the
    pixels are). Pixels without light are grey. Writes the figure when `path` is given. Raises ShapeError, also without
    an axis, UnitError for limits that do not rise, and StorageError.
    """
    cube, axis = transient_of(source, axis, "peak_time_picture")
    axis = axis_of(cube, axis, "peak_time_picture")
    peaks = peak_time(torch.nan_to_num(cube, posinf=0.0, neginf=0.0), axis).numpy()
    low, high = _limits(peaks, axis, limits)
    figure, (panel,) = picture_figure(peaks.shape[0], peaks.shape[1], side=5.0)
    panel.set_facecolor("0.6")
    panel.set_axis_on()
    panel.set_xticks([])
    panel.set_yticks([])
    image = panel.imshow(peaks, cmap="viridis", vmin=low, vmax=high, interpolation="nearest")
    panel.set_title(title or "arrival of the peak", fontsize=10)
    bar_in_metres_and_nanoseconds(figure, image, panel, low, high)
    return save_figure(figure, path, "peak_time_picture")


def rainbow(
    source: Source,
    path: str | Path | None = None,
    *,
    axis: TimeAxis | None = None,
    style: str = "peak",
    limits: tuple[float, float] | None = None,
    period_opl: float | None = None,
    exposure: float | None = None,
) -> Image:
    """RGB (H, W, 3) uint8: hue says when, brightness how much light arrives. Red is early, violet late.

    `style` "peak" gives every pixel the hue of its `peak_time`; "fusion" adds up the light of all bins, each in its own
    hue, so that early and late light mix as coloured lamps do. Hues run once over `limits` (metres; None: from 1 % to
    99 % of the `light_curve`), or again and again every `period_opl` metres, which draws lines of equal time.
    Brightness is the steady intensity (sum over channels) on the sRGB curve; `exposure` None makes 5 % of it white.
    Pixels that are not finite are magenta. Without an axis, lengths are counted in bins. Writes the image when `path`
    is given. Raises ArgumentError, ShapeError, UnitError and StorageError.
    """
    if not is_one_of(style, STYLES):
        raise ArgumentError(f"rainbow: expected style 'peak' or 'fusion', got {checks.shown(style)}.")
    cube, axis = transient_of(source, axis, "rainbow")
    axis = axis or TimeAxis(0.0, 1.0, cube.shape[1])
    steady = cube.sum((0, 1))
    broken = ~torch.isfinite(steady).numpy()
    cube = torch.nan_to_num(cube, posinf=0.0, neginf=0.0)
    image = torch.nan_to_num(steady, nan=0.0, posinf=0.0, neginf=0.0)[None]
    level = tone_map(image, exposure_of(image, 0.95) if exposure is None else exposure)[..., 0].numpy()
    low, high = _arrival_limits(cube, axis) if limits is None else checked_limits(limits)
    if style == "peak":
        shown = colour_maps.rainbow(_hue(peak_time(cube, axis).numpy(), low, high, period_opl), level)
    else:
        shown = _fused(cube, _hue(axis.centers_opl.numpy(), low, high, period_opl), level)
    shown[broken] = BROKEN
    return save_image(to_bytes(shown), path, "rainbow")


def bar_in_metres_and_nanoseconds(figure: Any, image: Any, panel: Any, low: float, high: float) -> None:
    """A colour bar with metres on its right and nanoseconds on its left."""
    bar = figure.colorbar(image, ax=panel, shrink=0.85, pad=0.2)
    bar.set_label("optical path length (m)")
    twin = bar.ax.twinx()
    twin.set_ylim(1e9 * opl_to_seconds(low), 1e9 * opl_to_seconds(high))
    # A twin pushes the first axis to the left; here it is the other way round.
    bar.ax.yaxis.set_ticks_position("right")
    bar.ax.yaxis.set_label_position("right")
    twin.yaxis.set_ticks_position("left")
    twin.yaxis.set_label_position("left")
    twin.set_ylabel("time (ns)")


def _hue(opl: NDArray[np.float64], low: float, high: float, period: float | None) -> NDArray[np.float64]:
    if period is None:
        return np.asarray((opl - low) / (high - low))
    period = checked_positive("period_opl", period, "rainbow")
    return np.asarray(np.mod((opl - low) / period, 1.0))


def _fused(cube: Tensor, hues: NDArray[np.float64], level: NDArray[np.float64]) -> NDArray[np.float64]:
    """Linear colours of the bins, mixed with their share of a pixel's light and brought to its brightness."""
    colours = torch.from_numpy(_to_linear(colour_maps.rainbow(hues)))
    values = cube.sum(0).clamp(min=0)
    share = values / values.sum(0).clamp(min=torch.finfo(values.dtype).tiny)
    mixed = torch.einsum("thw,tc->hwc", share.double(), colours)
    shown = tone_map(mixed.permute(2, 0, 1), exposure=1.0).numpy()
    return np.asarray(shown * level[..., None])


def _to_linear(shown: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4))


def _limits(peaks: NDArray[np.float64], axis: TimeAxis, limits: tuple[float, float] | None) -> tuple[float, float]:
    if limits is not None:
        return checked_limits(limits)
    known = peaks[np.isfinite(peaks)]
    if not known.size:
        return axis.start_opl, axis.end_opl
    low, high = np.percentile(known, [1, 99])
    return float(low), float(max(high, low + axis.bin_width_opl))


def _arrival_limits(cube: Tensor, axis: TimeAxis) -> tuple[float, float]:
    arrived = light_curve(cube).cumsum(0)
    if not float(arrived[-1]) > 0:
        return axis.start_opl, axis.end_opl
    edges = torch.searchsorted(arrived / arrived[-1], torch.tensor([0.01, 0.99], dtype=torch.float64))
    first, last = (axis.start_opl + float(k) * axis.bin_width_opl for k in edges)
    return first, last + axis.bin_width_opl


def checked_limits(limits: tuple[float, float]) -> tuple[float, float]:
    """Two lengths in metres. Raises ShapeError for what is no pair of numbers, UnitError for those that do not rise."""
    pair = checks.real_array(limits)
    if pair is None or pair.shape != (2,):
        raise ShapeError(f"limits: expected two lengths in metres, got {checks.shown(limits)}.")
    low, high = pair.tolist()
    if not (np.isfinite(pair).all() and low < high):
        raise UnitError(f"limits: expected two lengths in metres, the first below the second, got {limits!r}.")
    return low, high
