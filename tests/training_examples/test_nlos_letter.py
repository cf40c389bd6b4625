"""The training example finds a hidden letter again, in few steps roughly and in all of them within its figures."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
import torch

from support.examples import example

VARIANT = "llvm_ad_mono"  # that of the example


@pytest.mark.slow
def test_a_few_steps_halve_the_errors_of_a_pose(tmp_path):
    found = example("nlos_letter").main(["--smoke", "--fit", "pose", "--kind", "confocal", "--output", str(tmp_path)])
    errors = found["pose, confocal"]["fits"]["pose, confocal, seed 0"]
    assert errors["position, mm"][0] == pytest.approx(100.0, rel=1e-6)
    assert errors["rotation, degrees"][0] == pytest.approx(20.0, rel=1e-6)
    assert errors["position, mm"][1] < 50
    assert errors["rotation, degrees"][1] < 10
    assert (tmp_path / "nlos_letter_pose_confocal_seed0.png").read_bytes().startswith(b"\x89PNG")
    assert json.loads((tmp_path / "nlos_letter.json").read_text()) == found
    with np.load(tmp_path / "nlos_letter_pose_confocal_seed0.npz") as kept:
        assert kept["counts"].shape == (512, 8, 8)
        # 110 counts a point are meant; six standard deviations of the sum of 64 points.
        assert abs(kept["counts"].sum() - 64 * 110) < 6 * math.sqrt(64 * 110)
        center = (kept["found"] - kept["truth"]).mean(0)
        assert 1000 * np.linalg.norm(center) == pytest.approx(errors["position, mm"][1], rel=1e-6)


@pytest.mark.parametrize("kind", ["confocal", "single"])
def test_background_and_scale_are_found_from_counts(kind):
    """With the true vertices: scale to three standard deviations of the counts, background likewise."""
    module = example("nlos_letter")
    settings = module.Settings(points=8, measured_spp=4096)
    shape = module.letter(0)
    truth = module.placed(module.arrays(shape)[0], *module.true_pose(1))
    measurement = module.measure(kind, shape, truth, 1, settings)
    model, misfit = module.Model(shape, measurement, 4096), module.Misfit(measurement.counts)
    with torch.no_grad():
        light = model(truth, 3)
        for _ in range(20):
            misfit.likelihood(light)
    signal = misfit.scale * float(light.sum())
    # Counts of signal and of background share their noise where they overlap, which is a few of them.
    assert abs(signal - 6400) < 3 * math.sqrt(6400 + 640)
    assert abs(misfit.background * measurement.counts.numel() - 640) < 3 * math.sqrt(2 * 640)


@pytest.mark.soak
@pytest.mark.parametrize("kind", ["confocal", "single"])
def test_pose_within_three_millimetres_and_a_degree(tmp_path, kind):
    argv = ["--fit", "pose", "--kind", kind, "--seeds", *"01234", "--output", str(tmp_path)]
    median = example("nlos_letter").main(argv)[f"pose, {kind}"]["median"]
    assert median["position, mm"] < 3
    assert median["rotation, degrees"] < 1


@pytest.mark.soak
def test_shape_is_better_than_its_start(tmp_path):
    found = example("nlos_letter").main(["--fit", "shape", "--kind", "confocal", "--output", str(tmp_path)])
    first, last = found["shape, confocal"]["fits"]["shape, confocal, seed 0"]["surface, mm"]
    assert last < first / 5
