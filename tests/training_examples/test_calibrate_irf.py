"""The calibration example finds the widths, tails and the second lobe of responses that were made from a model."""

from __future__ import annotations

import re
import runpy
from pathlib import Path

import numpy as np
import pytest
import torch

from torchtransient import sensing

SCRIPT = Path(__file__).parents[2] / "training_examples" / "calibrate_irf.py"


def response(folder):
    """Two lobes 1.2 ns apart, of 60 ps with a tail of 80 ps, 2e6 counts, turned to begin in its highest bin."""
    edges = torch.arange(401, dtype=torch.float64) * 8e-12
    lobes = [sensing.TailedResponse(60e-12, [80e-12], [0.4], delay_s=d) for d in (0.8e-9, 2.0e-9)]
    mean = 2e6 * (0.7 * lobes[0].mass(edges) + 0.3 * lobes[1].mass(edges)) + 5
    counts = torch.poisson(mean, generator=torch.Generator().manual_seed(0))
    path = folder / "irf.npy"
    np.save(path, counts.roll(-int(counts.argmax())).numpy())
    return path


def frames(folder):
    """Six zones with one width of 1 ns and a tail of 0.8 ns."""
    edges = torch.arange(65, dtype=torch.float64) * 250e-12
    rows = [
        5000 * sensing.TailedResponse(1e-9, [0.8e-9], [1.0], delay_s=(4 + 0.6 * k) * 1e-9).mass(edges) + 3
        for k in range(6)
    ]
    path = folder / "frame.npz"
    np.savez(path, hists=torch.poisson(torch.stack(rows), generator=torch.Generator().manual_seed(1)).numpy())
    return path


@pytest.mark.slow
def test_finds_what_was_put_in(tmp_path, capsys):
    options = [
        "--irf", response(tmp_path), "--smoke", "--frames", frames(tmp_path), "--steps", "160",
        "--output", tmp_path / "out",
    ]  # fmt: skip
    runpy.run_path(str(SCRIPT))["main"]([str(x) for x in options])
    printed = capsys.readouterr().out
    lobes = re.findall(r"lobe at +([\d.]+) ps: share ([\d.]+), width +([\d.]+) ps, tail +([\d.]+) ps", printed)
    (early, share, width, tail), (late, _, _, _) = [[float(x) for x in lobe] for lobe in lobes]
    assert abs(late - early - 1200) < 5
    assert abs(share - 0.7) < 0.02
    assert abs(width - 60) < 4
    assert abs(tail - 80) < 12
    found = re.search(r"width (\d+) ps, tail (\d+) ps, residual ([\d.]+) %", printed)
    width, tail, residual = (float(x) for x in found.groups())
    assert abs(width - 1000) < 100
    assert abs(tail - 800) < 100
    assert residual < 6
    assert (tmp_path / "out" / "calibrate_irf.png").read_bytes().startswith(b"\x89PNG")
