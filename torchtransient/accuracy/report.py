"""Reports of what accuracy costs: a table, a picture, a file."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import KW_ONLY, asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from torchtransient.accuracy.errors_of_estimates import TAIL_RUNS, Tail
from torchtransient.accuracy.statistics import Slope, log_log_slope, student_t_quantile
from torchtransient.array_files.part_files import write_text
from torchtransient.checks import check_source, is_one_of, positive, shown
from torchtransient.errors import ArgumentError, StorageError, UnitError

if TYPE_CHECKING:
    from torchtransient.vis.accuracy_curve import Curve

# Two-sided 95 % of a normal deviate.
_DEVIATE = 1.96


@dataclass(frozen=True)
class Choice:
    """Settings that are compared.

    A sampler and a temporal filter by their plugin names, and where they are compared too, an integrator, a depth (-1:
    no limit) and the width of a bin in metres of optical path. Empty or None: the renderer's.
    """

    sampler: str
    temporal_filter: str
    integrator: str = ""
    max_depth: int | None = None
    bin_width_opl: float | None = None

    def __str__(self) -> str:
        depth = "" if self.max_depth is None else f"depth {self.max_depth}" if self.max_depth >= 0 else "any depth"
        width = "" if self.bin_width_opl is None else f"bins of {self.bin_width_opl:g} m"
        return ", ".join(filter(None, (self.integrator, self.sampler, self.temporal_filter, depth, width)))


@dataclass(frozen=True)
class CostPoint:
    """One point of a curve.

    `quantity`: "transient", "phasor", a name of `quantities` or the key of a gradient. `spp`: samples per pixel really
    drawn. `seconds`, `cpu_seconds`: medians of wall and CPU time of one run (forward for values, forward and backward
    for gradients). The errors are those of `ErrorEstimate`. `tail`: tail of a gradient's distribution; where
    it is heavy the errors are NaN. The total errors are those against the finest setting, bias included; `total_error`
    is relative, and so is `bias`, 0 within its noise. All are NaN where they were not measured.
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
    cpu_seconds: float = math.nan
    comparisons: int = 0
    total_squared_error: float = math.nan
    total_squared_error_standard_error: float = math.nan
    total_error: float = math.nan
    bias: float = math.nan

    @property
    def error(self) -> float:
        """Relative error with the bias where it was measured, else that of the noise; NaN where it is not known.

        The total error is no less than the noise, of which it is a worse estimate where there is little bias: against a
        reference its squared error can come out below zero.
        """
        known = [e for e in (self.relative_error, self.total_error) if e > 0 or (e == 0 and self.squared_error == 0)]
        return max(known, default=math.nan)


@dataclass(frozen=True)
class SamplesNeeded:
    """Samples per pixel that a relative error takes, from a line through measured errors.

    `spp`: estimate. `low`, `high`: its 95 % interval, for errors that scatter about the line as those measured do.
    `seconds`: time of one run of `spp`, from the last measured one in proportion. `slope`: that of log squared relative
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


@dataclass(frozen=True)
class Recommendation:
    """Quickest measured setting that reaches an error.

    `spp`: samples per pixel. `error`: relative error at `spp`, bias included where it was measured, and `low`, `high`
    its 95 % interval. `seconds`, `cpu_seconds`: time of one run.
    """

    _: KW_ONLY
    quantity: str
    choice: Choice
    spp: int
    error: float
    low: float
    high: float
    seconds: float
    cpu_seconds: float

    def __str__(self) -> str:
        return (
            f"{self.quantity}: {self.choice}, {self.spp} spp: error {self.error:.2%} ({self.low:.2%} to "
            f"{self.high:.2%}), {self.seconds:.3g} s"
        )


@dataclass
class AccuracyReport:
    """Error against seconds and samples for every quantity and choice. Made by :func:`cost_of_accuracy`.

    ``str(report)`` is `table()`.

    Attributes:
        points: one entry for each quantity, choice and number of samples.
        method: how errors were measured.
        settings: settings of the measurement, by name.
    """

    points: list[CostPoint]
    method: str
    settings: dict[str, Any] = field(default_factory=dict)

    def quantities(self) -> list[str]:
        """Return the names of the measured quantities, values first."""
        return list(dict.fromkeys(point.quantity for point in self.points))

    def curves(self) -> Iterator[tuple[str, Choice, list[CostPoint]]]:
        """Yield every curve as (quantity, choice, points in rising spp)."""
        keys = dict.fromkeys((point.quantity, point.choice) for point in self.points)
        for quantity, choice in keys:
            yield quantity, choice, self.curve(quantity, choice)

    def curve(self, quantity: str, choice: Choice) -> list[CostPoint]:
        """Return the points of one curve in rising spp; empty where there is none.

        Args:
            quantity: name of the quantity.
            choice: settings of the curve.
        """
        found = [p for p in self.points if (p.quantity, p.choice) == (quantity, choice)]
        return sorted(found, key=lambda p: p.spp)

    def slope(self, quantity: str, choice: Choice) -> Slope | None:
        """Fit a line through log squared error against log spp; -1 for independent samples.

        Its standard error is that of the scatter about the line, or that of the points where it is larger: of few
        points the scatter is known by chance alone.

        Args:
            quantity: name of the quantity.
            choice: settings of the curve.

        Returns:
            The line, None with fewer than three points.
        """
        good = [p for p in self.curve(quantity, choice) if p.squared_error > 0]
        if len(good) < 3:
            return None
        line = log_log_slope([p.spp for p in good], [p.squared_error for p in good])
        u = np.log([float(p.spp) for p in good])
        weights = (u - u.mean()) / ((u - u.mean()) ** 2).sum()
        known = np.array([p.squared_error_standard_error / p.squared_error for p in good])
        of_points = math.sqrt(float((weights**2 * np.nan_to_num(known) ** 2).sum()))
        return replace(line, standard_error=max(line.standard_error, of_points))

    def band(self, point: CostPoint, *, total: bool = False) -> tuple[float, float]:
        """Return the 95 % interval of a point's relative error, or of its total error.

        Bounds are factors, the exponential of the relative standard error of the squared error times Student's t. A
        few runs hardly know that standard error: that of the noise is pooled over the points of the curve, which have
        the same number of entries.

        Args:
            point: point of this report.
            total: return the interval of the total error.

        Returns:
            (low, high), NaN where there is none.
        """
        if total:
            value, degrees = point.total_error, float(point.repeats - 1)
            deviation = point.total_squared_error_standard_error / point.total_squared_error
        else:
            value, curve = point.relative_error, self.curve(point.quantity, point.choice)
            pooled = [(p.squared_error_standard_error / p.squared_error) ** 2 for p in curve if p.squared_error > 0]
            pooled = [x for x in pooled if math.isfinite(x)]
            degrees = float(sum(p.comparisons - 1 for p in curve)) if point.comparisons > 1 else math.inf
            deviation = math.sqrt(sum(pooled) / len(pooled)) if pooled else math.nan
        if point.tail is not None:
            degrees = math.inf
        if not (value > 0 and math.isfinite(deviation)):
            return math.nan, math.nan
        # The relative error is the root of the squared one.
        factor = math.exp(min(0.5 * student_t_quantile(_DEVIATE, degrees) * deviation, 300.0))
        return value / factor, value * factor

    def pareto(self, quantity: str | None = None) -> list[CostPoint]:
        """Return the points of a quantity that no other is both quicker and closer than, in rising seconds.

        Closer by `CostPoint.error`: with the bias of a small depth, a filter and a wide bin where it was measured.

        Args:
            quantity: name of the quantity, None for the first.
        """
        quantity = self._quantity("pareto", quantity)
        known = [p for p in self.points if p.quantity == quantity and p.error >= 0]
        front: list[CostPoint] = []
        for point in sorted(known, key=lambda p: (p.seconds, p.error)):
            if not front or point.error < front[-1].error:
                front.append(point)
        return front

    def recommend(self, error: float, *, quantity: str | None = None) -> Recommendation:
        """Return the quickest setting and samples per pixel for a relative error, 0.05 for 5 %.

        On each curve of `CostPoint.error`, the error between two measured points is a power of the samples; the samples
        are the fewest whose error is at most `error`, and none are beyond those that were measured. Except of
        "independent" they are powers of two or measured ones: other numbers are spread less evenly. The quickest of
        many noisy curves is often a lucky one: where the interval reaches far beyond, measure with more `repeats`.

        Args:
            error: relative error, bias included where it was measured.
            quantity: name of a quantity, None for the first one of the report.

        Raises:
            UnitError: for an error that is not between 0 and 1.
            ArgumentError: for a quantity that the report does not have, and where no curve reaches the error.
        """
        wanted = positive("recommend: error", error)
        if wanted >= 1:
            raise UnitError(f"recommend: error: expected a share below 1, 0.05 for 5 %, got {shown(error)}.")
        quantity = self._quantity("recommend", quantity)
        curves = [[p for p in curve if p.error >= 0] for name, _, curve in self.curves() if name == quantity]
        found = [self._reached(curve, wanted) for curve in curves if any(p.error <= wanted for p in curve)]
        if found:
            return min(found, key=lambda each: (each.seconds, each.error))
        known = [p for curve in curves for p in curve]
        if not known:
            raise ArgumentError(f"recommend: no curve of {quantity} has an error that is known.")
        best = min(known, key=lambda p: p.error)
        biased = f", of it {best.bias:.2%} bias, which more samples do not lower" if best.bias > 0 else ""
        raise ArgumentError(
            f"recommend: expected an error of {quantity} that a measured setting reaches, got {wanted:.2%}; the least "
            f"is {best.error:.2%}, of {best.spp} spp [{best.choice}]{biased}. Measure more samples or other settings, "
            "or ask spp_for, which extrapolates the noise."
        )

    def _reached(self, curve: list[CostPoint], wanted: float) -> Recommendation:
        """The first place of a curve, in rising samples, where its error is at most `wanted`."""
        n = next(i for i, p in enumerate(curve) if p.error <= wanted)
        before, after = curve[max(n - 1, 0)], curve[n]
        share, spp = 1.0, after.spp
        between = n > 0 and after.error > 0 and after.spp > before.spp
        if between:
            share = math.log(before.error / wanted) / math.log(before.error / after.error)
            spp = math.ceil(before.spp * (after.spp / before.spp) ** share * (1.0 - 1e-9))
            if after.choice.sampler != "independent":
                spp = min(1 << (spp - 1).bit_length(), after.spp)
            share = math.log(spp / before.spp) / math.log(after.spp / before.spp)
        part = 1.0 if not between else (spp - before.spp) / (after.spp - before.spp)
        low, high = (
            math.exp((1.0 - share) * math.log(a) + share * math.log(b)) if after.error > 0 else after.error
            for a, b in zip(self._interval(before), self._interval(after), strict=True)
        )
        reached = before.error ** (1.0 - share) * after.error**share if share < 1.0 else after.error
        return Recommendation(
            quantity=after.quantity,
            choice=after.choice,
            spp=spp,
            error=reached,
            low=low,
            high=high,
            seconds=before.seconds + part * (after.seconds - before.seconds),
            cpu_seconds=before.cpu_seconds + part * (after.cpu_seconds - before.cpu_seconds),
        )

    def _interval(self, point: CostPoint) -> tuple[float, float]:
        """The band of `CostPoint.error`."""
        return self.band(point, total=point.total_error == point.error)

    def _quantity(self, who: str, quantity: str | None) -> str:
        """The quantity, the first one for None."""
        if quantity is None:
            return self.quantities()[0]
        if not is_one_of(quantity, self.quantities()):
            raise ArgumentError(f"{who}: quantity: expected one of {self.quantities()}, got {shown(quantity)}.")
        return quantity

    def spp_for(self, error: float, *, quantity: str | None = None, choice: Choice | None = None) -> SamplesNeeded:
        """Return the samples per pixel for a relative error, by the line through the logarithms of the squared relative
        errors of one curve.

        Its interval holds the scatter of the points about the line, or their own standard errors where those are
        larger, and grows with the distance from what was measured. A curve that flattens out, as against a reference
        with a bias, is not seen beyond its end.

        Args:
            error: relative error (`CostPoint.relative_error`), 0.05 for 5 %.
            quantity, choice: quantity and choice of the curve; None: the first one of the report.

        Raises:
            UnitError: for an error that is not positive.
            ArgumentError: for a curve that the report does not have, and for one with less than three points of known
                error, or whose error does not fall.
        """
        wanted = positive("spp_for: error", error)
        quantity = self._quantity("spp_for", quantity)
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
        """Return the squared error times seconds of the first choice over that of another: above 1, less error in equal
        time.

        Geometric mean over the runs with equal position in the list of samples.

        Args:
            quantity: name of the quantity.
            choice: the other choice.

        Returns:
            The factor, NaN where an error is not positive.
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
        """Return the points as text, one row each, with the slope and the gain of each curve, and the Pareto fronts."""
        lines = []
        header = f"{'spp':>7} {'seconds':>10} {'CPU s':>10} {'squared error':>22} {'relative':>10} {'median bin':>11}"
        for quantity, choice, curve in self.curves():
            slope = self.slope(quantity, choice)
            tail = f"slope {slope.slope:+.2f} +- {slope.standard_error:.2f}, " if slope is not None else ""
            lines.append(f"{quantity} [{choice}]  {tail}gain {self.gain(quantity, choice):.2f}")
            of_runs = curve[0].tail
            if of_runs is not None and of_runs.heavy:
                lines[-1] = f"{quantity} [{choice}]  heavy tailed: no error"
                reason = (
                    f"tail index {of_runs.index:.2g}, one of {TAIL_RUNS} runs has "
                    f"{of_runs.largest:.0%} of the squared deviations"
                )
                if math.isnan(of_runs.index):
                    reason = f"of {TAIL_RUNS} runs some are not finite"
                lines.append(f"  {reason}; seconds of a run:")
                lines += [f"  {p.spp:>7} spp {p.seconds:>10.4g}" for p in curve] + [""]
                continue
            has_total = not math.isnan(curve[0].total_error)
            lines.append(header + (f" {'total':>10} {'bias':>10}" if has_total else ""))
            for p in curve:
                deviation = p.squared_error_standard_error
                spread = f"+- {deviation:.1e}" if math.isfinite(deviation) else ""
                lines.append(
                    f"{p.spp:>7} {p.seconds:>10.4g} {_plain(p.cpu_seconds):>10} {p.squared_error:>11.3e} "
                    f"{spread:>10} {_percent(p.relative_error):>10} {_percent(p.median_bin_error):>11}"
                    + (f" {_percent(p.total_error):>10} {_percent(p.bias):>10}" if has_total else "")
                )
            lines.append("")
        for quantity in self.quantities():
            front = self.pareto(quantity)
            if len({p.choice for p in self.points if p.quantity == quantity}) > 1 and front:
                lines.append(f"Pareto front of {quantity}")
                lines += [f"  {p.seconds:>10.4g} s {_percent(p.error):>10}  {p.spp} spp [{p.choice}]" for p in front]
                lines.append("")
        lines.append(f"error {self.method}; gain: squared error x seconds of the first choice over this one")
        if any(not math.isnan(p.total_error) for p in self.points):
            lines.append("total: against the finest setting, noise and bias")
        if any(math.isnan(p.relative_error) for p in self.points if not (p.tail and p.tail.heavy)):
            lines.append("-: the noise hides the quantity itself, so that there is nothing to be relative to")
        return "\n".join(lines)

    def __str__(self) -> str:
        return self.table()

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain data; NaN becomes None and an infinite number "inf", since JSON has neither."""
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
        plain = _for_json({"method": self.method, "settings": self.settings, "slopes": slopes, "points": points})
        return dict(plain)

    def to_json(self, path: str | Path) -> None:
        """Write `to_dict()` to a file.

        Args:
            path: path of the file.

        Raises:
            StorageError: when it cannot be written.
        """
        write_text(path, json.dumps(self.to_dict(), indent=2) + "\n", "accuracy report")

    @classmethod
    def from_json(cls, path: str | Path) -> AccuracyReport:
        """Return the report of a file that `to_json` wrote.

        Args:
            path: path of the file.

        Raises:
            StorageError: for other files.
        """
        source = check_source(path, "accuracy report")
        try:
            data = json.loads(source.read_text(encoding="utf-8"))
            points = [_point(dict(entry)) for entry in data["points"]]
            return cls(points, data["method"], data["settings"])
        except (ValueError, KeyError, TypeError) as error:
            raise StorageError(f"{source}: expected a file of AccuracyReport.to_json, got another: {error}.") from error

    def plot(self, path: str | Path) -> None:
        """Draw squared relative error with 95 % bands, logarithmic, a row per quantity.

        The noise against samples with its slopes, and against seconds the error with its bias, where that was measured,
        and the Pareto front.

        Args:
            path: path of the picture.

        Raises:
            StorageError: when it cannot be written.
        """
        from torchtransient.vis.accuracy_curve import plot_accuracy

        plot_accuracy([self._drawn(quantity, choice, curve) for quantity, choice, curve in self.curves()], path)

    def _drawn(self, quantity: str, choice: Choice, curve: list[CostPoint]) -> Curve:
        from torchtransient.vis.accuracy_curve import Curve

        slope, front = self.slope(quantity, choice), self.pareto(quantity)
        alone = len({p.choice for p in self.points if p.quantity == quantity}) == 1
        has_total = not math.isnan(curve[0].total_error)
        return Curve(
            quantity=quantity,
            label=str(choice),
            spp=[p.spp for p in curve],
            seconds=[p.seconds for p in curve],
            squared_relative_error=[p.relative_error**2 for p in curve],
            band=_squares([self.band(p) for p in curve]),
            total=[p.error**2 for p in curve] if has_total else None,
            total_band=_squares([self._interval(p) for p in curve]) if has_total else None,
            slope=None if slope is None else (slope.slope, slope.standard_error),
            on_front=[not alone and p in front for p in curve],
        )


def _squares(bands: list[tuple[float, float]]) -> list[tuple[float, float]]:
    return [(low**2, high**2) for low, high in bands]


def _point(entry: dict[str, Any]) -> CostPoint:
    """Return the point of an entry in a file; None is NaN, except in choice and tail."""
    choice = Choice(**{f.name: entry.pop(f.name) for f in fields(Choice) if f.name in entry})
    tail = entry.pop("tail", None)
    tail = None if tail is None else Tail(**{name: _number(value) for name, value in tail.items()})
    plain: dict[str, Any] = {name: _number(value) for name, value in entry.items() if name != "quantity"}
    return CostPoint(choice=choice, quantity=entry["quantity"], tail=tail, **plain)


def _number(value: float | str | None) -> float:
    return math.nan if value is None else float(value) if isinstance(value, str) else value


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


def _plain(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.4g}"


def _for_json(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _for_json(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_for_json(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None if math.isnan(value) else str(value)
    return value
