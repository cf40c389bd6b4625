"""The measuring loop: which run comes when, what is timed, what is compared with what."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from tqdm import tqdm

from torchtransient.accuracy.errors_of_estimates import NOT_MEASURED, TAIL_RUNS, ErrorTally, Reference, Tail, relative
from torchtransient.accuracy.report import AccuracyReport, Choice, CostPoint
from torchtransient.checks import as_whole, shown
from torchtransient.errors import UnitError


@dataclass(frozen=True)
class Estimates:
    """What one run returns: arrays by quantity, and the samples per pixel it really drew.

    `derived`: function that makes further arrays, which is not timed.
    """

    arrays: Mapping[str, ArrayLike]
    spp: int
    derived: Callable[[], Mapping[str, ArrayLike]] = dict


@dataclass(frozen=True)
class Task:
    """One thing that is timed on its own: `run(spp, seed)` must return finished numbers, not pending kernels.

    `time_dims` gives the axis of time bins for the quantities that have one. `tails`: whether the tail of its
    distribution is looked at first, which holds 96 runs in memory. `to_common`: functions by quantity that bring its
    array to the shape which all choices share; they are not timed.
    """

    run: Callable[[int, int], Estimates]
    time_dims: Mapping[str, int] = field(default_factory=dict)
    tails: bool = False
    to_common: Mapping[str, Callable[[NDArray[np.float32]], NDArray[np.float32]]] = field(default_factory=dict)

    def comparable(self, estimates: Estimates) -> dict[str, NDArray[np.float32]]:
        """Arrays of a run in the shape that all choices share."""
        given = {**estimates.arrays, **estimates.derived()}
        arrays = {name: np.asarray(array, dtype=np.float32) for name, array in given.items()}
        return {name: self.to_common[name](x) if name in self.to_common else x for name, x in arrays.items()}


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
    finest: Mapping[str, Choice] | None = None,
) -> AccuracyReport:
    """Run every task of every candidate at every `spp`, `repeats` times, and report errors and median seconds.

    Each candidate first warms up (kernels are compiled) at the sample count that follows. Within a repeat, the
    candidates take turns, so that a change of the machine's speed meets all of them. Every candidate is compared with
    itself: with its own reference of `reference_spp` samples (two independent halves), or, without one, in pairs of
    independent runs; then `repeats` must be even. Of tasks with `tails`, 96 runs of 16 samples (or of the smallest
    count) come first: where they show a heavy tail, there is no error.

    `finest`: by name of a task, the choice whose reference all choices are compared with as well: what that finds is
    the total error, variance and bias. That reference has `reference_spp` samples, or four times the largest of `spp`.
    Raises UnitError for values out of range.
    """
    counts = checked_counts(spp, repeats, reference_spp)
    tail_spp = min(_TAIL_SPP, counts[0])
    finest = dict(finest or {})
    # Choices with a reference of their own, and those that are the reference of the total error.
    referred = {choice: list(candidate) for choice, candidate in candidates.items()} if reference_spp else {}
    for name, choice in finest.items():
        if name not in referred.setdefault(choice, []):
            referred[choice].append(name)
    of_reference = reference_spp or 4 * max(counts)
    total = len(candidates) * sum(counts) * (repeats + 1) + of_reference * sum(map(len, referred.values()))
    total += tail_spp * TAIL_RUNS * sum(task.tails for candidate in candidates.values() for task in candidate.values())
    points: list[CostPoint] = []
    with tqdm(total=total, unit="spp", disable=not progress, desc="cost of accuracy") as bar:
        found = _references(candidates, referred, of_reference, seed, bar)
        own = found if reference_spp else {}
        common = {
            (choice, name, quantity): reference
            for choice in candidates
            for (of, name, quantity), reference in found.items()
            if finest.get(name) == of
        }
        tails = _tails(candidates, tail_spp, seed + 1000 + len(counts) * (repeats + 1), bar)
        for n, count in enumerate(counts):
            first_seed = seed + 1000 + n * (repeats + 1)
            points += _measure_count(candidates, count, repeats, first_seed, own, common, tails, bar)
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
    own: Mapping[Key, Reference],
    common: Mapping[Key, Reference],
    tails: Mapping[Key, Tail],
    bar: Any,
) -> list[CostPoint]:
    """All points at one sample count. `own`: references of each choice, `common`: those of the total error."""
    for candidate in candidates.values():
        for task in candidate.values():
            task.run(count, first_seed + repeats)
        bar.update(count)
    seconds: dict[tuple[Choice, str], list[float]] = {}
    cpu_seconds: dict[tuple[Choice, str], list[float]] = {}
    tallies: dict[Key, ErrorTally] = {}
    totals: dict[Key, ErrorTally] = {}
    drawn: dict[tuple[Choice, str], int] = {}
    for repeat in range(repeats):
        for choice, candidate in candidates.items():
            for name, task in candidate.items():
                begin, begin_cpu = time.perf_counter(), time.process_time()
                estimates = task.run(count, first_seed + repeat)
                cpu_seconds.setdefault((choice, name), []).append(time.process_time() - begin_cpu)
                seconds.setdefault((choice, name), []).append(time.perf_counter() - begin)
                drawn[choice, name] = estimates.spp
                for quantity, array in task.comparable(estimates).items():
                    key = (choice, name, quantity)
                    if key not in tallies:
                        tallies[key] = ErrorTally(task.time_dims.get(quantity), own.get(key))
                        if key in common:
                            totals[key] = ErrorTally(None, common[key])
                    tallies[key].add(array)
                    if key in totals:
                        totals[key].add(array)
            bar.update(count)
    points = []
    for (choice, name, quantity), tally in tallies.items():
        tail = tails.get((choice, name, quantity))
        error = tally.result(tail)
        total = totals[choice, name, quantity].result(tail) if (choice, name, quantity) in totals else NOT_MEASURED
        points.append(
            CostPoint(
                choice=choice,
                quantity=quantity,
                spp=drawn[choice, name],
                seconds=statistics.median(seconds[choice, name]),
                squared_error=error.squared,
                squared_error_standard_error=error.squared_standard_error,
                # What is compared with one reference is relative to it.
                relative_error=error.relative if math.isnan(total.power) else relative(error.squared, total.power),
                median_bin_error=error.median_bin,
                repeats=repeats,
                tail=tail,
                cpu_seconds=statistics.median(cpu_seconds[choice, name]),
                comparisons=error.comparisons,
                total_squared_error=total.squared,
                total_squared_error_standard_error=total.squared_standard_error,
                total_error=total.relative,
                bias=total.bias,
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
                for quantity, array in task.comparable(task.run(spp, first_seed + run)).items():
                    runs.setdefault(quantity, []).append(np.array(array))
                bar.update(spp)
            found |= {(choice, name, quantity): Tail.of(several) for quantity, several in runs.items()}
    return found


def _references(
    candidates: Mapping[Choice, Candidate], referred: Mapping[Choice, Sequence[str]], spp: int, seed: int, bar: Any
) -> dict[Key, Reference]:
    """References of some tasks of some choices."""
    references: dict[Key, Reference] = {}
    for choice, names in referred.items():
        for name in names:
            task = candidates[choice][name]
            halves = [task.comparable(task.run(spp // 2, seed + half)) for half in range(2)]
            for quantity in halves[0]:
                references[choice, name, quantity] = Reference(halves[0][quantity], halves[1][quantity])
            bar.update(spp)
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
