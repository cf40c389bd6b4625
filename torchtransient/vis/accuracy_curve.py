"""Error against time and samples, as a picture."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from torchtransient.errors import ShapeError
from torchtransient.vis.files import save_figure

# Okabe and Ito, "Color Universal Design" (2008), without yellow and black, which lines on white and fronts need.
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00")
_MARKERS, _OTHERS, _GUIDE, _FRONT = "osD^v<", "0.75", "0.5", "0.15"


@dataclass(frozen=True)
class Curve:
    """One line of the picture. Its lists have equal length; `seconds` and errors that are not positive are left out.

    `squared_relative_error`: that of the noise, at each point. `band`: its interval at each point, None for none.
    `total`, `total_band`: the same with the bias, None where it is not known. `slope`: slope of the line through the
    logarithms, and its error. `on_front`: points of the Pareto front.
    """

    quantity: str
    label: str
    spp: Sequence[float]
    seconds: Sequence[float]
    squared_relative_error: Sequence[float]
    band: Sequence[tuple[float, float]] | None = None
    total: Sequence[float] | None = None
    total_band: Sequence[tuple[float, float]] | None = None
    slope: tuple[float, float] | None = None
    on_front: Sequence[bool] = ()


def plot_accuracy(curves: Sequence[Curve], path: str | Path) -> None:
    """Write a log-log PNG of squared relative errors, a row per quantity.

    On the left with the bias, where it is known, and the Pareto front against seconds, on the right of the noise
    against samples per pixel. A dashed guide of slope -1 starts at the first point of the first curve: independent
    samples fall along it. Of more than six curves those on the front have colours, the first ones where there is none.

    Args:
        curves: the lines.
        path: file to write the picture to.

    Raises:
        ShapeError: without curves.
        StorageError: when it cannot be written.
    """
    from matplotlib.figure import Figure

    if not curves:
        raise ShapeError("plot_accuracy: expected at least one curve, got none")
    quantities = list(dict.fromkeys(curve.quantity for curve in curves))
    figure = Figure(figsize=(12.0, 3.6 * len(quantities) + 0.4), layout="constrained")
    axes = figure.subplots(len(quantities), 2, squeeze=False, sharey="row")
    for row, quantity in zip(axes, quantities, strict=True):
        lines = [curve for curve in curves if curve.quantity == quantity]
        for axis, unit in zip(row, ("seconds", "spp"), strict=True):
            _draw(axis, lines, unit)
        _limit(row[0])
        row[0].set_title(quantity, loc="left", fontsize=10)
        row[0].set_ylabel("squared relative error")
        if any(curve.total is not None for curve in lines):
            row[0].set_title("noise and bias", loc="right", fontsize=9, color="0.4")
            row[1].set_title("noise alone", loc="right", fontsize=9, color="0.4")
        shown = [line for line in row[1].lines if not line.get_label().startswith("_")]
        shown.sort(key=lambda line: line.get_color() in (_OTHERS, _GUIDE))
        front = [line for line in row[0].lines if line.get_label() == "Pareto front"]
        row[1].legend(handles=shown + front, fontsize=8, frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    for axis, label in zip(axes[-1], ("seconds per render", "samples per pixel"), strict=True):
        axis.set_xlabel(label)
    save_figure(figure, path, "plot_accuracy", dpi=100)


def _limit(axis: Any) -> None:
    """Show the points of a row: a band that is not known may be any size."""
    axes = axis.get_shared_y_axes().get_siblings(axis)
    points = [np.asarray(line.get_ydata()) for each in axes for line in each.lines if line.get_color() != _GUIDE]
    values = np.concatenate(points) if points else np.empty(0)
    if values.size:
        axis.set_ylim(values.min() / 4.0, values.max() * 4.0)


def _colours(lines: Sequence[Curve]) -> dict[int, int]:
    """Numbers of colours by number of the curve; curves without one are grey."""
    if len(lines) <= len(_COLOURS):
        return {i: i for i in range(len(lines))}
    on_front = [i for i, curve in enumerate(lines) if any(curve.on_front)]
    return {i: n for n, i in enumerate((on_front or list(range(len(lines))))[: len(_COLOURS)])}


def _draw(axis: Any, lines: Sequence[Curve], unit: str) -> None:
    """One panel: the curves over `unit` ("seconds" or "spp"), the guide and the front."""
    from matplotlib.ticker import NullFormatter

    starts, ends, front = [], [], []
    colours, hidden = _colours(lines), False
    look: dict[str, Any]
    for i, curve in enumerate(lines):
        x = np.asarray(getattr(curve, unit), dtype=np.float64)
        with_bias = unit == "seconds" and curve.total is not None
        values, band = (curve.total, curve.total_band) if with_bias else (curve.squared_relative_error, curve.band)
        y = np.asarray(values, dtype=np.float64)
        good = (x > 0) & (y > 0)
        if good.any():
            starts.append((x[good][0], y[good][0]))
            ends.append(x[good].max())
        front += [(x[k], y[k]) for k, held in enumerate(curve.on_front) if held and good[k]]
        colour, alpha = _OTHERS, 0.1
        if i in colours:
            colour, alpha, slope = _COLOURS[colours[i]], 0.18, ""
            if curve.slope is not None and unit == "spp":
                slope = f"\nslope {curve.slope[0]:+.2f} ± {curve.slope[1]:.2f}".replace("-", "\N{MINUS SIGN}")
            look = {"marker": _MARKERS[colours[i]], "markersize": 4, "linewidth": 1.2, "label": curve.label + slope}
        else:
            look = {"linewidth": 0.8, "zorder": 1, "label": "_" if hidden else f"{len(lines) - len(colours)} others"}
            hidden = True
        axis.plot(x[good], y[good], color=colour, **look)
        if band is not None:
            low, high = np.asarray(band, dtype=np.float64)[good].T
            if unit == "spp":
                axis.fill_between(x[good], low, high, color=colour, alpha=alpha, linewidth=0)
            else:  # points of a curve need not follow each other in time
                axis.vlines(x[good], low, high, color=colour, alpha=2 * alpha, linewidth=3, zorder=1)
    if starts:
        x0, y0 = starts[0]
        x1 = max(*ends, 2 * x0)
        axis.plot([x0, x1], [y0, y0 * x0 / x1], color=_GUIDE, linestyle="--", linewidth=0.8, label="slope -1")
    if front and unit == "seconds":
        ordered = np.asarray(sorted(front))
        axis.plot(
            *ordered.T, color=_FRONT, linewidth=0.8, linestyle=":", drawstyle="steps-post", marker="o", markersize=9,
            markerfacecolor="none", label="Pareto front", zorder=3,
        )  # fmt: skip
    axis.set_xscale("log")
    if starts:
        axis.set_yscale("log")
    else:
        axis.text(0.5, 0.5, "no error", transform=axis.transAxes, ha="center", va="center", color="0.5")
        axis.set_yticks([])
    axis.grid(True, which="major", color="0.9", linewidth=0.6)
    axis.set_axisbelow(True)
    # Less than a decade would be labelled at every minor tick, one over the other.
    counts = np.unique(np.concatenate([np.asarray(getattr(curve, unit), dtype=np.float64) for curve in lines]))
    axis.xaxis.set_minor_formatter(NullFormatter())
    counts = counts[counts > 0]
    if not counts.size:
        return
    if unit == "spp":
        axis.set_xticks(counts, [f"{count:g}" for count in counts])
    else:
        low, high = math.log10(counts.min()), math.log10(counts.max())
        steps = [m * 10.0**e for e in range(math.floor(low), math.ceil(high) + 1) for m in (1, 2, 5)]
        ticks = [t for t in steps if counts.min() / 1.3 <= t <= counts.max() * 1.3]
        axis.set_xticks(ticks, [f"{t:g}" for t in ticks])
