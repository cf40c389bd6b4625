"""Roots of transients: the wavefield that f-k migration takes is one of a measured intensity.

The square root has no derivative at zero, where most bins of a capture are. H / sqrt(|H| + floor) has one: it is H /
sqrt(floor) near zero, its slope is nowhere more than 1 / sqrt(floor), and far above the floor it is the root.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from torchtransient.checks import finite, shown
from torchtransient.errors import ShapeError, UnitError

COUNTS_FLOOR = 0.25
"""Floor for photon counts: the slope is at most 2, the root of one count 0.89, that of none zero."""


def stabilized_root(transient: Tensor, floor: float = COUNTS_FLOOR) -> Tensor:
    """``H / sqrt(|H| + floor)`` of every value, odd in H: what background leaves below zero keeps its sign.

    ``floor``: in the unit of the transient, 1/4 for photon counts; a small part of the brightest bin for radiance. With
    0 it is the root itself, sign kept, whose derivative grows without bound towards zero and counts as zero there.
    Differentiable any number of times, in both modes. Whole numbers become float32. Values must be finite. Raises
    UnitError for a floor below zero and for one that the transient's precision takes for zero, ShapeError for what is
    no tensor of real numbers.
    """
    if not isinstance(transient, Tensor) or transient.is_complex():
        got = transient.dtype if isinstance(transient, Tensor) else shown(transient)
        raise ShapeError(f"stabilized_root: expected a transient as a tensor of real numbers, got {got}.")
    h = transient if transient.is_floating_point() else transient.to(torch.float32)
    floor = checked_floor(floor, h.dtype)
    if floor:
        return h * torch.rsqrt(h.abs() + floor)
    empty = h == 0
    # The inner `where` keeps the infinite slope at zero out of products with zero, which would be NaN.
    magnitude = torch.where(empty, torch.ones_like(h), h.abs())
    return torch.where(empty, torch.zeros_like(h), torch.sign(h) * magnitude.sqrt())


class StabilizedRoot(nn.Module):
    """:func:`stabilized_root` as a layer."""

    def __init__(self, floor: float = COUNTS_FLOOR) -> None:
        super().__init__()
        self.floor = checked_floor(floor)

    def forward(self, transient: Tensor) -> Tensor:
        return stabilized_root(transient, self.floor)

    def extra_repr(self) -> str:
        return f"floor={self.floor:g}"


def checked_floor(value: float, dtype: torch.dtype = torch.float64) -> float:
    """A floor of :func:`stabilized_root` in a precision. Raises UnitError."""
    floor = finite("stabilized_root: floor", value)
    if floor < 0:
        raise UnitError(f"stabilized_root: expected a floor of zero or more, got {floor!r}. For counts take 0.25.")
    # Smaller ones vanish or have few digits, and empty bins would be zero over zero.
    if 0 < floor < (least := torch.finfo(dtype).tiny):
        raise UnitError(
            f"stabilized_root: expected a floor of zero or of {least:.3g} at least in {dtype}, got {floor!r}. Scale "
            "the transient, or take double precision."
        )
    return floor
