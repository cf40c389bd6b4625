"""What a bound on the depth leaves out, and Russian roulette, against the geometric series of a furnace."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from torchtransient import scenes
from torchtransient.accuracy import z_test

VARIANT = "llvm_ad_mono"
REFLECTANCE, RADIANCE = 0.8, 2.0


def build(node):
    if isinstance(node, np.ndarray):
        return mi.ScalarTransform4f(node)
    return {key: build(value) for key, value in node.items()} if isinstance(node, dict) else node


def furnace(max_depth, rr_depth):
    description = scenes.furnace(
        1.0, REFLECTANCE, RADIANCE, num_bins=50, start_opl=0.0, bin_width_opl=4.0, spp=512, max_depth=max_depth
    )
    description["integrator"]["rr_depth"] = rr_depth
    return mi.load_dict(build(description))


@pytest.mark.parametrize("depth", [1, 64])
def test_truncated_series(depth):
    """Guards against a depth that is off by one, and against a roulette that cuts below rr_depth: n vertices give
    Le (1 - rho^n) / (1 - rho), which lacks Le rho^n / (1 - rho), without any noise."""
    scene = furnace(depth, rr_depth=1000)
    steady, transient = (np.array(v, dtype=float) for v in scene.integrator().render(scene, spp=64))
    lacking = RADIANCE * REFLECTANCE**depth / (1 - REFLECTANCE)
    np.testing.assert_allclose(steady, RADIANCE / (1 - REFLECTANCE) - lacking, rtol=2e-5)
    film = scene.sensors()[0].film()
    total = transient.sum() + film.energy_before + film.energy_after
    assert total == pytest.approx(steady.sum(), rel=2e-5)


LONG = [pytest.param(*pair, marks=pytest.mark.slow) for pair in [(64, 1), (64, 5), (-1, 10)]]


@pytest.mark.parametrize("depth, rr_depth", [(-1, 1), *LONG])
def test_roulette_is_unbiased(depth, rr_depth):
    """Guards against survivors that are not weighted up (or are, twice): the mean is that of the series, with or
    without a bound.
    """
    scene = furnace(depth, rr_depth)
    steady = [np.array(scene.integrator().render(scene, spp=1024, seed=k)[0], dtype=float).mean() for k in range(12)]
    exact = RADIANCE * (1 - (REFLECTANCE**depth if depth > 0 else 0)) / (1 - REFLECTANCE)
    result = z_test(steady, exact)
    assert result.passed, str(result)
    assert np.std(steady) > 0
    assert np.std(steady) / np.sqrt(12) < 0.01 * exact
