"""Small cases of the whole library on CUDA against LLVM, each in a process of its own: `gpu_check.sh --cases`.

`gpu_check.py` asks whether one scene agrees within its noise, and how fast it is; this asks whether every way through
the library works on a GPU at all, and gives the numbers of LLVM for the same seed. A case that crashes takes no other
with it. What a case is for and why it has its tolerance stands in `_gpu_cases_*.py`.

`--variant llvm_ad` compares LLVM with itself: whether the cases work, on a machine without a GPU.

Prints one line per case and exits with 1 if any failed.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from _gpu_cases_registry import CALLS_RTOL, Case, all_cases
from _runner import HERE, environment
from tqdm import tqdm

CHILD = HERE / "_gpu_cases_registry.py"
CASE_SECONDS = 90.0
LEAST_SECONDS = 5.0  # importing takes as long


@dataclass(frozen=True)
class Run:
    """How the process of one case and one variant ended. `file`: what it found, if it did."""

    ended: str
    messages: str = ""
    file: Path | None = None


@dataclass
class Verdict:
    """`worst`: the largest relative difference to the reference, None where there is nothing to compare."""

    worst: float | None = None
    problems: list[str] = field(default_factory=list)
    messages: str = ""


def run(name: str, variant: str, file: Path, seconds: float) -> Run:
    """One case in a process of its own."""
    if seconds < LEAST_SECONDS:
        return Run("was not started: no time was left (--seconds)")
    command = [sys.executable, "-X", "faulthandler", str(CHILD), name, variant, str(file)]
    with tempfile.TemporaryFile("w+", errors="replace") as written:
        try:
            code = subprocess.run(command, stdout=written, stderr=written, timeout=seconds, check=False).returncode
            ended = "" if code == 0 else f"ended with exit code {code}"
        except subprocess.TimeoutExpired:
            ended = f"did not end within {seconds:.0f} s"
        written.seek(0)
        return Run(ended, written.read(), None if ended else file)


def relative_difference(value: np.ndarray, reference: np.ndarray) -> float:
    """Of norms; that of the value itself where the reference is zero."""
    norm = float(np.linalg.norm(reference))
    difference = float(np.linalg.norm(value.astype(np.float64) - reference.astype(np.float64)))
    return difference / norm if norm else difference


def judge(found: dict[str, np.ndarray], reference: dict[str, np.ndarray] | None, rtol: float) -> Verdict:
    """Facts hold, numbers are finite, equal those of the reference, and are the same in every call of one seed."""
    verdict = Verdict()
    facts = {key for key, value in found.items() if value.dtype == bool and value.ndim == 0}
    verdict.problems += [f"not true: {key}" for key in found if key in facts and not found[key]]
    for key, value in found.items():
        if key in facts:
            continue
        if value.dtype.kind == "f" and not np.isfinite(value).all():
            verdict.problems.append(f"{key}: not finite")
        first = found.get("call 0: " + key.partition(": ")[2]) if key.startswith("call ") else None
        if first is not None and not (off := relative_difference(value, first)) <= CALLS_RTOL:
            verdict.problems.append(f"{key}: {off:.2g} off call 0, expected {CALLS_RTOL:g}")
        if reference is None:
            continue
        if key not in reference or reference[key].shape != value.shape:
            there = reference[key].shape if key in reference else "nothing"
            verdict.problems.append(f"{key}: of shape {value.shape}, the reference has {there}")
            continue
        off = relative_difference(value, reference[key])
        verdict.worst = max(verdict.worst or 0.0, off)
        if not off <= rtol:
            verdict.problems.append(f"{key}: relative difference {off:.2g}, expected {rtol:g}")
    if reference is not None:
        verdict.problems += [f"{key}: only in the reference" for key in reference if key not in found]
    return verdict


def verdict_of(case: Case, own: Run, other: Run | None) -> Verdict:
    """Of both processes. A case whose reference did not run has compared nothing, and fails."""
    for side, ran in (("", own), ("the reference ", other)):
        if ran is not None and ran.file is None:
            return Verdict(problems=[side + ran.ended], messages=ran.messages)
    arrays = [None if ran is None or ran.file is None else dict(np.load(ran.file)) for ran in (own, other)]
    verdict = judge(arrays[0] or {}, arrays[1], case.rtol)
    verdict.messages = own.messages
    return verdict


def measured(cases: dict[str, Case], options: argparse.Namespace) -> dict[str, Verdict]:
    """Verdicts of all cases, in their order; both sides of a case run one after the other."""
    end = time.monotonic() + options.seconds

    def one(entry: tuple[str, Case]) -> tuple[str, Verdict]:
        name, case = entry
        runs: list[Run | None] = []
        for place, prefix in enumerate((options.variant, options.reference if case.compared else None)):
            file = Path(folder) / f"{name}.{place}.npz"
            left = min(CASE_SECONDS, end - time.monotonic())
            runs.append(run(name, f"{prefix}_{case.kind}", file, left) if prefix else None)
        return name, verdict_of(case, runs[0] or Run("did not run"), runs[1])

    verdicts = {}
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(options.jobs) as pool:
        for name, verdict in tqdm(pool.map(one, cases.items()), total=len(cases), unit="case", desc="gpu_cases"):
            verdicts[name] = verdict
            tqdm.write(line(name, verdict, cases[name].rtol))
    return verdicts


def line(name: str, verdict: Verdict, rtol: float) -> str:
    """As it is printed."""
    worst = "facts alone" if verdict.worst is None else f"{verdict.worst:.2g} of {rtol:g}"
    return f"{'FAIL' if verdict.problems else 'ok  '} {name:<20} {worst:<18} {'; '.join(verdict.problems[:3])}".rstrip()


def parsed(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="*", metavar="CASE", help="names of cases; all if none is given")
    parser.add_argument("--variant", default="cuda_ad", choices=("cuda_ad", "llvm_ad"), help="what is checked")
    parser.add_argument("--reference", default="llvm_ad", choices=("cuda_ad", "llvm_ad"), help="what it is checked by")
    parser.add_argument("--quick", action="store_true", help="the cheapest cases alone")
    parser.add_argument("--jobs", type=int, default=min(10, os.cpu_count() or 1), help="cases at a time")
    parser.add_argument("--seconds", type=float, default=900.0, help="for all; cases that do not end by then fail")
    parser.add_argument("--json", type=Path, default=None, help="write the report to this file")
    options = parser.parse_args(arguments)
    known = all_cases()
    unknown = [name for name in options.cases if name not in known]
    if unknown:
        parser.error(f"there is no case {', '.join(unknown)}; there are {', '.join(known)}")
    return options


def main() -> None:
    options = parsed()
    cases = {name: case for name, case in all_cases().items() if name in options.cases or not options.cases}
    if options.quick:
        cases = {name: case for name, case in cases.items() if case.quick}
    on_gpu = options.variant.startswith("cuda")
    left_out = [name for name, case in cases.items() if case.cuda_only and not on_gpu]
    cases = {name: case for name, case in cases.items() if name not in left_out}
    if left_out:
        print(f"left out, of CUDA alone: {', '.join(left_out)}")
    verdicts = measured(cases, options)
    for name, verdict in verdicts.items():
        if verdict.problems:
            print(f"\n=== {name}\n" + "\n".join(verdict.problems) + f"\n{verdict.messages[-3000:]}")
    passed = sum(not verdict.problems for verdict in verdicts.values())
    print(f"{passed} of {len(verdicts)} cases passed")
    if options.json is not None:
        gpu = torch.cuda.get_device_name() if on_gpu else None
        data: dict[str, Any] = {
            "benchmark": "gpu_cases",
            "settings": {"reference": options.reference, "quick": options.quick},
            "worst_relative_difference": {name: verdict.worst for name, verdict in verdicts.items()},
            "tolerance": {name: case.rtol for name, case in cases.items() if case.compared},
            "problems": {name: verdict.problems for name, verdict in verdicts.items() if verdict.problems},
            "checks_passed": passed,
            "checks": len(verdicts),
            "environment": {**environment(options.variant), "gpu": gpu},
        }
        options.json.write_text(json.dumps(data, indent=2) + "\n", encoding="utf-8")
        print(f"written to {options.json}")
    sys.exit(0 if verdicts and passed == len(verdicts) else 1)


if __name__ == "__main__":
    main()
