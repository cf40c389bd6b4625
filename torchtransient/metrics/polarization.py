"""Metrics of degree and angle of polarization, of Stokes components.

The four components are along `stokes_dim`: -4 of pictures (..., 4, C, Y, X), -5 of transients (..., 4, C, T, Y, X).
Elements that are dark in the target have no polarization and do not count. Frames have to agree: see `tt.stokes`.
"""

from __future__ import annotations

import math
from typing import Literal, get_args

import torch
from torch import Tensor

from torchtransient import stokes
from torchtransient.checks import shown
from torchtransient.errors import ArgumentError, ShapeError, UnitError
from torchtransient.floating import is_true
from torchtransient.losses.checks import check_level, check_mask, check_pair
from torchtransient.losses.results import Picture
from torchtransient.metrics.phase import phase_mae
from torchtransient.metrics.tally import Finish, Kind, Reduction, Tally, check_finite

Part = Literal["total", "linear", "circular"]
_DEGREES = {
    "total": stokes.degree_of_polarization,
    "linear": stokes.degree_of_linear_polarization,
    "circular": stokes.degree_of_circular_polarization,
}
_PICTURE = 2
_COMPONENTS = 4


def dop_mae(
    input: Picture,
    target: Picture,
    *,
    stokes_dim: int = stokes.STEADY_DIM,
    part: Part = "total",
    floor: float = 0.0,
    mask: Tensor | None = None,
    reduction: Reduction = "mean",
) -> Tensor:
    """Compute the mean absolute error of the degree of polarization, `mean(|DoP(input) - DoP(target)|)`.

    Degrees above one, of noise, are compared as they are.

    Args:
        input: Stokes components (..., 4, C, Y, X), or a polarized result with `steady`.
        target: Stokes components of the same shape.
        stokes_dim: dimension of the components.
        part: "total", "linear" or "circular" (signed) polarization.
        floor: brightness, in the unit of the light, that the target has to exceed to count.
        mask: elements that count, in the shape without the components.
        reduction: "mean" of all, "item" of each picture, or "none".

    Returns:
        Scalar, the shape without components and picture for "item", without components for "none"; NaN where nothing
        counts.

    Raises:
        UnitError: for an input without light, or not finite, where the target counts.
        ShapeError: for two shapes, and without four components along `stokes_dim`.
        ArgumentError: for another `part`.
    """
    where = "dop_mae"
    difference, counts = _degrees(input, target, stokes_dim, part, floor, mask, where)
    return Tally(difference.abs(), counts, _PICTURE).result(reduction, where)


def dop_rmse(
    input: Picture,
    target: Picture,
    *,
    stokes_dim: int = stokes.STEADY_DIM,
    part: Part = "total",
    floor: float = 0.0,
    mask: Tensor | None = None,
    reduction: Reduction = "mean",
) -> Tensor:
    """Compute the root mean square error of the degree of polarization.

    Args:
        input, target: Stokes components (..., 4, C, Y, X), or polarized results with `steady`, see `dop_mae`.
        stokes_dim: dimension of the components.
        part: "total", "linear" or "circular" (signed) polarization.
        floor: brightness, in the unit of the light, that the target has to exceed to count.
        mask: elements that count, in the shape without the components.
        reduction: "mean" of all, "item" of each picture, or "none".
    """
    where = "dop_rmse"
    difference, counts = _degrees(input, target, stokes_dim, part, floor, mask, where)
    return Tally(difference.square(), counts, _PICTURE, Finish(Kind.ROOT)).result(reduction, where)


def aolp_mae(
    input: Picture,
    target: Picture,
    *,
    stokes_dim: int = stokes.STEADY_DIM,
    floor: float = 0.0,
    mask: Tensor | None = None,
    reduction: Reduction = "mean",
) -> Tensor:
    """Compute the mean absolute error of the angle of linear polarization, modulo pi, radians in [0, pi/2].

    Each element weighs as the linear part `|(S1, S2)|` of its target: the angle of hardly polarized light is noise. For
    angles in place of Stokes components take `phase_mae(..., period=math.pi)`.

    Args:
        floor: linear part that the target has to exceed to count. For the other arguments see `dop_mae`.

    Raises:
        UnitError: for an input without linear polarization where the target counts.
    """
    where = "aolp_mae"
    x, y, dim = _stokes_pair(input, target, stokes_dim, where)
    linear = [torch.hypot(s.select(dim, 1), s.select(dim, 2)) for s in (x, y)]
    counts = _counts(linear[1], floor, mask, where)
    clean = _finite((x, y), counts, dim, where)
    _check_there(linear[0], counts, "linear polarization", where)
    angles = [stokes.angle_of_linear_polarization(s, dim) for s in clean]
    weight = torch.where(counts, linear[1], torch.zeros_like(linear[1]))
    return phase_mae(angles[0], angles[1], period=math.pi, weight=weight, reduction=reduction)


def _degrees(
    input: object, target: object, stokes_dim: int, part: Part, floor: float, mask: Tensor | None, where: str
) -> tuple[Tensor, Tensor]:
    if part not in get_args(Part):
        raise ArgumentError(f"{where}: expected part 'total', 'linear' or 'circular', got {part!r}.")
    x, y, dim = _stokes_pair(input, target, stokes_dim, where)
    counts = _counts(y.select(dim, 0), floor, mask, where)
    clean = _finite((x, y), counts, dim, where)
    _check_there(x.select(dim, 0), counts, "light", where)
    ours, theirs = (_DEGREES[part](s, dim) for s in clean)
    return ours - theirs, counts


def _stokes_pair(input: object, target: object, stokes_dim: int, where: str) -> tuple[Tensor, Tensor, int]:
    x, y = check_pair(_picture("input", input, where), _picture("target", target, where), where)
    if not -x.ndim <= stokes_dim < x.ndim or x.shape[stokes_dim] != _COMPONENTS:
        raise ShapeError(
            f"{where}: expected four Stokes components along stokes_dim={stokes_dim}, got {tuple(x.shape)}. They are "
            "along -4 of a picture (..., 4, C, Y, X) and -5 of a transient (..., 4, C, T, Y, X) of polarized variants."
        )
    return x, y, stokes_dim % x.ndim


def _picture(name: str, x: object, where: str) -> object:
    """Return the tensor of a polarized result: a batch of four unpolarized renders has its shape."""
    if isinstance(x, Tensor):
        return x
    steady = getattr(x, "steady", None)
    if not isinstance(steady, Tensor) or getattr(x, "polarized", True) is not True:
        raise ShapeError(f"{where}: expected {name} as a tensor or a render by a polarized variant, got {shown(x)}.")
    return steady


def _counts(level: Tensor, floor: float, mask: Tensor | None, where: str) -> Tensor:
    least = check_level("floor", floor, level.new_empty(()), where, zero=True)
    given = check_mask(mask, level, where)
    check_finite(level, given, "target", where)
    lit = level > least.clamp_min(torch.finfo(level.dtype).tiny)
    return lit if given is None else given & lit


def _finite(pair: tuple[Tensor, Tensor], counts: Tensor, dim: int, where: str) -> list[Tensor]:
    """Return both tensors, with horizontal light where nothing counts."""
    found = []
    for x, name in zip(pair, ("input", "target"), strict=True):
        full = counts.unsqueeze(dim).expand(x.shape)
        check_finite(x, full, name, where)
        found.append(torch.where(full, x, torch.ones_like(x)))
    return found


def _check_there(level: Tensor, counts: Tensor, what: str, where: str) -> None:
    missing = counts & ~(level > torch.finfo(level.dtype).tiny)
    if not is_true(~missing):
        raise UnitError(
            f"{where}: expected an input with {what} where the target has some, got {int(missing.sum())} entries of "
            "none. Leave them out with mask=, and say how many those are."
        )
