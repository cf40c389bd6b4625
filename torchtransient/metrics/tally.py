"""What metrics share: elements with weights, their means over a batch or an item, and checks of what is compared.

Every metric of this room is a weighted mean of elements (pixels, points, pictures), and a function of that mean: the
root of a mean square, the angle of a mean direction. Two sums tell it, so batches and processes add up. Sums are taken
in double precision. Where nothing counts there is no mean: the answer is NaN, since any number would be an opinion.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Literal, get_args

import torch
from torch import Tensor

from torchtransient.errors import ArgumentError, ShapeError, UnitError
from torchtransient.floating import is_true
from torchtransient.losses.comparison import check_device, check_mask

Reduction = Literal["mean", "item", "none"]


class Kind(IntEnum):
    """What a metric is of the mean of its elements. Numbers, which processes can send each other."""

    MEAN = 0
    ROOT = 1
    ANGLE = 2


@dataclass(frozen=True)
class Finish:
    """The step from the mean of the elements, complex for directions, to the metric."""

    kind: Kind = Kind.MEAN
    scale: float = 1.0

    def of(self, total: Tensor, weight: Tensor) -> Tensor:
        """The metric of two sums; NaN without weight."""
        counts = weight > 0
        mean = total / torch.where(counts, weight, torch.ones_like(weight))
        if self.kind == Kind.ANGLE:
            mean = torch.angle(mean)
        elif self.kind == Kind.ROOT:
            # with the slope of its lowest point at zero, where that of the root is infinite
            exact = mean == 0
            mean = torch.where(exact, mean, torch.where(exact, torch.ones_like(mean), mean).sqrt())
        return torch.where(counts, mean * self.scale, torch.full_like(mean, torch.nan))


@dataclass
class Collector:
    """Given as a `reduction`: takes the sums of a metric, (real, imaginary, weight), while its mean is returned."""

    sums: Tensor | None = None
    finish: Finish | None = None


@dataclass(frozen=True)
class Tally:
    """Elements (...) of a metric and how much each counts; the last `item` dimensions are one item of a batch.

    `weights`: truth values or numbers of at least 0, None for ones; what stands where nothing counts does not matter.
    """

    values: Tensor
    weights: Tensor | None = None
    item: int = 0
    finish: Finish = Finish()

    def result(self, reduction: Reduction | Collector, where: str) -> Tensor:
        """The metric of all elements, of each item (...), or of each element, NaN where nothing counts."""
        if isinstance(reduction, Collector):
            total, weight = self._sums(tuple(range(self.values.ndim)))
            imaginary = total.imag if total.is_complex() else torch.zeros_like(total)
            reduction.sums = torch.stack([total.real, imaginary, weight]).detach()
            reduction.finish = self.finish
            return self._ratio(total, weight)
        check_reduction(reduction, where)
        if reduction == "mean":
            return self._ratio(*self._sums(tuple(range(self.values.ndim))))
        if reduction == "item":
            return self._ratio(*self._sums(tuple(range(-min(self.item, self.values.ndim), 0))))
        return self._ratio(*self._sums(()))

    def _sums(self, dims: tuple[int, ...]) -> tuple[Tensor, Tensor]:
        values = self.values.to(torch.complex128 if self.values.is_complex() else torch.float64)
        weights = torch.ones_like(values.real) if self.weights is None else self.weights.to(torch.float64)
        weighed = torch.where(weights > 0, values, torch.zeros_like(values)) * weights
        if not dims:  # torch takes no dimensions for all of them
            return weighed, weights
        return weighed.sum(dims), weights.sum(dims)

    def _ratio(self, total: Tensor, weight: Tensor) -> Tensor:
        return self.finish.of(total, weight).to(self.values.real.dtype)


def check_reduction(reduction: object, where: str) -> None:
    if not isinstance(reduction, Collector) and reduction not in get_args(Reduction):
        raise ArgumentError(f"{where}: expected reduction 'mean', 'item' or 'none', got {reduction!r}.")


def check_finite(x: Tensor, mask: Tensor | None, name: str, where: str) -> None:
    """Raises UnitError for NaN and infinite numbers where `mask` counts."""
    wrong = ~torch.isfinite(x) if mask is None else ~torch.isfinite(x) & mask
    if not is_true(~wrong):
        raise UnitError(
            f"{where}: expected {name} of finite numbers where it is measured, got {int(wrong.sum())} of "
            f"{wrong.numel()} that are NaN or infinite. Leave them out with mask=, and say how many those are."
        )


def check_weight(weight: Tensor | None, mask: Tensor | None, like: Tensor, where: str) -> Tensor | None:
    """How much each element counts: the weight where the mask counts. Raises ShapeError, UnitError, DeviceError."""
    mask = check_mask(mask, like, where)
    if weight is None:
        return mask
    if not isinstance(weight, Tensor) or weight.is_complex():
        got = weight.dtype if isinstance(weight, Tensor) else type(weight).__name__
        raise UnitError(f"{where}: expected weight as a tensor of real numbers, got {got}.")
    check_device(weight, like, where, "weight and tensors")
    try:
        full = weight.expand(like.shape).to(torch.float64)
    except RuntimeError:
        raise ShapeError(
            f"{where}: expected a weight that broadcasts to {tuple(like.shape)}, got {tuple(weight.shape)}."
        ) from None
    if mask is not None:
        full = torch.where(mask, full, torch.zeros_like(full))
    if not is_true(torch.isfinite(full) & (full >= 0)):
        raise UnitError(f"{where}: expected weights that are finite and not below zero, got others.")
    return full
