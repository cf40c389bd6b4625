"""Negative log-likelihoods that match the noise of the sensors: Poisson and read noise, and what all of them share.

All take a prediction, rates or means (..., C, T, H, W), and measurements of the same shape: `(input, target)`, as torch
and the other losses. They are exact, and finite with finite gradients at zero counts, in empty bins and of a model
without any light. Where the model says "impossible" (a count where the mean is 0) the logarithm goes on as its tangent,
from a mean of 1e-9 of the counts of the bin on (`count_log`): convex, with a slope, and no fit notices, since as many
bins as that hold less than one count in all. Of a prediction in float16 slopes end where float16 holds them, at 2^15
times the bins averaged over: of sums over first photons of many cycles that is too early, take means. A `floor` is a
choice: in the unit of the mean, it is added to it and biases what is as dark as it (0 is the plain formula, infinite
there). Counts below 0 (those of a normal surrogate) enter the same formulas, which are linear in them: the gradient
stays unbiased. With `constant` there is no such formula, and they are an error. NaN in what counts, in counts or
model, is NaN in the loss. Terms that do not depend on the mean are left out unless `constant`. Counts may be whole
numbers, truth values of frames, or half precision; the loss is computed and returned in the precision of the more
precise of the two, float32 at least. `dim`: where time is (`layouts.py`). `mask`: truth values that broadcast to the
tensors, True counts (`comparison.py`). A measurement in the place of the prediction is an error where it shows
(`check_prediction`).
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import torch
from torch import Tensor, nn

from torchtransient.checks import flag
from torchtransient.errors import GradientError, TorchTransientWarning, UnitError
from torchtransient.floating import is_true
from torchtransient.losses.comparison import (
    Reduction,
    check_dense,
    check_level,
    check_mask,
    check_option,
    check_pair,
    check_reduction,
    counted,
    item_mean,
    working_dtype,
)
from torchtransient.losses.comparison import reduce as _reduce
from torchtransient.losses.layouts import check_held, item_dims, time_dim
from torchtransient.losses.results import LIGHT, Light, reads

# Of the counts of a bin: the mean below which its logarithm is continued by the tangent. Bins of so small a mean hold
# less than one count in a thousand million of them, more than a fit has, so that a fit of exact likelihoods is one of
# these; and a slope of 1e9 has a square that single precision holds.
LEAST_MEAN = 1e-9
# Of predictions in float16, whose numbers of full precision go from 6e-5 to 65504: a slope that is one of them.
_LEAST_IN_HALF = 2.0**-15
# The bins that a loss of a float16 prediction is averaged over, whose parts are compared in single precision.
_OF_HALF: ContextVar[Tensor | float | None] = ContextVar("of_half", default=None)
# Smaller records are examples made by hand, where whole numbers say nothing.
_A_RECORD = 64
# Relative to the average of an item: small against noise, large enough that 1/floor stays a usable gradient.
_RELATIVE_FLOOR = 1e-3
# Of the counts of an item: a model that is darker than that has the floor of one that is as bright. Small enough that
# no model that is about right has a floor made of noise; continuous: the loss falls all the way out of the dark.
_DARK = 0.1


def check_prediction(input: object, target: object, where: str) -> tuple[Tensor, Tensor]:
    """Both in their common dtype. Raises ShapeError, DeviceError; UnitError for other numbers.

    What tells that they are the wrong way round is an error: an integer prediction (UnitError), a target with a
    gradient and a prediction without (GradientError), or with both, where the first one holds counts and the second one
    does not: draws in front of their own mean (GradientError). Counts in front of a record without gradient that holds
    none may have a reason, and are a warning.
    """
    pair = check_pair(input, target, where, names="prediction and counts")
    if isinstance(input, Tensor) and not input.is_floating_point():
        raise UnitError(
            f"{where}: expected a prediction of a floating dtype first and counts second, got {input.dtype} first. "
            "Take (input, target) in that order; a prediction of whole numbers as input.float()."
        )
    if isinstance(input, Tensor) and isinstance(target, Tensor):
        if target.requires_grad and not input.requires_grad:
            raise GradientError(
                f"{where}: expected the prediction first, got an input without and a target with a gradient. Take "
                "(input, target) in that order, or target.detach()."
            )
        if _are_counts(input) and not _are_counts(target):
            if target.requires_grad:
                raise GradientError(
                    f"{where}: expected the prediction first, got counts with a gradient first (draws of a chain with "
                    "straight_through?) and a target with a gradient that holds none. Take (input, target) in that "
                    "order; if it is right, target.detach()."
                )
            warnings.warn(
                f"{where}: the first argument holds counts and the second one does not. The prediction comes first: "
                "(input, target).",
                TorchTransientWarning,
                stacklevel=4,
            )
    return pair


def _are_counts(x: Tensor) -> bool:
    """Whole numbers, not all alike, of a record, as far as it can be looked at."""
    if x.numel() < _A_RECORD or not x.is_floating_point():
        return x.numel() >= _A_RECORD
    # of predictions as a rule a few entries say enough
    few = x.view(-1)[:: x.numel() // _A_RECORD] if x.is_contiguous() else x.select(0, 0) if x.ndim else x
    return is_true(few == few.round()) and is_true((x == x.round()) & (x.amin() != x.amax()))


def check_rates(model: Tensor, where: str) -> None:
    """Rates cannot be negative. NaN passes and is what comes out."""
    if bool((model < 0).any()):
        raise UnitError(f"{where}: expected rates >= 0, got negative ones. Clamp or use softplus upstream.")


def check_constant(counts: Tensor, constant: bool, where: str) -> None:
    """The logarithm of a factorial wants counts: UnitError for negative ones."""
    flag(f"{where}: constant", constant)
    if constant and bool((counts < 0).any()):
        raise UnitError(f"{where}: expected counts >= 0 with constant=True, got negative ones. Leave the constant out.")


def floored(model: Tensor, floor: Tensor | float | None, where: str) -> Tensor:
    """The model over the floor that was given."""
    return model if floor is None else model + check_level("floor", floor, model, where, zero=True)


def dark_level(
    counts: Tensor, floor: object, input: object, exposures: int = 1, averaged: Tensor | float = 1
) -> Tensor | None:
    """Of each bin, the mean per exposure below which a logarithm goes on as its tangent; None with a floor. `input`:
    the prediction as it was given, in the precision that its gradient is given in. A slope is counts over the level,
    over the number of bins that the loss is `averaged` over: in float16 it has to be a number, however many exposures.
    """
    if floor is not None:
        return None
    least: Tensor | float = LEAST_MEAN / exposures
    outer = _OF_HALF.get()
    if outer is not None or (isinstance(input, Tensor) and input.dtype == torch.float16):
        averaged = averaged if outer is None else outer
        least = torch.as_tensor(_LEAST_IN_HALF / averaged, dtype=counts.dtype, device=counts.device).clamp_min(least)
    return (least * counts.detach().abs()).clamp_min(torch.finfo(counts.dtype).tiny)


@contextmanager
def in_the_name_of(input: object, averaged: Tensor | float) -> Iterator[None]:
    """Likelihoods inside are those of parts of a prediction `input`, averaged over as many bins as it says."""
    token = _OF_HALF.set(averaged if isinstance(input, Tensor) and input.dtype == torch.float16 else None)
    try:
        yield
    finally:
        _OF_HALF.reset(token)


def averaged_over(value: Tensor, mask: Tensor | None, reduction: Reduction) -> Tensor | float:
    """The number that a loss of these values is divided by."""
    if reduction != "mean":
        return 1
    return max(value.numel(), 1) if mask is None else mask.sum().clamp_min(1)


def count_log(counts: Tensor, mean: Tensor, least: Tensor | None) -> Tensor:
    """`counts log(mean)`; 0 without counts; where the mean is below `least`, the tangent of the logarithm there."""
    hit = counts != 0
    dark = None if least is None else hit & (mean < least)
    if dark is None or least is None or not bool(dark.any()):
        # where on the input: xlogy(0, 0) has a NaN gradient
        return torch.where(hit, counts * torch.where(hit, mean, 1.0).log(), 0.0)
    level = torch.where(dark, least, 1.0)
    near = torch.where(hit & ~dark, mean, level)
    return torch.where(hit, counts * (near.log() + torch.where(dark, mean / level - 1, 0.0)), 0.0)


def relative_floor(
    model: Tensor,
    share: float = _RELATIVE_FLOOR,
    *,
    mask: Tensor | None = None,
    dim: int | None = None,
    measured: Tensor | None = None,
) -> Tensor:
    """`share` of the mean of each item (its C, T, H, W) of the model, without gradient: a floor that knows the scale.

    Broadcasts to `model`. Items of a batch have floors of their own, so that a bright one does not cover a dark one.
    `measured`, of the shape and in the unit of the model: an item whose mean is below a tenth of that of its
    measurement has the floor of one at a tenth, since a count in it has to cost something finite. Without it the
    floor of an item that is dark altogether is the least positive number of the precision.
    `dim`: where time is, which says what is an item (`losses.layouts`). `mask`: means are over what counts. Raises
    ShapeError, UnitError, DeviceError.
    """
    where = "relative_floor"
    check_dense((model,), where)
    model = model.to(working_dtype((model,), where))
    if measured is not None:
        model, measured = check_pair(model, measured, where, names="model and measured")
    mask = check_mask(mask, model, where)
    part = check_level("share", share, model.new_empty(()), where)
    return _relative_floor(model, item_dims(model, dim, where), mask, measured, part)


def _relative_floor(
    model: Tensor,
    dims: tuple[int, ...],
    mask: Tensor | None,
    measured: Tensor | None,
    share: Tensor | float = _RELATIVE_FLOOR,
) -> Tensor:
    item = item_mean(model, dims, mask)
    if measured is not None:
        least = _DARK * item_mean(measured.to(model.dtype), dims, mask)
        item = torch.where(item < least, least, item)  # NaN of a bin that counts is no level
    return (share * item).clamp_min(torch.finfo(model.dtype).tiny)


@reads(input=LIGHT, target=LIGHT)
def poisson_nll(
    input: Light,
    target: Light,
    *,
    floor: Tensor | float | None = None,
    constant: bool = False,
    dim: int | None = None,
    mask: Tensor | None = None,
    reduction: Reduction = "mean",
) -> Tensor:
    """-log of the Poisson probability of counts: m - n log m (+ log n! with `constant`), m = input, n = target.

    `input`: mean counts of a model, any shape; `target`: counts, of the same shape. Exact: a bin without counts has
    value m and gradient 1, at m = 0 too; a count in a bin of mean 0 costs about 20 nats and pulls with a slope of 1e9.
    `floor`: m = input + floor instead, which biases bins as dark as it; 0: infinite where a count meets a mean of 0.
    `relative_floor` makes one of the model. `dim` is looked at only: nothing here goes along time.
    An input that is a noisy render biases a fit, by many times the noise of the counts (docs/noisy_renders.md): its
    logarithm turns noise into an error. Raises ShapeError for different shapes, UnitError for negative means,
    GradientError for a prediction in the place of the counts.
    """
    where = "poisson_nll"
    check_held(reduction, dim, where)
    mean, counts = check_prediction(input, target, where)
    if dim is not None:
        time_dim(mean, dim, where)
    mask = check_mask(mask, mean, where)
    counts, mean = counted(counts, mask), counted(mean, mask, 1.0)
    check_rates(mean, where)
    check_constant(counts, constant, where)
    m = floored(mean, floor, where)
    level = dark_level(counts, floor, input, averaged=averaged_over(mean, mask, reduction))
    value = m - count_log(counts, m, level)
    if constant:
        value = value + torch.lgamma(counts + 1)
    return _reduce(value, reduction, where, mask)


poisson_loss = poisson_nll


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
    """-log-likelihood of a normal distribution: read noise, and the normal approximation of shot noise.

    (y - m)^2 / (2 v) + log(v)/2 (+ log(2 pi)/2 with `constant`), v = read_noise^2 + max(m, 0) with `shot_noise`, m the
    `input`, a mean, and y the `target`, a measurement, in electrons. `read_noise` > 0, a number or a tensor that
    broadcasts; differentiable in it and in `input`. No floor: the read noise is the least width. Raises as
    `poisson_nll`, but takes means below zero.
    """
    where = "read_noise_nll"
    check_reduction(reduction, where)
    flag(f"{where}: shot_noise", shot_noise)
    flag(f"{where}: constant", constant)
    mean, measured = check_prediction(input, target, where)
    mask = check_mask(mask, mean, where)
    measured, mean = counted(measured, mask), counted(mean, mask)
    # without it an empty pixel has no width
    sigma = check_level("read_noise", read_noise, mean, where, square=True)
    variance = sigma**2 + (mean.clamp_min(0) if shot_noise else torch.zeros_like(mean))
    value = (measured - mean) ** 2 / (2 * variance) + 0.5 * variance.log()
    if constant:
        value = value + 0.5 * math.log(2 * math.pi)
    return _reduce(value, reduction, where, mask)


class PoissonNLL(nn.Module):
    """`poisson_nll(input, target)` with its options held."""

    def __init__(
        self,
        floor: float | None = None,
        dim: int | None = None,
        reduction: Reduction = "mean",
        *,
        constant: bool = False,
    ) -> None:
        super().__init__()
        check_held(reduction, dim, "PoissonNLL")
        check_option("floor", floor, "PoissonNLL", zero=True)
        flag("PoissonNLL: constant", constant)
        self.floor, self.dim, self.reduction, self.constant = floor, dim, reduction, constant

    def forward(self, input: Light, target: Light, mask: Tensor | None = None) -> Tensor:
        return poisson_nll(
            input,
            target,
            floor=self.floor,
            constant=self.constant,
            dim=self.dim,
            mask=mask,
            reduction=self.reduction,
        )


PoissonLoss = PoissonNLL


class ReadNoiseNLL(nn.Module):
    """`read_noise_nll(input, target, read_noise)` with its options held."""

    def __init__(
        self,
        read_noise: float,
        shot_noise: bool = True,
        reduction: Reduction = "mean",
        *,
        constant: bool = True,
    ) -> None:
        super().__init__()
        check_held(reduction, None, "ReadNoiseNLL")
        flag("ReadNoiseNLL: shot_noise", shot_noise)
        flag("ReadNoiseNLL: constant", constant)
        check_option("read_noise", read_noise, "ReadNoiseNLL", needed=True, square=True)
        self.read_noise, self.shot_noise, self.reduction = read_noise, shot_noise, reduction
        self.constant = constant

    def forward(self, input: Light, target: Light, mask: Tensor | None = None) -> Tensor:
        return read_noise_nll(
            input,
            target,
            self.read_noise,
            shot_noise=self.shot_noise,
            constant=self.constant,
            mask=mask,
            reduction=self.reduction,
        )
