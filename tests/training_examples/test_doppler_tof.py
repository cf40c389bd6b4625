"""The training example runs as a script; the renderer's fit knows the speeds better than the formula."""

from __future__ import annotations

import re
import runpy
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / "training_examples" / "doppler_tof.py"


@pytest.mark.slow
def test_multipath_is_no_speed(tmp_path, capsys):
    (errors,) = runpy.run_path(str(SCRIPT))["main"](["--smoke", "--output", str(tmp_path)])
    printed = re.findall(r"(formula without noise|formula, bodies|formula|fit) ([\d.]+) m/s", capsys.readouterr().out)
    assert {name: float(value) for name, value in printed} == pytest.approx(errors, abs=6e-4)
    # Of 1.7 m/s (rms); the formula errs by its detours, noise or not.
    assert errors["formula without noise"] > 0.3
    assert errors["fit"] < 0.5 * min(errors[name] for name in ("formula without noise", "formula", "formula, bodies"))
    assert (tmp_path / "doppler_tof.png").read_bytes().startswith(b"\x89PNG")
