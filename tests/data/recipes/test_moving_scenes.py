"""Recipes of scenes that move: velocities vary as other keys do, films of rates are stored, motions are written."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch

import torchtransient as tt
from support.moving_scenes import moving_scene, wall

D = tt.data
VARIANT = "llvm_ad_mono"
RATES, AXIS = tt.RateAxis(-8.0, 0.5, 32), tt.TimeAxis(2.0, 0.5, 8)
KEY = "wall.velocity.linear"
SETTINGS = {
    "variant": VARIANT, "rates": RATES, "time_axis": AXIS, "spp": 8, "labels": ["velocity", "radial_velocity"],
    "temporal_filter": "tent",
}  # fmt: skip


def moving():
    scene = tt.load(moving_scene(wall=wall((0, 0, 2), (0, 0, 0)), size=3, fov=10.0), variant=VARIANT)
    return scene.moving({"wall": tt.Motion(linear=(0.0, 0.0, -1.0))})


def recipe(scene=None, vary=None, **changes):
    along = D.Uniform(low=[0.0, 0.0, -3.0], high=[0.0, 0.0, 3.0])
    return D.Recipe(scene or moving(), {KEY: along} if vary is None else vary, **{**SETTINGS, **changes})


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    place = tmp_path_factory.mktemp("fans")
    D.generate(recipe(), place, 3, workers=0, progress=False)
    return place


def test_velocities_vary_as_any_key(folder):
    speeds = set()
    for sample in D.TransientDataset(folder):
        linear = torch.as_tensor(sample["values"][KEY]).double()
        speeds.add(float(linear[2]))
        assert sample["rates"].shape == (1, 32, 8, 3, 3)
        # The middle pixel looks along z; lamp and camera stand at one place, so that the rate is twice the speed.
        light = sample["rates"][0, :, :, 1, 1].sum(-1).double()
        rate = float((light * RATES.centers).sum() / light.sum())
        assert rate == pytest.approx(2 * float(linear[2]), rel=0.01, abs=0.01)
        np.testing.assert_allclose(sample["velocity"][:, 1, 1], linear, rtol=1e-5)
        assert float(sample["radial_velocity"][1, 1]) == pytest.approx(float(linear[2]), rel=1e-4)
    assert len(speeds) == 3


def test_windows_of_time_are_cut_behind_the_rates(folder):
    whole, part = D.TransientDataset(folder), D.TransientDataset(folder, window=slice(2, 6))
    assert torch.equal(part[0]["rates"], whole[0]["rates"][:, :, 2:6]) and part.axis.num_bins == 4


def test_motions_and_films_are_written():
    given = recipe()
    plain = json.loads(json.dumps(given.to_dict()))
    back = D.Recipe.from_dict(plain)
    assert back.key() == given.key() and back.settings.rates == RATES
    for name, array in given.maker().sample(0).arrays.items():
        np.testing.assert_array_equal(back.maker().sample(0).arrays[name], array)
    beats = recipe(rates=None, chirps=tt.Chirps(1e9, 1e-6, 1550e-9), vary={})
    again = D.Recipe.from_dict(json.loads(json.dumps(beats.to_dict())))
    assert again.settings.chirps == beats.settings.chirps
    assert again.maker().sample(1).arrays["beats"].shape == (1, 2, 8, 3, 3)


def test_other_motions_are_another_recipe():
    still, other = moving(), moving().moving({"wall": tt.Motion(linear=(0.0, 0.0, 2.0))})
    others = [recipe(still, {}), recipe(other, {}), recipe(still, {}, rates=tt.RateAxis(-4.0, 0.25, 32))]
    assert len({one.key() for one in others}) == 3


def test_flips_mirror_velocities():
    light, velocity = torch.rand(1, 4, 5, 3, 3), torch.tensor([1.0, 2.0, 3.0])[:, None, None].expand(3, 3, 3)
    pose = torch.from_numpy(np.asarray(moving_scene()["sensor"]["to_world"], dtype=np.float32))
    sample = {"rates": light, "radial_velocity": light[0, 0, 0], "velocity": velocity, "to_world": pose}
    found = D.Augment(D.Flip(p=1.0))(sample)
    for name in ("rates", "radial_velocity"):
        assert torch.equal(found[name], sample[name].flip(-1))
    torch.testing.assert_close(found["velocity"], velocity * torch.tensor([-1.0, 1.0, 1.0])[:, None, None])


def test_flips_of_polarized_rates_change_signs():
    stokes = torch.rand(4, 1, 5, 6, 3, 3)
    sample = {"rates": stokes, "steady": stokes.sum((2, 3)), "intrinsics": torch.eye(3)}
    found = D.Augment(D.Flip(p=1.0), polarized=True)(sample)
    signs = torch.tensor([1.0, 1.0, -1.0, -1.0])
    torch.testing.assert_close(found["rates"], stokes.flip(-1) * signs.reshape(4, 1, 1, 1, 1, 1))
    torch.testing.assert_close(found["rates"].sum((2, 3)), found["steady"])
