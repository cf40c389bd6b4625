"""The training example runs as a script: on simulated captures always, on measured ones where their folder is named."""

from __future__ import annotations

import os
import re
import runpy
from pathlib import Path

import pytest
import torch

import torchtransient as tt

SCRIPT = Path(__file__).parents[2] / "training_examples" / "denoise_histograms.py"
METHODS = ("counts and a floor", "Gaussian over time", "... and positions", "best Gaussian here", "network")
MEASURED = "TORCHTRANSIENT_MEASURED_DATA"


def table(printed):
    names = "|".join(map(re.escape, METHODS))
    rows = re.findall(rf"^({names}) +([\d. ]+)$", printed, re.MULTILINE)
    return {name: [float(x) for x in values.split()] for name, values in rows}


@pytest.mark.slow
def test_simulated_captures_lose_their_noise(tmp_path, capsys, monkeypatch):
    monkeypatch.delenv(MEASURED, raising=False)
    (nats,) = runpy.run_path(str(SCRIPT))["main"](["--smoke", "--output", str(tmp_path)])
    printed = capsys.readouterr().out
    assert "simulated captures stand in" in printed
    rows = table(printed)
    assert tuple(rows) == METHODS
    assert all(rows[name] == pytest.approx(nats[name], abs=0.006) for name in METHODS)
    # Neighbours in time and position each tell something. A smoke run's network has not gone past them yet.
    assert all(a > b > c for a, b, c in zip(*(nats[name] for name in METHODS[:3]), strict=True))
    assert all(n < g for n, g in zip(nats["network"], nats["Gaussian over time"], strict=True))
    assert (tmp_path / "denoise_histograms.png").read_bytes().startswith(b"\x89PNG")


def test_the_likelihood_that_is_lost():
    lost = runpy.run_path(str(SCRIPT))["lost"]
    mean = torch.tensor([3.0, 0.0, 1.5]).reshape(1, 1, 3, 1)
    assert lost(mean + 1e-9, mean).item() == pytest.approx(0.0, abs=1e-6)
    rate = torch.tensor([2.0, 0.5, 4.0]).reshape(1, 1, 3, 1)
    # The difference of two Poisson log-likelihoods of these counts.
    likely = [tt.losses.poisson_nll(of, mean, reduction="sum") for of in (rate, mean)]
    assert lost(rate, mean).item() == pytest.approx((likely[0] - likely[1]).item(), abs=1e-6)


def test_a_folder_without_files_is_said(tmp_path):
    with pytest.raises(tt.errors.TorchTransientError, match=r"direct_after\.mat"):
        runpy.run_path(str(SCRIPT))["measured"](tmp_path)


@pytest.mark.measured
def test_measured_captures_lose_their_noise(tmp_path):
    folder = os.environ.get(MEASURED)
    if not folder:
        pytest.fail(f"set {MEASURED} to the folder that holds keyhole/E and keyhole/K", pytrace=False)
    run = runpy.run_path(str(SCRIPT))
    tracks = [run["measured"](Path(folder, "keyhole", letter)) for letter in "EK"]
    assert [tuple(track.shape) for track in tracks] == [(1, 1, 144, 100), (1, 1, 144, 66)]
    assert all(bool((track == track.round()).all()) for track in tracks)
    (nats,) = run["main"](["--smoke", "--measured", folder, "--output", str(tmp_path)])
    assert all(n < g for n, g in zip(nats["network"], nats["Gaussian over time"], strict=True))
