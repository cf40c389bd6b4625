"""Negative log-likelihoods that match the noise of sensors: Poisson, read noise, and detectors with dead time.

All take `(input, target)`: a prediction (rates or means) and a measurement of the same shape. They are exact, and
finite with finite gradients at zero counts, in empty bins and for a model without light.

- Where the model calls a count impossible (a mean of 0), the logarithm continues as its tangent below a mean of 1e-9 of
  the counts of the bin: convex, with a slope, and without effect on fits, since as many bins as that hold less than one
  count. For a prediction in float16 the slope ends at 2^15 times the number of bins averaged over, which float16 holds.
- `floor`, in the unit of the mean, is added to the mean instead and biases bins as dark as it; 0 is the plain formula,
  infinite where a count meets a mean of 0.
- Counts below 0 (of a normal surrogate) enter the same formulas, which are linear in them: gradients stay unbiased.
  With `constant`, the logarithms of factorials, they raise UnitError.
- NaN in counts or model is NaN in the loss, unless masked.
- The loss is computed in the more precise dtype of both, float32 at least; detectors with dead time count in float64.

Detectors with dead time need the counts of masked bins, which take cycles from later bins; only pixels without any bin
that counts are left out.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import cast

import torch
from torch import Tensor

from torchtransient.errors import GradientError, ShapeError, TorchTransientWarning, UnitError, level_of_user
from torchtransient.floating import is_true
from torchtransient.losses.checks import (
    Reduction,
    check_dense,
    check_level,
    check_mask,
    check_number,
    check_pair,
    check_whole,
    counted,
    item_mean,
    reduce,
    working_dtype,
)
from torchtransient.losses.layouts import as_columns, bins_dim, item_dims
from torchtransient.losses.loss_module import LossModule
from torchtransient.losses.results import LIGHT, TRANSIENT, Light, Transient, reads
from torchtransient.sensing.dead_time.renewal import check_dead_bins
from torchtransient.sensing.spad import exposed_cycles, first_photon_log_prob

# Mean, relative to the counts of a bin, below which its logarithm is continued by the tangent. Bins of so small a mean
# hold less than one count in 1e9, and a slope of 1e9 has a square that single precision holds.
_LEAST_MEAN = 1e-9
# The same for predictions in float16, whose normal numbers go from 6e-5 to 65504.
_LEAST_IN_HALF = 2.0**-15
# Number of bins that the loss of a float16 prediction is averaged over, while its parts are compared in float32.
_OF_HALF: ContextVar[Tensor | float | None] = ContextVar("of_half", default=None)
# Smaller records are written by hand, where whole numbers say nothing.
_A_RECORD = 64
# Relative to the average of an item: small against noise, large enough that 1/floor is a usable gradient.
_RELATIVE_FLOOR = 1e-3
# Relative to the counts of an item: a darker model has the floor of a model this bright. Continuous, so that the loss
# falls all the way out of the dark.
_DARK = 0.1
_TIME = -3


# ------------------------------------------------------------------------------------------------- Poisson, read noise


@reads(input=LIGHT, target=LIGHT)
def poisson_nll(
    input: Light,
    target: Light,
    *,
    floor: Tensor | float | None = None,
    constant: bool = False,
    mask: Tensor | None = None,
    reduction: Reduction = "mean",
) -> Tensor:
    """Compute the negative log-likelihood of Poisson counts, `m - n log m` with mean m and counts n, in nats.

    Exact: a bin without counts has the value m and the gradient 1, at m = 0 too; a count at a mean of 0 costs about 20
    nats, with a slope of 1e9. The logarithm of a *noisy render* biases a fit by many times the noise of the counts
    (docs/noisy_renders.md).

    Args:
        input: mean counts of a model, any shape, not negative.
        target: counts, of the same shape.
        floor: mean counts added to those of the model, number or tensor that broadcasts; `relative_floor` makes one of
            the model.
        constant: add `log n!`.
        mask: bins that count.
        reduction: "mean" over bins that count, "sum", or "none".

    Returns:
        Scalar, or the shape of the input for "none".

    Raises:
        UnitError: for negative means, or an integer prediction (which is in the place of the counts).
        GradientError: for a target with a gradient where the input has none or holds counts: arguments swapped.
        ShapeError: for two shapes.
    """
    where = "poisson_nll"
    mean, counts, mask = _rates(input, target, mask, where)
    counts = counted(counts, mask)
    _check_constant(counts, constant, where)
    m = _floored(mean, floor, where)
    level = _dark_level(counts, floor, input, averaged=divisor(mean, mask, reduction))
    value = m - _count_log(counts, m, level)
    if constant:
        value = value + torch.lgamma(counts + 1)
    return reduce(value, reduction, where, mask)


poisson_loss = poisson_nll


class PoissonNLL(LossModule, function=poisson_nll, by_place=("floor", "reduction")):
    """`poisson_nll` with its options held."""


PoissonLoss = PoissonNLL


@reads(input=LIGHT, target=LIGHT)
def read_noise_nll(
    input: Light,
    target: Light,
    read_noise: Tensor | float,
    *,
    shot_noise: bool = True,
    constant: bool = True,
    mask: Tensor | None = None,
    reduction: Reduction = "mean",
) -> Tensor:
    """Compute the negative log-likelihood of normal read noise with the normal approximation of shot noise.

    `(y - m)^2 / (2 v) + log(v) / 2` with the variance `v = read_noise^2 + max(m, 0)`, in nats.

    Args:
        input: mean m in electrons, any shape, negative too.
        target: measurement y in electrons, of the same shape.
        read_noise: standard deviation in electrons, above zero; number or tensor that broadcasts, differentiable.
        shot_noise: False leaves `max(m, 0)` out of the variance.
        constant: add `log(2 pi) / 2`.
        mask: bins that count.
        reduction: "mean" over bins that count, "sum", or "none".

    Returns:
        Scalar, or the shape of the input for "none".

    Raises:
        UnitError: for a read noise that is not above zero, or an integer prediction.
        GradientError: for swapped arguments, as in `poisson_nll`.
    """
    where = "read_noise_nll"
    mean, measured = _check_prediction(input, target, where)
    mask = check_mask(mask, mean, where)
    measured, mean = counted(measured, mask), counted(mean, mask)
    sigma = check_level("read_noise", read_noise, mean, where, square=True)
    variance = sigma**2 + (mean.clamp_min(0) if shot_noise else torch.zeros_like(mean))
    value = (measured - mean) ** 2 / (2 * variance) + 0.5 * variance.log()
    if constant:
        value = value + 0.5 * math.log(2 * math.pi)
    return reduce(value, reduction, where, mask)


class ReadNoiseNLL(LossModule, function=read_noise_nll, by_place=("read_noise", "shot_noise", "reduction")):
    """`read_noise_nll` with its options held."""


def relative_floor(
    model: Tensor,
    share: float = _RELATIVE_FLOOR,
    *,
    mask: Tensor | None = None,
    dim: int | None = None,
    measured: Tensor | None = None,
) -> Tensor:
    """Compute a `floor` for likelihoods: a share of the mean of each item of the model, without gradient. ::

        loss = poisson_nll(model, counts, floor=relative_floor(model, measured=counts))

    Args:
        model: means or rates (..., C, T, H, W), or another layout with `dim`.
        share: share of the mean of an item.
        mask: bins that count.
        dim: dimension of time, which says what an item is (`losses.layouts`).
        measured: counts in the shape and unit of the model. An item darker than a tenth of its measurement has the
            floor of one at a tenth, so that a count in it has a finite cost.

    Returns:
        Tensor that broadcasts to the model, one number per item; for dark items the least normal number.

    Raises:
        ShapeError: for two shapes, or without `dim` where the shape is ambiguous.
    """
    where = "relative_floor"
    check_dense((model,), where)
    model = model.to(working_dtype((model,), where))
    if measured is not None:
        model, measured = check_pair(model, measured, where, names="model and measured")
    mask = check_mask(mask, model, where)
    part = check_level("share", share, model.new_empty(()), where)
    dims = item_dims(model, dim, where)
    item = item_mean(model, dims, mask)
    if measured is not None:
        least = _DARK * item_mean(measured, dims, mask)
        item = torch.where(item < least, least, item)  # keeps NaN
    return (part * item).clamp_min(torch.finfo(model.dtype).tiny)


# ------------------------------------------------------------------------------------------------------------ dead time


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
    """Compute the negative log-likelihood of a synchronous SPAD: binomial in each bin given the cycles still armed.

    `r (armed - n) - n log(1 - exp(-r))`, in nats; convex in r, least at the Coates estimate. Flat beyond the width of a
    pulse: from farther away take `multiscale_loss` of it.

    Args:
        input: rates r (..., C, T, H, W), expected detections per cycle and bin of a detector without dead time.
        target: histogram n of `cycles` cycles, of the same shape.
        cycles: number of laser cycles.
        dead_bins: dead time in bins of a detector that is armed again within the cycle (`SynchronousSPAD`); None: one
            detection per cycle.
        floor: rate added to r, number or tensor that broadcasts, see `poisson_nll`.
        constant: add the binomial coefficients.
        dim: dimension of time, -3 by default (`losses.layouts`).
        mask: bins that count; pixels without any are left out.
        reduction: "mean" over bins that count, "sum", or "none".

    Returns:
        Scalar, or the shape of the input for "none".

    Raises:
        UnitError: for more counts than cycles, for negative rates, and for cycles or dead times that are none.
        GradientError: for swapped arguments, as in `poisson_nll`.
        ShapeError: for two shapes, or without `dim` where the shape is ambiguous.

    Source: Coates 1968; Shin et al. 2015 for the likelihood.
    """
    where = "first_photon_nll"
    rate, _, mask = _rates(input, target, mask, where)
    number = check_whole("cycles", cycles, where, UnitError)
    dead = None if dead_bins is None else check_dead_bins(check_number("dead_bins", dead_bins, where))
    dim = bins_dim(rate, dim, where)
    measured = _exact(target, mask, dim)
    _check_constant(measured, constant, where)
    n, r = as_columns(measured, dim), as_columns(_floored(rate, floor, where), dim).to(torch.float64)
    level = _dark_level(n, floor, input, number, divisor(rate, mask, reduction))
    below = None if level is None else (r < level) & (n != 0)
    dark = below if below is not None and bool(below.any()) else None
    near = r if level is None or dark is None else torch.where(dark, level, r)
    value = -first_photon_log_prob(n, near, number, dead_bins=dead, constant=constant, where=where)
    if level is not None and dark is not None:
        # the tangent; the part of cycles that do not fire is linear in the rate
        least = torch.where(dark, level, 1.0)
        quiet = (exposed_cycles(n, number, dead) - n).clamp_min(0)
        value = value + torch.where(dark, (quiet - n / torch.expm1(least)) * (r - least), 0.0)
    return reduce(value.to(rate.dtype).reshape(rate.shape), reduction, where, mask)


first_photon_loss = first_photon_nll


class FirstPhotonNLL(LossModule, function=first_photon_nll, by_place=("cycles", "dead_bins")):
    """`first_photon_nll` with its options held."""


FirstPhotonLoss = FirstPhotonNLL


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
    """Compute the negative log-likelihood of a free-running SPAD with non-paralyzable dead time, up to a constant.

    `r armed - n log r`, in nats: photons arrive as a Poisson process while the detector is armed, and the histogram
    tells when that is (`armed_periods`). Exact but for the periods at both ends of the exposure and the positions of
    detections inside a bin: the best rate, n / armed, has an error of second order in the counts of a bin per period.

    Args:
        input: rates r (..., C, T, H, W), photons per period and bin.
        target: histogram n of `periods` periods, of the same shape.
        periods: number of laser periods.
        dead_bins: dead time in bins.
        floor: rate added to r, number or tensor that broadcasts, see `poisson_nll`.
        dim: dimension of time, -3 by default (`losses.layouts`).
        mask: bins that count; pixels without any are left out.
        reduction: "mean" over bins that count, "sum", or "none".

    Returns:
        Scalar, or the shape of the input for "none".

    Raises:
        UnitError: for counts that do not fit into the periods with this dead time, and for negative rates.
        GradientError: for swapped arguments, as in `poisson_nll`.
        ShapeError: for two shapes, or without `dim` where the shape is ambiguous.

    Source: Rapp et al. 2019 and Gupta et al. 2019, see `sensing.free_running`.
    """
    where = "free_running_nll"
    rate, _, mask = _rates(input, target, mask, where)
    dim = bins_dim(rate, dim, where)
    n = as_columns(_exact(target, mask, dim), dim)
    armed = armed_periods(n, periods, dead_bins)
    # the ends of the exposure and the positions inside a bin leave an uncertainty of about the root of the counts
    if bool((armed < -(2 + 6 * n.sum(_TIME, keepdim=True).clamp_min(0).sqrt())).any()):
        raise UnitError(
            f"{where}: expected counts that fit into {periods} periods with dead time {dead_bins:g} bins, "
            "got more. Check periods and dead time."
        )
    r = as_columns(_floored(rate, floor, where), dim).to(torch.float64)
    level = _dark_level(n, floor, input, periods, divisor(rate, mask, reduction))
    value = r * armed.clamp_min(0) - _count_log(n, r, level)
    return reduce(value.to(rate.dtype).reshape(rate.shape), reduction, where, mask)


class FreeRunningNLL(LossModule, function=free_running_nll, by_place=("periods", "dead_bins")):
    """`free_running_nll` with its options held."""


def armed_periods(counts: Tensor, periods: int, dead_bins: float) -> Tensor:
    """Compute the periods in which a free-running detector was armed, from its histogram.

    Every detection takes the dead time that follows it, round the period and for as many periods as it lasts.
    Detections count as spread evenly over their bin. Linear in the counts. Paralyzable dead times are not supported.

    Args:
        counts: histogram (..., T, H, W) of `periods` laser periods of T bins.
        periods: number of periods.
        dead_bins: dead time in bins.

    Returns:
        Number of periods, averaged over each bin, in the shape of the counts, float64; below zero where the counts do
        not fit.

    Raises:
        ShapeError: for less than three dimensions, and for complex numbers.
        UnitError: for periods or dead times that are none.
    """
    where = "armed_periods"
    if counts.ndim < 3 or counts.is_complex():
        raise ShapeError(f"{where}: expected real counts (..., T, H, W), got {counts.dtype} {tuple(counts.shape)}.")
    periods = check_whole("periods", periods, where, UnitError)
    dead_bins = check_dead_bins(check_number("dead_bins", dead_bins, where))
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


# ------------------------------------------------------------------------------------------ counts against a prediction


def _check_prediction(input: object, target: object, where: str) -> tuple[Tensor, Tensor]:
    """Return prediction and counts in their common dtype. Raises for swapped arguments where that is certain.

    Counts first and a record without gradient that holds none may be meant, and are a warning.
    """
    pair = check_pair(input, target, where, names="prediction and counts")
    input, target = cast(tuple[Tensor, Tensor], (input, target))
    order = "Take (input, target) in that order"
    if not input.is_floating_point():
        raise UnitError(f"{where}: expected a floating prediction first, got {input.dtype}. {order}, or input.float().")
    swapped = _are_counts(input) and not _are_counts(target)
    if target.requires_grad and (swapped or not input.requires_grad):
        raise GradientError(
            f"{where}: expected the prediction first, got a target with a gradient, and an input that has none or "
            f"holds counts (draws of a chain with straight_through?). {order}; if it is right, target.detach()."
        )
    if swapped:
        said = f"{where}: the first argument holds counts and the second one does not. {order}."
        warnings.warn(said, TorchTransientWarning, stacklevel=level_of_user())
    return pair


def _are_counts(x: Tensor) -> bool:
    """Return True for a record of whole numbers that are not all alike; False where values cannot be read."""
    if x.numel() < _A_RECORD or not x.is_floating_point():
        return x.numel() >= _A_RECORD
    # a few entries tell most predictions
    few = x.view(-1)[:: x.numel() // _A_RECORD] if x.is_contiguous() else x.select(0, 0) if x.ndim else x
    return is_true(few == few.round()) and is_true((x == x.round()) & (x.amin() != x.amax()))


def _rates(input: object, target: object, mask: Tensor | None, where: str) -> tuple[Tensor, Tensor, Tensor | None]:
    """Return rates, 1 where they do not count, counts and mask. Raises UnitError for negative rates; NaN passes."""
    rate, counts = _check_prediction(input, target, where)
    mask = check_mask(mask, rate, where)
    rate = counted(rate, mask, 1.0)
    if bool((rate < 0).any()):
        raise UnitError(f"{where}: expected rates >= 0, got negative ones. Clamp or use softplus upstream.")
    return rate, counts, mask


def _check_constant(counts: Tensor, constant: bool, where: str) -> None:
    """Raise UnitError for logarithms of factorials of negative counts."""
    if constant and bool((counts < 0).any()):
        raise UnitError(f"{where}: expected counts >= 0 with constant=True, got negative ones. Leave the constant out.")


def _exact(target: object, mask: Tensor | None, dim: int) -> Tensor:
    """Counts in float64, 0 in pixels of which no bin counts: single precision may not hold sums of them."""
    counts = cast(Tensor, target).to(torch.float64)
    return counts if mask is None else counted(counts, mask.any(dim, keepdim=True))


# ----------------------------------------------------------------------------------------------- logarithms in the dark


def _floored(model: Tensor, floor: Tensor | float | None, where: str) -> Tensor:
    """Return the model plus the floor, if any."""
    return model if floor is None else model + check_level("floor", floor, model, where, zero=True)


def _dark_level(
    counts: Tensor, floor: object, input: object, exposures: int = 1, averaged: Tensor | float = 1
) -> Tensor | None:
    """Mean per exposure of each bin below which its logarithm continues as the tangent; None with a floor.

    For a prediction `input` in float16 the slope, counts over level over the bins `averaged`, has to be a float16.
    """
    if floor is not None:
        return None
    least: Tensor | float = _LEAST_MEAN / exposures
    outer = _OF_HALF.get()
    if outer is not None or (isinstance(input, Tensor) and input.dtype == torch.float16):
        averaged = averaged if outer is None else outer
        least = torch.as_tensor(_LEAST_IN_HALF / averaged, dtype=counts.dtype, device=counts.device).clamp_min(least)
    return (least * counts.detach().abs()).clamp_min(torch.finfo(counts.dtype).tiny)


@contextmanager
def parts_of(input: object, averaged: Tensor | float) -> Iterator[None]:
    """Enter a context in which likelihoods compare parts of a prediction.

    Args:
        input: the prediction.
        averaged: number of bins that each part averages.
    """
    token = _OF_HALF.set(averaged if isinstance(input, Tensor) and input.dtype == torch.float16 else None)
    try:
        yield
    finally:
        _OF_HALF.reset(token)


def divisor(value: Tensor, mask: Tensor | None, reduction: Reduction) -> Tensor | float:
    """Return the number that the reduction of values divides by.

    Args:
        value: loss of each element.
        mask: boolean tensor of the same shape, None for all.
        reduction: "none", "sum" or "mean".
    """
    if reduction != "mean":
        return 1
    return max(value.numel(), 1) if mask is None else mask.sum().clamp_min(1)


def _count_log(counts: Tensor, mean: Tensor, least: Tensor | None) -> Tensor:
    """`counts log(mean)`; 0 without counts; where the mean is below `least`, the tangent of the logarithm there."""
    hit = counts != 0
    # where on the input: xlogy(0, 0) has a NaN gradient
    some = hit | (mean >= torch.finfo(mean.dtype).tiny)
    dark = None if least is None else hit & (mean < least)
    if dark is None or least is None or not bool(dark.any()):
        return torch.where(some, counts * torch.where(some, mean, 1.0).log(), 0.0)
    level = torch.where(dark, least, 1.0)
    near = torch.where(some & ~dark, mean, level)
    return torch.where(some, counts * (near.log() + torch.where(dark, mean / level - 1, 0.0)), 0.0)
