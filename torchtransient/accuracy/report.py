"""What accuracy costs, as a table, a picture and a file."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import KW_ONLY, asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from torchtransient.accuracy.errors_of_estimates import TAIL_RUNS, Tail
from torchtransient.accuracy.statistics import Slope, log_log_slope
from torchtransient.array_files.part_files import write_text
from torchtransient.checks import is_one_of, positive, shown
from torchtransient.errors import ArgumentError

# Two-sided 95 % of a normal deviate.
_DEVIATE = 1.96


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


@dataclass(frozen=True)
class SamplesNeeded:
    """Samples per pixel that a relative error takes, from a line through measured errors.

    `spp`: estimate. `low`, `high`: its 95 % interval, for errors that scatter about the line as those measured do.
    `seconds`: time of one run of `spp`, from the last measured one in proportion. `slope`: of log squared relative
    error against log spp. `extrapolated`: `spp` lies outside of the samples that were measured.
    """

    _: KW_ONLY
    spp: float
    low: float
    high: float
    seconds: float
    slope: Slope
    extrapolated: bool

    def __str__(self) -> str:
        where = ", extrapolated" if self.extrapolated else ""
        return f"{self.spp:.3g} spp ({self.low:.3g} to {self.high:.3g}{where}), about {self.seconds:.3g} s"


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

    def spp_for(self, error: float, *, quantity: str | None = None, choice: Choice | None = None) -> SamplesNeeded:
        """Samples per pixel for a relative error (`CostPoint.relative_error`, 0.05 for 5 %), by the line through the
        logarithms of the squared relative errors of one curve.

        The curve is that of `quantity` and `choice`, None for the first one of the report. Its interval holds the
        scatter of the points about the line, or their own standard errors where those are larger, and grows with the
        distance from what was measured. A curve that flattens out, as against a reference with a bias, is not seen
        beyond its end.

        Raises UnitError for an error that is not positive, ArgumentError for a curve that the report does not have,
        and for one with less than three points of known error, or whose error does not fall.
        """
        wanted = positive("spp_for: error", error)
        quantity = self.quantities()[0] if quantity is None else quantity
        if not is_one_of(quantity, self.quantities()):
            raise ArgumentError(f"spp_for: quantity: expected one of {self.quantities()}, got {shown(quantity)}.")
        curves = {found: points for name, found, points in self.curves() if name == quantity}
        choice = next(iter(curves)) if choice is None else choice
        if choice not in curves:
            raise ArgumentError(f"spp_for: choice: expected one of {list(map(str, curves))}, got {shown(choice)}.")
        points = [p for p in curves[choice] if p.relative_error > 0]
        if len(points) < 3:
            raise ArgumentError(
                f"spp_for: expected at least three points of known error of {quantity} [{choice}], got {len(points)}; "
                "measure more of them, cost_of_accuracy(spp=...)."
            )
        return _samples_needed(points, wanted)

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


def _samples_needed(points: list[CostPoint], error: float) -> SamplesNeeded:
    """Invert the line of at least three points: u = (log error^2 - offset) / slope, and its variance."""
    u = np.log([float(p.spp) for p in points])
    v = 2.0 * np.log([p.relative_error for p in points])
    line = log_log_slope(np.exp(u), np.exp(v))
    if line.slope >= 0:
        raise ArgumentError(
            f"spp_for: expected an error that falls with the samples, got slope {line.slope:+.2f} +- "
            f"{line.standard_error:.2f}; measure with more repeats, or samples further apart."
        )
    at = (2.0 * math.log(error) - math.log(line.factor)) / line.slope
    spread = float(((u - u.mean()) ** 2).sum())
    known = [(p.squared_error_standard_error / p.squared_error) ** 2 for p in points if p.squared_error > 0]
    of_points = float(np.mean([x for x in known if math.isfinite(x)] or [0.0]))
    # Of few points the scatter is known by chance alone: what their own repeats say counts as well.
    scatter = max(line.standard_error**2 * spread, of_points)
    deviation = math.sqrt(scatter * (1.0 / len(points) + (at - float(u.mean())) ** 2 / spread)) / abs(line.slope)
    width = _DEVIATE * deviation
    last = points[-1]
    spp, low, high = (_exp(x) for x in (at, at - width, at + width))
    measured = last.spp >= spp >= points[0].spp
    seconds = last.seconds * spp / last.spp
    return SamplesNeeded(spp=spp, low=low, high=high, seconds=seconds, slope=line, extrapolated=not measured)


def _exp(x: float) -> float:
    """The exponential, infinite where a float does not hold it."""
    return math.exp(x) if x < 700.0 else math.inf


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
