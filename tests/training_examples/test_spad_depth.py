"""The training example runs as a script; a few steps make the network better than what it starts from."""

from __future__ import annotations

import re
import runpy
from pathlib import Path

SCRIPT = Path(__file__).parents[2] / "training_examples" / "spad_depth.py"


def test_runs_and_beats_the_filters_in_much_light(tmp_path, capsys):
    options = {"--steps": 16, "--batch": 2, "--size": 12, "--channels": 4, "--test-scenes": 6, "--output": tmp_path}
    run = runpy.run_path(str(SCRIPT))["main"]
    run([str(x) for pair in options.items() for x in pair])
    printed = capsys.readouterr().out
    rows = re.findall(r"^(matched filter|Coates \+ matched filter|network) +([\d. ]+)$", printed, re.MULTILINE)
    errors = {name: [float(x) for x in values.split()] for name, values in rows}
    assert set(errors) == {"matched filter", "Coates + matched filter", "network"}
    # At 3 photons per cycle pile-up hides most surfaces from the filter, and its correction finds them.
    assert errors["Coates + matched filter"][2] < 0.5 * errors["matched filter"][2]
    assert errors["network"][2] < errors["matched filter"][2]
    assert (tmp_path / "spad_depth.png").read_bytes().startswith(b"\x89PNG")
