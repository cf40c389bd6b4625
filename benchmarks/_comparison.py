"""Libraries, and commits of this one, side by side: rows that take turns, their ratios, and what a first call costs.

A benchmark says its rows; `Comparison` runs them. With `--baseline PATH`, the root of a second checkout of the project
(a worktree of an older commit), every row of ours runs a second time with the package of that checkout, in a process of
its own and right after the current one. Scenes are always those of the current benchmark. Mitsuba's own integrators run
on both sides as well: their ratios are the noise of the machine.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from _runner import ROOT, Worker, arguments, encoded, environment, interleave, ratio, report, summary

OURS, PEER, BASELINE = "torchtransient", "mitransient", "baseline"
# What a change of the code may cost over the commit before it.
BASELINE_BAR = 1.02


@dataclass(frozen=True)
class Row:
    """One line of a table.

    `scene`: a Mitsuba dictionary as `torchtransient.scenes` makes them. `gradients`: keys of parameters, and `shifts`:
    transforms with the direction in which they move; with any of them the row times render and backward pass together.
    `against`: rows of the same library to form ratios with, and the bar of each, which holds for ours alone.
    `control`: an integrator of Mitsuba's, which no commit of ours changes.
    """

    name: str
    scene: Mapping[str, Any]
    gradients: tuple[str, ...] = ()
    shifts: Mapping[str, list[float]] = field(default_factory=dict)
    against: Mapping[str, float | None] = field(default_factory=dict)
    control: bool = False

    @property
    def action(self) -> str:
        """What the worker is asked to do."""
        return "backward" if self.gradients or self.shifts else "render"


def checkout(path: str) -> Path:
    """An argument that names the root of a checkout of this project."""
    root = Path(path).resolve()
    if not (root / "torchtransient" / "__init__.py").is_file():
        raise argparse.ArgumentTypeError(
            f"expected the root of a checkout with the folder torchtransient/ in it, got {path}; "
            "make one with `git worktree add PATH COMMIT`"
        )
    return root


def add_baseline(parser: argparse.ArgumentParser) -> None:
    """The option that names a second checkout."""
    parser.add_argument("--baseline", type=checkout, help="root of a second checkout of this project to compare with")


def comparison_arguments(description: str | None, *, gradients: bool = False) -> argparse.ArgumentParser:
    """The options of a benchmark that compares; `gradients` adds the choice to time backward passes, too."""
    parser = arguments(description)
    add_baseline(parser)
    parser.add_argument(
        "--first-calls", type=int, default=None, help="fresh processes for the first call of a row, 3 with --baseline"
    )
    if gradients:
        what = "time render and backward, too; always with --baseline"
        parser.add_argument("--gradients", action="store_true", help=what)
    return parser


def wants_gradients(options: argparse.Namespace) -> bool:
    """Whether backward passes are to be timed."""
    return bool(options.gradients or options.baseline)


def with_tent(scene: Mapping[str, Any]) -> dict[str, Any]:
    """The scene with a temporal filter that has a slope, which gradients of path lengths need."""
    sensor = scene["sensor"]
    return {**scene, "sensor": {**sensor, "film": {**sensor["film"], "temporal_filter": "tent"}}}


class Comparison:
    """The workers of one benchmark and the rows they run."""

    def __init__(self, options: argparse.Namespace, spp: int) -> None:
        self.options, self.spp = options, spp
        self.repeats: int = options.repeats or (2 if options.quick else 9)
        self.rows: dict[str, list[Row]] = {}
        self.ratios: list[tuple[str, str, float | None]] = []
        self.workers = {OURS: Worker(OURS, options.variant)}
        if options.baseline is not None:
            self.workers[BASELINE] = Worker(OURS, options.variant, checkout=options.baseline)
        if options.peer_python:
            self.workers[PEER] = Worker(PEER, options.variant, options.peer_python)

    def add(self, library: str, rows: Iterable[Row]) -> None:
        """Rows of ours (`OURS`) or of the peer (`PEER`), which does without them when it was not asked for."""
        if library not in self.workers:
            return
        self.rows[library] = list(rows)
        for row in self.rows[library]:
            for anchor, bar in row.against.items():
                self.ratios.append((f"{library}: {row.name}", f"{library}: {anchor}", bar if library == OURS else None))

    def add_ratio(self, of: str, to: str, bar: float | None = None) -> None:
        """A ratio between rows of ours and of the peer, as `library: row`; nothing without a peer."""
        if PEER in self.workers:
            self.ratios.append((of, to, bar))

    def run(self, name: str, settings: Mapping[str, Any], path: Path | None) -> None:
        """Time every row in turn, let the workers end, take the first calls, and report."""
        cases = {}
        for library, rows in self.rows.items():
            sides = [OURS, BASELINE] if library == OURS and BASELINE in self.workers else [library]
            for row in rows:
                for side in sides:
                    cases[f"{side}: {row.name}"] = self._case(side, row)
        seconds = interleave(cases, self.repeats)
        for worker in self.workers.values():
            worker.close()
        results: dict[str, Any] = {
            "cases": {case: summary(values) for case, values in seconds.items()},
            "ratios": [ratio(seconds, *pair) for pair in self.ratios],
        }
        if BASELINE in self.workers:
            for row in self.rows[OURS]:
                bar = None if row.control else BASELINE_BAR
                results["ratios"].append(ratio(seconds, f"{OURS}: {row.name}", f"{BASELINE}: {row.name}", bar))
        first = self._first_calls()
        if first:
            results["first_calls"] = first
        results["environment"] = environment(self.options.variant)
        results["workers"] = {side: worker.versions for side, worker in self.workers.items()}
        report(name, {**settings, "repeats": self.repeats, "quick": self.options.quick}, results, path)

    def _case(self, side: str, row: Row) -> Any:
        worker = self.workers[side]
        load(worker, row)
        request = {"do": row.action, "name": row.name, "spp": self.spp}
        return lambda seed: worker.ask(**request, seed=seed)["seconds"]

    def _first_calls(self) -> list[dict[str, Any]]:
        """What the first call of every row of ours costs, in processes that take turns and find no compiled kernel."""
        rounds = self.options.first_calls
        if rounds is None:
            rounds = 0 if BASELINE not in self.workers else 1 if self.options.quick else 3
        checkouts = {OURS: ROOT} if BASELINE not in self.workers else {OURS: ROOT, BASELINE: self.options.baseline}
        rows = [row for row in self.rows[OURS] if not row.control] if rounds else []
        return [self._first_call(row, checkouts, rounds) for row in rows]

    def _first_call(self, row: Row, checkouts: Mapping[str, Path], rounds: int) -> dict[str, Any]:
        answers: dict[str, list[dict[str, Any]]] = {side: [] for side in checkouts}
        for _ in range(rounds):
            for side, root in checkouts.items():
                answers[side].append(first_call(row, self.options.variant, self.spp, root))
        seconds = {side: [answer["seconds"] for answer in found] for side, found in answers.items()}
        compiling = {side: [compile_seconds(answer) for answer in found] for side, found in answers.items()}
        result: dict[str, Any] = {"row": row.name}
        for side, found in answers.items():
            kernels = found[0]["kernels"]
            result[side] = {
                "kernels": len(kernels),
                "launches": sum(kernel["launches"] for kernel in kernels),
                "operations": sum(kernel["operations"] for kernel in kernels),
                "ir_bytes": sum(kernel["ir_bytes"] for kernel in kernels),
                "seconds": summary(seconds[side]),
                "compile_seconds": summary(compiling[side]),
            }
        if BASELINE in answers:
            result["seconds_over_baseline"] = ratio(seconds, OURS, BASELINE)
            result["compile_seconds_over_baseline"] = ratio(compiling, OURS, BASELINE)
            result["no_more_kernels"] = result[OURS]["kernels"] <= result[BASELINE]["kernels"]
        return result


def load(worker: Worker, row: Row) -> None:
    """Let a worker load the scene of a row."""
    worker.ask(
        do="load", name=row.name, scene=encoded(row.scene), gradients=list(row.gradients), shifts=dict(row.shifts)
    )


def first_call(row: Row, variant: str, spp: int, root: Path = ROOT) -> dict[str, Any]:
    """Seconds and kernels of a row's first call in a fresh process that finds no compiled kernel on the disk."""
    with tempfile.TemporaryDirectory() as cache:
        worker = Worker(OURS, variant, checkout=root, cache=Path(cache))
        load(worker, row)
        answer = worker.ask(do="first", what=row.action, name=row.name, spp=spp, seed=0)
        worker.close()
    return answer


def compile_seconds(answer: Mapping[str, Any]) -> float:
    """Seconds of code generation and compilation of all kernels of a first call."""
    return sum(kernel["compile_seconds"] for kernel in answer["kernels"])
