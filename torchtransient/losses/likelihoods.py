"""Negative log-likelihoods that match the noise of the sensors: Poisson and read noise, and what all of them share.

All take rates or means (..., C, T, H, W) and measurements of the same shape, and are finite, with finite gradients, at
zero counts, in empty bins and of a model without any light. Where the model says "impossible" (a count where the mean
is 0) a floor keeps them so: `floor`, in the unit of the mean, is added to it (0 is the exact likelihood, which is
infinite there). Counts below 0 (those of a normal surrogate) enter the same formulas,
which are linear in them: the gradient stays unbiased. With `constant` there is no such formula, and they are an error.
NaN in what counts, in counts or model, is NaN in the loss. Terms that do not depend on the mean are left out unless
`constant`. Counts may be whole numbers, truth values of frames, or half precision; the loss is computed and returned in
the precision of the more precise of the two, float32 at least. `dim`: where time is, which also says over what the
average is (`layouts.py`). `mask`: truth values that broadcast to the tensors, True counts (`comparison.py`).
`poisson_loss(input, target)` is the same with the model first, as torch and the other losses.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from torchtransient.errors import UnitError
from torchtransient.losses.comparison import (
    Reduction,
    check_dense,
    check_flag,
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
from torchtransient.losses.layouts import check_held, item_dims
from torchtransient.losses.results import LIGHT, Light, reads

# Relative to the average of an item: small against noise, large enough that 1/floor stays a usable gradient.
_RELATIVE_FLOOR = 1e-3
# Of the counts of an item: a model that is darker than that has the floor of one that is as bright. Small enough that
# no model that is about right has a floor made of noise; continuous: the loss falls all the way out of the dark.
_DARK = 0.1


class Options(NamedTuple):
    """What all likelihoods of counts take by name."""

    floor: Tensor | float | None
    dim: int | None
    mask: Tensor | None
    reduction: Reduction
    constant: bool = False


def check_counts(measured: object, model: object, where: str) -> tuple[Tensor, Tensor]:
    """Both in their common dtype. Raises ShapeError, DeviceError; UnitError for other numbers and whole models."""
    pair = check_pair(measured, model, where, names="counts and model")
    if isinstance(model, Tensor) and not model.is_floating_point():
        raise UnitError(f"{where}: expected a model of a floating dtype, got {model.dtype}. Use model.float().")
    return pair


def check_rates(model: Tensor, where: str) -> None:
    """Rates cannot be negative. NaN passes and is what comes out."""
    if bool((model.detach() < 0).any()):
        raise UnitError(f"{where}: expected rates >= 0, got negative ones. Clamp or use softplus upstream.")


def check_constant(counts: Tensor, constant: bool, where: str) -> None:
    """The logarithm of a factorial wants counts: UnitError for negative ones."""
    check_flag("constant", constant, where)
    if constant and bool((counts < 0).any()):
        raise UnitError(f"{where}: expected counts >= 0 with constant=True, got negative ones. Leave the constant out.")


def floored(model: Tensor, expected: Tensor, options: Options, mask: Tensor | None, where: str) -> Tensor:
    """The model over its floor; `expected`: what was measured, in the unit of the model."""
    if options.floor is None:
        return model + _relative_floor(model, item_dims(model, options.dim, where, " or floor="), mask, expected)
    return model + check_level("floor", options.floor, model, where, zero=True)


def relative_floor(
    model: Tensor,
    share: float = _RELATIVE_FLOOR,
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


@reads(counts=LIGHT, mean=LIGHT)
def poisson_nll(
    counts: Light,
    mean: Light,
    *,
    floor: Tensor | float | None = None,
    constant: bool = False,
    dim: int | None = None,
    mask: Tensor | None = None,
    reduction: Reduction = "mean",
) -> Tensor:
    """-log of the Poisson probability of `counts`: m - n log m (+ log n! with `constant`), m = mean + floor.

    `floor` None: 1e-3 of the average of each item (`relative_floor`, of a dark one by its counts), which biases empty
    bins by as much; 0: the exact likelihood, infinite where a count meets a mean of 0. Empty bins have value m and
    gradient 1 even at m = 0. A mean that is a noisy render biases a fit, by many times the noise of the counts
    (docs/noisy_renders.md). Raises ShapeError for different shapes, UnitError for negative means.
    """
    return _poisson(counts, mean, Options(floor, dim, mask, reduction, constant), "poisson_nll")


def _poisson(given: object, model: object, options: Options, where: str) -> Tensor:
    check_held(options.reduction, options.dim, where)
    counts, mean = check_counts(given, model, where)
    mask = check_mask(options.mask, mean, where)
    counts, mean = counted(counts, mask), counted(mean, mask, 1.0)
    check_rates(mean, where)
    check_constant(counts, options.constant, where)
    m = floored(mean, counts, options, mask, where)
    hit = counts != 0
    # where on the input: xlogy(0, 0) has a NaN gradient
    log_mean = torch.where(hit, m, torch.ones_like(m)).log()
    value = m - torch.where(hit, counts * log_mean, torch.zeros_like(m))
    if options.constant:
        value = value + torch.lgamma(counts + 1)
    return _reduce(value, options.reduction, where, mask)


@reads(input=LIGHT, target=LIGHT)
def poisson_loss(
    input: Light,
    target: Light,
    *,
    floor: Tensor | float | None = None,
    dim: int | None = None,
    mask: Tensor | None = None,
    reduction: Reduction = "mean",
) -> Tensor:
    """`poisson_nll(target, input)`: a model's mean counts (..., C, T, Y, X) against counts.

    Biased where the mean is a Monte Carlo render, whose noise its logarithm turns into an error of the fit: take
    squares over a variance that is no function of the render, or many samples at the end (docs/noisy_renders.md).
    """
    return _poisson(target, input, Options(floor, dim, mask, reduction), "poisson_loss")


@reads(measured=LIGHT, mean=LIGHT)
def read_noise_nll(
    measured: Light,
    mean: Light,
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
    where = "read_noise_nll"
    check_reduction(reduction, where)
    check_flag("shot_noise", shot_noise, where)
    check_flag("constant", constant, where)
    measured, mean = check_counts(measured, mean, where)
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
    """`poisson_nll(counts, mean)` with its options held."""

    def __init__(self, floor: float | None = None, dim: int | None = None, reduction: Reduction = "mean") -> None:
        super().__init__()
        check_held(reduction, dim, "PoissonNLL")
        check_option("floor", floor, "PoissonNLL", zero=True)
        self.floor, self.dim, self.reduction = floor, dim, reduction

    def forward(self, counts: Light, mean: Light, mask: Tensor | None = None) -> Tensor:
        return poisson_nll(counts, mean, floor=self.floor, dim=self.dim, mask=mask, reduction=self.reduction)


class PoissonLoss(nn.Module):
    """`poisson_loss(input, target)` with its options held."""

    def __init__(self, floor: float | None = None, dim: int | None = None, reduction: Reduction = "mean") -> None:
        super().__init__()
        check_held(reduction, dim, "PoissonLoss")
        check_option("floor", floor, "PoissonLoss", zero=True)
        self.floor, self.dim, self.reduction = floor, dim, reduction

    def forward(self, input: Light, target: Light, mask: Tensor | None = None) -> Tensor:
        return poisson_loss(input, target, floor=self.floor, dim=self.dim, mask=mask, reduction=self.reduction)


class ReadNoiseNLL(nn.Module):
    """`read_noise_nll(measured, mean, read_noise)` with its options held."""

    def __init__(self, read_noise: float, shot_noise: bool = True, reduction: Reduction = "mean") -> None:
        super().__init__()
        check_held(reduction, None, "ReadNoiseNLL")
        check_flag("shot_noise", shot_noise, "ReadNoiseNLL")
        check_option("read_noise", read_noise, "ReadNoiseNLL", needed=True, square=True)
        self.read_noise, self.shot_noise, self.reduction = read_noise, shot_noise, reduction

    def forward(self, measured: Light, mean: Light, mask: Tensor | None = None) -> Tensor:
        return read_noise_nll(
            measured, mean, self.read_noise, shot_noise=self.shot_noise, mask=mask, reduction=self.reduction
        )
