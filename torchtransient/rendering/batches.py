"""Renders in independent batches of samples, for their error bars."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import torch

from torchtransient.errors import ArgumentError
from torchtransient.interfaces import RENDER
from torchtransient.rendering import engine
from torchtransient.rendering.error_bars import BatchErrors, RunningMean, differences_of, in_cells
from torchtransient.rendering.job import RenderJob, RunLog, mix_seed
from torchtransient.rendering.output import RenderOutput

_BATCH = 0xBA7C4


def run_in_batches(job: RenderJob, values: Sequence[torch.Tensor]) -> tuple[torch.Tensor, ...]:
    """Execute a job whose ``errors`` ask for error bars.

    Args:
        job: the job.
        values: values of its parameters, in the order of its keys.

    Returns:
        Steady and response, as :func:`.engine.run`; the differences are added to ``job.errors``.
    """
    request = job.errors
    assert request is not None
    count = request.batches
    sizes = [job.spp // count + (b < job.spp % count) for b in range(count)]
    runs: list[RunLog] = []
    sums, steady_sums, numbers, running = [], [], [], RunningMean()
    steady = response = torch.zeros(())
    for b, spp in enumerate(sizes):
        log: list[RunLog] = []
        items = tuple(replace(item, seed=mix_seed(item.seed, _BATCH + b)) for item in job.items)
        part = replace(job, items=items, spp=spp, log=log, progress=_share(job.progress, b, count), errors=None)
        image, cube = engine.run(part, RENDER, values)
        runs += log
        numbers.append(runs[-1].spp)
        mean = request.mean_of(cube, 3 + request.rows, request.is_complex)
        sums.append(in_cells(mean, request.cells))
        running.add(mean, numbers[-1], last=b == count - 1)
        steady_sums.append(request.mean_of(image, 2))
        share = numbers[-1] / sum(numbers)
        steady, response = (image, cube) if b == 0 else (steady.lerp_(image, share), response.lerp_(cube, share))
        del image, cube, mean
    job.log.append(joined(job, runs, [n / sum(numbers) for n in numbers]))
    request.differences.append(differences_of(sums, numbers))
    request.squares.append(in_cells(running.squared_error(), request.cells))
    request.steady.append(differences_of(steady_sums, numbers))
    return steady, response


def with_differences(output: RenderOutput, request: BatchErrors, leading: tuple[int, ...]) -> RenderOutput:
    """Return an output with the differences between its batches.

    Args:
        output: mean of the batches.
        request: request of the call that made it.
        leading: sizes of the dimensions of items.
    """
    if len(request.differences) != 1:
        raise ArgumentError(
            "errors: expected a call outside of torch.func.vmap, which takes the batches of samples apart. Give "
            "the values a batch dimension instead."
        )
    measured = request.differences[0].movedim(-1, -3).movedim(0, -1)
    squares, steady = request.squares[0].movedim(-1, -3), request.steady[0].movedim(0, -1)
    return replace(
        output,
        differences=measured.reshape(*leading, *measured.shape[1:]),
        squares=squares.reshape(*leading, *squares.shape[1:]),
        steady_differences=steady.reshape(*leading, *steady.shape[1:]),
        cells=request.cells,
    )


def joined(job: RenderJob, runs: Sequence[RunLog], weights: Sequence[float]) -> RunLog:
    """Return the report of a whole call; ``recorded`` is that of the last batch.

    Args:
        job: job of the call.
        runs: reports of its batches.
        weights: share of the samples of each.
    """

    def energies(name: str) -> tuple[float, ...]:
        rows = [getattr(run, name) for run in runs]
        return tuple(sum(w * x for w, x in zip(weights, column, strict=True)) for column in zip(*rows, strict=True))

    return replace(
        runs[-1],
        items=job.items,
        seconds=sum(run.seconds for run in runs),
        spp=sum(run.spp for run in runs),
        energy_before=energies("energy_before"),
        energy_after=energies("energy_after"),
        energy_total=energies("energy_total"),
    )


def _share(progress: Callable[[float], None] | None, part: int, count: int) -> Callable[[float], None] | None:
    return None if progress is None else lambda done: progress((part + done) / count)
