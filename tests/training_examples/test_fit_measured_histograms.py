"""The training example runs on a simulated chip always, and on measured counts where their folder is named."""

from __future__ import annotations

import importlib
import os
from pathlib import Path

import numpy as np
import pytest
import torch

import torchtransient as tt

FOLDER = Path(__file__).parents[2] / "training_examples"
MEASURED = "TORCHTRANSIENT_MEASURED_DATA"
FIT, BASELINE = "fit, with what is left over", "neighbours, shifted"


@pytest.fixture
def example(monkeypatch):
    """The script and the chip that it imports, as where it is run."""
    monkeypatch.syspath_prepend(FOLDER)
    with tt.threads(1):
        yield importlib.import_module("fit_measured_histograms")


def pulses(positions):
    """Histograms (N, T) of one normal pulse, as wide as the core of a measured one, at positions in bins."""
    bins = torch.arange(49.0)
    return 1e5 * torch.exp(-0.5 * ((bins - torch.as_tensor(positions)[:, None]) / 1.2) ** 2) + 10.0


def test_a_plane_says_where_the_pulse_left_out_is(example):
    chip = importlib.import_module("nine_zones")
    # Directions (x, y, 1) meet the plane z = 17 + 2 x - 3 y at z = 17 / (1 - 2 x + 3 y); lengths in bins.
    x, y = chip.CENTRES.T
    distance = 17.0 * (1 + x**2 + y**2).sqrt() / (1 - (2 * x - 3 * y) / 17.0)
    positions = distance + chip.ZERO - chip.FIRST
    counts = pulses(positions)
    for left in (0, 4, 7):
        predict = example.shifted(counts, left, [n for n in range(9) if n != left])
        # A mean over five bins leaves out more of the pulse on one side: 0.1 bins where its middle is between two.
        assert example.peak(predict(0.0)) == pytest.approx(float(positions[left]), abs=0.15)
        assert example.peak(predict(2.0)) - example.peak(predict(0.0)) == pytest.approx(2.0, abs=0.15)


def test_the_judge_finds_delay_gain_and_background(example):
    counts = pulses([20.0])[0]
    figures, best = example.judge(lambda delay: 3.0 * pulses([19.0 + delay])[0] + 500.0, counts)
    in_place, wrong, late_ps, own, own_wrong = figures
    assert late_ps == pytest.approx(88.0, rel=0.01)  # one bin
    assert in_place > 100 > 1e-3 > own
    assert wrong > 10 > 0.2 > own_wrong
    assert float(best.sum()) == pytest.approx(float(counts.sum()), rel=1e-3)


@pytest.mark.slow
def test_a_simulated_chip_is_predicted(example, tmp_path, capsys, monkeypatch):
    monkeypatch.delenv(MEASURED, raising=False)
    (rows,) = example.main(["--smoke", "--output", str(tmp_path)])
    printed = capsys.readouterr().out
    assert "a simulated chip stands in" in printed
    assert all(f"\n{name} " in printed for name in rows)
    own = {name: np.mean([row[3] for row in figures]) for name, figures in rows.items()}
    # The counts are of the same model: within 1 of the deviations it must be, where neighbours have another width.
    assert own["fit"] < 0.5 * min(own[BASELINE], own["all eight, shifted"])
    assert own[FIT] < 0.5 * own[BASELINE]
    assert (tmp_path / "fit_measured_histograms.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.measured
def test_measured_zones_are_predicted(example, tmp_path):
    folder = os.environ.get(MEASURED)
    if not folder:
        pytest.fail(f"set {MEASURED} to the folder that holds consumer_lidar/ams_U_iter_0.npy", pytrace=False)
    counts = example.measured(folder)
    assert counts.shape == (9, 49)
    # Means of twenty exposures, where single precision tells whole numbers of twentieths.
    few = 20 * counts[counts < 1e5]
    assert float((few - few.round()).abs().max()) <= 20 * 1e5 * 2**-24
    (rows,) = example.main(["--smoke", "--measured", folder, "--output", str(tmp_path)])
    assert all(row[3] < 2 for row in rows[FIT])
