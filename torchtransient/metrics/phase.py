"""Metrics of periodic quantities: phases, angles of polarization, distances modulo the range of a camera.

Differences are taken the short way round. Phases are real tensors, or phasors, whose phases are compared.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchtransient.checks import positive
from torchtransient.errors import UnitError
from torchtransient.floating import is_true
from torchtransient.losses.checks import check_mask, check_pair, counted
from torchtransient.losses.results import PHASOR, Phasors, reads
from torchtransient.metrics.tally import Finish, Kind, Reduction, Tally, check_finite, check_weight

_PICTURE = 2


def wrapped_difference(input: Tensor, target: Tensor, *, period: float = 2 * math.pi) -> Tensor:
    """Compute the difference the short way round, `input - target` in [-period/2, period/2].

    Args:
        input: real tensor, any shape.
        target: tensor of the same shape and unit.
        period: period in the same unit, above zero.

    Returns:
        Tensor of that shape; half a period is either of both ends.

    Raises:
        ShapeError: for two shapes.
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
    """Compute the mean absolute wrapped difference of phases.

    Args:
        input: phases (..., Y, X) in the unit of `period`, or complex phasors.
        target: phases or phasors, of the same kind and shape. Phasors of zero have no phase and do not count.
        period: 2 pi for radians, pi for angles of polarization, `c / (2 f)` for distances that a modulation frequency f
            wraps.
        weight: weight of each element, tensor that broadcasts, the modulus of the target for instance.
        mask: elements that count.
        reduction: "mean" of all, "item" of each picture, or "none".

    Returns:
        In the unit of `period`; scalar, (...) for "item", (..., Y, X) for "none"; NaN where nothing counts.

    Raises:
        UnitError: for an input that is not finite, or a phasor of zero, where it counts; for phases and phasors mixed.
        ShapeError: for two shapes.
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
    """Compute the root mean square wrapped difference of phases (..., Y, X).

    Args:
        input, target: phases (..., Y, X) in the unit of `period`, or complex phasors, see `phase_mae`.
        period: period after which phases repeat, see `phase_mae`.
        weight: weight of each element, tensor that broadcasts.
        mask: elements that count.
        reduction: "mean" of all, "item" of each picture, or "none".
    """
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
    """Compute the signed circular mean of phase differences: the angle of the mean of `exp(i (input - target))`.

    Right across the jump, where a mean of wrapped differences is wrong; meaningless for differences spread evenly over
    the circle. Source: Fisher 1993.

    Args:
        input, target: phases (..., Y, X) in the unit of `period`, or complex phasors, see `phase_mae`.
        period: period after which phases repeat, see `phase_mae`.
        weight: weight of each element, tensor that broadcasts.
        mask: elements that count.
        reduction: "mean" of all, "item" of each picture, or "none".

    Returns:
        In (-period/2, period/2].
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
    """Return the wrapped difference and its weights."""
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
    # a product of both may overflow single precision
    return _wrapped(torch.angle(x) - torch.angle(y), 2 * math.pi) * (turn / (2 * math.pi)), counts
