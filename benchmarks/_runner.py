"""What all benchmarks share: worker processes, interleaved timing, medians with quartiles, JSON and tables.

The rules: every side runs in one call of one script, A B A B; warm-up before the first timed run; the timed region ends
after `dr.eval` and `dr.sync_thread`; seeds are pinned; medians and interquartile ranges are reported, never a best run.
Measured is the checkout that this file belongs to, in child processes too, whatever is installed: import this module
before `torchtransient`.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
sys.path.insert(0, str(ROOT))
os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))


def arguments(description: str | None, *, peer: bool = True) -> argparse.ArgumentParser:
    """The options that every benchmark has."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--quick", action="store_true", help="tiny sizes: checks that the script runs, measures nothing"
    )
    parser.add_argument("--repeats", type=int, default=None, help="timed runs of every case")
    parser.add_argument("--json", type=Path, default=None, help="write the report to this file")
    parser.add_argument("--variant", default="llvm_ad_rgb", help="Mitsuba variant")
    if peer:
        parser.add_argument("--peer-python", default=None, help="python of an environment with mitransient 1.3.1")
    return parser


def curve_arguments(description: str | None, picture: str, numbers: str, *, repeats: int) -> argparse.ArgumentParser:
    """The options of a benchmark that draws error against time into `picture` and writes `numbers` next to it."""
    parser = argparse.ArgumentParser(description=(description or "").split("\n", 1)[0])
    parser.add_argument("--picture", type=Path, help=f"written to {picture}, if not given")
    parser.add_argument("--json", type=Path, help=f"written to {numbers}, if not given")
    parser.add_argument("--repeats", type=int, default=repeats)
    parser.add_argument("--quick", action="store_true", help="tiny: shows that it runs, measures nothing")
    return parser


def output(given: Path | None, kept: str | Path, *, quick: bool) -> Path:
    """`given`, else the file that is kept in the repository; of a quick run, which measures nothing, one elsewhere."""
    if given is None and not quick:
        return Path(kept)
    path = given or Path(tempfile.gettempdir()) / "torchtransient_quick_runs" / Path(kept).name
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


class ChildProcess:
    """A process that reads one JSON object per line and answers each with one line; it speaks first."""

    def __init__(self, command: Sequence[str], **popen: Any) -> None:
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, **popen)
        self.greeting = self._answer()

    def ask(self, **request: Any) -> dict[str, Any]:
        """Send one request and wait for its answer; RuntimeError when the process ended instead."""
        if self.process.stdin is None:
            raise RuntimeError("the process has no input")
        self.process.stdin.write(json.dumps(request) + "\n")
        self.process.stdin.flush()
        return self._answer()

    def _answer(self) -> dict[str, Any]:
        line = self.process.stdout.readline() if self.process.stdout else ""
        if not line:
            raise RuntimeError(f"a process ended with exit code {self.process.wait()}; its messages are above")
        answer: dict[str, Any] = json.loads(line)
        return answer

    def close(self) -> None:
        """Let the process end."""
        if self.process.stdin:
            self.process.stdin.close()
        self.process.wait(timeout=60)


class Worker(ChildProcess):
    """A `_worker.py` process. `python` runs it; `checkout` has the package that it imports.

    With `cache`, an empty folder, Dr.Jit finds no kernel of an earlier run. A foreign library runs in the environment
    of its own `python`.
    """

    def __init__(
        self, library: str, variant: str, python: str | None = None, checkout: Path = ROOT, cache: Path | None = None
    ) -> None:
        environment = dict(os.environ)
        ours = library == "torchtransient"
        if ours:
            environment["PYTHONPATH"] = os.pathsep.join((str(checkout), environment["PYTHONPATH"]))
        else:
            del environment["PYTHONPATH"]
        if cache is not None:
            environment["DRJIT_CACHE_DIR"] = str(cache)
        command = [python or sys.executable, str(HERE / "_worker.py"), library, variant]
        super().__init__(command, env=environment, cwd=checkout if ours else None)
        package = self.greeting.pop("package")
        self.versions = self.greeting
        if ours:
            self.versions["commit"] = commit_of(checkout)
            if Path(package).resolve() != (checkout / "torchtransient").resolve():
                raise RuntimeError(f"expected the package of {checkout}, the worker imported {package}")


def commit_of(checkout: Path) -> str | None:
    """Which commit a checkout is at, with a `+` when files differ from it; None outside of git."""
    git = ["git", "-C", str(checkout)]
    try:
        commit = subprocess.run([*git, "rev-parse", "--short=12", "HEAD"], check=True, capture_output=True, text=True)
        state = subprocess.run([*git, "status", "--porcelain", "-uno"], check=True, capture_output=True, text=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    return commit.stdout.strip() + ("+" if state.stdout else "")


def encoded(node: Any) -> Any:
    """A scene dictionary of `torchtransient.scenes` as JSON: arrays become {"matrix": ...}."""
    if isinstance(node, np.ndarray):
        return {"matrix": node.tolist()}
    if isinstance(node, dict):
        return {key: encoded(value) for key, value in node.items()}
    return node


def steady(scene: dict[str, Any], integrator: str) -> dict[str, Any]:
    """The same scene for one of Mitsuba's own integrators and its `hdrfilm`."""
    sensor = dict(scene["sensor"])
    film = {key: sensor["film"][key] for key in ("width", "height", "rfilter")}
    sensor["film"] = {"type": "hdrfilm", "pixel_format": "rgb", "component_format": "float32", **film}
    return {**scene, "sensor": sensor, "integrator": {**scene["integrator"], "type": integrator}}


def interleave(cases: Mapping[str, Callable[[int], float]], repeats: int, warm_up: int = 2) -> dict[str, list[float]]:
    """Seconds of every case, `repeats` each, taking turns; `cases[name](seed)` returns the seconds of one run."""
    for seed in range(warm_up):
        for run in cases.values():
            run(seed)
    seconds: dict[str, list[float]] = {name: [] for name in cases}
    for seed in range(repeats):
        for name, run in cases.items():
            seconds[name].append(run(100 + seed))
            print(f"  {name}: {seconds[name][-1]:.4f} s", file=sys.stderr)
    return seconds


def summary(values: Sequence[float]) -> dict[str, Any]:
    """Median, quartiles, extremes and the values themselves."""
    low, high = np.percentile(values, [25, 75])
    quartiles = {"median": statistics.median(values), "q25": float(low), "q75": float(high)}
    return {**quartiles, "min": min(values), "max": max(values), "runs": list(values)}


def ratio(seconds: Mapping[str, Sequence[float]], name: str, anchor: str, bar: float | None = None) -> dict[str, Any]:
    """Median over the rounds of name / anchor, with quartiles; `bar` is what it should not exceed."""
    rounds = [a / b for a, b in zip(seconds[name], seconds[anchor], strict=True)]
    result = {"of": name, "to": anchor, **summary(rounds)}
    if bar is not None:
        result.update(bar=bar, within=bool(result["median"] <= bar))
    return result


def environment(variant: str | None = None) -> dict[str, Any]:
    """Versions and the size of the machine, without its name."""
    packages: dict[str, str | None] = {}
    for name in ("torch", "mitsuba", "drjit", "numpy", "torchtransient"):
        try:
            packages[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            packages[name] = None
    cpus = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    own = {"python": platform.python_version(), "machine": platform.machine(), "cpus": cpus, "variant": variant}
    return {**own, **packages}


def _without_verdicts(node: Any) -> Any:
    """The same data without what a run at toy size cannot tell."""
    if isinstance(node, Mapping):
        return {k: _without_verdicts(v) for k, v in node.items() if k not in ("bar", "bar_seconds", "within")}
    if isinstance(node, list):
        return [_without_verdicts(item) for item in node]
    return node


def spread(row: Mapping[str, Any]) -> str:
    """Quartiles and extremes of a summary, to print."""
    return f"[{row['q25']:.3f}, {row['q75']:.3f}]  ({row['min']:.3f} to {row['max']:.3f})"


def report(name: str, settings: Mapping[str, Any], results: Mapping[str, Any], path: Path | None) -> None:
    """Print `results` as a table and write everything as JSON if a path was given. A quick run judges no bar."""
    if settings.get("quick"):
        results = _without_verdicts(results)
    print(f"\n{name}")
    for key, value in settings.items():
        print(f"  {key} = {value}")
    for case, row in results.get("cases", {}).items():
        print(f"  {case:<44} {row['median']:>10.4f} s   [{row['q25']:.4f}, {row['q75']:.4f}]")
    for row in results.get("ratios", []):
        bar = "" if "bar" not in row else f"   bar {row['bar']:.2f}: {'reached' if row['within'] else 'MISSED'}"
        print(f"  {row['of']} / {row['to']}: {row['median']:.3f}   {spread(row)}{bar}")
    for row in results.get("first_calls", []):
        print(f"  first call of {row['row']}:")
        for side in (side for side in ("torchtransient", "baseline") if side in row):
            found = row[side]
            counts = f"{found['kernels']} kernels, {found['launches']} launches"
            kernels = f"{counts}, {found['operations']} operations, {found['ir_bytes']} bytes"
            times = f"{found['seconds']['median']:.3f} s, compiled in {found['compile_seconds']['median']:.3f} s"
            print(f"    {side:<16} {kernels}; {times}")
        for what in ("seconds", "compile_seconds"):
            over = row.get(f"{what}_over_baseline")
            if over:
                print(f"    {what} over baseline: {over['median']:.3f}   {spread(over)}")
    for key, value in results.items():
        if key not in ("cases", "ratios", "first_calls"):
            print(f"  {key}: {value}")
    if path is not None:
        data = {"benchmark": name, "settings": dict(settings), **results}
        path.write_text(json.dumps(data, indent=2) + "\n", encoding="utf-8")
        print(f"  written to {path}")
