"""Negative log-likelihoods that match the noise of the sensors: Poisson, first-photon, free-running, read noise.

All take rates or means (..., C, T, H, W) and measurements of the same shape, and are finite, with finite gradients, at
zero counts and in empty bins. Where the model says "impossible" (a count where the mean is 0) a floor keeps them so:
`floor`, in the unit of the mean, is added to it. Counts below 0 (those of a normal surrogate) enter the same formulas,
which keeps the gradient unbiased. Terms that do not depend on the mean are left out unless `constant`.
Counts may be whole numbers, truth values of frames, or half precision; the loss is computed and returned in the
precision of the more precise of the two, float32 at least. `dim`: where time is, which also says over what the average
is (`layouts.py`). `mask`: truth values that broadcast to the tensors, True
counts (`comparison.py`). First-photon and free-running detectors are dead for some time after every detection: a bin
that does not count still takes cycles from those behind it, only pixels without any bin that counts are not looked at.
`poisson_loss(input, target)` and `first_photon_loss` are the same with the model first, as torch and the other losses.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from torchtransient.errors import UnitError
from torchtransient.losses.comparison import (
    Reduction,
    check_dense,
    check_level,
    check_mask,
    check_pair,
    check_whole,
    counted,
    item_mean,
    working_dtype,
)
from torchtransient.losses.comparison import reduce as _reduce
from torchtransient.losses.layouts import as_columns, bins_dim, item_dims
from torchtransient.quantities import positive
from torchtransient.sensing.running_sums import split_dead_time
from torchtransient.sensing.spad import first_photon_log_prob

_TIME = -3
# Relative to the average of an item: small against noise, large enough that 1/floor stays a usable gradient.
_RELATIVE_FLOOR = 1e-3


def _check(measured: Tensor, model: Tensor, where: str) -> tuple[Tensor, Tensor]:
    """Both in their common dtype. Raises ShapeError, DeviceError; UnitError for other numbers and whole models."""
    pair = check_pair(measured, model, where, names="counts and model")
    if not model.is_floating_point():
        raise UnitError(f"{where}: expected a model of a floating dtype, got {model.dtype}. Use model.float().")
    return pair


def _check_rates(model: Tensor, where: str) -> None:
    """Rates cannot be negative. NaN passes and is what comes out."""
    if bool((model.detach() < 0).any()):
        raise UnitError(f"{where}: expected rates >= 0, got negative ones. Clamp or use softplus upstream.")


def _exact(measured: Tensor, mask: Tensor | None, dim: int) -> Tensor:
    """Counts in double precision, 0 in pixels of which no bin counts: detectors that are dead need sums of them."""
    counts = measured.to(torch.float64)
    return counts if mask is None else counted(counts, mask.any(dim, keepdim=True))


def _floored(
    model: Tensor, floor: Tensor | float | None, dim: int | None, mask: Tensor | None, where: str
) -> Tensor:
    if floor is None:
        return model + _relative_floor(model, item_dims(model, dim, where, " or floor="), mask)
    return model + check_level("floor", floor, model, where, zero=True)


def relative_floor(
    model: Tensor, share: float = _RELATIVE_FLOOR, mask: Tensor | None = None, dim: int | None = None
) -> Tensor:
    """`share` of the mean of each item (its C, T, H, W) of the model, without gradient: a floor that knows the scale.

    Broadcasts to `model`. Items of a batch have floors of their own, so that a bright one does not cover a dark one; an
    item that is dark altogether has that of the whole batch, since a count in it has to cost something finite. `dim`:
    where time is, which says what is an item (`losses.layouts`). `mask`: means are over what counts.
    """
    where = "relative_floor"
    check_dense((model,), where)
    model = model.to(working_dtype((model,), where))
    mask = check_mask(mask, model, where)
    part = check_level("share", share, model.new_empty(()), where)
    return _relative_floor(model, item_dims(model, dim, where), mask, part)


def _relative_floor(
    model: Tensor, dims: tuple[int, ...], mask: Tensor | None, share: Tensor | float = _RELATIVE_FLOOR
) -> Tensor:
    size = counted(model.detach(), mask).abs()
    number = max(1, size.numel()) if mask is None else mask.sum().clamp_min(1)
    whole = size.sum() / number
    item = item_mean(model, dims, mask) if len(dims) < model.ndim else whole
    return (share * torch.where(item > 0, item, whole)).clamp_min(torch.finfo(model.dtype).tiny)


def poisson_nll(
    counts: Tensor,
    mean: Tensor,
    *,
    floor: Tensor | float | None = None,
    constant: bool = False,
    dim: int | None = None,
    mask: Tensor | None = None,
    reduction: Reduction = "mean",
) -> Tensor:
    """-log of the Poisson probability of `counts`: m - n log m (+ log n! with `constant`), m = mean + floor.

    `floor` None: 1e-3 of the average of each item (`relative_floor`), which biases empty bins by as much; 0: the exact
    likelihood, infinite where a count meets a mean of 0. Empty bins have value m and gradient 1 even at m = 0. Raises
    ShapeError for different shapes, UnitError for negative means.
    """
    counts, mean = _check(counts, mean, "poisson_nll")
    mask = check_mask(mask, mean, "poisson_nll")
    counts, mean = counted(counts, mask), counted(mean, mask, 1.0)
    _check_rates(mean, "poisson_nll")
    m = _floored(mean, floor, dim, mask, "poisson_nll")
    hit = counts != 0
    # where on the input: xlogy(0, 0) has a NaN gradient
    log_mean = torch.where(hit, m, torch.ones_like(m)).log()
    value = m - torch.where(hit, counts * log_mean, torch.zeros_like(m))
    if constant:
        value = value + torch.lgamma(counts + 1)
    return _reduce(value, reduction, "poisson_nll", mask)


def first_photon_nll(
    counts: Tensor,
    rate: Tensor,
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
    where = "first_photon_nll"
    measured, rate = counts, _check(counts, rate, where)[1]
    number = check_whole("cycles", cycles, where, UnitError)
    dead = None if dead_bins is None else positive(f"{where}: dead_bins", dead_bins)
    dim = bins_dim(rate, dim, where)
    mask = check_mask(mask, rate, where)
    rate = counted(rate, mask, 1.0)
    _check_rates(rate, where)
    n, r = (as_columns(x, dim) for x in (_exact(measured, mask, dim), _floored(rate, floor, dim, mask, where)))
    value = -first_photon_log_prob(n, r, number, dead, constant=constant).reshape(rate.shape)
    return _reduce(value, reduction, where, mask)


def armed_periods(counts: Tensor, periods: int, dead_bins: float) -> Tensor:
    """Periods in which a free-running detector was armed, averaged over each bin, from its histogram: float64.

    Every detection takes the dead time that follows it, round the period and for as many periods as it lasts.
    Detections count as spread evenly over their bin.
    """
    split_dead_time(dead_bins)  # says what is wrong with a dead time that is too short
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


def free_running_nll(
    counts: Tensor,
    rate: Tensor,
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
    measured, rate = counts, _check(counts, rate, where)[1]
    periods, dead_bins = check_whole("periods", periods, where, UnitError), positive(f"{where}: dead_bins", dead_bins)
    dim = bins_dim(rate, dim, where)
    mask = check_mask(mask, rate, where)
    rate = counted(rate, mask, 1.0)
    _check_rates(rate, where)
    n = as_columns(_exact(measured, mask, dim), dim)
    armed = armed_periods(n, periods, dead_bins)
    # the ends of the exposure and the places inside a bin leave an uncertainty of about the square root of the counts
    if bool((armed < -(2 + 6 * n.sum(_TIME, keepdim=True).sqrt())).any()):
        raise UnitError(
            f"{where}: expected counts that fit into {periods} periods with dead time {dead_bins:g} bins, "
            "got more. Check periods and dead time."
        )
    r = as_columns(_floored(rate, floor, dim, mask, where), dim).to(torch.float64)
    hit = n != 0
    value = r * armed.clamp_min(0) - torch.where(hit, n * torch.where(hit, r, torch.ones_like(r)).log(), 0.0)
    return _reduce(value.to(rate.dtype).reshape(rate.shape), reduction, where, mask)


def read_noise_nll(
    measured: Tensor,
    mean: Tensor,
    read_noise: Tensor | float,
    *,
    shot_noise: bool = True,
    constant: bool = True,
    mask: Tensor | None = None,
    reduction: Reduction = "mean",
) -> Tensor:
    """-log-likelihood of a normal distribution: read noise, and the normal approximation of shot noise.

    (y - m)^2 / (2 v) + log(v)/2 (+ log(2 pi)/2 with `constant`), v = read_noise^2 + max(m, 0) with `shot_noise`, in
    electrons. `read_noise` > 0, a number or a tensor that broadcasts; differentiable in it and in `mean`.
    """
    measured, mean = _check(measured, mean, "read_noise_nll")
    mask = check_mask(mask, mean, "read_noise_nll")
    measured, mean = counted(measured, mask), counted(mean, mask)
    # without it an empty pixel has no width
    sigma = check_level("read_noise", read_noise, mean, "read_noise_nll", square=True)
    variance = sigma**2 + (mean.clamp_min(0) if shot_noise else torch.zeros_like(mean))
    value = (measured - mean) ** 2 / (2 * variance) + 0.5 * variance.log()
    if constant:
        value = value + 0.5 * math.log(2 * math.pi)
    return _reduce(value, reduction, "read_noise_nll", mask)


def poisson_loss(
    input: Tensor,
    target: Tensor,
    *,
    floor: Tensor | float | None = None,
    dim: int | None = None,
    mask: Tensor | None = None,
    reduction: Reduction = "mean",
) -> Tensor:
    """`poisson_nll(target, input)`: a model's mean counts (..., C, T, Y, X) against counts."""
    return poisson_nll(target, input, floor=floor, dim=dim, mask=mask, reduction=reduction)


def first_photon_loss(
    input: Tensor,
    target: Tensor,
    cycles: int,
    *,
    dead_bins: float | None = None,
    floor: Tensor | float | None = None,
    dim: int | None = None,
    mask: Tensor | None = None,
    reduction: Reduction = "mean",
) -> Tensor:
    """`first_photon_nll(target, input, cycles)`: a model's rates per cycle and bin against a histogram of counts."""
    return first_photon_nll(
        target, input, cycles, dead_bins=dead_bins, floor=floor, dim=dim, mask=mask, reduction=reduction
    )


class PoissonNLL(nn.Module):
    """`poisson_nll(counts, mean)` with its options held."""

    def __init__(self, floor: float | None = None, dim: int | None = None, reduction: Reduction = "mean") -> None:
        super().__init__()
        self.floor, self.dim, self.reduction = floor, dim, reduction

    def forward(self, counts: Tensor, mean: Tensor, mask: Tensor | None = None) -> Tensor:
        return poisson_nll(counts, mean, floor=self.floor, dim=self.dim, mask=mask, reduction=self.reduction)


class FirstPhotonNLL(nn.Module):
    """`first_photon_nll(counts, rate, cycles)` with its options held."""

    def __init__(
        self,
        cycles: int,
        dead_bins: float | None = None,
        floor: float | None = None,
        dim: int | None = None,
        reduction: Reduction = "mean",
    ) -> None:
        super().__init__()
        self.cycles, self.dead_bins, self.floor = cycles, dead_bins, floor
        self.dim, self.reduction = dim, reduction

    def forward(self, counts: Tensor, rate: Tensor, mask: Tensor | None = None) -> Tensor:
        return first_photon_nll(
            counts, rate,
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
        self.periods, self.dead_bins, self.floor = periods, dead_bins, floor
        self.dim, self.reduction = dim, reduction

    def forward(self, counts: Tensor, rate: Tensor, mask: Tensor | None = None) -> Tensor:
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


class ReadNoiseNLL(nn.Module):
    """`read_noise_nll(measured, mean, read_noise)` with its options held."""

    def __init__(self, read_noise: float, shot_noise: bool = True, reduction: Reduction = "mean") -> None:
        super().__init__()
        self.read_noise, self.shot_noise, self.reduction = read_noise, shot_noise, reduction

    def forward(self, measured: Tensor, mean: Tensor, mask: Tensor | None = None) -> Tensor:
        return read_noise_nll(
            measured, mean, self.read_noise, shot_noise=self.shot_noise, mask=mask, reduction=self.reduction
        )


class PoissonLoss(nn.Module):
    """`poisson_loss(input, target)` with its options held."""

    def __init__(self, floor: float | None = None, dim: int | None = None, reduction: Reduction = "mean") -> None:
        super().__init__()
        self.floor, self.dim, self.reduction = floor, dim, reduction

    def forward(self, input: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
        return poisson_loss(input, target, floor=self.floor, dim=self.dim, mask=mask, reduction=self.reduction)


class FirstPhotonLoss(nn.Module):
    """`first_photon_loss(input, target, cycles)` with its options held."""

    def __init__(
        self,
        cycles: int,
        dead_bins: float | None = None,
        floor: float | None = None,
        dim: int | None = None,
        reduction: Reduction = "mean",
    ) -> None:
        super().__init__()
        self.cycles, self.dead_bins, self.floor = cycles, dead_bins, floor
        self.dim, self.reduction = dim, reduction

    def forward(self, input: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
        return first_photon_loss(
            input, target,
            self.cycles,
            dead_bins=self.dead_bins,
            floor=self.floor,
            dim=self.dim,
            mask=mask,
            reduction=self.reduction,
        )
