"""Still pictures of a render: overview, arrival times, time as hue, streaks, moments, histograms, gradients."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchtransient.axes import TimeAxis
from torchtransient.checks import positive
from torchtransient.errors import ArgumentError, ShapeError, UnitError
from torchtransient.units import opl_to_seconds
from torchtransient.vis import colour_maps
from torchtransient.vis.files import Image, figure_type, picture_figure, save_figure, save_image, to_bytes
from torchtransient.vis.sources import Source, as_tensor, images_of, pixel_of, transient_of
from torchtransient.vis.tone_mapping import BROKEN, exposure_of, tone_map
from torchtransient.vis.videos import moment

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_ROWS_AT_ONCE = 32

# ------------------------------------------------------------------------------------------- when light arrives


def _light_curve(transient: Tensor) -> Tensor:
    """Return the share of a pixel's light that arrives in each bin, averaged over the pixels that see light.

    (T,) float64 of light (C, T, H, W); sums to 1, 0 without light.
    """
    total = torch.zeros(transient.shape[1], dtype=torch.float64, device=transient.device)
    lit = 0
    for part in _row_bands(transient):
        values = part.sum(0).clamp(min=0)
        energy = values.sum(0)
        seen = energy > 0
        lit += int(seen.sum())
        total += torch.where(seen, values / energy.where(seen, 1), 0).sum((1, 2), dtype=torch.float64)
    return total / max(lit, 1)


def peak_time(transient: Tensor, axis: TimeAxis) -> Tensor:
    """Return when most light (sum over channels) arrives at each pixel.

    Args:
        transient: transient (C, T, H, W), C = 1 or 3.
        axis: time axis of the transient.

    Returns:
        (H, W) float64, metres: centre of the brightest bin, the first of equal ones; NaN without light.

    Raises:
        ShapeError: for another shape, and another number of bins.
    """
    transient = _on_axis(transient, axis, "peak_time")
    centers = axis.centers_opl.to(transient.device)
    rows = []
    for part in _row_bands(transient):
        highest, index = part.sum(0).max(0)
        rows.append(torch.where(highest > 0, centers[index], torch.nan))
    return torch.cat(rows)


def _moments_of_arrival(transient: Tensor, shares: tuple[float, ...] = (0.1, 0.5, 0.9)) -> list[int]:
    """Return the bins by which rising shares of the light have arrived, different ones if they can be.

    Without any light, shares of the bins.
    """
    arrived = _light_curve(transient).cumsum(0)
    bins = arrived.numel()
    if not float(arrived[-1]) > 0:
        return [int(share * (bins - 1)) for share in shares]
    wanted = torch.tensor(shares, dtype=torch.float64, device=arrived.device) * arrived[-1]
    # Shares that are reached exactly at an edge must not depend on the last digit of a sum.
    found = [min(int(i), bins - 1) for i in torch.searchsorted(arrived, wanted - 1e-9)]
    for n in range(1, len(found)):
        found[n] = min(max(found[n], found[n - 1] + 1), bins - 1)
    return found


def _median_pixel(steady: Tensor) -> tuple[int, int]:
    """Return (row, column) of the pixel of median brightness among the lit ones: neither the lamp nor darkness."""
    brightness = steady.sum(0).flatten()
    order = brightness.argsort(stable=True)
    order = order[brightness[order] > 0] if bool((brightness > 0).any()) else order
    flat = int(order[(order.numel() - 1) // 2])
    return flat // steady.shape[-1], flat % steady.shape[-1]


def _row_bands(transient: Tensor) -> Iterator[Tensor]:
    """Yield parts of some rows: the sum over channels of a whole cube would take a third of its memory more."""
    for row in range(0, transient.shape[2], _ROWS_AT_ONCE):
        yield transient.detach()[:, :, row : row + _ROWS_AT_ONCE]


def _on_axis(given: Any, axis: TimeAxis, who: str) -> Tensor:
    transient = torch.as_tensor(given)
    if transient.ndim != 4 or transient.shape[0] not in (1, 3) or transient.shape[1] != axis.num_bins:
        raise ShapeError(
            f"{who}: expected a transient (C, {axis.num_bins}, H, W) with C = 1 or 3 and the bins of the axis, got "
            f"{tuple(transient.shape)}; of a batch, choose one."
        )
    return transient


# -------------------------------------------------------------------------------------------------- one page of all


def plot_overview(
    transient: Tensor,
    steady: Tensor,
    axis: TimeAxis,
    *,
    path: str | Path,
    pixel: tuple[int, int] | None = None,
    title: str = "",
    errors: Tensor | None = None,
) -> Figure:
    """Draw a render on one page: steady image, time of the peak, three moments, the histogram of a pixel.

    Args:
        transient: transient (C, T, H, W), C = 1 or 3 in linear sRGB.
        steady: steady image (C, H, W). Each image has its own exposure.
        axis: time axis.
        path: file to write the picture to.
        pixel: pixel (row, column); None for one of median brightness.
        title: text above the picture.
        errors: standard errors (T, H, W), the ``error_map`` of a render with ``errors=``: a band of two standard errors
            around the mean over channels in the histogram.

    Returns:
        The matplotlib figure.

    Raises:
        ShapeError: for other shapes or a pixel outside.
        StorageError: when the file cannot be written.
        MissingPackageError: without matplotlib (extra ``vis``).
    """
    transient, steady = _on_axis(transient, axis, "plot_overview"), torch.as_tensor(steady)
    size = (transient.shape[-2], transient.shape[-1])
    if steady.shape != (len(transient), *size) or (errors is not None and errors.shape != transient.shape[1:]):
        raise ShapeError(
            f"plot_overview: expected steady (C, H, W) and errors (T, H, W) of the transient {tuple(transient.shape)}, "
            f"got {tuple(steady.shape)} and {None if errors is None else tuple(errors.shape)}."
        )
    pixel = pixel_of(_median_pixel(steady) if pixel is None else pixel, size, "plot_overview")
    figure = figure_type()(figsize=(12.0, 7.4), layout="constrained")
    upper, lower = figure.subfigures(2, 1, squeeze=False).flat
    panels = upper.subplots(1, 3)
    _draw_steady(panels[0], steady, pixel)
    _draw_peak_time(upper, panels[1], transient, axis)
    _draw_histogram(panels[2], transient, axis, pixel, errors)
    for panel, index in zip(lower.subplots(1, 3), _moments_of_arrival(transient), strict=True):
        panel.imshow(tone_map(transient[:, index].cpu()).numpy(), interpolation="nearest")
        opl, time_s = float(axis.centers_opl[index]), float(axis.centers_s[index])
        panel.set_title(f"{opl:.3f} m = {time_s * 1e9:.3f} ns (bin {index})", fontsize=10)
        panel.set_axis_off()
    if title:
        figure.suptitle(title, fontsize=11)
    return save_figure(figure, path, "plot_overview")


def _draw_steady(panel: Any, steady: Tensor, pixel: tuple[int, int]) -> None:
    panel.imshow(tone_map(steady.cpu()).numpy(), interpolation="nearest")
    panel.plot(pixel[1], pixel[0], marker="o", markersize=9, markerfacecolor="none", color="deepskyblue")
    panel.set_title("steady", fontsize=10)
    panel.set_axis_off()


def _draw_peak_time(figure: Any, panel: Any, transient: Tensor, axis: TimeAxis) -> None:
    image = panel.imshow(peak_time(transient, axis).cpu().numpy(), interpolation="nearest", cmap="viridis")
    figure.colorbar(image, ax=panel, label="optical path length (m)", shrink=0.85)
    panel.set_title("time of the peak", fontsize=10)
    panel.set_axis_off()


def _draw_histogram(
    panel: Any, transient: Tensor, axis: TimeAxis, pixel: tuple[int, int], errors: Tensor | None
) -> None:
    values = transient[:, :, pixel[0], pixel[1]].detach().cpu().numpy()
    if errors is not None:
        band, mean = 2 * torch.as_tensor(errors)[:, pixel[0], pixel[1]].detach().cpu().numpy(), values.mean(0)
        edges = axis.edges_opl.numpy()
        panel.stairs(mean + band, edges, baseline=mean - band, fill=True, color="0.85")
        label = "mean over channels, 2 standard errors of its cell"
        panel.stairs(mean, edges, color="0.4", linewidth=0.8, label=label)
        panel.legend(fontsize=8, frameon=False)
    for curve, colour in zip(values, _line_colours(len(values)), strict=True):
        panel.stairs(curve, axis.edges_opl.numpy(), color=colour, linewidth=1.0)
    panel.set_xlabel("optical path length (m)")
    panel.set_ylabel("radiance in a bin")
    panel.set_title(f"pixel at row {pixel[0]}, column {pixel[1]}", fontsize=10)
    panel.margins(x=0)


# ----------------------------------------------------------------------------------------------- time as a colour


def peak_time_picture(
    source: Source,
    path: str | Path | None = None,
    *,
    axis: TimeAxis | None = None,
    title: str = "",
) -> Figure:
    """Draw the :func:`peak_time` of every pixel, with a colour bar in metres and in nanoseconds.

    The scale holds 98 % of the pixels.

    Args:
        source, axis: transient, or a result or file that has one, and its time axis, see ``frames``.
        path: file to write the figure to.
        title: text above the picture.

    Returns:
        The matplotlib figure. Pixels without light are grey.

    Raises:
        ShapeError: for other shapes, and without an axis.
        StorageError: when the figure cannot be written.
    """
    cube, axis = transient_of(source, axis, "peak_time_picture")
    if axis is None:
        raise ShapeError(
            f"peak_time_picture: a transient of {cube.shape[1]} bins without an axis has no times. Give "
            "axis=TimeAxis(...), or a RenderOutput, which knows its own."
        )
    peaks = peak_time(torch.nan_to_num(cube, posinf=0.0, neginf=0.0), axis).numpy()
    low, high = _limits(peaks, axis)
    figure, (panel,) = picture_figure(peaks.shape[0], peaks.shape[1], side=5.0)
    panel.set_facecolor("0.6")
    panel.set_axis_on()
    panel.set_xticks([])
    panel.set_yticks([])
    image = panel.imshow(peaks, cmap="viridis", vmin=low, vmax=high, interpolation="nearest")
    panel.set_title(title or "arrival of the peak", fontsize=10)
    _bar_in_metres_and_nanoseconds(figure, image, panel, low, high)
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
    """Draw when light arrives as hue, red is early and violet late, and how much as brightness.

    Args:
        source, axis: transient, or a result or file that has one, and its time axis, see ``frames``. Without an axis,
            lengths are counted in bins.
        path: file to write the image to.
        style: "peak" gives every pixel the hue of its :func:`peak_time`; "fusion" adds up the light of all bins, each
            in its own hue, so that early and late light mix as coloured lamps do.
        limits: lengths over which hues run once, metres; None for where 1 % to 99 % of the light arrives.
        period_opl: metres after which hues repeat, which draws lines of equal time.
        exposure: factor of the sum over channels before the sRGB curve; None makes 5 % of the pixels white.

    Returns:
        RGB (H, W, 3) uint8. Pixels that are not finite are magenta.

    Raises:
        ArgumentError: for another style.
        ShapeError: for other shapes.
        UnitError: for limits that do not rise, and a period or an exposure that is not positive.
        StorageError: when the image cannot be written.
    """
    cube, axis = transient_of(source, axis, "rainbow")
    axis = axis or TimeAxis(0.0, 1.0, cube.shape[1])
    steady = cube.sum((0, 1))
    broken = ~torch.isfinite(steady).numpy()
    cube = torch.nan_to_num(cube, posinf=0.0, neginf=0.0)
    image = torch.nan_to_num(steady, nan=0.0, posinf=0.0, neginf=0.0)[None]
    level = tone_map(image, exposure_of(image, 0.95) if exposure is None else exposure)[..., 0].numpy()
    low, high = _arrival_limits(cube, axis) if limits is None else limits
    if not low < high:
        raise UnitError(f"rainbow: expected limits in metres, the first below the second, got {limits!r}.")
    if style == "peak":
        colours = colour_maps.rainbow(_hue(peak_time(cube, axis).numpy(), low, high, period_opl), level)
    elif style == "fusion":
        colours = _fused(cube, _hue(axis.centers_opl.numpy(), low, high, period_opl), level)
    else:
        raise ArgumentError(f"rainbow: expected style 'peak' or 'fusion', got {style!r}.")
    colours[broken] = BROKEN
    return save_image(to_bytes(colours), path, "rainbow")


def _bar_in_metres_and_nanoseconds(figure: Any, image: Any, panel: Any, low: float, high: float) -> None:
    """Draw a colour bar with metres on its right and nanoseconds on its left."""
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
    period = positive("rainbow: period_opl", period)
    return np.asarray(np.mod((opl - low) / period, 1.0))


def _fused(cube: Tensor, hues: NDArray[np.float64], level: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return linear colours of the bins, mixed with their share of a pixel's light and brought to its brightness."""
    colours = torch.from_numpy(_to_linear(colour_maps.rainbow(hues)))
    values = cube.sum(0).clamp(min=0)
    share = values / values.sum(0).clamp(min=torch.finfo(values.dtype).tiny)
    mixed = torch.einsum("thw,tc->hwc", share.double(), colours)
    shown = tone_map(mixed.permute(2, 0, 1), exposure=1.0).numpy()
    return np.asarray(shown * level[..., None])


def _to_linear(shown: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4))


def _limits(peaks: NDArray[np.float64], axis: TimeAxis) -> tuple[float, float]:
    known = peaks[np.isfinite(peaks)]
    if not known.size:
        return axis.start_opl, axis.end_opl
    low, high = np.percentile(known, [1, 99])
    return float(low), float(max(high, low + axis.bin_width_opl))


def _arrival_limits(cube: Tensor, axis: TimeAxis) -> tuple[float, float]:
    arrived = _light_curve(cube).cumsum(0)
    if not float(arrived[-1]) > 0:
        return axis.start_opl, axis.end_opl
    edges = torch.searchsorted(arrived / arrived[-1], torch.tensor([0.01, 0.99], dtype=torch.float64))
    first, last = (axis.start_opl + float(k) * axis.bin_width_opl for k in edges)
    return first, last + axis.bin_width_opl


# ------------------------------------------------------------------------------------ cuts, moments and histograms


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
    """Draw one row or column of pixels over time, as a streak camera sees it, time downwards.

    Args:
        source, axis: transient, or a result or file that has one, and its time axis, see ``frames``.
        path: file to write the figure to.
        row, column: index of the row or of the column, one of both; None for the middle row.
        exposure, curve: factor before the tone curve and its name, see ``tone_map``; "log" shows the front and weak
            light behind it.

    Returns:
        The matplotlib figure.

    Raises:
        ArgumentError: for a row and a column.
        ShapeError: for other shapes and a line outside of the image.
        StorageError: when the figure cannot be written.
    """
    cube, axis = transient_of(source, axis, "streak")
    if row is not None and column is not None:
        raise ArgumentError("streak: expected row or column, got both.")
    what, given, dim = ("row", row, 2) if column is None else ("column", column, 3)
    number = cube.shape[dim] // 2 if given is None else given
    if not -cube.shape[dim] <= number < cube.shape[dim]:
        raise ShapeError(f"streak: {what} {number} lies outside of an image of {cube.shape[2]} x {cube.shape[3]}.")
    number %= cube.shape[dim]
    line = cube.select(dim, number)
    picture = tone_map(line, exposure_of(line, 0.999) if exposure is None else exposure, curve).numpy()
    figure = figure_type()(figsize=(6.2, 5.2), layout="constrained")
    panel = figure.subplots()
    pixels = line.shape[2]
    start, end = (0.0, float(cube.shape[1])) if axis is None else (axis.start_opl, axis.end_opl)
    panel.imshow(picture, aspect="auto", interpolation="nearest", extent=(-0.5, pixels - 0.5, end, start))
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
    """Draw moments beside each other, each with its time.

    Args:
        source, axis: transient, or a result or file that has one, and its time axis, see ``frames``.
        path: file to write the figure to.
        bins: bins that are shown; None takes ``count`` moments between which equal shares of the light arrive.
        count: number of moments.
        columns: most moments in a row.
        exposure: factor for all moments; None gives each its own, for late light is far weaker than early light.
        curve: tone curve, "srgb", "gamma", "linear" or "log", see ``tone_map``.
        title: text above the figure.

    Returns:
        The matplotlib figure.

    Raises:
        ShapeError: for other shapes, and bins outside of the axis.
        StorageError: when the figure cannot be written.
    """
    cube, axis, word = images_of(source, axis, "frame_grid")
    total = cube.shape[1]
    if bins is None:
        shares = tuple(float(s) for s in (np.arange(count) + 0.5) / count)
        bins = _moments_of_arrival(cube.nan_to_num(posinf=0.0, neginf=0.0), shares)
    if not all(0 <= index < total for index in bins):
        raise ShapeError(f"frame_grid: expected bins from 0 to {total - 1}, got {list(bins)}.")
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
) -> Figure:
    """Draw light over time of some pixels, a panel each.

    Args:
        source, axis: transient, or a result or file that has one, and its time axis, see ``frames``. Of any number of
            channels: three are red, green and blue lines, one is black, others go from violet to yellow.
        path: file to write the figure to.
        pixels: pixels (row, column).
        log: take a logarithmic scale.

    Returns:
        The matplotlib figure.

    Raises:
        ShapeError: for a pixel outside of the image.
        StorageError: when the figure cannot be written.
    """
    cube, axis, word = images_of(source, axis, "histogram", any_channels=True)
    height, width = cube.shape[2:]
    pixels = [pixel_of(pixel, (height, width), "histogram") for pixel in pixels]
    figure = figure_type()(figsize=(7.0, 0.5 + 2.1 * len(pixels)), layout="constrained")
    panels = figure.subplots(len(pixels), 1, sharex=True, squeeze=False)[:, 0]
    edges = np.arange(cube.shape[1] + 1) if axis is None else axis.edges_opl.numpy()
    for panel, (row, column) in zip(panels, pixels, strict=True):
        curves = cube[:, :, row, column].numpy()
        colours = _line_colours(len(curves))
        # On a logarithmic scale an empty bin is a gap, not a line down to the frame.
        drawn = np.where(curves > 0, curves, np.nan) if log and bool((curves > 0).any()) else curves
        for curve, colour in zip(drawn, colours, strict=True):
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


# -------------------------------------------------------------------------------------------------------- gradients


def gradient_picture(gradient: Source, path: str | Path | None = None, *, label: str = "", title: str = "") -> Figure:
    """Draw a gradient, summed over channels: blue is negative, white zero, red positive.

    The symmetric scale ends where 99 % of the pixels are, so that some noisy ones do not hide the others.

    Args:
        gradient: gradient (C, H, W) or (H, W): the numbers themselves, not a tensor that has them as ``.grad``.
        path: file to write the figure to.
        label: text at the colour bar.
        title: text above the figure.

    Returns:
        The matplotlib figure. Pixels that are not finite are green.

    Raises:
        ShapeError: for other shapes.
        StorageError: when the figure cannot be written.
    """
    values = as_tensor(gradient, "gradient_picture")
    if values.ndim == 2:
        values = values[None]
    if values.ndim != 3 or values.is_complex():
        raise ShapeError(f"gradient_picture: expected real (C, H, W) or (H, W), got {tuple(values.shape)}.")
    image = values.double().sum(0).numpy()
    limit = colour_maps.symmetric_limit(image)
    figure, (panel,) = picture_figure(image.shape[0], image.shape[1], side=4.4)
    import matplotlib

    colours = matplotlib.colormaps["RdBu_r"].with_extremes(bad="limegreen")
    drawn = panel.imshow(image, cmap=colours, vmin=-limit, vmax=limit, interpolation="nearest")
    panel.set_title(title, fontsize=10)
    extend = "both" if (np.abs(image[np.isfinite(image)]) > limit).any() else "neither"
    figure.colorbar(drawn, ax=[panel], shrink=0.85, label=label, extend=extend)
    return save_figure(figure, path, "gradient_picture")
