"""Losses of photon counts on scales where bright and dark bins have a say: roots, and logarithms of ratios.

`sqrt(m)` of a mean is not the mean of the root of counts: at 0.4 counts it is 7 % higher (Jensen), and dark bins, of
which there are most, outvote bright ones. `expected_root_loss` compares with the expected root, and is least at the
right mean.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from torchtransient.errors import ShapeError
from torchtransient.losses.checks import (
    Reduction,
    check_dense,
    check_level,
    item_scale,
    masked_pair,
    reduce,
    working_dtype,
)
from torchtransient.losses.layouts import item_dims
from torchtransient.losses.loss_module import LossModule
from torchtransient.losses.results import LIGHT, Light, reads

_OFFSET = 3 / 8
_BACKGROUND = 1e-3
# Table of the expected root between s = sqrt(m + 3/8) at m = 0 and _LAST, every _STEP; the series is good to 1e-11
# above.
_FIRST, _LAST, _STEP = math.sqrt(_OFFSET), 8.0, 1 / 32
# Coefficients a_k of `sum_k a_k u^(1/2 - k)`, u = m + 3/8, k from 1: Taylor's series of the root over the central
# moments of a Poisson distribution, `mu_(j+1) = m (mu_j' + j mu_(j-1))`.
_TAIL = (-1 / 4, -1 / 64, -9 / 512, -949 / 16384, -28455 / 131072, -2034341 / 2097152, -86876713 / 16777216)


def anscombe(counts: Tensor, read_noise: Tensor | float = 0.0) -> Tensor:
    """Stabilize the variance of photon counts: `2 sqrt(n + 3/8 + read_noise^2)`, whose noise has a variance of one.

    The variance is 1 within 1/(8 m) at a mean of m >= 4, 0.72 at m = 1, and vanishes with the light.

    Args:
        counts: tensor of any shape. Counts below zero, of a record less its background, continue the tangent at zero.
        read_noise: standard deviation in counts, zero or more; number or tensor that broadcasts, differentiable.

    Returns:
        Roots in the shape of the counts; torch's default dtype for integers, float32 for half precision.

    Raises:
        UnitError: for a read noise below zero, and for complex counts.

    Source: Anscombe 1948; Starck, Murtagh and Bijaoui 1998 with read noise, at a gain of one.
    """
    counts = _floating(counts, "anscombe")
    sigma = check_level("read_noise", read_noise, counts, "anscombe", zero=True, square=True)
    offset = _OFFSET + sigma.square()
    negative = counts < 0
    root = (torch.where(negative, torch.zeros_like(counts), counts) + offset).sqrt()
    return 2 * root + torch.where(negative, counts, torch.zeros_like(counts)) / offset.sqrt()


@reads(input=LIGHT, target=LIGHT)
def root_loss(
    input: Light,
    target: Light,
    *,
    root: Callable[[Tensor], Tensor] = anscombe,
    mask: Tensor | None = None,
    reduction: Reduction = "mean",
) -> Tensor:
    """Compute the squared difference of roots, `(root(input) - root(target))^2`. Symmetric.

    With `anscombe` it is about 1 per bin where `input` is the mean that `target` was drawn from: the loss of a perfect
    fit.

    Args:
        input: photon counts or means, any shape.
        target: photon counts or means, of the same shape.
        root: function that keeps the shape; `reconstruction.stabilized_root` with a floor of 1/4 is what f-k migration
            sees. `functools.partial` holds options.
        mask: elements that count.
        reduction: "mean", "sum" or "none".

    Returns:
        Scalar, or the shape of the input for "none".

    Raises:
        ShapeError: for two shapes, and for a root that changes the shape.
    """
    where = "root_loss"
    input, target, mask = masked_pair(input, target, mask, where)
    ours = root(input)
    if ours.shape != input.shape:
        raise ShapeError(f"{where}: expected a root that keeps the shape, got {tuple(ours.shape)}.")
    return reduce((ours - root(target)).square(), reduction, where, mask)


class RootLoss(LossModule, function=root_loss, by_place=("root", "reduction")):
    """`root_loss` with its options held."""


def expected_anscombe(mean: Tensor) -> Tensor:
    """Compute `E[2 sqrt(n + 3/8)]` of Poisson counts n: the average of `anscombe` of counts.

    Within 1e-10 of the sum over all counts in float64, values and slopes: by a table up to a mean of 64, by the series
    in 1/(m + 3/8) above. Read noise is not supported.

    Args:
        mean: mean counts, any shape. Means below zero continue the tangent at zero.

    Returns:
        Expected roots, in the shape of the mean; dtypes as those of `anscombe`.

    Raises:
        UnitError: for complex means.
    """
    mean = _floating(mean, "expected_anscombe")
    negative = mean < 0
    light = torch.where(negative, torch.zeros_like(mean), mean)
    return anscombe(light) + _correction(light) + torch.where(negative, mean, torch.zeros_like(mean)) * _SLOPE


@reads(input=LIGHT, target=LIGHT)
def expected_root_loss(
    input: Light, target: Light, *, mask: Tensor | None = None, reduction: Reduction = "mean"
) -> Tensor:
    """Compute the squared error of roots of counts, `(anscombe(target) - expected_anscombe(input))^2`.

    Nearly twice the negative log-likelihood of counts, without its logarithm: on average least where `input` is the
    mean that `target` was drawn from, however few counts. There it is the variance of `anscombe`, 1 within 1/(8 m) for
    a mean of m >= 4. A noisy `input` biases it by less than half of the bias of the Poisson likelihood
    (docs/noisy_renders.md).

    Args:
        input: mean counts of a model, any shape; finite for zero and below.
        target: counts, of the same shape.
        mask: elements that count.
        reduction: "mean", "sum" or "none".

    Returns:
        Scalar, or the shape of the input for "none".

    Raises:
        ShapeError: for two shapes.
    """
    where = "expected_root_loss"
    input, target, mask = masked_pair(input, target, mask, where)
    residual = anscombe(target) - expected_anscombe(input)
    return reduce(residual.square(), reduction, where, mask)


class ExpectedRootLoss(LossModule, function=expected_root_loss, by_place=("reduction",)):
    """`expected_root_loss` with its reduction held."""


@reads(input=LIGHT, target=LIGHT)
def log_ratio_loss(
    input: Light,
    target: Light,
    *,
    background: Tensor | float | None = None,
    dim: int | None = None,
    mask: Tensor | None = None,
    reduction: Reduction = "mean",
) -> Tensor:
    """Compute the squared logarithm of a ratio, `log((input + background) / (target + background))^2`.

    Compares relative errors of bins brighter than the background, and errors of darker ones as shares of it.

    Args:
        input: light, a tensor of any shape. Values below zero continue the tangent of the logarithm at zero.
        target: light, of the same shape.
        background: level where noise begins, in the unit of the light, above zero; number or tensor that broadcasts.
            None: 1e-3 of the mean of each item of the target (of the input where that is dark), which is not symmetric.
        dim: dimension of time, which says what an item is (`losses.layouts`).
        mask: elements that count.
        reduction: "mean", "sum" or "none".

    Returns:
        Scalar, or the shape of the input for "none".

    Raises:
        UnitError: for a background that is not above zero.
        ShapeError: for two shapes, or without `dim` and `background` where the shape is ambiguous.
    """
    where = "log_ratio_loss"
    input, target, mask = masked_pair(input, target, mask, where)
    if background is None:
        level = _BACKGROUND * item_scale(target, input, item_dims(input, dim, where, " or background="), mask)
    else:
        level = check_level("background", background, input, where)
    return reduce((_log(input, level) - _log(target, level)).square(), reduction, where, mask)


class LogRatioLoss(LossModule, function=log_ratio_loss, by_place=("background", "dim", "reduction")):
    """`log_ratio_loss` with its options held."""


def _log(x: Tensor, level: Tensor) -> Tensor:
    """`log(x + level)`, and its tangent at zero below zero."""
    negative, zero = x < 0, torch.zeros_like(x)
    return (torch.where(negative, zero, x) + level).log() + torch.where(negative, x, zero) / level


def _floating(x: Tensor, where: str) -> Tensor:
    """Return counts in a floating dtype of single precision or better."""
    check_dense((x,), where)
    whole = not (x.is_floating_point() or x.is_complex())
    return x.to(torch.get_default_dtype() if whole else working_dtype((x,), where))


def _correction(mean: Tensor) -> Tensor:
    """`E[2 sqrt(n + 3/8)] - 2 sqrt(m + 3/8)`, in s = sqrt(m + 3/8), which has a slope at m = 0."""
    s = (mean + _OFFSET).sqrt()
    tail = torch.where(s < _LAST, torch.full_like(s, _LAST), s)
    near, series = tail.square().reciprocal(), torch.full_like(s, _TAIL[-1])
    for coefficient in reversed(_TAIL[:-1]):
        series = torch.addcmul(s.new_full((), coefficient), series, near)
    place = ((torch.where(s < _LAST, s, torch.full_like(s, _FIRST)) - _FIRST) / _SPACING).clamp_min(0)
    number = place.floor().clamp_max(_PIECES.shape[1] - 1).nan_to_num(0).long()
    # one row a power: gathered from a line of its own, which is twice as fast as along the columns of a table
    rows = [row.index_select(0, number.flatten()).reshape(s.shape) for row in _PIECES.to(s)]
    part, value = place - number, rows[-1]
    for row in reversed(rows[:-1]):
        value = torch.addcmul(row, value, part)
    return torch.where(s < _LAST, value, series / tail)


def _pieces() -> tuple[Tensor, float]:
    """Coefficients (6, pieces) of quintics with value, slope and curvature of the correction at both ends, and a width.

    Slopes of means over Poisson counts are means of differences: `d/dm E g(n) = E[g(n + 1) - g(n)]`.
    """
    number = math.ceil((_LAST - _FIRST) / _STEP)
    spacing = (_LAST - _FIRST) / number
    s = torch.linspace(_FIRST, _LAST, number + 1, dtype=torch.float64)[:, None]
    m, n = (s.square() - _OFFSET).clamp_min(0), torch.arange(200, dtype=torch.float64)
    probability = (torch.xlogy(n, m) - m - torch.lgamma(n + 1)).exp()
    g = [2 * (n + k + _OFFSET).sqrt() for k in range(3)]
    mean, slope, curvature = ((probability * x).sum(1) for x in (g[0], g[1] - g[0], g[2] - 2 * g[1] + g[0]))
    s = s[:, 0]
    # by s and in steps of one piece: dm/ds = 2 s, and the 2 s taken away is linear
    value, first, second = mean - 2 * s, (2 * s * slope - 2) * spacing, (4 * s**2 * curvature + 2 * slope) * spacing**2
    c0, c1, c2 = value[:-1], first[:-1], second[:-1] / 2
    rest, rest1, rest2 = value[1:] - c0 - c1 - c2, first[1:] - c1 - 2 * c2, second[1:] - 2 * c2
    c3 = 10 * rest - 4 * rest1 + rest2 / 2
    c4 = -15 * rest + 7 * rest1 - rest2
    c5 = 6 * rest - 3 * rest1 + rest2 / 2
    return torch.stack([c0, c1, c2, c3, c4, c5]), spacing


_PIECES, _SPACING = _pieces()
# at a mean of zero
_SLOPE = 2 * (math.sqrt(1 + _OFFSET) - math.sqrt(_OFFSET))
