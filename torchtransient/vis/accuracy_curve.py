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


@dataclass(frozen=True)
class Curve:
    """One line of the picture. The three lists have equal length; `seconds` and errors that are not positive are left
    out."""

    quantity: str
    label: str
    spp: Sequence[float]
    seconds: Sequence[float]
    squared_relative_error: Sequence[float]


def plot_accuracy(curves: Sequence[Curve], path: str | Path) -> None:
    """Write a log-log PNG: squared relative error against seconds (left) and samples per pixel (right), a row per
    quantity.

    A dashed guide of slope -1 starts at the first point of the first curve: independent samples fall along it.
    Raises ShapeError without curves and StorageError when `path` cannot be written. Needs matplotlib (extra `vis`).
    """
    from matplotlib.figure import Figure

    if not curves:
        raise ShapeError("plot_accuracy: expected at least one curve, got none")
    quantities = list(dict.fromkeys(curve.quantity for curve in curves))
    figure = Figure(figsize=(10.0, 3.6 * len(quantities) + 0.4), layout="constrained")
    axes = figure.subplots(len(quantities), 2, squeeze=False, sharey="row")
    for row, quantity in zip(axes, quantities, strict=True):
        lines = [curve for curve in curves if curve.quantity == quantity]
        for axis, unit in zip(row, ("seconds", "spp"), strict=True):
            _draw(axis, lines, unit)
        row[0].set_title(quantity, loc="left", fontsize=10)
        row[0].set_ylabel("squared relative error")
        row[1].legend(fontsize=8, frameon=False)
    for axis, label in zip(axes[-1], ("seconds per render", "samples per pixel"), strict=True):
        axis.set_xlabel(label)
    save_figure(figure, path, "plot_accuracy", dpi=100)


def _draw(axis: Any, lines: Sequence[Curve], unit: str) -> None:
    """One panel: the curves over `unit` ("seconds" or "spp") and the guide."""
    from matplotlib.ticker import NullFormatter

    starts, ends = [], []
    for i, curve in enumerate(lines):
        x = np.asarray(getattr(curve, unit), dtype=np.float64)
        y = np.asarray(curve.squared_relative_error, dtype=np.float64)
        good = (x > 0) & (y > 0)
        if good.any():
            starts.append((x[good][0], y[good][0]))
            ends.append(x[good].max())
        axis.plot(x[good], y[good], marker="osD^v<>P"[i % 8], markersize=4, linewidth=1.2, label=curve.label)
    if starts:
        x0, y0 = starts[0]
        x1 = max(*ends, 2 * x0)
        axis.plot([x0, x1], [y0, y0 * x0 / x1], color="0.5", linestyle="--", linewidth=0.8, label="slope -1")
    axis.set_xscale("log")
    if starts:
        axis.set_yscale("log")
    else:
        axis.text(0.5, 0.5, "no error", transform=axis.transAxes, ha="center", va="center", color="0.5")
        axis.set_yticks([])
    axis.grid(True, which="major", color="0.9", linewidth=0.6)
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
