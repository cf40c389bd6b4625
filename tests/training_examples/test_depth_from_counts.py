"""The training example runs as a script, on a data set and online; a few steps make more of the pixels right."""

from __future__ import annotations

import re
import runpy
from pathlib import Path

import pytest

import torchtransient as tt

SCRIPT = Path(__file__).parents[2] / "training_examples" / "depth_from_counts.py"
METHODS = ("highest bin", "matched filter", "untrained", "network")


@pytest.mark.slow
@pytest.mark.parametrize("way", [pytest.param([], id="on disk"), pytest.param(["--online"], id="online")])
def test_the_network_beats_the_filter(tmp_path, capsys, way):
    run = runpy.run_path(str(SCRIPT))["main"]
    (errors,) = run(["--smoke", "--output", str(tmp_path), *way])
    printed = capsys.readouterr().out
    rows = dict(re.findall(rf"^({'|'.join(METHODS)}) +([\d.]+) .*%$", printed, re.MULTILINE))
    assert tuple(rows) == METHODS
    assert all(float(rows[name]) == pytest.approx(errors[name].all_mm, abs=0.06) for name in METHODS)
    # It begins as the filter that it corrects.
    assert errors["untrained"].far_off == pytest.approx(errors["matched filter"].far_off, abs=0.05)
    assert errors["network"].far_off < 0.9 * errors["matched filter"].far_off
    assert (tmp_path / "depth_from_counts.png").read_bytes().startswith(b"\x89PNG")
    # What is learnt from online is on no disk.
    (folder,) = (path for path in tmp_path.iterdir() if path.is_dir())
    assert tt.data.verify(folder).samples == (4 if way else 28)
