"""`renderer.variation`: the same values in other settings."""

from __future__ import annotations

import mitsuba as mi
import pytest
import torch

import torchtransient as tt
from torchtransient.errors import ArgumentError, SceneError

VARIANT, KEY = "llvm_ad_mono", "red.reflectance.value"
AXIS = tt.TimeAxis(4.0, 0.5, 10)


@pytest.fixture(scope="module", autouse=True)
def variant():
    mi.set_variant(VARIANT)


def scene():
    return tt.load(tt.scenes.cornell_box(4, num_bins=20, bin_width_opl=0.2), VARIANT)


@pytest.fixture(scope="module")
def renderer():
    made = tt.TransientRenderer(scene(), [KEY], spp=8, physics="ignore")
    with torch.no_grad():
        made.values[KEY].fill_(0.9)
    return made


def test_is_that_of_a_renderer_made_so(renderer):
    settings = {"max_depth": 2, "time_axis": AXIS}
    before = renderer(seed=1).transient.detach().clone()
    twin = renderer.variation(**settings)
    value = torch.full_like(renderer.values[KEY], 0.9)
    made = tt.TransientRenderer(scene(), {KEY: value}, spp=8, physics="ignore", **settings)
    found, expected = twin(seed=1), made(seed=1)
    assert found.axis == expected.axis and found.stats.max_depth == expected.stats.max_depth
    torch.testing.assert_close(found.transient, expected.transient)
    gradient, wanted = (
        torch.autograd.grad(out.transient.sum(), of.values[KEY])[0] for out, of in ((found, twin), (expected, made))
    )
    torch.testing.assert_close(gradient, wanted)
    torch.testing.assert_close(renderer(seed=1).transient, before)


def test_another_integrator(renderer):
    twin = renderer.variation(integrator="transient_path_reuse")
    assert twin(seed=1).stats.integrator == "transient_path_reuse"
    assert renderer(seed=1).stats.integrator == "transient_path"
    with pytest.raises(SceneError):
        renderer.variation(integrator="no_such_integrator")


def test_lists_of_sensors_stay_lists():
    twin = tt.TransientRenderer(scene(), spp=4, sensors=[0]).variation(max_depth=2)
    assert twin(seed=1).transient.shape == (1, 1, 20, 4, 4)


def test_films_without_bins_have_no_axis(renderer):
    phasors = tt.TransientRenderer(scene(), frequencies=[0.5])
    with pytest.raises(ArgumentError, match="time_axis: a phasor film has no bins"):
        phasors.variation(time_axis=AXIS)
    with pytest.raises(ArgumentError, match="max_depth"):
        renderer.variation(max_depth=-2)
