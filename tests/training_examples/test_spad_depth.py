"""The training example runs as a script; a few steps make the network better than what it starts from."""

from __future__ import annotations

import re
import runpy
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / "training_examples" / "spad_depth.py"
METHODS = ("matched filter", "Coates + matched filter", "network")


@pytest.mark.slow
def test_runs_and_beats_the_filters_in_much_light(tmp_path, capsys):
    (errors,) = runpy.run_path(str(SCRIPT))["main"](["--smoke", "--workers", "1", "--output", str(tmp_path)])
    printed = capsys.readouterr().out
    rows = re.findall(r"^((?:all: )?(?:matched filter|Coates \+ matched filter|network)) +([\d. ]+)$", printed, re.M)
    found = {name: [float(x) for x in values.split()] for name, values in rows}
    assert set(found) == {*METHODS, *(f"all: {name}" for name in METHODS)}
    assert all(found[name] == pytest.approx(errors[name], abs=0.06) for name in found)
    # At 3 photons per cycle pile-up hides most surfaces from the filter, and its correction finds them.
    assert found["Coates + matched filter"][2] < 0.5 * found["matched filter"][2]
    assert found["network"][2] < 0.8 * found["Coates + matched filter"][2]
    # A pixel of two surfaces has no depth that all could agree on.
    assert found["all: network"][1] > found["network"][1]
    assert (tmp_path / "spad_depth.png").read_bytes().startswith(b"\x89PNG")
