"""Optical lengths in media: null collisions, boundaries and indices of refraction."""

import numpy as np
import pytest

from support.media_scenes import block, camera, film, homogeneous, load, volume
from support.runs import T, runs
from torchtransient.accuracy import two_sample_z_test, z_test

VARIANT = "llvm_ad_mono"


@pytest.mark.slow
@pytest.mark.parametrize("majorant", [1.2, 4.0])
def test_grid_of_one_density_is_homogeneous(majorant):
    """In every bin, however many null collisions a majorant above the density makes."""
    density = volume(np.full((3, 3, 3), 1.2)) | {"max_value": majorant}
    grid = {"type": "heterogeneous", "sigma_t": density, "albedo": 0.8}
    axis = {"bins": 40, "bin_width": 0.4}
    _, a = runs(load(block(grid), camera(**axis)), spp=512)
    _, b = runs(load(block(homogeneous(1.2, 0.8)), camera(**axis)), spp=512)
    # Histograms of the whole picture have many events in each bin.
    a, b = a.sum((1, 2)), b.sum((1, 2))
    result = two_sample_z_test(a, b, rounding=1e-6)
    assert result.passed and result.chi2_z < 4, str(result)
    centers = (np.arange(40) + 0.5) * 0.4
    mean = [(x[..., 0] * centers).sum(1) / x.sum((1, 2)) for x in (a, b)]
    assert two_sample_z_test(*mean).passed
    # Lengths of null collisions left out would shorten the mean by metres.
    assert mean[0].mean() == pytest.approx(mean[1].mean(), abs=0.1)


def test_null_collisions_do_not_change_arrivals():
    """Through a thin cloud that only absorbs, light arrives when it does without: all of it at one length."""
    density = volume(np.full((2, 2, 2), 0.1)) | {"max_value": 5.0}
    objects = block({"type": "heterogeneous", "sigma_t": density, "albedo": 0.0})
    objects["lamp"] = {"type": "point", "position": [0, 0, 4], "intensity": 10.0}
    sensor = {"type": "radiancemeter", "origin": [0, 0, 4], "direction": [0, 0, -1], "film": film(1, 1, bins=150)}
    _, transient = runs(load(objects, sensor, max_depth=2), count=8, spp=4096)
    histogram = transient.reshape(8, -1)
    arrival = int(2 * 6.0 / 0.1)
    assert histogram.sum() == pytest.approx(histogram[:, arrival - 1 : arrival + 1].sum())
    expected = 0.6 / np.pi * 10 / 36 * np.exp(-2 * 0.1 * 2.0)
    result = z_test(histogram.sum(1), expected)
    assert result.passed, str(result)


def test_medium_in_a_glass_slab():
    """Light that runs m times to and fro in a slab arrives n 2 d m later, and weaker by Fresnel and Beer."""
    n, d, σ = 1.5, 2.0, 0.3
    objects = {
        "slab": {
            "type": "cube",
            "to_world": T().scale([20, 20, d / 2]),
            "bsdf": {"type": "dielectric", "int_ior": n, "ext_ior": 1.0},
            "interior": homogeneous(σ, 0.0),
        },
        "lamp": {
            "type": "rectangle",
            "to_world": T().translate([0, 0, -3]).scale(20),
            "emitter": {"type": "area", "radiance": 1.0},
            "bsdf": {"type": "diffuse", "reflectance": 0.0},
        },
    }
    sensor = {"type": "radiancemeter", "origin": [0, 0, 4], "direction": [0, 0, -1], "film": film(1, 1, bins=300)}
    _, transient = runs(load(objects, sensor, max_depth=20), count=10, spp=8192)
    histogram = transient.reshape(10, 100, 3).sum(2)  # bins of 0.3
    R = ((n - 1) / (n + 1)) ** 2
    for m in (0, 1):
        length = 3.0 + 2.0 + n * d * (2 * m + 1)
        expected = (1 - R) ** 2 * np.exp(-σ * d * (2 * m + 1)) * R ** (2 * m)
        result = z_test(histogram[:, int(length / 0.3)], expected)
        assert result.passed, (m, str(result))


@pytest.mark.slow
def test_scattering_medium_of_another_index():
    """The same medium in a block with and without an index: scattered light is later by the index, not weaker. A rough
    boundary of nearly the same index on both sides is the open one.
    """
    axis = {"bins": 30, "bin_width": 0.6}
    medium = homogeneous(1.0, 0.9)
    rough = {"type": "roughdielectric", "int_ior": 1.0005, "ext_ior": 1.0, "alpha": 0.01}
    # A boundary that refracts counts as a scattering event: let neither reach its limit.
    _, a = runs(load(block(medium, rough), camera(**axis), max_depth=60), spp=1024)
    _, b = runs(load(block(medium), camera(**axis), max_depth=60), spp=1024)
    result = two_sample_z_test(a.sum((1, 2)), b.sum((1, 2)), rounding=1e-6)
    assert result.passed, str(result)


@pytest.mark.slow
def test_unwarped_first_leg():
    """Without the first leg everything comes earlier, and no more or less of it."""
    objects = block(homogeneous(1.0, 0.8))
    full, reference = runs(load(objects, camera()), count=3)
    unwarped, transient = runs(load(objects, camera(), camera_unwarp=True), count=3)
    np.testing.assert_allclose(full, unwarped, rtol=1e-5)
    first = [np.argmax(x.sum((0, 1, 2, 4)) > 0) for x in (transient, reference)]
    assert first[0] < first[1] - 15
