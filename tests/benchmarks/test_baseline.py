"""Benchmarks with a second checkout: here the same one, so that everything has to come out equal."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def run(script, tmp_path, *arguments, baseline=ROOT):
    report = tmp_path / "report.json"
    command = [sys.executable, str(ROOT / "benchmarks" / script), "--baseline", str(baseline), "--json", str(report)]
    done = subprocess.run([*command, *arguments], capture_output=True, text=True, cwd=tmp_path)
    return done, json.loads(report.read_text(encoding="utf-8")) if report.is_file() else None


@pytest.mark.slow
def test_kernels_are_the_same_in_every_process(tmp_path):
    done, report = run("kernels.py", tmp_path, "--variants", "llvm_ad_mono")
    assert done.returncode == 0, done.stderr
    assert len(report["jobs"]) == 3
    for job in report["jobs"].values():
        ours, baseline = ([k["hash"] for k in job[side]] for side in ("torchtransient", "baseline"))
        assert ours and ours == baseline
    # A render compiles one kernel, which stands in front of each backward pass to a colour again.
    render, colour, _ = (job["torchtransient"] for job in report["jobs"].values())
    assert len(render) == 1 and render[0]["hash"] == colour[0]["hash"]


@pytest.mark.soak
def test_every_row_is_compared(tmp_path):
    done, report = run("backward_cost.py", tmp_path, "--quick")
    assert done.returncode == 0, done.stderr
    rows = [name.removeprefix("baseline: ") for name in report["cases"] if name.startswith("baseline: ")]
    assert rows == ["render", "albedo", "albedo and wall"]
    ratios = {ratio["of"]: ratio for ratio in report["ratios"] if ratio["to"].startswith("baseline: ")}
    for row in rows:
        ratio = ratios[f"torchtransient: {row}"]
        assert 0 < ratio["min"] <= ratio["q25"] <= ratio["median"] <= ratio["q75"] <= ratio["max"]
    assert [call["row"] for call in report["first_calls"]] == rows
    for call in report["first_calls"]:
        assert call["torchtransient"]["kernels"] == call["baseline"]["kernels"] > 0
        assert call["torchtransient"]["ir_bytes"] == call["baseline"]["ir_bytes"]
        # Nothing came from a cache: the compiler took its time.
        assert call["torchtransient"]["compile_seconds"]["min"] > 0.02


@pytest.mark.slow
def test_a_folder_without_the_package_is_refused(tmp_path):
    done, _ = run("kernels.py", tmp_path, baseline=tmp_path)
    assert done.returncode == 2 and "expected the root of a checkout" in done.stderr
