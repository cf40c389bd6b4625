"""The example runs as a script, reports both fits and draws their curves."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / "training_examples" / "fit_glass_index.py"


@pytest.mark.slow
def test_runs_and_moves_towards_the_truth(tmp_path):
    picture = tmp_path / "curves.png"
    options = {"--steps": 6, "--spp": 16384, "--resolution": 4, "--repetitions": 6, "--output": picture}
    done = subprocess.run(
        [sys.executable, SCRIPT, *(str(x) for pair in options.items() for x in pair)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    results = dict(re.findall(r"^from the (\w+) image: index ([\d.]+)", done.stdout, re.MULTILINE))
    assert set(results) == {"transient", "steady"}
    # Six steps of at most 0.02 each from 1.2 on. All of them go upwards: at 16,384 samples the derivative of the
    # transient is twice its deviation and more.
    assert 1.25 < float(results["transient"]) <= 1.321
    assert picture.read_bytes().startswith(b"\x89PNG")
