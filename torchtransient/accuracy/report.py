"""What accuracy costs, as a table, a picture and a file."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from torchtransient.accuracy.errors_of_estimates import TAIL_RUNS, Tail
from torchtransient.accuracy.statistics import Slope, log_log_slope
from torchtransient.array_files.part_files import write_text


@dataclass(frozen=True)
class Choice:
    """What is compared: a sampler and a temporal filter, both by their plugin names."""

    sampler: str
    temporal_filter: str

    def __str__(self) -> str:
        return f"{self.sampler}, {self.temporal_filter}" if self.temporal_filter else self.sampler


@dataclass(frozen=True)
class CostPoint:
    """One point of a curve.

    `quantity`: "transient", "phasor" or the key of a gradient. `spp`: samples per pixel really drawn. `seconds`: median
    wall time of one run (forward for values, forward and backward for gradients). The errors are those of
    `ErrorEstimate`. `tail`: of a gradient, the tail of its distribution; where it is heavy the errors are NaN.
    """

    choice: Choice
    quantity: str
    spp: int
    seconds: float
    squared_error: float
    squared_error_standard_error: float
    relative_error: float
    median_bin_error: float
    repeats: int
    tail: Tail | None = None


@dataclass
class AccuracyReport:
    """Error against seconds and samples for every quantity and choice. Made by `cost_of_accuracy`."""

    points: list[CostPoint]
    method: str
    settings: dict[str, Any] = field(default_factory=dict)

    def quantities(self) -> list[str]:
        """Names of what was measured, values first."""
        return list(dict.fromkeys(point.quantity for point in self.points))

    def curves(self) -> Iterator[tuple[str, Choice, list[CostPoint]]]:
        """Every curve as (quantity, choice, points in rising spp)."""
        keys = dict.fromkeys((point.quantity, point.choice) for point in self.points)
        for quantity, choice in keys:
            curve = [p for p in self.points if (p.quantity, p.choice) == (quantity, choice)]
            yield quantity, choice, sorted(curve, key=lambda p: p.spp)

    def slope(self, quantity: str, choice: Choice) -> Slope | None:
        """Line through log squared error against log spp; -1 for independent samples. None with fewer than three
        points."""
        for name, candidate, curve in self.curves():
            if (name, candidate) == (quantity, choice):
                good = [p for p in curve if p.squared_error > 0]
                if len(good) >= 3:
                    return log_log_slope([p.spp for p in good], [p.squared_error for p in good])
        return None

    def gain(self, quantity: str, choice: Choice) -> float:
        """Squared error times seconds of the first choice over that of `choice`: above 1 means less error in equal
        time.

        Geometric mean over the runs with equal position in the list of samples; NaN where an error is not positive.
        """
        curves = {c: curve for name, c, curve in self.curves() if name == quantity}
        if choice not in curves:
            return math.nan
        first = next(iter(curves.values()))
        ratios = [
            (a.squared_error * a.seconds) / (b.squared_error * b.seconds)
            for a, b in zip(first, curves[choice], strict=False)
            if a.squared_error > 0 and b.squared_error > 0 and b.seconds > 0 and a.seconds > 0
        ]
        return float(np.exp(np.mean(np.log(ratios)))) if ratios else math.nan

    def table(self) -> str:
        """The points as text, one row each, with the slope and the gain of each curve."""
        lines = []
        header = f"{'spp':>7} {'seconds':>10} {'squared error':>22} {'relative':>10} {'median bin':>11}"
        for quantity, choice, curve in self.curves():
            slope = self.slope(quantity, choice)
            tail = f"slope {slope.slope:+.2f} +- {slope.standard_error:.2f}, " if slope is not None else ""
            lines.append(f"{quantity} [{choice}]  {tail}gain {self.gain(quantity, choice):.2f}")
            of_runs = curve[0].tail
            if of_runs is not None and of_runs.heavy:
                lines[-1] = f"{quantity} [{choice}]  heavy tailed: no error"
                reason = (
                    f"tail index {of_runs.index:.1f} (below 2 the variance is infinite), one of {TAIL_RUNS} runs has "
                    f"{of_runs.largest:.0%} of the squared deviations"
                )
                if math.isnan(of_runs.index):
                    reason = f"of {TAIL_RUNS} runs some are not finite"
                lines.append(f"  {reason}; seconds of a run:")
                lines += [f"  {p.spp:>7} spp {p.seconds:>10.4g}" for p in curve] + [""]
                continue
            lines.append(header)
            for p in curve:
                deviation = p.squared_error_standard_error
                spread = f"+- {deviation:.1e}" if math.isfinite(deviation) else ""
                lines.append(
                    f"{p.spp:>7} {p.seconds:>10.4g} {p.squared_error:>11.3e} {spread:>10} "
                    f"{_percent(p.relative_error):>10} {_percent(p.median_bin_error):>11}"
                )
            lines.append("")
        lines.append(f"error {self.method}; gain: squared error x seconds of the first choice over this one")
        if any(math.isnan(p.relative_error) for p in self.points if not (p.tail and p.tail.heavy)):
            lines.append("-: the noise hides the quantity itself, so that there is nothing to be relative to")
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain data; NaN becomes None, since JSON has none."""
        slopes = []
        for quantity, choice, _ in self.curves():
            slope = self.slope(quantity, choice)
            if slope is not None:
                slopes.append(
                    {
                        "quantity": quantity,
                        **asdict(choice),
                        "slope": slope.slope,
                        "standard_error": slope.standard_error,
                    }
                )
        points = [{**{k: v for k, v in asdict(p).items() if k != "choice"}, **asdict(p.choice)} for p in self.points]
        plain = _without_nan({"method": self.method, "settings": self.settings, "slopes": slopes, "points": points})
        return dict(plain)

    def to_json(self, path: str | Path) -> None:
        """Write `to_dict()` to `path`; StorageError when the file cannot be written."""
        write_text(path, json.dumps(self.to_dict(), indent=2) + "\n", "accuracy report")

    def plot(self, path: str | Path) -> None:
        """Log-log picture of relative error squared against seconds and spp, a row per quantity, with a guide of slope
        -1."""
        from torchtransient.vis.accuracy_curve import Curve, plot_accuracy

        curves = [
            Curve(
                quantity=quantity,
                label=str(choice),
                spp=[p.spp for p in curve],
                seconds=[p.seconds for p in curve],
                squared_relative_error=[p.relative_error**2 for p in curve],
            )
            for quantity, choice, curve in self.curves()
        ]
        plot_accuracy(curves, path)


def _percent(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.2%}"


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_nan(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_without_nan(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
