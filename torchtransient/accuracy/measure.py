"""The measuring loop: which run comes when, what is timed, what is compared with what."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from numpy.typing import ArrayLike
from tqdm import tqdm

from torchtransient.accuracy.errors_of_estimates import ErrorTally, Reference
from torchtransient.accuracy.report import AccuracyReport, Choice, CostPoint
from torchtransient.errors import UnitError
from torchtransient.quantities import as_whole, shown


@dataclass(frozen=True)
class Estimates:
    """What one run returns: arrays by quantity, and the samples per pixel it really drew."""

    arrays: Mapping[str, ArrayLike]
    spp: int


@dataclass(frozen=True)
class Task:
    """One thing that is timed on its own: `run(spp, seed)` must return finished numbers, not pending kernels.

    `time_dims` gives the axis of time bins for the quantities that have one.
    """

    run: Callable[[int, int], Estimates]
    time_dims: Mapping[str, int] = field(default_factory=dict)


Candidate = Mapping[str, Task]


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
    independent runs; then `repeats` must be even. Raises UnitError for values out of range.
    """
    counts = checked_counts(spp, repeats, reference_spp)
    total = len(candidates) * sum(counts) * (repeats + 1) + len(candidates) * (reference_spp or 0)
    points: list[CostPoint] = []
    with tqdm(total=total, unit="spp", disable=not progress, desc="cost of accuracy") as bar:
        references = _references(candidates, reference_spp, seed, bar)
        for n, count in enumerate(counts):
            first_seed = seed + 1000 + n * (repeats + 1)
            points += _measure_count(candidates, count, repeats, first_seed, references, bar)
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
    references: Mapping[tuple[Choice, str, str], Reference],
    bar: Any,
) -> list[CostPoint]:
    """All points at one sample count."""
    for candidate in candidates.values():
        for task in candidate.values():
            task.run(count, first_seed + repeats)
        bar.update(count)
    seconds: dict[tuple[Choice, str], list[float]] = {}
    tallies: dict[tuple[Choice, str, str], ErrorTally] = {}
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
        error = tally.result()
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
            )
        )
    return points


def _references(
    candidates: Mapping[Choice, Candidate], reference_spp: int | None, seed: int, bar: Any
) -> dict[tuple[Choice, str, str], Reference]:
    references: dict[tuple[Choice, str, str], Reference] = {}
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
