"""The measuring loop: which run comes when, what is timed, what is compared with what."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from tqdm import tqdm

from torchtransient.accuracy.errors_of_estimates import TAIL_RUNS, ErrorTally, Reference, Tail
from torchtransient.accuracy.report import AccuracyReport, Choice, CostPoint
from torchtransient.checks import as_whole, shown
from torchtransient.errors import UnitError


@dataclass(frozen=True)
class Estimates:
    """What one run returns: arrays by quantity, and the samples per pixel it really drew."""

    arrays: Mapping[str, ArrayLike]
    spp: int


@dataclass(frozen=True)
class Task:
    """One thing that is timed on its own: `run(spp, seed)` must return finished numbers, not pending kernels.

    `time_dims` gives the axis of time bins for the quantities that have one. `tails`: whether the tail of its
    distribution is looked at first, which holds 96 runs in memory.
    """

    run: Callable[[int, int], Estimates]
    time_dims: Mapping[str, int] = field(default_factory=dict)
    tails: bool = False


Candidate = Mapping[str, Task]
# A quantity of a task of a choice.
Key = tuple[Choice, str, str]
# Samples per pixel of the runs that show a tail, at most: sums of many samples hide it from a few runs.
_TAIL_SPP = 16


def measure(
    candidates: Mapping[Choice, Candidate],
    spp: Sequence[int],
    *,
    reference_spp: int | None = None,
    repeats: int = 4,
    seed: int = 0,
    progress: bool = True,
    settings: dict[str, Any] | None = None,
) -> AccuracyReport:
    """Run every task of every candidate at every `spp`, `repeats` times, and report errors and median seconds.

    Each candidate first warms up (kernels are compiled) at the sample count that follows. Within a repeat, the
    candidates take turns, so that a change of the machine's speed meets all of them. Every candidate is compared with
    itself: with its own reference of `reference_spp` samples (two independent halves), or, without one, in pairs of
    independent runs; then `repeats` must be even. Of tasks with `tails`, 96 runs of 16 samples (or of the smallest
    count) come first: where they show a heavy tail, there is no error. Raises UnitError for values out of
    range.
    """
    counts = checked_counts(spp, repeats, reference_spp)
    tail_spp = min(_TAIL_SPP, counts[0])
    total = len(candidates) * sum(counts) * (repeats + 1) + len(candidates) * (reference_spp or 0)
    total += tail_spp * TAIL_RUNS * sum(task.tails for candidate in candidates.values() for task in candidate.values())
    points: list[CostPoint] = []
    with tqdm(total=total, unit="spp", disable=not progress, desc="cost of accuracy") as bar:
        references = _references(candidates, reference_spp, seed, bar)
        tails = _tails(candidates, tail_spp, seed + 1000 + len(counts) * (repeats + 1), bar)
        for n, count in enumerate(counts):
            first_seed = seed + 1000 + n * (repeats + 1)
            points += _measure_count(candidates, count, repeats, first_seed, references, tails, bar)
    method = "in pairs of independent runs" if reference_spp is None else f"against a reference of {reference_spp} spp"
    quantities = list(dict.fromkeys(p.quantity for p in points))
    choices = list(candidates)
    points.sort(key=lambda p: (quantities.index(p.quantity), choices.index(p.choice)))
    return AccuracyReport(points, method, dict(settings or {}))


def _measure_count(
    candidates: Mapping[Choice, Candidate],
    count: int,
    repeats: int,
    first_seed: int,
    references: Mapping[Key, Reference],
    tails: Mapping[Key, Tail],
    bar: Any,
) -> list[CostPoint]:
    """All points at one sample count."""
    for candidate in candidates.values():
        for task in candidate.values():
            task.run(count, first_seed + repeats)
        bar.update(count)
    seconds: dict[tuple[Choice, str], list[float]] = {}
    tallies: dict[Key, ErrorTally] = {}
    drawn: dict[tuple[Choice, str], int] = {}
    for repeat in range(repeats):
        for choice, candidate in candidates.items():
            for name, task in candidate.items():
                begin = time.perf_counter()
                estimates = task.run(count, first_seed + repeat)
                seconds.setdefault((choice, name), []).append(time.perf_counter() - begin)
                drawn[choice, name] = estimates.spp
                for quantity, array in estimates.arrays.items():
                    key = (choice, name, quantity)
                    if key not in tallies:
                        tallies[key] = ErrorTally(task.time_dims.get(quantity), references.get(key))
                    tallies[key].add(array)
            bar.update(count)
    points = []
    for (choice, name, quantity), tally in tallies.items():
        tail = tails.get((choice, name, quantity))
        error = tally.result(tail)
        points.append(
            CostPoint(
                choice=choice,
                quantity=quantity,
                spp=drawn[choice, name],
                seconds=statistics.median(seconds[choice, name]),
                squared_error=error.squared,
                squared_error_standard_error=error.squared_standard_error,
                relative_error=error.relative,
                median_bin_error=error.median_bin,
                repeats=repeats,
                tail=tail,
            )
        )
    return points


def _tails(candidates: Mapping[Choice, Candidate], spp: int, first_seed: int, bar: Any) -> dict[Key, Tail]:
    found: dict[Key, Tail] = {}
    for choice, candidate in candidates.items():
        for name, task in candidate.items():
            if not task.tails:
                continue
            runs: dict[str, list[NDArray[np.float32]]] = {}
            for run in range(TAIL_RUNS):
                for quantity, array in task.run(spp, first_seed + run).arrays.items():
                    runs.setdefault(quantity, []).append(np.array(array, dtype=np.float32))
                bar.update(spp)
            found |= {(choice, name, quantity): Tail.of(several) for quantity, several in runs.items()}
    return found


def _references(
    candidates: Mapping[Choice, Candidate], reference_spp: int | None, seed: int, bar: Any
) -> dict[Key, Reference]:
    references: dict[Key, Reference] = {}
    if reference_spp is None:
        return references
    for choice, candidate in candidates.items():
        for name, task in candidate.items():
            halves = [task.run(reference_spp // 2, seed + half).arrays for half in range(2)]
            for quantity in halves[0]:
                references[choice, name, quantity] = Reference(halves[0][quantity], halves[1][quantity])
        bar.update(reference_spp)
    return references


def checked_counts(spp: Sequence[int], repeats: int, reference_spp: int | None) -> list[int]:
    """The sample counts of a measurement, in order. Raises UnitError."""
    listed = isinstance(spp, Sequence) or getattr(spp, "ndim", None) == 1
    found = [as_whole(n) for n in spp] if listed and not isinstance(spp, (str, bytes)) else []
    counts = [n for n in found if n is not None and 1 <= n < 2**32]
    if not counts or len(set(counts)) != len(found):
        raise UnitError(f"spp: expected different sample counts of at least 1, below 2^32, got {shown(spp)}")
    for name, value in (("repeats", repeats), ("reference_spp", reference_spp)):
        if as_whole(value) is None and (value is not None or name == "repeats"):
            raise UnitError(f"{name}: expected a whole number, got {shown(value)}")
    if repeats < 2 or (reference_spp is None and repeats % 2):
        raise UnitError(
            "repeats: expected at least 2, and an even number without a reference (runs are compared in pairs), "
            f"got {repeats}"
        )
    if reference_spp is not None and reference_spp < 4 * max(counts):
        raise UnitError(
            f"reference_spp: expected at least four times the largest spp ({4 * max(counts)}), got "
            f"{shown(reference_spp)}; use None to compare independent runs instead"
        )
    return sorted(counts)
