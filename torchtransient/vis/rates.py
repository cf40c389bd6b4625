"""Light over the rates of its paths: range-Doppler maps, and speeds as a picture."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchtransient.axes import RateAxis, TimeAxis
from torchtransient.checks import is_one_of, of_class, shown
from torchtransient.errors import ArgumentError, ShapeError
from torchtransient.vis import colour_maps
from torchtransient.vis.files import figure_type, picture_figure, save_figure
from torchtransient.vis.sources import Source, as_tensor, pixel_of, read_rates
from torchtransient.vis.tone_mapping import checked_positive

if TYPE_CHECKING:
    from matplotlib.figure import Figure

READINGS = ("mean", "peak")


def range_doppler(
    source: Source,
    path: str | Path | None = None,
    *,
    axis: TimeAxis | None = None,
    rate_axis: RateAxis | None = None,
    pixel: tuple[int, int] | None = None,
    decades: float = 4.0,
    title: str = "",
) -> Figure:
    """A matplotlib figure of light over the rate and the length of its paths, brightness on a logarithmic scale.

    Rates run to the right, lengths upwards; the other edges have the speed of approach, half the rate with its sign
    changed, and the distance, half the length, of what is seen from beside the light.

    Args:
        source: light (C, R, T, H, W), or a result or its file that has it as ``rates``; channels are added up.
        path: file to write the figure to.
        axis, rate_axis: axes of T and R; None takes those of the result, ``axis`` and ``rate_axis``.
        pixel: (row, column); None for the mean over all pixels.
        decades: powers of ten from the brightest bin to the darkest colour.
        title: text above the figure.

    Raises:
        ShapeError: for other shapes, axes that do not fit or are not known, a pixel outside.
        UnitError: unless ``decades`` is positive.
        StorageError: when the figure cannot be written.
    """
    me = "range_doppler"
    light, axis, rate_axis = _rates_of(source, axis, rate_axis, me)
    decades = checked_positive("decades", decades, me)
    if axis is None:
        raise ShapeError(f"{me}: light over {light.shape[1]} bins of length needs axis=TimeAxis(...) to be drawn.")
    if pixel is None:
        shared = light.mean((-2, -1)).numpy()
    else:
        row, column = pixel_of(pixel, (light.shape[-2], light.shape[-1]), me)
        shared = light[..., row, column].numpy()
    from matplotlib.colors import LogNorm

    figure = figure_type()(figsize=(6.6, 5.4), layout="constrained")
    panel = figure.subplots()
    known = shared[np.isfinite(shared)]
    top = float(known.max()) if known.size and known.max() > 0 else 1.0
    floor = top * 10.0**-decades
    image = panel.imshow(
        np.maximum(shared, floor).T, cmap=_colours("magma"), norm=LogNorm(floor, top), aspect="auto", origin="lower",
        interpolation="nearest", extent=(rate_axis.start, rate_axis.end, axis.start_opl, axis.end_opl),
    )  # fmt: skip
    panel.set_xlabel("rate of the optical path length (m/s)")
    panel.set_ylabel("optical path length (m)")
    panel.secondary_xaxis("top", functions=(_to_approach, _to_rate)).set_xlabel("speed of approach (m/s)")
    panel.secondary_yaxis("right", functions=(_to_distance, _to_length)).set_ylabel("distance (m)")
    figure.colorbar(image, ax=panel, shrink=0.85, pad=0.02, label="light in a bin")
    if title:
        figure.suptitle(title, fontsize=11)
    return save_figure(figure, path, me)


def speed_picture(
    source: Source,
    path: str | Path | None = None,
    *,
    rate_axis: RateAxis | None = None,
    reading: str = "mean",
    limit: float | None = None,
    title: str = "",
) -> Figure:
    """A matplotlib figure of the speed of approach of every pixel: blue comes nearer, red goes away, white stands.

    Args:
        source: light (C, R, T, H, W), or a result or its file that has it as ``rates``: the speed is
            minus half the rate; or speeds (H, W) or (1, H, W) in m/s, as `sensing.range_and_speed` finds them.
        path: file to write the figure to.
        rate_axis: axis of R; None takes that of the result, ``rate_axis``.
        reading: "mean", the mean rate of a pixel's light, or "peak", the rate of its brightest bin, all lengths added
            up.
        limit: end of the symmetric scale, m/s; None for where 99 % of the pixels are.
        title: text above the picture.

    Pixels without light or speed are grey.

    Raises:
        ShapeError: for other shapes, and a rate axis that does not fit or is not known.
        ArgumentError: for another reading.
        UnitError: unless the limit is positive.
        StorageError: when the figure cannot be written.
    """
    me = "speed_picture"
    if not is_one_of(reading, READINGS):
        raise ArgumentError(f"{me}: expected a reading out of {', '.join(READINGS)}, got {shown(reading)}.")
    speeds = _speeds(source, rate_axis, reading, me)
    end = colour_maps.symmetric_limit(speeds) if limit is None else checked_positive("limit", limit, me)
    figure, (panel,) = picture_figure(speeds.shape[0], speeds.shape[1], side=4.6)
    image = panel.imshow(speeds, cmap=_colours("RdBu"), vmin=-end, vmax=end, interpolation="nearest")
    outside = np.abs(speeds[np.isfinite(speeds)]) > end
    extend = "both" if outside.any() else "neither"
    figure.colorbar(image, ax=panel, shrink=0.85, label="speed of approach (m/s)", extend=extend)
    panel.set_title(title, fontsize=10)
    return save_figure(figure, path, me)


def _speeds(source: Source, rate_axis: RateAxis | None, reading: str, who: str) -> NDArray[np.float64]:
    """Speeds of approach (H, W), NaN without light."""
    if getattr(source, "rates", None) is None:
        given = as_tensor(source, who)
        if given.ndim == 2 or (given.ndim == 3 and given.shape[0] == 1):
            if given.is_complex() or not given.numel():
                raise ShapeError(f"{who}: expected speeds (H, W) in m/s, got {given.dtype} {tuple(given.shape)}.")
            return given.double().reshape(given.shape[-2:]).numpy()
    light, _, axis = _rates_of(source, None, rate_axis, who)
    spectrum = light.sum(1)
    total = spectrum.sum(0)
    if reading == "peak":
        rate = axis.centers[spectrum.argmax(0)]
    else:
        rate = torch.einsum("rhw,r->hw", spectrum, axis.centers) / torch.where(total > 0, total, 1.0)
    return torch.where(total > 0, -rate / 2, torch.nan).numpy()


def _rates_of(
    source: Source, axis: TimeAxis | None, rate_axis: RateAxis | None, who: str
) -> tuple[Tensor, TimeAxis | None, RateAxis]:
    """Light (R, T, H, W), float64, channels added up, and its axes."""
    if isinstance(source, str | Path):
        source = read_rates(Path(source))
    held = getattr(source, "rates", None)
    if held is not None:
        axis = getattr(source, "axis", None) if axis is None else axis
        rate_axis = getattr(source, "rate_axis", None) if rate_axis is None else rate_axis
    light = as_tensor(source if held is None else held, who)
    if light.ndim != 5 or light.is_complex() or not light.numel():
        raise ShapeError(
            f"{who}: expected light over rates and lengths (C, R, T, H, W), got {tuple(light.shape)}; of a batch, "
            "choose one entry."
        )
    if rate_axis is None:
        raise ShapeError(f"{who}: light over {light.shape[1]} rates needs rate_axis=RateAxis(...) to have speeds.")
    of_class(f"{who}: rate_axis", rate_axis, RateAxis)
    if axis is not None:
        of_class(f"{who}: axis", axis, TimeAxis)
    bins = light.shape[2] if axis is None else axis.num_bins
    if tuple(light.shape[1:3]) != (rate_axis.num_bins, bins):
        raise ShapeError(
            f"{who}: expected light (C, {rate_axis.num_bins}, {bins}, H, W) as the axes have it, got "
            f"{tuple(light.shape)}."
        )
    return light.double().sum(0), axis, rate_axis


def _colours(name: str) -> Any:
    figure_type()
    import matplotlib

    return matplotlib.colormaps[name].with_extremes(bad=(0.5, 0.5, 0.5))


def _to_approach(rate: Any) -> Any:
    return -np.asarray(rate) / 2


def _to_rate(approach: Any) -> Any:
    return -2 * np.asarray(approach)


def _to_distance(opl: Any) -> Any:
    return np.asarray(opl) / 2


def _to_length(distance: Any) -> Any:
    return 2 * np.asarray(distance)
