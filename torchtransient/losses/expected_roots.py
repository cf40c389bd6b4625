"""The root of counts against the root that counts of a model's mean have on average: a squared error of few photons.

`sqrt(m)` of a mean is not the mean of the root of counts: of 0.4 counts it is 7 % higher (Jensen), and dark bins, of
which there are most, outvote bright ones. Against the expected root the squared error is least at the right mean.
"""

from __future__ import annotations

import math
from fractions import Fraction

import torch
from torch import Tensor, nn

from torchtransient.losses.comparison import (
    Reduction,
    check_dense,
    check_mask,
    check_pair,
    check_reduction,
    counted,
    reduce,
    working_dtype,
)
from torchtransient.losses.results import LIGHT, Light, reads
from torchtransient.losses.roots import anscombe

_OFFSET = Fraction(3, 8)
# Between s = sqrt(m + 3/8) at m = 0 and _LAST, every _STEP; the series is good to 1e-11 from there on.
_FIRST, _LAST, _STEP = math.sqrt(_OFFSET), 8.0, 1 / 32
_TERMS = 7


def expected_anscombe(mean: Tensor) -> Tensor:
    """`E[2 sqrt(n + 3/8)]` of Poisson counts n of that mean: what `anscombe` of counts is on average. Any shape.

    Within 1e-10 of the sum over all counts (in double precision; single precision has its rounding), values and
    slopes: from a table up to a mean of 64, from the series in 1/(m + 3/8) above. Means below zero, which no counts
    have, continue the tangent at zero, so that values and gradients are finite. Whole numbers count in torch's default
    dtype, half precision in float32. No read noise. Raises UnitError for complex numbers, ShapeError for no tensor.
    """
    where = "expected_anscombe"
    check_dense((mean,), where)
    whole = not (mean.is_floating_point() or mean.is_complex())
    mean = mean.to(torch.get_default_dtype() if whole else working_dtype((mean,), where))
    negative = mean < 0
    light = torch.where(negative, torch.zeros_like(mean), mean)
    return anscombe(light) + _correction(light) + torch.where(negative, mean, torch.zeros_like(mean)) * _SLOPE


@reads(input=LIGHT, target=LIGHT)
def expected_root_loss(
    input: Light, target: Light, *, mask: Tensor | None = None, reduction: Reduction = "mean"
) -> Tensor:
    """`(anscombe(target) - expected_anscombe(input))^2` of each element, any shape: a model's mean counts, and counts.

    Twice the negative log-likelihood of counts, nearly, without its logarithm: on average it is least where `input` is
    the mean that `target` was drawn of, however few counts, and there it is the variance of `anscombe`, 1 within
    1/(8 m) for a mean of m >= 4. A noisy `input` biases it, by the curvature of the root alone
    (docs/noisy_renders.md: less than half of the bias of the Poisson likelihood).
    Finite for zero counts, zero means, and values below zero. Raises ShapeError, UnitError.
    """
    where = "expected_root_loss"
    check_reduction(reduction, where)
    input, target = check_pair(input, target, where)
    mask = check_mask(mask, input, where)
    residual = anscombe(counted(target, mask)) - expected_anscombe(counted(input, mask))
    return reduce(residual.square(), reduction, where, mask)


def _correction(mean: Tensor) -> Tensor:
    """`E[2 sqrt(n + 3/8)] - 2 sqrt(m + 3/8)`, in s = sqrt(m + 3/8), which has a slope at m = 0."""
    s = (mean + float(_OFFSET)).sqrt()
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


def _tail() -> list[float]:
    """`a_k` of `sum_k a_k u^(1/2 - k)`, u = m + 3/8, k from 1: Taylor's series at m over the central moments.

    Those of a Poisson distribution: `mu_(j+1) = m (mu_j' + j mu_(j-1))`, polynomials in m.
    """
    moments = [[Fraction(1)], [Fraction(0)]]
    for j in range(1, 2 * _TERMS):
        slope = [power * c for power, c in enumerate(moments[j])][1:]
        before = [j * c for c in moments[j - 1]]
        size = max(len(slope), len(before))
        both = [sum((p[i] for p in (slope, before) if i < len(p)), Fraction(0)) for i in range(size)]
        moments.append([Fraction(0), *both])
    found, binomial = [Fraction(0)] * (_TERMS + 1), Fraction(1)
    for j, moment in enumerate(moments):
        for power, c in enumerate(moment):
            for i in range(power + 1):  # m^p = (u - 3/8)^p
                k = j - i
                if j > 0 and k <= _TERMS:
                    found[k] += binomial * c * math.comb(power, i) * (-_OFFSET) ** (power - i)
        binomial *= (Fraction(1, 2) - j) / (j + 1)
    return [2 * float(c) for c in found[1:]]


def _pieces() -> tuple[Tensor, float]:
    """Coefficients (6, pieces) of quintics that meet value, slope and curvature of the correction at both their ends.

    Slopes of means over Poisson counts are means of differences: `d/dm E g(n) = E[g(n + 1) - g(n)]`.
    """
    number = math.ceil((_LAST - _FIRST) / _STEP)
    spacing = (_LAST - _FIRST) / number
    s = torch.linspace(_FIRST, _LAST, number + 1, dtype=torch.float64)[:, None]
    m, n = (s.square() - float(_OFFSET)).clamp_min(0), torch.arange(200, dtype=torch.float64)
    probability = (torch.xlogy(n, m) - m - torch.lgamma(n + 1)).exp()
    g = [2 * (n + k + float(_OFFSET)).sqrt() for k in range(3)]
    mean, slope, curvature = (
        (probability * x).sum(1) for x in (g[0], g[1] - g[0], g[2] - 2 * g[1] + g[0])
    )
    s = s[:, 0]
    # by s and in steps of one piece: dm/ds = 2 s, and the 2 s taken away is linear
    value, first, second = mean - 2 * s, (2 * s * slope - 2) * spacing, (4 * s**2 * curvature + 2 * slope) * spacing**2
    c0, c1, c2 = value[:-1], first[:-1], second[:-1] / 2
    rest, rest1, rest2 = value[1:] - c0 - c1 - c2, first[1:] - c1 - 2 * c2, second[1:] - 2 * c2
    c3 = 10 * rest - 4 * rest1 + rest2 / 2
    c4 = -15 * rest + 7 * rest1 - rest2
    c5 = 6 * rest - 3 * rest1 + rest2 / 2
    return torch.stack([c0, c1, c2, c3, c4, c5]), spacing


_TAIL = _tail()
_PIECES, _SPACING = _pieces()
# at a mean of zero
_SLOPE = 2 * (math.sqrt(1 + _OFFSET) - math.sqrt(_OFFSET))


class ExpectedRootLoss(nn.Module):
    """`expected_root_loss(input, target)` with its reduction held."""

    def __init__(self, reduction: Reduction = "mean") -> None:
        super().__init__()
        check_reduction(reduction, "ExpectedRootLoss")
        self.reduction = reduction

    def forward(self, input: Light, target: Light, mask: Tensor | None = None) -> Tensor:
        return expected_root_loss(input, target, mask=mask, reduction=self.reduction)
