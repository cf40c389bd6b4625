"""Axis, speed and pose of a turning fan from the beats of a coherent lidar."""

from __future__ import annotations

import math
import runpy
from pathlib import Path

import pytest
import torch
from torch.nn import functional

import torchtransient as tt

FOLDER = Path(__file__).parents[2] / "training_examples"


@pytest.fixture(scope="module")
def spin():
    return runpy.run_path(str(FOLDER / "fit_spin.py"))


@pytest.fixture(autouse=True)
def one_thread():
    with tt.threads(1):
        yield


def test_the_middle_is_as_far_off_as_said(spin):
    axis, speed, millimetres, degrees = spin["errors"](
        spin["values_of"](torch.zeros(9)), spin["values_of"](spin["true_numbers"](3, 0.2))
    )
    assert axis == pytest.approx(math.degrees(math.asin(0.2)), rel=1e-4)
    # 20 % of the middle's speed is 25 % of 0.8 and 17 % of 1.2 of it.
    assert min(abs(speed - 25), abs(speed - 100 / 6)) < 1e-3
    assert (millimetres, degrees) == pytest.approx((50.0, 10.0), rel=1e-4)


@pytest.mark.slow
def test_one_light_is_blind_for_turns_about_the_bisector(spin):
    """As far as the fan is small: a tenth of what other turns do to the spectra. Two lights see each turn."""
    hub, sensor, light = torch.tensor([[0.0, 0.0, 0.2], [-1.2, 0.0, 2.4], [1.6, 0.6, 2.2]])
    to_sensor, to_light = (functional.normalize(place - hub, dim=0) for place in (sensor, light))
    bisector = functional.normalize(to_sensor + to_light, dim=0)
    across = functional.normalize(torch.linalg.cross(to_sensor, to_light), dim=0)
    seen = {}
    for one_light in (True, False):
        renderer = spin["renderer_of"](spin["scene_of"](one_light), 64)

        def frame(turn, renderer=renderer):
            with torch.no_grad():
                return renderer(spin["values_of"](torch.cat([torch.zeros(6), turn])), seed=1).beats

        still = frame(torch.zeros(3))
        width = spin["AXIS"].bin_width_opl
        changes = [
            float(tt.losses.wasserstein_loss(frame(0.1 * way), still, width, creation_cost_opl=2.0))
            for way in (bisector, across)
        ]
        seen[one_light] = changes[0] / changes[1]
    assert seen[True] < 0.1  # 0.03
    assert seen[False] > 0.2  # 0.4


@pytest.mark.slow
def test_axis_and_speed_from_one_frame(spin, tmp_path, capsys):
    (fit,) = spin["main"](["--smoke", "--output", str(tmp_path)])
    assert capsys.readouterr().out.endswith("fit_spin: 1 of 1 within 1 degree and 1 %\n")
    # Guesses of 2.5 to 4 degrees and 3 to 8 %; four seeds end within 0.06 degrees and 0.26 %.
    assert fit.errors[-1][0] < 0.3
    assert fit.errors[-1][1] < 0.8
    for name in ("fit_spin", "fit_spin_range_doppler_guess", "fit_spin_range_doppler_found"):
        assert (tmp_path / f"{name}.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_speckle_costs_little(spin, tmp_path):
    """A single look: contrast one in every bin."""
    options = ["--smoke", "--no-network", "--steps", "100", "--looks", "1", "--output", str(tmp_path)]
    (fit,) = spin["main"](options)
    # Of one look, ten seeds end within 0.8 degrees and 0.9 %.
    assert fit.errors[0][0] > 11
    assert fit.good
