"""Films of many values: all threads make them zero, and lanes add to them directly."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.gradient_cases.scenes import camera, room

VARIANT = "llvm_ad_rgb"
pytestmark = pytest.mark.usefixtures("no_leftovers")
BINS, SIZE = 700, 64


@pytest.fixture
def scene():
    sensor = camera(fov=60.0, bins=BINS, width=0.02, start=4.0, size=SIZE, filter="box")
    return mi.load_dict(room(sensor=sensor))


@pytest.mark.slow
def test_direct_sums_lose_nothing(scene, monkeypatch):
    """The transient of lanes that add each by itself is that of lanes that add together, and sums to the image."""
    film = scene.sensors()[0].film()
    assert film.reduce_mode(dr.zeros(mi.Float, SIZE * SIZE * BINS * 3), False, True) == dr.ReduceMode.Direct
    steady, direct = (np.array(t, dtype=np.float64) for t in scene.integrator().render(scene, seed=1, spp=16))
    inside = direct.sum()
    outside = (film.energy_before + film.energy_after) * film.channel_count()
    np.testing.assert_allclose(inside + outside, steady.sum(), rtol=1e-5)
    monkeypatch.setattr(type(film), "knows_crowds", False)
    together = np.array(scene.integrator().render(scene, seed=1, spp=16)[1], dtype=np.float64)
    np.testing.assert_allclose(direct, together, rtol=1e-4, atol=1e-6 * together.max())
