"""Tests for Monte Carlo results whose tolerances follow from the noise itself, never from taste.

All of them work on independent runs along the first axis, shape (K, ...). The score of an entry is Student's t of its K
runs, mapped to the normal deviate of the same probability: for normally distributed runs it is a standard normal
deviate whatever K is. Runs with few events per entry are not normal; give each run enough samples.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
from numpy.typing import ArrayLike, NDArray

from torchtransient.errors import ShapeError, UnitError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ZTest:
    """Outcome of a test of many entries at once.

    `z`: normal deviates, in the shape of one run, 0 where both sides are exactly equal without noise and inf where they
    differ without noise. `limit`: the deviate that the largest |z| of this many entries exceeds with probability
    `alpha` if all is well. `chi2_z`: deviate of the sum of z^2 against a chi-squared with `entries` degrees of freedom
    (Wilson-Hilferty); independent entries are assumed, correlation makes it wider.
    """

    z: Array
    limit: float
    chi2_z: float
    entries: int
    alpha: float

    @property
    def worst(self) -> float:
        """The largest |z|."""
        return float(np.max(np.abs(self.z), initial=0.0))

    @property
    def passed(self) -> bool:
        """True if no single entry stands out. Look at `chi2_z` for a small shift of all of them."""
        return self.worst <= self.limit

    def __str__(self) -> str:
        where = np.unravel_index(int(np.argmax(np.abs(self.z))), self.z.shape) if self.z.size else ()
        index = tuple(int(i) for i in where)
        return (
            f"worst |z| {self.worst:.2f} at {index}, limit {self.limit:.2f} ({self.entries} noisy entries, "
            f"alpha {self.alpha:g}), chi2 deviate {self.chi2_z:+.2f}"
        )


def standard_error(runs: ArrayLike) -> Array:
    """Return the standard error of the mean over independent runs.

    Args:
        runs: independent runs, (K, ...), K >= 2.

    Returns:
        (...).
    """
    data = _runs("runs", runs)
    return np.asarray(data.std(axis=0, ddof=1) / math.sqrt(data.shape[0]), dtype=np.float64)


def z_test(runs: ArrayLike, expected: ArrayLike, *, alpha: float = 1e-3, rounding: float = 0.0) -> ZTest:
    """Test that independent runs (K, ...) have the mean `expected` (...), which is known exactly.

    Args:
        runs: independent runs, (K, ...), K >= 2.
        expected: the mean, (...) or one number.
        alpha: probability that a correct result fails, over all entries together (Sidak).
        rounding: absolute error that is forgiven, for float32 results with hardly any noise.

    Raises:
        ShapeError: if the shapes differ or K < 2.
        UnitError: if `alpha` is not between 0 and 1.
    """
    data = _runs("runs", runs)
    target = np.asarray(expected, dtype=np.float64)
    if target.shape not in ((), data.shape[1:]):
        raise ShapeError(f"expected: wanted shape {data.shape[1:]} of one run, got {target.shape}")
    return _score(data.mean(axis=0) - target, standard_error(data), data.shape[0] - 1.0, alpha, rounding)


def two_sample_z_test(
    runs_a: ArrayLike, runs_b: ArrayLike, *, alpha: float = 1e-3, rounding: float = 0.0
) -> ZTest:
    """Test that two sets of independent runs have the same mean (Welch's test per entry).

    Args:
        runs_a: runs of one set, (K, ...), K >= 2.
        runs_b: runs of the other set, (M, ...), M >= 2.
        alpha: probability that equal means fail, over all entries together.
        rounding: absolute difference that is forgiven.

    Raises:
        ShapeError: if the shapes of one run differ, or a set has fewer than two.
    """
    a, b = _runs("runs_a", runs_a), _runs("runs_b", runs_b)
    if a.shape[1:] != b.shape[1:]:
        raise ShapeError(f"expected runs of equal shape, got {a.shape[1:]} and {b.shape[1:]}")
    va, vb = standard_error(a) ** 2, standard_error(b) ** 2
    denominator = va**2 / (a.shape[0] - 1) + vb**2 / (b.shape[0] - 1)
    with np.errstate(invalid="ignore", divide="ignore"):
        dof = np.where(denominator > 0, (va + vb) ** 2 / denominator, 1.0)
    return _score(a.mean(axis=0) - b.mean(axis=0), np.sqrt(va + vb), dof, alpha, rounding)


def pool_small_bins(expected: ArrayLike, minimum: float) -> NDArray[np.intp]:
    """Return the first indices of groups of neighbouring bins that each hold a minimum.

    Few events in a bin are not normally distributed; pool both sides of a test with `np.add.reduceat(values, starts,
    axis=-1)`. Bins left at the end join the last group.

    Args:
        expected: expected number of events in each bin, (T,).
        minimum: smallest expected number of events in a group.

    Raises:
        UnitError: when all bins together hold less.
    """
    energy = np.asarray(expected, dtype=np.float64)
    if energy.ndim != 1:
        raise ShapeError(f"pool_small_bins: expected one row of bins, got shape {energy.shape}")
    starts, held = [0], 0.0
    for i, value in enumerate(energy):
        held += float(value)
        if held >= minimum and i + 1 < energy.size:
            starts.append(i + 1)
            held = 0.0
    if held < minimum:
        if len(starts) == 1:
            raise UnitError(f"pool_small_bins: all bins together hold {held:g}, less than {minimum:g}")
        starts.pop()
    return np.asarray(starts, dtype=np.intp)


@dataclass(frozen=True)
class Slope:
    """A straight line through (log x, log y): slope, its standard error, and y at x = 1."""

    slope: float
    standard_error: float
    factor: float


def log_log_slope(x: ArrayLike, y: ArrayLike) -> Slope:
    """Fit a line through (log x, log y) by least squares. The variance of Monte Carlo has slope -1 in spp.

    Args:
        x, y: coordinates of the points, (N,), N >= 3, positive.

    Raises:
        ShapeError, UnitError: for other numbers.
    """
    xs, ys = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    if xs.ndim != 1 or xs.shape != ys.shape or xs.size < 3:
        raise ShapeError(f"log_log_slope: expected two rows of the same length >= 3, got {xs.shape} and {ys.shape}")
    if np.any(xs <= 0) or np.any(ys <= 0):
        raise UnitError("log_log_slope: expected positive numbers; leave out exact results before fitting")
    u, v = np.log(xs), np.log(ys)
    spread = float(((u - u.mean()) ** 2).sum())
    if spread == 0.0:
        raise UnitError("log_log_slope: expected more than one distinct x")
    slope = float(((u - u.mean()) * (v - v.mean())).sum()) / spread
    offset = float(v.mean()) - slope * float(u.mean())
    residual = float(((v - offset - slope * u) ** 2).sum()) / (xs.size - 2)
    return Slope(slope, math.sqrt(residual / spread), math.exp(offset))


def student_t_deviate(t: float, dof: float) -> float:
    """Return the normal deviate with the tail probability of Student's t.

    Args:
        t: deviate of Student's t.
        dof: degrees of freedom.
    """
    if math.isinf(t):
        return t
    tail = 0.5 * _incomplete_beta(dof / 2.0, 0.5, dof / (dof + t * t))
    if tail == 0.0:
        return math.copysign(math.inf, t)
    return math.copysign(-NormalDist().inv_cdf(min(tail, 0.5)), t)


def student_t_quantile(z: float, dof: float) -> float:
    """Return Student's t with the tail probability of a normal deviate, the inverse of :func:`student_t_deviate`.

    Args:
        z: normal deviate, above zero.
        dof: degrees of freedom; infinite ones return z itself.
    """
    if math.isinf(dof):
        return z
    low, high = z, 2.0 * z
    while student_t_deviate(high, dof) < z:
        high *= 2.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if student_t_deviate(middle, dof) < z else (low, middle)
    return 0.5 * (low + high)


def _score(difference: Array, error: Array, dof: float | Array, alpha: float, rounding: float) -> ZTest:
    if not 0.0 < alpha < 1.0:
        raise UnitError(f"alpha: expected a probability between 0 and 1, got {alpha!r}")
    excess = np.sign(difference) * np.maximum(np.abs(difference) - rounding, 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.where(excess == 0.0, 0.0, excess / error)
    t = np.where(np.isfinite(difference) & np.isfinite(error), t, np.inf)
    z = np.asarray(np.vectorize(student_t_deviate, otypes=[np.float64])(t, dof))
    noisy = np.asarray(error > 0.0)
    entries = int(noisy.sum())
    limit = -NormalDist().inv_cdf((1.0 - (1.0 - alpha) ** (1.0 / max(entries, 1))) / 2.0)
    total = float((z[noisy] ** 2).sum())
    chi2_z = 0.0
    if entries:
        k = 2.0 / (9.0 * entries)
        chi2_z = ((total / entries) ** (1.0 / 3.0) - (1.0 - k)) / math.sqrt(k)
    return ZTest(z, limit, chi2_z, entries, alpha)


def _runs(name: str, runs: ArrayLike) -> Array:
    data = np.asarray(runs, dtype=np.float64)
    if data.ndim < 1 or data.shape[0] < 2:
        raise ShapeError(f"{name}: expected at least two independent runs along the first axis, got shape {data.shape}")
    return data


def _incomplete_beta(a: float, b: float, x: float) -> float:
    """Regularised incomplete beta function by its continued fraction (modified Lentz), a, b > 0, 0 <= x <= 1."""
    if x <= 0.0 or x >= 1.0:
        return min(max(x, 0.0), 1.0)
    if x > (a + 1.0) / (a + b + 2.0):
        return 1.0 - _incomplete_beta(b, a, 1.0 - x)
    front = math.exp(math.lgamma(a + b) - math.lgamma(a) - math.lgamma(b) + a * math.log(x) + b * math.log1p(-x)) / a
    tiny = 1e-300
    c, d = 1.0, 1.0 / (1.0 - (a + b) * x / (a + 1.0) or tiny)
    fraction = d
    for m in range(1, 500):
        even = m * (b - m) * x / ((a + 2 * m - 1) * (a + 2 * m))
        odd = -(a + m) * (a + b + m) * x / ((a + 2 * m) * (a + 2 * m + 1))
        for coefficient in (even, odd):
            d = 1.0 / (1.0 + coefficient * d or tiny)
            c = 1.0 + coefficient / c or tiny
            step = c * d
            fraction *= step
        if abs(step - 1.0) < 1e-15:
            break
    return front * fraction
