"""Sums of metrics over pixels, items, batches and processes.

Every metric is a function of a weighted mean of elements (pixels, points, pictures): the mean, the root of a mean
square, the angle of a mean direction. Two sums determine it, so batches and processes add up, in double precision.
Where nothing counts there is no mean, and the metric is NaN.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Literal, get_args

import torch
import torch.distributed as dist
from torch import Tensor, nn

from torchtransient.checks import shown
from torchtransient.errors import ArgumentError, UnitError
from torchtransient.floating import is_true
from torchtransient.losses.checks import check_mask, check_pair, counted, expanded

Reduction = Literal["mean", "item", "none"]


class Kind(IntEnum):
    """Function of the mean that gives a metric, as a number that processes can send to each other."""

    MEAN = 0
    ROOT = 1
    ANGLE = 2


@dataclass(frozen=True)
class Finish:
    """Step from the mean of the elements, complex for directions, to the metric."""

    kind: Kind = Kind.MEAN
    scale: float = 1.0

    def of(self, total: Tensor, weight: Tensor) -> Tensor:
        """Return the metric of two sums.

        Args:
            total: sum of the weighted elements, complex for directions, any shape.
            weight: sum of the weights, of the same shape.

        Returns:
            Real tensor of that shape, NaN where there is no weight.
        """
        counts = weight > 0
        mean = total / torch.where(counts, weight, torch.ones_like(weight))
        if self.kind == Kind.ANGLE:
            mean = torch.angle(mean)
        elif self.kind == Kind.ROOT:
            # with slope zero at zero, where that of the root is infinite
            exact = mean == 0
            mean = torch.where(exact, mean, torch.where(exact, torch.ones_like(mean), mean).sqrt())
        return torch.where(counts, mean * self.scale, torch.full_like(mean, torch.nan))


@dataclass
class Collector:
    """Reduction that receives the sums of a metric, (real, imaginary, weight), while its mean is returned."""

    sums: Tensor | None = None
    finish: Finish | None = None


@dataclass(frozen=True)
class Tally:
    """Elements (...) of a metric and their weights; the last `item` dimensions are one item of a batch.

    `weights`: a mask or numbers of at least 0, None for ones. Elements without weight may hold anything.
    """

    values: Tensor
    weights: Tensor | None = None
    item: int = 0
    finish: Finish = Finish()

    def result(self, reduction: Reduction | Collector, where: str) -> Tensor:
        """Return the metric, NaN where nothing counts.

        Args:
            reduction: "mean" of all elements, "item" of each item, "none" of each element, or a collector of sums.
            where: begins the message.

        Raises:
            ArgumentError: for other reductions.
        """
        if isinstance(reduction, Collector):
            total, weight = self._sums(tuple(range(self.values.ndim)))
            imaginary = total.imag if total.is_complex() else torch.zeros_like(total)
            reduction.sums = torch.stack([total.real, imaginary, weight]).detach()
            reduction.finish = self.finish
            return self._ratio(total, weight)
        if reduction not in get_args(Reduction):
            raise ArgumentError(f"{where}: expected reduction 'mean', 'item' or 'none', got {reduction!r}.")
        summed = {"mean": self.values.ndim, "item": min(self.item, self.values.ndim), "none": 0}[reduction]
        return self._ratio(*self._sums(tuple(range(-summed, 0))))

    def _sums(self, dims: tuple[int, ...]) -> tuple[Tensor, Tensor]:
        values = self.values.to(torch.complex128 if self.values.is_complex() else torch.float64)
        weights = torch.ones_like(values.real) if self.weights is None else self.weights.to(torch.float64)
        weighed = torch.where(weights > 0, values, torch.zeros_like(values)) * weights
        if not dims:  # torch takes no dimensions for all of them
            return weighed, weights
        return weighed.sum(dims), weights.sum(dims)

    def _ratio(self, total: Tensor, weight: Tensor) -> Tensor:
        return self.finish.of(total, weight).to(self.values.real.dtype)


def measured_pair(
    input: object, target: object, mask: Tensor | None, where: str
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Return estimate and truth of one shape, 0 where they do not count, and the mask.

    Args:
        input, target: real tensors.
        mask: boolean tensor that broadcasts, None for all.
        where: begins the message.

    Raises:
        UnitError: for NaN and infinite numbers that count.
        ShapeError: for other types, and two shapes.
    """
    x, y = check_pair(input, target, where)
    kept = check_mask(mask, x, where)
    check_finite(x, kept, "input", where)
    check_finite(y, kept, "target", where)
    return counted(x, kept), counted(y, kept), kept


def check_finite(x: Tensor, mask: Tensor | None, name: str, where: str) -> None:
    """Check that elements are finite where they count.

    Args:
        x: the elements.
        mask: boolean tensor, True for elements that count; None for all.
        name: name of `x` in the message.
        where: begins the message.

    Raises:
        UnitError: for NaN and infinite numbers.
    """
    wrong = ~torch.isfinite(x) if mask is None else ~torch.isfinite(x) & mask
    if not is_true(~wrong):
        raise UnitError(
            f"{where}: expected {name} of finite numbers where it is measured, got {int(wrong.sum())} of "
            f"{wrong.numel()} that are NaN or infinite. Leave them out with mask=, and say how many those are."
        )


def check_weight(weight: Tensor | None, mask: Tensor | None, like: Tensor, where: str) -> Tensor | None:
    """Return the weight of each element, 0 where masked.

    Args:
        weight: tensor that broadcasts, None for ones.
        mask: boolean tensor that broadcasts, None for all.
        like: the elements.
        where: begins the message.

    Raises:
        ShapeError: for tensors that do not broadcast.
        UnitError: for complex weights, and those below zero or not finite.
    """
    mask = check_mask(mask, like, where)
    if weight is None:
        return mask
    if weight.is_complex():
        raise UnitError(f"{where}: expected a weight of real numbers, got {weight.dtype}.")
    full = expanded(weight, like, "weight", where).to(torch.float64)
    if mask is not None:
        full = torch.where(mask, full, torch.zeros_like(full))
    if not is_true(torch.isfinite(full) & (full >= 0)):
        raise UnitError(f"{where}: expected weights that are finite and not below zero, got others.")
    return full


class Running(nn.Module):
    """A metric over the batches of an epoch and the processes of a run. ::

        rmse = tt.metrics.Running(tt.metrics.depth_rmse)
        for batch in validation:
            rmse.update(network(batch["light"]), batch["depth"], mask=batch["alive"])
        print(rmse.compute())                                        # of all pixels of all batches

    `compute` is the metric of all batches at once, however they are cut: the root of the mean square of all pixels, not
    a mean of roots. A call updates, and returns the metric of its batch.

    Each process has its own sums, on the device of its last batch. They are not buffers: `DistributedDataParallel` does
    not overwrite them, `.half()` does not round them, a `state_dict` does not hold them.

    Args:
        metric: metric of `tt.metrics` with a reduction.
        options: options of the metric, held.

    Raises:
        ArgumentError: for functions without a reduction, a median for instance.
    """

    sums: Tensor
    _finish: Finish | None

    def __init__(self, metric: Callable[..., Tensor], **options: Any) -> None:
        super().__init__()
        self.name = str(getattr(metric, "__name__", shown(metric)))
        if "reduction" not in inspect.signature(metric).parameters:
            raise ArgumentError(f"Running: expected a metric of tt.metrics with a reduction, got {self.name}.")
        self.metric, self.options = metric, options
        self.reset()

    def update(self, *args: Any, **keywords: Any) -> Tensor:
        """Add a batch, with the arguments of the metric. Returns the metric of this batch."""
        collector = Collector()
        with torch.no_grad():
            value = self.metric(*args, **{**self.options, **keywords}, reduction=collector)
        if collector.sums is None or collector.finish is None:
            raise ArgumentError(f"Running: expected a metric of tt.metrics, got {self.name}, which gives no sums.")
        self.sums, self._finish = self.sums.to(collector.sums.device) + collector.sums, collector.finish
        return value

    def forward(self, *args: Any, **keywords: Any) -> Tensor:
        """Call `update`."""
        return self.update(*args, **keywords)

    def compute(self, *, across_ranks: bool = False) -> Tensor:
        """Return the metric of all batches since the last reset, float64, NaN if nothing has counted.

        Args:
            across_ranks: include the batches of all processes of the default group, which all have to call this. The
                sums of each process stay its own.

        Raises:
            ArgumentError: if `across_ranks` without a process group.
        """
        sums, finish = self.sums, self._finish
        if across_ranks:
            if not (dist.is_available() and dist.is_initialized()):
                raise ArgumentError("Running: expected a process group for across_ranks=True, got none.")
            # a process without a batch has no finish of its own
            sums = sums.to(_device_of_group(sums.device), copy=True)
            kinds = sums.new_tensor([int(finish.kind), finish.scale] if finish else [0.0, 0.0])
            dist.all_reduce(sums)
            dist.all_reduce(kinds, op=dist.ReduceOp.MAX)
            finish = Finish(Kind(int(kinds[0])), float(kinds[1]))
        finish = finish or Finish()
        total = torch.complex(sums[0], sums[1]) if finish.kind == Kind.ANGLE else sums[0]
        return finish.of(total, sums[2])

    def reset(self) -> None:
        """Forget all batches."""
        self.sums = torch.zeros(3, dtype=torch.float64)
        self._finish = None

    def extra_repr(self) -> str:
        return ", ".join([self.name, *(f"{name}={value!r}" for name, value in self.options.items())])


def _device_of_group(device: torch.device) -> torch.device:
    """Return the device of sums over processes: a process without a batch has CPU sums, which nccl does not take."""
    if device.type == "cpu" and dist.get_backend() == "nccl":
        return torch.device("cuda", torch.cuda.current_device())
    return device
