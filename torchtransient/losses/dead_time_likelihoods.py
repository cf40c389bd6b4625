"""Negative log-likelihoods of detectors that are dead after a detection: first-photon and free-running.

Rates and histograms, their order, what happens in the dark, floors, masks and `dim` as in `likelihoods.py`. A bin that
does not count still takes cycles from those behind it, only pixels without any bin that counts are not looked at: NaN
in one is NaN in the loss of those behind it (free-running: of the pixel).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from torchtransient.checks import flag, positive
from torchtransient.errors import ShapeError, UnitError
from torchtransient.losses.comparison import (
    Reduction,
    check_dense,
    check_mask,
    check_number,
    check_option,
    check_reduction,
    check_whole,
    counted,
)
from torchtransient.losses.comparison import reduce as _reduce
from torchtransient.losses.layouts import as_columns, bins_dim, check_held
from torchtransient.losses.likelihoods import (
    averaged_over,
    check_constant,
    check_prediction,
    check_rates,
    count_log,
    dark_level,
    floored,
)
from torchtransient.losses.results import TRANSIENT, Transient, reads
from torchtransient.sensing.dead_time.renewal import check_dead_bins
from torchtransient.sensing.spad.spad import exposed_cycles, first_photon_log_prob

_TIME = -3


def _check_dead_time(dead_bins: float, where: str) -> float:
    check_number("dead_bins", dead_bins, where)
    number = positive(f"{where}: dead_bins", dead_bins)
    try:
        check_dead_bins(number)
    except UnitError as error:
        raise UnitError(f"{where}: {error}") from None
    return number


def _exact(target: object, mask: Tensor | None, dim: int) -> Tensor:
    """Counts in double precision, 0 in pixels of which no bin counts: detectors that are dead need sums of them."""
    # as they were given: single precision, that of the pair, may not hold them
    counts = check_dense((target,), "counts")[0].to(torch.float64)
    return counts if mask is None else counted(counts, mask.any(dim, keepdim=True))


@reads(input=TRANSIENT, target=TRANSIENT)
def first_photon_nll(
    input: Transient,
    target: Transient,
    cycles: int,
    *,
    dead_bins: float | None = None,
    floor: Tensor | float | None = None,
    constant: bool = False,
    dim: int | None = None,
    mask: Tensor | None = None,
    reduction: Reduction = "mean",
) -> Tensor:
    """-log-likelihood of a synchronous SPAD's histogram: binomial in each bin given the cycles still armed.

    -(n log(1 - exp(-r)) - r (armed - n)), convex in r, least at the Coates estimate. `input`: r (..., C, T, H, W),
    expected detections per cycle and bin of a detector that is never dead, from none to any number; `target`: n, the
    histogram of `cycles` cycles, of the same shape; `dead_bins`: several detections per cycle (`SynchronousSPAD`).
    Exact; `floor`, in the unit of r, as in `poisson_nll`. Flat beyond the width of a pulse: from farther away take
    `multiscale_loss` of it (docs/losses.md). Raises as `poisson_nll`, and UnitError for more counts than cycles.
    """
    where = "first_photon_nll"
    check_reduction(reduction, where)
    rate = check_prediction(input, target, where)[0]
    number = check_whole("cycles", cycles, where, UnitError)
    dead = None if dead_bins is None else _check_dead_time(dead_bins, where)
    dim = bins_dim(rate, dim, where)
    mask = check_mask(mask, rate, where)
    rate = counted(rate, mask, 1.0)
    check_rates(rate, where)
    measured = _exact(target, mask, dim)
    check_constant(measured, constant, where)
    n, r = as_columns(measured, dim), as_columns(floored(rate, floor, where), dim).to(torch.float64)
    level = dark_level(n, floor, input, number, averaged_over(rate, mask, reduction))
    dark = None if level is None else _dark(n, r, level)
    near = r if level is None or dark is None else torch.where(dark, level, r)
    value = -first_photon_log_prob(n, near, number, dead_bins=dead, constant=constant, where=where)
    if level is not None and dark is not None:
        # the tangent: what does not fire is linear in the rate anyway
        least = torch.where(dark, level, 1.0)
        quiet = (exposed_cycles(n, number, dead) - n).clamp_min(0)
        value = value + torch.where(dark, (quiet - n / torch.expm1(least)) * (r - least), 0.0)
    return _reduce(value.to(rate.dtype).reshape(rate.shape), reduction, where, mask)


def _dark(n: Tensor, r: Tensor, level: Tensor) -> Tensor | None:
    """Counts where rates are below the level; None without any, as a rule."""
    below = r < level
    found = below & (n != 0) if bool(below.any()) else below
    return found if bool(found.any()) else None


first_photon_loss = first_photon_nll


def armed_periods(counts: Tensor, periods: int, dead_bins: float) -> Tensor:
    """Periods in which a free-running detector was armed, averaged over each bin, from its histogram: float64.

    `counts` (..., T, H, W) of `periods` laser periods of T bins; `dead_bins`: the dead time in bins. Every detection
    takes the dead time that follows it, round the period and for as many periods as it lasts. Detections
    count as spread evenly over their bin. Linear in the counts; below zero where they do not fit. Raises ShapeError for
    what is no such tensor, UnitError for other numbers. Not supported: paralyzable dead times.
    """
    where = "armed_periods"
    (counts,) = check_dense((counts,), where)
    if counts.ndim < 3:
        raise ShapeError(f"{where}: expected counts (..., T, H, W), got {tuple(counts.shape)}. Add the missing ones.")
    if counts.is_complex():
        raise UnitError(f"{where}: expected counts, got complex numbers ({counts.dtype}). Give the histogram.")
    periods, dead_bins = check_whole("periods", periods, where, UnitError), _check_dead_time(dead_bins, where)
    whole = math.floor(dead_bins + 1e-9)
    part = max(0.0, dead_bins - whole)
    bins = counts.shape[_TIME]
    h = counts.to(torch.float64)
    rounds, rest = divmod(whole, bins)
    total = h.sum(_TIME, keepdim=True)
    before = h.cumsum(_TIME) - h
    # sum of h over the `rest` bins before bin k, round the period
    earlier = before.roll(rest, _TIME)
    index = torch.arange(bins, device=h.device).view(-1, 1, 1)
    window = rounds * total + torch.where(index < rest, before - earlier + total, before - earlier)
    # a detection u < 1 bins after the start of its bin reaches to whole + part + u: edges by integrals over both bins
    edges = 0.5 * h - 0.5 * (1 - part) ** 2 * h.roll(whole, _TIME) + 0.5 * part**2 * h.roll(whole + 1, _TIME)
    return periods - window - edges


@reads(input=TRANSIENT, target=TRANSIENT)
def free_running_nll(
    input: Transient,
    target: Transient,
    *,
    periods: int,
    dead_bins: float,
    floor: Tensor | float | None = None,
    dim: int | None = None,
    mask: Tensor | None = None,
    reduction: Reduction = "mean",
) -> Tensor:
    """-log-likelihood of a free-running SPAD's histogram with non-paralyzable dead time, up to a constant.

    That of photons while the detector is armed, which the histogram alone tells (`armed_periods`): r armed - n log(r),
    r = `input`, photons per period and bin, n = `target`, the counts of `periods` periods.
    Exact but for the periods at both ends of the exposure and the places of detections inside a bin: the error of the
    best rate, r = n/armed, is second order in the counts of a bin per period. Its least is where Rapp et al. and Gupta
    et al. (see `sensing.free_running`) put it. Arguments as in `first_photon_nll`.
    """
    where = "free_running_nll"
    check_reduction(reduction, where)
    rate = check_prediction(input, target, where)[0]
    periods, dead_bins = check_whole("periods", periods, where, UnitError), _check_dead_time(dead_bins, where)
    dim = bins_dim(rate, dim, where)
    mask = check_mask(mask, rate, where)
    rate = counted(rate, mask, 1.0)
    check_rates(rate, where)
    n = as_columns(_exact(target, mask, dim), dim)
    armed = armed_periods(n, periods, dead_bins)
    # the ends of the exposure and the places inside a bin leave an uncertainty of about the square root of the counts
    if bool((armed < -(2 + 6 * n.sum(_TIME, keepdim=True).clamp_min(0).sqrt())).any()):
        raise UnitError(
            f"{where}: expected counts that fit into {periods} periods with dead time {dead_bins:g} bins, "
            "got more. Check periods and dead time."
        )
    r = as_columns(floored(rate, floor, where), dim).to(torch.float64)
    level = dark_level(n, floor, input, periods, averaged_over(rate, mask, reduction))
    value = r * armed.clamp_min(0) - count_log(n, r, level)
    return _reduce(value.to(rate.dtype).reshape(rate.shape), reduction, where, mask)


class FirstPhotonNLL(nn.Module):
    """`first_photon_nll(input, target, cycles)` with its options held."""

    def __init__(
        self,
        cycles: int,
        dead_bins: float | None = None,
        *,
        floor: float | None = None,
        dim: int | None = None,
        reduction: Reduction = "mean",
        constant: bool = False,
    ) -> None:
        super().__init__()
        where = "FirstPhotonNLL"
        check_held(reduction, dim, where)
        check_option("floor", floor, where, zero=True)
        flag(f"{where}: constant", constant)
        self.cycles = check_whole("cycles", cycles, where, UnitError)
        self.dead_bins = None if dead_bins is None else _check_dead_time(dead_bins, where)
        self.floor, self.dim, self.reduction, self.constant = floor, dim, reduction, constant

    def forward(self, input: Transient, target: Transient, mask: Tensor | None = None) -> Tensor:
        return first_photon_nll(
            input,
            target,
            self.cycles,
            dead_bins=self.dead_bins,
            floor=self.floor,
            constant=self.constant,
            dim=self.dim,
            mask=mask,
            reduction=self.reduction,
        )


FirstPhotonLoss = FirstPhotonNLL


class FreeRunningNLL(nn.Module):
    """`free_running_nll(input, target, periods, dead_bins)` with its options held."""

    def __init__(
        self,
        periods: int,
        dead_bins: float,
        *,
        floor: float | None = None,
        dim: int | None = None,
        reduction: Reduction = "mean",
    ) -> None:
        super().__init__()
        where = "FreeRunningNLL"
        check_held(reduction, dim, where)
        check_option("floor", floor, where, zero=True)
        self.periods = check_whole("periods", periods, where, UnitError)
        self.dead_bins = _check_dead_time(dead_bins, where)
        self.floor, self.dim, self.reduction = floor, dim, reduction

    def forward(self, input: Transient, target: Transient, mask: Tensor | None = None) -> Tensor:
        return free_running_nll(
            input,
            target,
            periods=self.periods,
            dead_bins=self.dead_bins,
            floor=self.floor,
            dim=self.dim,
            mask=mask,
            reduction=self.reduction,
        )
