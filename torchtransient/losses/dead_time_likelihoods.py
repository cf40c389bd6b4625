"""Negative log-likelihoods of detectors that are dead after a detection: first-photon and free-running.

Rates and histograms, floors, masks and `dim` as those of `likelihoods.py`. A bin that does not count still takes cycles
from those behind it, only pixels without any bin that counts are not looked at: NaN in one is NaN in the loss of those
behind it (free-running: of the pixel). `first_photon_loss(input, target)` is the same with the model first.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from torchtransient.errors import UnitError
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
from torchtransient.losses.likelihoods import Options, check_constant, check_counts, check_rates, floored
from torchtransient.losses.results import TRANSIENT, Transient, reads
from torchtransient.quantities import positive
from torchtransient.sensing.dead_time_cycle import check_dead_bins
from torchtransient.sensing.spad import first_photon_log_prob

_TIME = -3


def _check_dead_time(dead_bins: float, where: str) -> float:
    check_number("dead_bins", dead_bins, where)
    number = positive(f"{where}: dead_bins", dead_bins)
    try:
        check_dead_bins(number)
    except UnitError as error:
        raise UnitError(f"{where}: {error}") from None
    return number


def _exact(measured: Tensor, mask: Tensor | None, dim: int) -> Tensor:
    """Counts in double precision, 0 in pixels of which no bin counts: detectors that are dead need sums of them."""
    counts = measured.to(torch.float64)
    return counts if mask is None else counted(counts, mask.any(dim, keepdim=True))


@reads(counts=TRANSIENT, rate=TRANSIENT)
def first_photon_nll(
    counts: Transient,
    rate: Transient,
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

    -(n log(1 - exp(-r)) - r (armed - n)), r = rate + floor, convex in r, least at the Coates estimate. `counts`:
    (..., C, T, H, W) of `cycles` cycles; `rate`: expected detections per cycle and bin of a detector that is never
    dead; `dead_bins`: several detections per cycle (`SynchronousSPAD`). `floor` as in `poisson_nll`. Raises ShapeError;
    UnitError for negative rates or more counts than cycles.
    """
    options = Options(floor, dim, mask, reduction, constant)
    return _first_photon(counts, rate, cycles, dead_bins, options, "first_photon_nll")


@reads(input=TRANSIENT, target=TRANSIENT)
def first_photon_loss(
    input: Transient,
    target: Transient,
    cycles: int,
    *,
    dead_bins: float | None = None,
    floor: Tensor | float | None = None,
    dim: int | None = None,
    mask: Tensor | None = None,
    reduction: Reduction = "mean",
) -> Tensor:
    """`first_photon_nll(target, input, cycles)`: a model's rates per cycle and bin against a histogram of counts.

    Flat beyond the width of a pulse: from farther away take `multiscale_loss` of it (docs/losses.md).
    """
    options = Options(floor, dim, mask, reduction)
    return _first_photon(target, input, cycles, dead_bins, options, "first_photon_loss")


def _first_photon(
    given: object, model: object, cycles: int, dead_bins: float | None, options: Options, where: str
) -> Tensor:
    check_reduction(options.reduction, where)
    (measured, _), rate = check_dense((given, model), where), check_counts(given, model, where)[1]
    number = check_whole("cycles", cycles, where, UnitError)
    dead = None if dead_bins is None else _check_dead_time(dead_bins, where)
    dim = bins_dim(rate, options.dim, where)
    mask = check_mask(options.mask, rate, where)
    rate = counted(rate, mask, 1.0)
    check_rates(rate, where)
    measured = _exact(measured, mask, dim)
    check_constant(measured, options.constant, where)
    n, r = (as_columns(x, dim) for x in (measured, floored(rate, measured / number, options, mask, where)))
    value = -first_photon_log_prob(n, r, number, dead, constant=options.constant, where=where).reshape(rate.shape)
    return _reduce(value, options.reduction, where, mask)


def armed_periods(counts: Tensor, periods: int, dead_bins: float) -> Tensor:
    """Periods in which a free-running detector was armed, averaged over each bin, from its histogram: float64.

    Every detection takes the dead time that follows it, round the period and for as many periods as it lasts.
    Detections count as spread evenly over their bin.
    """
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


@reads(counts=TRANSIENT, rate=TRANSIENT)
def free_running_nll(
    counts: Transient,
    rate: Transient,
    periods: int,
    dead_bins: float,
    *,
    floor: Tensor | float | None = None,
    dim: int | None = None,
    mask: Tensor | None = None,
    reduction: Reduction = "mean",
) -> Tensor:
    """-log-likelihood of a free-running SPAD's histogram with non-paralyzable dead time, up to a constant.

    That of photons while the detector is armed, which the histogram alone tells (`armed_periods`): r armed - n log(r).
    Exact but for the periods at both ends of the exposure and the places of detections inside a bin: the error of the
    best rate, r = n/armed, is second order in the counts of a bin per period. Its least is where Rapp et al. and Gupta
    et al. (see `sensing.free_running`) put it. Arguments as in `first_photon_nll`.
    """
    where = "free_running_nll"
    check_reduction(reduction, where)
    (measured, _), rate = check_dense((counts, rate), where), check_counts(counts, rate, where)[1]
    periods, dead_bins = check_whole("periods", periods, where, UnitError), _check_dead_time(dead_bins, where)
    dim = bins_dim(rate, dim, where)
    mask = check_mask(mask, rate, where)
    rate = counted(rate, mask, 1.0)
    check_rates(rate, where)
    n = as_columns(_exact(measured, mask, dim), dim)
    armed = armed_periods(n, periods, dead_bins)
    # the ends of the exposure and the places inside a bin leave an uncertainty of about the square root of the counts
    if bool((armed < -(2 + 6 * n.sum(_TIME, keepdim=True).clamp_min(0).sqrt())).any()):
        raise UnitError(
            f"{where}: expected counts that fit into {periods} periods with dead time {dead_bins:g} bins, "
            "got more. Check periods and dead time."
        )
    rate = floored(rate, n.reshape(rate.shape) / periods, Options(floor, dim, mask, reduction), mask, where)
    r = as_columns(rate, dim).to(torch.float64)
    hit = n != 0
    value = r * armed.clamp_min(0) - torch.where(hit, n * torch.where(hit, r, torch.ones_like(r)).log(), 0.0)
    return _reduce(value.to(rate.dtype).reshape(rate.shape), reduction, where, mask)


class _FirstPhoton(nn.Module):
    def __init__(
        self, cycles: int, dead_bins: float | None, floor: float | None, dim: int | None, reduction: Reduction
    ) -> None:
        super().__init__()
        where = type(self).__name__
        check_held(reduction, dim, where)
        check_option("floor", floor, where, zero=True)
        self.cycles = check_whole("cycles", cycles, where, UnitError)
        self.dead_bins = None if dead_bins is None else _check_dead_time(dead_bins, where)
        self.floor, self.dim, self.reduction = floor, dim, reduction


class FirstPhotonNLL(_FirstPhoton):
    """`first_photon_nll(counts, rate, cycles)` with its options held."""

    def __init__(
        self,
        cycles: int,
        dead_bins: float | None = None,
        floor: float | None = None,
        dim: int | None = None,
        reduction: Reduction = "mean",
    ) -> None:
        # here rather than in the base, whose name Python would give for an argument that is missing
        super().__init__(cycles, dead_bins, floor, dim, reduction)

    def forward(self, counts: Transient, rate: Transient, mask: Tensor | None = None) -> Tensor:
        return first_photon_nll(
            counts,
            rate,
            self.cycles,
            dead_bins=self.dead_bins,
            floor=self.floor,
            dim=self.dim,
            mask=mask,
            reduction=self.reduction,
        )


class FirstPhotonLoss(_FirstPhoton):
    """`first_photon_loss(input, target, cycles)` with its options held."""

    def __init__(
        self,
        cycles: int,
        dead_bins: float | None = None,
        floor: float | None = None,
        dim: int | None = None,
        reduction: Reduction = "mean",
    ) -> None:
        super().__init__(cycles, dead_bins, floor, dim, reduction)

    def forward(self, input: Transient, target: Transient, mask: Tensor | None = None) -> Tensor:
        return first_photon_loss(
            input,
            target,
            self.cycles,
            dead_bins=self.dead_bins,
            floor=self.floor,
            dim=self.dim,
            mask=mask,
            reduction=self.reduction,
        )


class FreeRunningNLL(nn.Module):
    """`free_running_nll(counts, rate, periods, dead_bins)` with its options held."""

    def __init__(
        self,
        periods: int,
        dead_bins: float,
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

    def forward(self, counts: Transient, rate: Transient, mask: Tensor | None = None) -> Tensor:
        return free_running_nll(
            counts,
            rate,
            self.periods,
            self.dead_bins,
            floor=self.floor,
            dim=self.dim,
            mask=mask,
            reduction=self.reduction,
        )
