"""The training example runs as a script; a few steps take a part of the multipath off."""

from __future__ import annotations

import re
import runpy
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / "training_examples" / "itof_multipath.py"
METHODS = ("16 MHz alone", "three frequencies", "less their bias", "no multipath", "network")


@pytest.mark.slow
def test_runs_and_takes_multipath_off(tmp_path, capsys):
    (errors,) = runpy.run_path(str(SCRIPT))["main"](["--smoke", "--output", str(tmp_path)])
    printed = capsys.readouterr().out
    rows = re.findall(rf"^({'|'.join(METHODS)}) +([\d. ]+)$", printed, re.MULTILINE)
    found = {name: [float(x) for x in values.split()] for name, values in rows}
    assert tuple(found) == METHODS
    assert all(found[name] == pytest.approx(errors[name], abs=0.06) for name in METHODS)
    mean, median = ({name: row[n] for name, row in errors.items()} for n in (0, 1))
    # Low frequencies suffer most; a camera in rooms without a second bounce hardly errs.
    assert mean["16 MHz alone"] > 3 * mean["three frequencies"]
    assert median["no multipath"] < 0.3 * median["three frequencies"]
    assert median["network"] < 0.8 * median["three frequencies"]
    assert mean["network"] < mean["less their bias"]
    assert (tmp_path / "itof_multipath.png").read_bytes().startswith(b"\x89PNG")
