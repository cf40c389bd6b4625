"""Total variation of hidden volumes, a penalty that is low for flat regions between sharp borders."""

from __future__ import annotations

import torch
from torch import Tensor

from torchtransient.checks import Numbers, shown
from torchtransient.errors import ShapeError
from torchtransient.losses.checks import (
    Reduction,
    check_dense,
    check_level,
    check_mask,
    check_number,
    counted,
    item_scale,
    reduce,
    squared_modulus,
    working_dtype,
)
from torchtransient.losses.loss_module import LossModule
from torchtransient.losses.results import VALUES, Volume, reads

_DIMS = (-3, -2, -1)
_SMOOTHING = 1e-3


@reads(volume=VALUES)
def total_variation(
    volume: Volume,
    *,
    spacing: Numbers | None = None,
    isotropic: bool = True,
    smoothing: float | None = None,
    mask: Tensor | None = None,
    reduction: Reduction = "mean",
) -> Tensor:
    """Compute the modulus of the gradient of each voxel, by differences to the next voxel along Z, Y and X.

    Times the volume of a voxel, the sum is the area of a surface times the step across it (anisotropic: the area of its
    projections onto the axes).

    Args:
        volume: real or complex volume (..., Z, Y, X).
        spacing: metres between voxels along Z, Y, X; None: that of the grid of a `HiddenVolume`, or 1.
        isotropic: root of the sum of squares; False: sum of moduli, which favors faces along the axes.
        smoothing: s in `sqrt(d^2 + s^2) - s` of a modulus d, units of the volume per metre: gradients are zero in flat
            places and finite everywhere. None: 1e-3 of the mean modulus of each Z, Y, X over the least spacing; 0: the
            modulus itself, with gradient zero in flat places.
        mask: voxels that count; there are no differences to the others.
        reduction: "mean" over voxels that count, "sum", or "none".

    Returns:
        Unit of the volume per metre (without spacing: per voxel); scalar, or the shape of the volume for "none".

    Raises:
        ShapeError: for less than three dimensions, and a spacing of other than three numbers above zero.
        UnitError: for a smoothing below zero.

    Source: Rudin, Osher and Fatemi 1992.
    """
    where = "total_variation"
    (volume,) = check_dense((volume,), where)
    if volume.ndim < 3:
        raise ShapeError(f"{where}: expected a volume (..., Z, Y, X), got {tuple(volume.shape)}.")
    volume = volume.to(working_dtype((volume,), where, complex_too=True))
    steps = (1.0, 1.0, 1.0) if spacing is None else tuple(check_number("spacing", step, where) for step in spacing)
    if len(steps) != 3 or min(steps) <= 0:
        raise ShapeError(f"{where}: expected three distances above zero, along Z, Y and X, got {shown(spacing)}.")
    mask = check_mask(mask, volume, where)
    seen = counted(volume, mask)
    if smoothing is None:
        smooth = _SMOOTHING / min(steps) * item_scale(seen, seen, _DIMS, mask)
    else:
        smooth = check_level("smoothing", smoothing, seen, where, zero=True, square=True)
    differences = [_difference(seen, mask, dim, step) for dim, step in zip(_DIMS, steps, strict=True)]
    scale = _scale(differences, smooth)
    squares = [squared_modulus(difference / scale) for difference in differences]
    if isotropic:
        squares = [torch.stack(squares).sum(0)]
    value = torch.stack([_smooth_root(square, smooth / scale) for square in squares]).sum(0) * scale
    return reduce(value, reduction, where, mask)


class TotalVariation(LossModule, function=total_variation, by_place=("spacing",)):
    """`total_variation` with its options held."""

    def forward(self, volume: Volume, mask: Tensor | None = None) -> Tensor:  # type: ignore[override]
        return self.loss(volume, mask=mask)


def _difference(x: Tensor, mask: Tensor | None, dim: int, step: float) -> Tensor:
    size = x.shape[dim]
    difference = x.diff(dim=dim) / step
    if mask is not None:
        both = mask.narrow(dim, 1, size - 1) & mask.narrow(dim, 0, size - 1)
        difference = counted(difference, both)
    return torch.cat([difference, torch.zeros_like(x.narrow(dim, 0, 1))], dim)


def _scale(differences: list[Tensor], smooth: Tensor) -> Tensor:
    """Largest difference of each item (..., 1, 1, 1), or the smoothing if larger, detached: a unit for safe squares."""
    parts = [(d.real.abs() + d.imag.abs() if d.is_complex() else d.abs()).detach().amax(_DIMS, True)
             for d in differences]  # fmt: skip
    largest = torch.stack(parts).amax(0)
    level = smooth.detach().amax(_DIMS, True) if smooth.ndim >= len(_DIMS) else smooth.detach().amax()
    largest = torch.maximum(largest, level)
    return torch.where((largest > 0) & largest.isfinite(), largest, torch.ones_like(largest))


def _smooth_root(square: Tensor, smooth: Tensor) -> Tensor:
    """`sqrt(d^2 + s^2) - s` without its cancellation: `d^2 / (sqrt(d^2 + s^2) + s)`."""
    under = square + smooth.square()
    # with slope zero at zero, which s = 0 reaches
    root = torch.where(under == 0, torch.ones_like(under), under).sqrt()
    return square / (root + smooth)
