"""Quantities that repeat: phases modulo 2 pi, angles of polarization modulo pi, distances modulo a camera's range.

A difference is taken the short way round. Phases come as real tensors, or as phasors, of which the phase is compared.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchtransient.checks import positive
from torchtransient.errors import UnitError
from torchtransient.floating import is_true
from torchtransient.losses.comparison import check_mask, check_pair, counted
from torchtransient.losses.results import PHASOR, Phasors, reads
from torchtransient.metrics.tally import Finish, Kind, Reduction, Tally, check_finite, check_weight

_PICTURE = 2


def wrapped_difference(input: Tensor, target: Tensor, *, period: float = 2 * math.pi) -> Tensor:
    """`input - target` the short way round, in [-period/2, period/2]; real tensors of one shape (...), in one unit.

    Half a period is either of both ends. Raises ShapeError, UnitError.
    """
    where = "wrapped_difference"
    x, y = check_pair(input, target, where)
    return _wrapped(x - y, positive(f"{where}: period", period))


def _wrapped(difference: Tensor, period: float) -> Tensor:
    # torch's remainder of IEEE, exact for any number of turns
    return difference - period * torch.round(difference / period)


@reads(input=PHASOR, target=PHASOR)
def phase_mae(
    input: Phasors,
    target: Phasors,
    *,
    period: float = 2 * math.pi,
    weight: Tensor | None = None,
    mask: Tensor | None = None,
    reduction: Reduction = "mean",
) -> Tensor:
    """Mean of the modulus of the wrapped difference of phases, or of the phases of phasors, (..., Y, X).

    Unit of `period`: radians by default; `math.pi` for angles of polarization, `c / (2 f)` for distances that a
    modulation frequency f wraps. Phasors, complex, are compared by their phase, as a part of the period: a target of
    exactly zero has none and does not count. `weight` (broadcasts): how much each element counts, the target's modulus
    for instance. `reduction`: "mean" of all, (); "item", of each picture, (...); "none", (..., Y, X). NaN where nothing
    counts. Raises ShapeError; UnitError, also for estimates that are NaN, infinite or phasors of zero where they count.
    """
    where = "phase_mae"
    difference, counts = _difference(input, target, period, weight, mask, where)
    return Tally(difference.abs(), counts, _PICTURE).result(reduction, where)


@reads(input=PHASOR, target=PHASOR)
def phase_rmse(
    input: Phasors,
    target: Phasors,
    *,
    period: float = 2 * math.pi,
    weight: Tensor | None = None,
    mask: Tensor | None = None,
    reduction: Reduction = "mean",
) -> Tensor:
    """Root of the mean square of the wrapped difference of phases (..., Y, X); as `phase_mae`."""
    where = "phase_rmse"
    difference, counts = _difference(input, target, period, weight, mask, where)
    squares = difference.double().square()
    return Tally(squares, counts, _PICTURE, Finish(Kind.ROOT)).result(reduction, where).to(difference.dtype)


@reads(input=PHASOR, target=PHASOR)
def phase_bias(
    input: Phasors,
    target: Phasors,
    *,
    period: float = 2 * math.pi,
    weight: Tensor | None = None,
    mask: Tensor | None = None,
    reduction: Reduction = "mean",
) -> Tensor:
    """Circular mean of `input - target`: the angle of the mean of `exp(i difference)`, in (-period/2, period/2].

    Fisher, Statistical Analysis of Circular Data, 1993. Signed, and right across the jump, where a mean of wrapped
    differences is not; of differences spread evenly over the circle it means nothing. As `phase_mae` otherwise.
    """
    where = "phase_bias"
    difference, counts = _difference(input, target, period, weight, mask, where)
    turns = 2 * math.pi / period * difference.double()
    finish = Finish(Kind.ANGLE, period / (2 * math.pi))
    directions = torch.polar(torch.ones_like(turns), turns)
    return Tally(directions, counts, _PICTURE, finish).result(reduction, where).to(difference.dtype)


def _difference(
    input: object, target: object, period: float, weight: Tensor | None, mask: Tensor | None, where: str
) -> tuple[Tensor, Tensor | None]:
    """The wrapped difference, and how much each of it counts."""
    turn = positive(f"{where}: period", period)
    if isinstance(input, Tensor) and isinstance(target, Tensor) and input.is_complex() != target.is_complex():
        raise UnitError(
            f"{where}: expected phases, or phasors, in both places, got {input.dtype} and {target.dtype}. Use "
            "torch.angle of the phasors."
        )
    x, y = check_pair(input, target, where, complex_too=True)
    kept = check_mask(mask, x, where)
    if x.is_complex():
        lit = y != 0
        kept = lit if kept is None else kept & lit
    counts = check_weight(weight, kept, x, where)
    measured = None if counts is None else counts > 0
    check_finite(x, measured, "input", where)
    check_finite(y, measured, "target", where)
    if not x.is_complex():
        return _wrapped(counted(x, measured) - counted(y, measured), turn), counts
    x, y = counted(x, measured, 1.0), counted(y, measured, 1.0)
    if not is_true(x != 0):
        raise UnitError(
            f"{where}: expected phasors other than zero where the target is, got {int((x == 0).sum())} of zero, which "
            "have no phase. Leave them out with mask=, and say how many those are."
        )
    # no product of both, which single precision may not hold
    return _wrapped(torch.angle(x) - torch.angle(y), 2 * math.pi) * (turn / (2 * math.pi)), counts
