"""The training example takes a detour of the light out of the phases, which no plane through the depths can."""

from __future__ import annotations

import runpy
from pathlib import Path

import pytest
import torch

SCRIPT = Path(__file__).parents[2] / "training_examples" / "fit_phasors.py"


@pytest.fixture(scope="module")
def example():
    return runpy.run_path(str(SCRIPT))


def test_a_plane_lies_in_itself(example):
    distances = example["distances_to_wall"](example["TRUTH"], 8)
    torch.testing.assert_close(example["plane_through"](distances), distances, rtol=1e-5, atol=0)


@pytest.mark.slow
def test_multipath_is_fitted_away(example, tmp_path, capsys):
    errors = example["main"](["--smoke", "--output", str(tmp_path)])
    assert capsys.readouterr().out.startswith("fit_phasors, seed 0: ")
    ((camera,), (plane,), *fits) = errors.values()
    # What is wrong with the depth is no noise (a tenth of it): late light has no mean of zero, and a plane keeps it.
    assert camera > 10
    assert plane == pytest.approx(camera, rel=0.05)
    # The model has the panel: its fit ends at the noise, and after these few steps still far below the detour.
    assert all(fit < 0.4 * camera for (fit,) in fits)
    assert (tmp_path / "fit_phasors.png").read_bytes().startswith(b"\x89PNG")
