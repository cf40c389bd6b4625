"""Squared and relative error of Monte Carlo estimates, from independent runs that are never all in memory.

Two ways to the same number, the expected squared error per entry:

* against a *reference* of two independent halves A and B: mean of (x - (A + B) / 2)^2 less the reference's own
  variance, (A - B)^2 / 4. It contains the bias of the estimate, if the reference has none.
* from *pairs* of independent runs: mean of (x1 - x2)^2 / 2, the variance. It sees no bias.

The power that a relative error divides by is the product of two independent runs, A B or x1 x2, whose expectation is
the squared truth; a squared estimate would add its variance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from torchtransient.accuracy.statistics import student_t_quantile
from torchtransient.errors import ShapeError

Array = NDArray[np.float64]

# Runs that show the tail of an estimate, and how many of them, the furthest off, its index is estimated from.
TAIL_RUNS, _FURTHEST = 96, 8
# Below this index the variance is infinite; above this share of the largest run it is not known. Normal runs pass
# (999 of 1000), runs with an index of 1.1 do not (98 of 100), those with an index of 2 do in 4 of 10 cases.
_LEAST_INDEX, _MOST_OF_ONE = 2.0, 1 / 3
# Relative distance of runs up to which they are equal, but for the rounding of single precision.
_ROUNDING = 1e-6
# Two-sided 95 % of a normal deviate.
_DEVIATE = 1.96


@dataclass(frozen=True)
class Tail:
    """Tail of an estimate's distribution, seen in independent runs; the distance of a run is the root of its mean
    squared deviation from the median run.

    `index`: alpha where the probability of a distance above d falls as d^-alpha (Hill 1975), infinite without noise, 0
    where most runs are alike. All are NaN where a run is not finite.
    `largest`: share of the run that is furthest off in the sum of squared distances. `spread`: standard deviation of
    the squared distance over its mean.
    """

    index: float
    largest: float
    spread: float

    @classmethod
    def of(cls, runs: Sequence[NDArray[np.float32]]) -> Tail:
        """Estimate the tail of runs.

        Args:
            runs: more than 8 arrays of equal shape.
        """
        wide = np.stack(runs).astype(np.float64)
        if not np.isfinite(wide).all():
            return cls(math.nan, math.nan, math.nan)
        median = np.median(wide, axis=0)
        squared = np.array([_square(run - median).mean() for run in wide])
        furthest = np.sqrt(np.sort(squared)[::-1][: _FURTHEST + 1])
        if furthest[0] <= _ROUNDING * math.sqrt(_square(median).mean()):
            return cls(math.inf, 0.0, 0.0)
        # Where no more than 8 runs differ from the others, few decide about the variance: an index of 0.
        excess = float(np.log(furthest[:-1] / furthest[-1]).mean()) if furthest[-1] > 0 else math.inf
        index = 1.0 / excess if excess > 0 else math.inf
        return cls(index, float(squared.max() / squared.sum()), float(squared.std(ddof=1) / squared.mean()))

    @property
    def heavy(self) -> bool:
        """True where the runs show no variance: few of them decide about it, and more would find a larger one."""
        return not (self.index >= _LEAST_INDEX and self.largest <= _MOST_OF_ONE)


@dataclass(frozen=True)
class Reference:
    """Two independent halves of a long reference, arrays of equal shape."""

    first: ArrayLike
    second: ArrayLike


@dataclass
class ErrorTally:
    """Sum of errors of independent runs of one estimate. `time_dim`: axis of time bins, None if there is none."""

    time_dim: int | None = None
    reference: Reference | None = None
    squared: list[Array] = field(default_factory=list)
    power: list[Array] = field(default_factory=list)
    _waiting: NDArray[np.float32] | None = None
    _reference_sums: tuple[Array, Array, NDArray[np.float32]] | None = None
    # Sums over the runs of the deviations from the reference, entry by entry, and of their squares.
    _deviations: NDArray[np.float32] | None = None
    _squares: NDArray[np.float32] | None = None

    def add(self, run: ArrayLike) -> None:
        """Add one independent run.

        Args:
            run: array of the shape of the others.

        Raises:
            ShapeError: for another shape than that of the reference or the run before.
        """
        x = np.asarray(run, dtype=np.float32)
        if self.reference is not None:
            noise, power, mean = self._against_reference(x)
            deviations = np.asarray(x - mean, dtype=np.float32)
            squares = _square(deviations)
            if self._deviations is None or self._squares is None:
                self._deviations, self._squares = np.zeros_like(deviations), np.zeros_like(deviations)
            self._deviations, self._squares = self._deviations + deviations, self._squares + np.float32(squares)
            self.squared.append(self._per_bin(squares) - noise)
            self.power.append(power)
        elif self._waiting is None:
            self._waiting = np.array(x, copy=True)
        else:
            if self._waiting.shape != x.shape:
                raise ShapeError(f"expected runs of equal shape, got {self._waiting.shape} and {x.shape}")
            self.squared.append(self._per_bin(_square(x - self._waiting)) / 2.0)
            self.power.append(self._per_bin(np.multiply(x, self._waiting, dtype=np.float64)))
            self._waiting = None

    def _against_reference(self, x: NDArray[np.float32]) -> tuple[Array, Array, NDArray[np.float32]]:
        """The reference's own noise and power per bin, and its mean; computed at the first run."""
        if self._reference_sums is None:
            if self.reference is None:
                raise ShapeError("ErrorTally: no reference was given")
            a = np.asarray(self.reference.first, dtype=np.float32)
            b = np.asarray(self.reference.second, dtype=np.float32)
            if a.shape != b.shape:
                raise ShapeError(f"expected two halves of equal shape, got {a.shape} and {b.shape}")
            mean = np.asarray((a + b) * np.float32(0.5), dtype=np.float32)
            power = self._per_bin(np.multiply(a, b, dtype=np.float64))
            self._reference_sums = self._per_bin(_square(a - b)) / 4.0, power, mean
        noise, power, mean = self._reference_sums
        if mean.shape != x.shape:
            raise ShapeError(f"expected a run of the reference's shape {mean.shape}, got {x.shape}")
        return noise, power, mean

    def _per_bin(self, values: Array) -> Array:
        """Mean over everything but time, shape (T,) or (1,)."""
        if self.time_dim is None:
            return np.asarray([values.mean()], dtype=np.float64)
        axes = tuple(i for i in range(values.ndim) if i != self.time_dim % values.ndim)
        return np.asarray(values.mean(axis=axes), dtype=np.float64)

    def result(self, tail: Tail | None = None) -> ErrorEstimate:
        """Return the figures of all runs so far.

        Args:
            tail: tail of the estimate's distribution, from runs of its own: where it is heavy all figures are NaN,
                elsewhere the standard error comes from its spread, which a few runs do not show. None: from these runs
                alone.

        Raises:
            ShapeError: without any run, and of a single one without a reference.
        """
        if not self.squared:
            raise ShapeError("ErrorTally: expected at least one run against a reference, or two without one")
        if tail is not None and tail.heavy:
            return NOT_MEASURED
        per_run = np.stack(self.squared)
        totals, runs = per_run.mean(axis=1), len(per_run)
        bias = self._bias() if self.reference is not None else _Bias(0.0, 0.0, 0.0, 0.0)
        if tail is not None:
            # Of a bias the spread of short runs says nothing.
            noise = (float(totals.mean()) - bias.squared) * tail.spread / math.sqrt(runs)
            error = math.hypot(noise, bias.times_noise)
        else:
            error = float(totals.std(ddof=1) / math.sqrt(runs)) if runs > 1 else math.nan
        # Few runs hardly know their own noise.
        least = student_t_quantile(_DEVIATE, max(runs - 1, 1)) * bias.standard_error
        squared, power = per_run.mean(axis=0), np.stack(self.power).mean(axis=0)
        lit = power > 0
        per_bin = np.sqrt(np.maximum(squared[lit], 0.0) / power[lit])
        mean_power = float(power.mean())
        mean_squared = float(squared.mean())
        return ErrorEstimate(
            squared=mean_squared,
            squared_standard_error=math.hypot(error, bias.error_of_reference),
            relative=relative(mean_squared, mean_power),
            median_bin=float(np.median(per_bin)) if lit.any() else math.nan,
            power=mean_power,
            bias=relative(bias.squared if bias.squared > least else 0.0, mean_power),
            comparisons=runs,
        )

    def _bias(self) -> _Bias:
        """Return the part of the deviation from the reference that all runs share, and errors of it; entries count as
        independent.

        With the mean d of the deviations, s^2 the variance of a run, and n = (A - B)^2 / 4 that of the reference's
        mean, b^2 = d^2 - s^2 / R - n. The squared error is off by -2 d e + e^2 - n by an error e of the reference's
        mean, which all runs share: E[n^2], with n estimated from two halves, is three times its square.
        """
        runs, reference = len(self.squared), self.reference
        if reference is None or self._deviations is None or self._squares is None:
            raise ShapeError("ErrorTally: no run was compared with a reference")
        halves = np.asarray(reference.first, np.float32) - np.asarray(reference.second, np.float32)
        of_reference = _square(halves) / 4.0
        mean = np.asarray(self._deviations, dtype=np.float64) / runs
        spread = np.maximum(np.asarray(self._squares, dtype=np.float64) / runs - _square(mean), 0.0)
        spread = spread * runs / max(runs - 1, 1)
        of_mean = spread / runs
        noise = of_mean + of_reference
        without_bias = _square(noise) + _square(of_mean) / max(runs - 1, 1) + _square(of_reference)

        def error(variances: Array) -> float:
            return math.sqrt(float(variances.sum())) / mean.size

        return _Bias(
            squared=max(float((_square(mean) - noise).mean()), 0.0),
            standard_error=error(2.0 * without_bias),
            times_noise=error(4.0 * _square(mean) * of_mean),
            error_of_reference=error(4.0 * _square(mean) * of_reference + 4.0 / 3.0 * _square(of_reference)),
        )


@dataclass(frozen=True)
class _Bias:
    """Squared bias, its standard error where there is none, and standard errors of the squared error: by its product
    with the noise, and by the noise of the reference."""

    squared: float
    standard_error: float
    times_noise: float
    error_of_reference: float


@dataclass(frozen=True)
class ErrorEstimate:
    """`squared`: expected squared error per entry, and its standard error over the runs (NaN for one run or pair),
    which contains that of the reference. `comparisons`: runs, or pairs of them, that it is the mean of.

    `relative`: root of squared error over power, all entries together, which bright bins decide. `median_bin`: the same
    per time bin, median over the bins that hold light, which dim, late bins decide. NaN where there is no light at all.
    `power`: mean square of the estimated quantity, which the squared error is relative to. `bias`: relative, against
    the reference, 0 within its noise.
    """

    squared: float
    squared_standard_error: float
    relative: float
    median_bin: float
    power: float = math.nan
    bias: float = math.nan
    comparisons: int = 0


NOT_MEASURED = ErrorEstimate(math.nan, math.nan, math.nan, math.nan)


def relative(squared: float, power: float) -> float:
    """Return the root of a squared error over a power; NaN without power.

    Args:
        squared: squared error, of which one below zero counts as none.
        power: mean square of the estimated quantity.
    """
    return math.sqrt(max(squared, 0.0) / power) if power > 0 else math.nan


def _square(values: NDArray[np.float32] | Array) -> Array:
    return np.multiply(values, values, dtype=np.float64)
