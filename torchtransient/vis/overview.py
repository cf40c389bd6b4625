"""A transient on one page: steady image, arrival times, three moments, one pixel's histogram."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchtransient.axes import TimeAxis
from torchtransient.checks import check_folder, of_class
from torchtransient.errors import ShapeError, StorageError
from torchtransient.vis.files import figure_type, save_figure
from torchtransient.vis.sources import pixel_of, real_tensor
from torchtransient.vis.tone_mapping import tone_map

_NANOSECONDS = 1e9
_ROWS_AT_ONCE = 32


def light_curve(transient: Tensor) -> Tensor:
    """(T,) float64: when the light of a pixel arrives, averaged over the pixels; sums to 1, or is 0 without light.

    Every pixel that sees light counts alike, whether it sees the lamp itself or a dark corner. `transient` is
    (C, T, H, W), else ShapeError.
    """
    transient = _checked(transient, "light_curve")
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
    """(H, W) float64, metres: centre of the bin in which most light (sum over channels) arrives; NaN where none does.

    The first of equal bins counts. Raises ShapeError when the transient is not (C, T, H, W) with the axis' T.
    """
    transient = _on_axis(transient, axis, "peak_time")
    centers = axis.centers_opl.to(transient.device)
    rows = []
    for part in _row_bands(transient):
        highest, index = part.sum(0).max(0)
        rows.append(torch.where(highest > 0, centers[index], torch.nan))
    return torch.cat(rows)


def moments_of_arrival(transient: Tensor, shares: tuple[float, ...] = (0.1, 0.5, 0.9)) -> list[int]:
    """Indices of the bins by which the given shares of the `light_curve` have arrived; they differ if they can.

    Without any light they are spread evenly. Raises ShapeError when the transient is not (C, T, H, W).
    """
    arrived = light_curve(transient).cumsum(0)
    bins = arrived.numel()
    if not float(arrived[-1]) > 0:
        return [int(share * (bins - 1)) for share in shares]
    wanted = torch.tensor(shares, dtype=torch.float64, device=arrived.device) * arrived[-1]
    # Shares that are reached exactly at an edge must not depend on the last digit of a sum.
    found = [min(int(i), bins - 1) for i in torch.searchsorted(arrived, wanted - 1e-9)]
    for n in range(1, len(found)):
        found[n] = min(max(found[n], found[n - 1] + 1), bins - 1)
    return found


def median_pixel(steady: Tensor) -> tuple[int, int]:
    """(row, column) of the pixel of median brightness among those of a steady image (C, H, W) that see light.

    Neither the lamp nor a corner in the dark. Raises ShapeError for another shape.
    """
    steady = real_tensor(steady, "median_pixel")
    if steady.ndim != 3 or steady.numel() == 0:
        raise ShapeError(f"median_pixel: expected a steady image (C, H, W), got {tuple(steady.shape)}.")
    brightness = steady.sum(0).flatten()
    order = brightness.argsort(stable=True)
    order = order[brightness[order] > 0] if bool((brightness > 0).any()) else order
    flat = int(order[(order.numel() - 1) // 2])
    return flat // steady.shape[-1], flat % steady.shape[-1]


def _row_bands(transient: Tensor) -> Iterator[Tensor]:
    """Parts of some rows: the sum over channels of a whole cube would be a third of it once more."""
    for row in range(0, transient.shape[2], _ROWS_AT_ONCE):
        yield transient.detach()[:, :, row : row + _ROWS_AT_ONCE]


@dataclass(frozen=True)
class Overview:
    """What `plot_overview` draws beside the images: the moments shown (bins) and the pixel (row, column)."""

    frames: tuple[int, ...]
    pixel: tuple[int, int]


def plot_overview(
    transient: Tensor,
    steady: Tensor,
    axis: TimeAxis,
    *,
    path: str | Path,
    pixel: tuple[int, int] | None = None,
    title: str = "",
    errors: Tensor | None = None,
) -> Overview:
    """Write a picture (PNG, or what the ending says) of a render and return what it shows.

    `transient` (C, T, H, W) and `steady` (C, H, W), C = 1 or 3 in linear sRGB. `pixel` (row, column) defaults to the
    `median_pixel`. Each image has its own exposure. `errors` (T, H, W), the `error_map` of a render with `errors=`: a
    band of two standard errors around the mean over channels in the histogram of the pixel.

    Raises ShapeError for other shapes or a pixel outside, and StorageError when the file cannot be written. Needs
    matplotlib (extra `vis`).
    """
    transient, steady = _on_axis(transient, axis, "plot_overview"), real_tensor(steady, "plot_overview: steady")
    height, width = transient.shape[-2:]
    if tuple(steady.shape) != (transient.shape[0], height, width):
        expected = (transient.shape[0], height, width)
        raise ShapeError(f"plot_overview: expected steady of shape {expected}, got {tuple(steady.shape)}.")
    if errors is not None:
        errors = real_tensor(errors, "plot_overview: errors")
        if errors.shape != transient.shape[1:]:
            raise ShapeError(
                f"plot_overview: expected errors of shape {tuple(transient.shape[1:])}, got {tuple(errors.shape)}."
            )
    row, column = pixel_of(median_pixel(steady) if pixel is None else pixel, (height, width), "plot_overview")
    shown = Overview(tuple(moments_of_arrival(transient)), (row, column))
    figure = figure_type()(figsize=(12.0, 7.4), layout="constrained")
    upper, lower = figure.subfigures(2, 1, squeeze=False).flat
    panels = upper.subplots(1, 3)
    _draw_steady(panels[0], steady, shown.pixel)
    _draw_peak_time(upper, panels[1], transient, axis)
    _draw_histogram(panels[2], transient, axis, shown.pixel, errors)
    for panel, index in zip(lower.subplots(1, 3), shown.frames, strict=True):
        panel.imshow(tone_map(transient[:, index].cpu()).numpy(), interpolation="nearest")
        opl, time_s = float(axis.centers_opl[index]), float(axis.centers_s[index])
        panel.set_title(f"{opl:.3f} m = {time_s * _NANOSECONDS:.3f} ns (bin {index})", fontsize=10)
        panel.set_axis_off()
    if title:
        figure.suptitle(title, fontsize=11)
    save_figure(figure, path, "plot_overview")
    return shown


def check_picture(path: str | Path, who: str = "picture") -> None:
    """Raise StorageError when matplotlib could not write to `path`, MissingPackageError without it. For before a long
    render."""
    check_folder(path, who)
    figure_type()
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    endings = FigureCanvasAgg.get_supported_filetypes()
    if Path(path).suffix.lstrip(".").lower() not in endings:
        known = ", ".join(f".{ending}" for ending in sorted(endings))
        raise StorageError(f"{who}: expected a name that ends in .png, or another of {known}, got '{path}'.")


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
    panel: Any, transient: Tensor, axis: TimeAxis, pixel: tuple[int, int], errors: Tensor | None = None
) -> None:
    values = transient[:, :, pixel[0], pixel[1]].detach().cpu().numpy()
    if errors is not None:
        band, mean = 2 * errors[:, pixel[0], pixel[1]].detach().cpu().numpy(), values.mean(0)
        edges = axis.edges_opl.numpy()
        panel.stairs(mean + band, edges, baseline=mean - band, fill=True, color="0.85")
        label = "mean over channels, 2 standard errors of its cell"
        panel.stairs(mean, edges, color="0.4", linewidth=0.8, label=label)
        panel.legend(fontsize=8, frameon=False)
    colours = ("tab:red", "tab:green", "tab:blue") if len(values) == 3 else ("black",)
    for curve, colour in zip(values, colours, strict=True):
        panel.stairs(curve, axis.edges_opl.numpy(), color=colour, linewidth=1.0)
    panel.set_xlabel("optical path length (m)")
    panel.set_ylabel("radiance in a bin")
    panel.set_title(f"pixel at row {pixel[0]}, column {pixel[1]}", fontsize=10)
    panel.margins(x=0)


def _checked(given: Any, who: str) -> Tensor:
    transient = real_tensor(given, who)
    if transient.ndim != 4 or transient.shape[0] not in (1, 3) or transient.numel() == 0:
        raise ShapeError(
            f"{who}: expected a transient (C, T, H, W) with C = 1 or 3, got {tuple(transient.shape)}; of a batch, "
            "choose one."
        )
    return transient


def _on_axis(given: Any, axis: Any, who: str) -> Tensor:
    transient = _checked(given, who)
    if transient.shape[1] != of_class(f"{who}: axis", axis, TimeAxis).num_bins:
        raise ShapeError(
            f"{who}: expected a transient with T = {axis.num_bins} bins as its axis has, got {transient.shape[1]}."
        )
    return transient
