"""A metric over the batches of an epoch, and over the processes of a run: sums that add up."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor, nn

from torchtransient.checks import shown
from torchtransient.errors import ArgumentError
from torchtransient.metrics.tally import Collector, Finish, Kind

_ROOM = __name__.rpartition(".")[0]


class Running(nn.Module):
    """A metric of this room over batches: `update`, `compute`, `reset`. ::

        rmse = tt.metrics.Running(tt.metrics.depth_rmse)
        for batch in validation:
            rmse.update(network(batch["light"]), batch["depth"], mask=batch["alive"])
        print(rmse.compute())                                        # of all pixels of all batches

    `compute` is what the metric says of all batches at once, however they are cut: the root of the mean square of all
    pixels and not the mean of roots. `options` are those of the metric, held. A call updates and returns the metric of
    its batch alone.

    In several processes each has its own sums; `compute(across_ranks=True)`, which all of them have to call, adds up
    copies of them by `torch.distributed.all_reduce`; what each process has stays its own. The sums
    are no buffer: `DistributedDataParallel` does not copy those of its first rank over the others, `.half()` does not
    round them, and a `state_dict` does not hold them. They live where the last batch did.

    Raises ArgumentError for functions that are no such metric (a median is not made of sums) and for options that it
    does not take.
    """

    sums: Tensor
    _finish: Finish | None

    def __init__(self, metric: Callable[..., Tensor], **options: Any) -> None:
        super().__init__()
        self.name = str(getattr(metric, "__name__", shown(metric)))
        known = set(inspect.signature(metric).parameters) if inspect.isfunction(metric) else set()
        if "reduction" not in known or not metric.__module__.startswith(_ROOM):
            raise ArgumentError(
                f"Running: expected a metric of tt.metrics with a reduction, depth_rmse for instance, got {self.name}."
            )
        # the collector is the reduction
        known -= {"reduction"}
        if set(options) - known:
            wrong = ", ".join(sorted(set(options) - known))
            raise ArgumentError(f"Running: {self.name} takes {', '.join(sorted(known))}, got {wrong}.")
        self.metric, self.options = metric, options
        self.reset()

    def update(self, *args: Any, **keywords: Any) -> Tensor:
        """Add a batch, given as to the metric. Returns the metric of this batch."""
        if "reduction" in keywords:
            raise ArgumentError("Running: expected no reduction, got one. Call the metric for maps and items.")
        collector = Collector()
        with torch.no_grad():
            value = self.metric(*args, **{**self.options, **keywords}, reduction=collector)
        if collector.sums is None or collector.finish is None:
            raise ArgumentError(f"Running: expected a metric of tt.metrics, got {self.name}, which gives no sums.")
        self.sums, self._finish = self.sums.to(collector.sums.device) + collector.sums, collector.finish
        return value

    def forward(self, *args: Any, **keywords: Any) -> Tensor:
        return self.update(*args, **keywords)

    def compute(self, *, across_ranks: bool = False) -> Tensor:
        """The metric of all batches since the last reset, float64 (); NaN where nothing has counted yet.

        `across_ranks`: of those of all processes of the default group.
        """
        sums, finish = self.sums, self._finish
        if across_ranks:
            if not (dist.is_available() and dist.is_initialized()):
                raise ArgumentError("Running: expected a process group for across_ranks=True, got none.")
            # a process without a batch learns from the others what becomes of the mean
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
    """Where processes add up: a process without a batch has its sums on the CPU, where nccl does not reach."""
    if device.type == "cpu" and dist.get_backend() == "nccl":
        return torch.device("cuda", torch.cuda.current_device())
    return device
