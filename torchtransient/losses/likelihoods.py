"""Negative log-likelihoods that match the noise of the sensors: Poisson, first-photon, free-running, read noise.

All take rates or means (..., C, T, H, W) and measurements of the same shape, and are finite, with finite gradients, at
zero counts and in empty bins. Where the model says "impossible" (a count where the mean is 0) a floor keeps them so:
`floor`, in the unit of the mean, is added to it. Counts below 0 (those of a normal surrogate) enter the same formulas,
which keeps the gradient unbiased. Terms that do not depend on the mean are left out unless `constant`.
Half precision is computed, and the loss returned, in float32.
"""

from __future__ import annotations

import math
from typing import Literal, get_args

import torch
from torch import Tensor, nn

from torchtransient.errors import ShapeError, UnitError
from torchtransient.sensing.running_sums import split_dead_time
from torchtransient.sensing.spad import first_photon_log_prob

Reduction = Literal["none", "sum", "mean"]

_TIME = -3
# Relative to the average of an item: small against noise, large enough that 1/floor stays a usable gradient.
_RELATIVE_FLOOR = 1e-3


def _check(measured: Tensor, model: Tensor, where: str) -> None:
    if not isinstance(measured, Tensor) or not isinstance(model, Tensor):
        raise ShapeError(f"{where}: expected two tensors, got {type(measured).__name__} and {type(model).__name__}.")
    if measured.shape != model.shape:
        raise ShapeError(
            f"{where}: expected counts and model of one shape, got {tuple(measured.shape)} and {tuple(model.shape)}."
        )
    if not model.is_floating_point():
        raise UnitError(f"{where}: expected a floating dtype, got {model.dtype}.")


def _check_counts(counts: Tensor, model: Tensor, where: str) -> None:
    """As `_check`, and rates cannot be negative. NaN in either passes and is what comes out."""
    _check(counts, model, where)
    if bool((model.detach() < 0).any()):
        raise UnitError(f"{where}: expected rates >= 0, got negative ones. Clamp or use softplus upstream.")


def _reduce(value: Tensor, reduction: Reduction, where: str) -> Tensor:
    if reduction not in get_args(Reduction):
        raise ShapeError(f"{where}: expected reduction 'none', 'sum' or 'mean', got {reduction!r}.")
    if reduction == "none":
        return value
    return value.sum() if reduction == "sum" else value.mean()


def _single(model: Tensor) -> Tensor:
    """Half precision, as networks give it under autocast, in float32: squares of counts exceed float16."""
    return model.float() if model.dtype in (torch.float16, torch.bfloat16) else model


def relative_floor(model: Tensor, share: float = _RELATIVE_FLOOR) -> Tensor:
    """`share` of the mean of each item (its C, T, H, W) of the model, without gradient: a floor that knows the scale.

    Broadcasts to `model`. Items of a batch have floors of their own, so that a bright one does not cover a dark one; an
    item that is dark altogether has that of the whole batch, since a count in it has to cost something finite.
    """
    size = model.detach().abs()
    whole = size.mean() if size.numel() else size.sum()
    item = size.mean((-4, -3, -2, -1), keepdim=True) if size.ndim > 4 else whole
    return (share * torch.where(item > 0, item, whole)).clamp_min(torch.finfo(model.dtype).tiny)


def poisson_nll(
    counts: Tensor,
    mean: Tensor,
    *,
    floor: Tensor | float | None = None,
    constant: bool = False,
    reduction: Reduction = "mean",
) -> Tensor:
    """-log of the Poisson probability of `counts`: m - n log m (+ log n! with `constant`), m = mean + floor.

    `floor` None: 1e-3 of the average of each item (`relative_floor`), which biases empty bins by as much; 0: the exact
    likelihood, infinite where a count meets a mean of 0. Empty bins have value m and gradient 1 even at m = 0. Raises
    ShapeError for different shapes, UnitError for negative means.
    """
    _check_counts(counts, mean, "poisson_nll")
    mean = _single(mean)
    m = mean + (relative_floor(mean) if floor is None else floor)
    hit = counts != 0
    # where on the input: xlogy(0, 0) has a NaN gradient
    log_mean = torch.where(hit, m, torch.ones_like(m)).log()
    value = m - torch.where(hit, counts * log_mean, torch.zeros_like(m))
    if constant:
        value = value + torch.lgamma(counts + 1)
    return _reduce(value, reduction, "poisson_nll")


def first_photon_nll(
    counts: Tensor,
    rate: Tensor,
    cycles: int,
    *,
    dead_bins: float | None = None,
    floor: Tensor | float | None = None,
    constant: bool = False,
    reduction: Reduction = "mean",
) -> Tensor:
    """-log-likelihood of a synchronous SPAD's histogram: binomial in each bin given the cycles still armed.

    -(n log(1 - exp(-r)) - r (armed - n)), r = rate + floor, convex in r, least at the Coates estimate. `counts`:
    (..., C, T, H, W) of `cycles` cycles; `rate`: expected detections per cycle and bin of a detector that is never
    dead; `dead_bins`: several detections per cycle (`SynchronousSPAD`). `floor` as in `poisson_nll`. Raises ShapeError;
    UnitError for negative rates or more counts than cycles.
    """
    _check_counts(counts, rate, "first_photon_nll")
    rate = _single(rate)
    r = rate + (relative_floor(rate) if floor is None else floor)
    value = -first_photon_log_prob(counts, r, cycles, dead_bins, constant=constant)
    return _reduce(value, reduction, "first_photon_nll")


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
    reduction: Reduction = "mean",
) -> Tensor:
    """-log-likelihood of a free-running SPAD's histogram with non-paralyzable dead time, up to a constant.

    That of photons while the detector is armed, which the histogram alone tells (`armed_periods`): r armed - n log(r).
    Exact but for the periods at both ends of the exposure and the places of detections inside a bin: the error of the
    best rate, r = n/armed, is second order in the counts of a bin per period. Its least is where Rapp et al. and Gupta
    et al. (see `sensing.free_running`) put it. Arguments as in `first_photon_nll`.
    """
    _check_counts(counts, rate, "free_running_nll")
    rate = _single(rate)
    n = counts.to(torch.float64)
    armed = armed_periods(n, periods, dead_bins)
    # the ends of the exposure and the places inside a bin leave an uncertainty of about the square root of the counts
    if bool((armed < -(2 + 6 * n.sum(_TIME, keepdim=True).sqrt())).any()):
        raise UnitError(
            f"free_running_nll: expected counts that fit into {periods} periods with dead time {dead_bins:g} bins, "
            "got more. Check periods and dead time."
        )
    r = (rate + (relative_floor(rate) if floor is None else floor)).to(torch.float64)
    hit = n != 0
    value = r * armed.clamp_min(0) - torch.where(hit, n * torch.where(hit, r, torch.ones_like(r)).log(), 0.0)
    return _reduce(value.to(rate.dtype), reduction, "free_running_nll")


def read_noise_nll(
    measured: Tensor,
    mean: Tensor,
    read_noise: Tensor | float,
    *,
    shot_noise: bool = True,
    constant: bool = True,
    reduction: Reduction = "mean",
) -> Tensor:
    """-log-likelihood of a normal distribution: read noise, and the normal approximation of shot noise.

    (y - m)^2 / (2 v) + log(v)/2 (+ log(2 pi)/2 with `constant`), v = read_noise^2 + max(m, 0) with `shot_noise`, in
    electrons. `read_noise` > 0, a number or a tensor that broadcasts; differentiable in it and in `mean`.
    """
    _check(measured, mean, "read_noise_nll")
    measured, mean = _single(measured), _single(mean)
    sigma = torch.as_tensor(read_noise, device=mean.device).to(mean.dtype)
    if not bool((sigma.detach() > 0).all()):
        raise UnitError("read_noise_nll: expected read_noise > 0 electrons: without it an empty pixel has no width.")
    variance = sigma**2 + (mean.clamp_min(0) if shot_noise else torch.zeros_like(mean))
    value = (measured - mean) ** 2 / (2 * variance) + 0.5 * variance.log()
    if constant:
        value = value + 0.5 * math.log(2 * math.pi)
    return _reduce(value, reduction, "read_noise_nll")


class PoissonNLL(nn.Module):
    """`poisson_nll(counts, mean)` with its options held."""

    def __init__(self, floor: float | None = None, reduction: Reduction = "mean") -> None:
        super().__init__()
        self.floor, self.reduction = floor, reduction

    def forward(self, counts: Tensor, mean: Tensor) -> Tensor:
        return poisson_nll(counts, mean, floor=self.floor, reduction=self.reduction)


class FirstPhotonNLL(nn.Module):
    """`first_photon_nll(counts, rate, cycles)` with its options held."""

    def __init__(
        self, cycles: int, dead_bins: float | None = None, floor: float | None = None, reduction: Reduction = "mean"
    ) -> None:
        super().__init__()
        self.cycles, self.dead_bins, self.floor, self.reduction = cycles, dead_bins, floor, reduction

    def forward(self, counts: Tensor, rate: Tensor) -> Tensor:
        return first_photon_nll(
            counts, rate, self.cycles, dead_bins=self.dead_bins, floor=self.floor, reduction=self.reduction
        )


class FreeRunningNLL(nn.Module):
    """`free_running_nll(counts, rate, periods, dead_bins)` with its options held."""

    def __init__(
        self, periods: int, dead_bins: float, floor: float | None = None, reduction: Reduction = "mean"
    ) -> None:
        super().__init__()
        self.periods, self.dead_bins, self.floor, self.reduction = periods, dead_bins, floor, reduction

    def forward(self, counts: Tensor, rate: Tensor) -> Tensor:
        return free_running_nll(counts, rate, self.periods, self.dead_bins, floor=self.floor, reduction=self.reduction)


class ReadNoiseNLL(nn.Module):
    """`read_noise_nll(measured, mean, read_noise)` with its options held."""

    def __init__(self, read_noise: float, shot_noise: bool = True, reduction: Reduction = "mean") -> None:
        super().__init__()
        self.read_noise, self.shot_noise, self.reduction = read_noise, shot_noise, reduction

    def forward(self, measured: Tensor, mean: Tensor) -> Tensor:
        return read_noise_nll(measured, mean, self.read_noise, shot_noise=self.shot_noise, reduction=self.reduction)
