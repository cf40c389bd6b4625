"""Light over the rates of its paths: range-Doppler maps."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from torch import Tensor

from torchtransient.axes import RateAxis, TimeAxis
from torchtransient.checks import positive
from torchtransient.errors import ShapeError
from torchtransient.vis.files import figure_type, grey_where_broken, save_figure
from torchtransient.vis.sources import Source, as_tensor, pixel_of, read_any

if TYPE_CHECKING:
    from matplotlib.figure import Figure


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
    """Draw light over the rate and the length of its paths, brightness on a logarithmic scale.

    Rates run to the right, lengths upwards; the other edges have the speed of approach, half the rate with its sign
    changed, and the distance, half the length, of targets seen from beside the light.

    Args:
        source: light (C, R, T, H, W), or a result or its file that has it as ``rates``; channels are added up.
        path: file to write the figure to.
        axis, rate_axis: axes of T and R; None takes those of the result, ``axis`` and ``rate_axis``.
        pixel: pixel (row, column); None for the mean over all pixels.
        decades: powers of ten from the brightest bin to the darkest colour.
        title: text above the figure.

    Returns:
        The matplotlib figure.

    Raises:
        ShapeError: for other shapes, axes that do not fit or are not known, a pixel outside.
        UnitError: unless ``decades`` is positive.
        StorageError: when the figure cannot be written.
    """
    me = "range_doppler"
    light, axis, rate_axis = _rates_of(source, axis, rate_axis, me)
    decades = positive(f"{me}: decades", decades)
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
        np.maximum(shared, floor).T, cmap=grey_where_broken("magma"), norm=LogNorm(floor, top), aspect="auto",
        origin="lower", interpolation="nearest",
        extent=(rate_axis.start, rate_axis.end, axis.start_opl, axis.end_opl),
    )  # fmt: skip
    panel.set_xlabel("rate of the optical path length (m/s)")
    panel.set_ylabel("optical path length (m)")
    approach = (lambda rate: -np.asarray(rate) / 2, lambda speed: -2 * np.asarray(speed))
    panel.secondary_xaxis("top", functions=approach).set_xlabel("speed of approach (m/s)")
    distance = (lambda opl: np.asarray(opl) / 2, lambda far: 2 * np.asarray(far))
    panel.secondary_yaxis("right", functions=distance).set_ylabel("distance (m)")
    figure.colorbar(image, ax=panel, shrink=0.85, pad=0.02, label="light in a bin")
    if title:
        figure.suptitle(title, fontsize=11)
    return save_figure(figure, path, me)


def _rates_of(
    source: Source, axis: TimeAxis | None, rate_axis: RateAxis | None, who: str
) -> tuple[Tensor, TimeAxis, RateAxis]:
    """Return light (R, T, H, W), float64, channels added up, and its axes."""
    if isinstance(source, str | Path):
        source = read_any(Path(source))
    held = getattr(source, "rates", source)
    if held is None:
        raise ShapeError(
            f"{who}: expected light by rates, got a result without; render with rates=tt.RateAxis(...). Beats are read "
            "by tt.sensing.range_and_speed."
        )
    axis = getattr(source, "axis", None) if axis is None else axis
    rate_axis = getattr(source, "rate_axis", None) if rate_axis is None else rate_axis
    if axis is None or rate_axis is None:
        raise ShapeError(f"{who}: light without its own axes needs axis=TimeAxis(...) and rate_axis=RateAxis(...).")
    light = as_tensor(held, who)
    if light.ndim != 5 or light.is_complex() or tuple(light.shape[1:3]) != (rate_axis.num_bins, axis.num_bins):
        raise ShapeError(
            f"{who}: expected light (C, {rate_axis.num_bins}, {axis.num_bins}, H, W) as the axes have it, got "
            f"{tuple(light.shape)}; of a batch, choose one entry."
        )
    return light.double().sum(0), axis, rate_axis
