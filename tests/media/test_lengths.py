"""Optical lengths in media: null collisions, boundaries, indices of refraction, grids that end inside their shape."""

import numpy as np
import pytest

from support.marks import long_rows
from support.media_scenes import block, camera, film, homogeneous, load, volume
from support.runs import T, runs
from torchtransient.accuracy import two_sample_z_test, z_test

VARIANT = "llvm_ad_mono"


@pytest.mark.slow
def test_grid_of_one_density_is_homogeneous():
    """In every bin, though a majorant above the density makes null collisions."""
    density = volume(np.full((3, 3, 3), 1.2)) | {"max_value": 4.0}
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
def test_unwarped_first_leg():
    """Without the first leg everything comes earlier, and no more or less of it."""
    objects = block(homogeneous(1.0, 0.8))
    full, reference = runs(load(objects, camera()), count=3)
    unwarped, transient = runs(load(objects, camera(), camera_unwarp=True), count=3)
    np.testing.assert_allclose(full, unwarped, rtol=1e-5)
    first = [np.argmax(x.sum((0, 1, 2, 4)) > 0) for x in (transient, reference)]
    assert first[0] < first[1] - 15


# --------------------------------------------------------------------------------------------------- grids from outside


SIGMA = 0.7
# The grid fills z from -1 to 1, its shape z from -3 to 3; beams start at z = 5, or at z = 2 inside of the shape.


def cloud(albedo=0.0, majorant=1.5):
    density = volume(np.full((2, 2, 2), SIGMA)) | {"max_value": majorant}
    return {"type": "heterogeneous", "sigma_t": density, "albedo": albedo}


def beam(start, bins=200, width=0.1):
    film_of_one = film(1, 1, bins=bins, bin_width=width)
    return {"type": "radiancemeter", "origin": [0.1, 0.1, start], "direction": [0, 0, -1], "film": film_of_one}


def shape(medium, half=3.0):
    return {"type": "cube", "to_world": T().scale(half), "bsdf": {"type": "null"}, "interior": medium}


def inside(start, sensor, block):
    """A beam that begins in the medium says so."""
    if start < 3.0:
        sensor["medium"] = block["interior"] = {"type": "ref", "id": "cloud"}
    return sensor, block


@pytest.mark.parametrize(("start", "light"), long_rows([(5.0, "connected"), (2.0, "found")], [(2.0, "found")]))
def test_light_through_a_grid(start, light):
    """exp(-σ l) with the length in the grid alone: by the walk of a ray to a lamp behind it, and by the shadow ray from
    a wall behind it to a lamp before it.
    """
    medium = cloud()
    objects = {"cloud": medium} if start < 3.0 else {}
    sensor, block = inside(start, beam(start), shape(medium))
    objects["block"] = block
    if light == "found":
        lamp = {"type": "rectangle", "to_world": T().translate([0, 0, -4]).scale(2)}
        objects["lamp"] = lamp | {"emitter": {"type": "area", "radiance": 2.0}}
        expected, arrival = 2.0 * np.exp(-SIGMA * 2), start + 4
    else:
        wall = {"type": "rectangle", "to_world": T().translate([0, 0, -4])}
        objects["wall"] = wall | {"bsdf": {"type": "diffuse", "reflectance": 0.6}}
        objects["lamp"] = {"type": "point", "position": [0.1, 0.1, 4], "intensity": 30.0}
        expected, arrival = 0.6 / np.pi * 30.0 / 64 * np.exp(-SIGMA * 4), start + 4 + 8
    _, transient = runs(load(objects, sensor, max_depth=2), count=8, spp=1 << 14)
    histogram = transient.reshape(8, -1)
    k = round(arrival / 0.1)
    assert histogram.sum() == pytest.approx(histogram[:, k - 1 : k + 1].sum())
    result = z_test(histogram.sum(1), expected)
    assert result.passed, str(result)
    assert histogram.sum(1).std() < 0.1 * expected


@pytest.mark.slow
def test_where_a_grid_scatters():
    """As a homogeneous block of the grid's size does, bin by bin: collisions begin at the grid and not at its shape."""
    histograms = []
    for medium in (shape(cloud(albedo=0.9)), shape(homogeneous(SIGMA, 0.9), half=1.0)):
        lamp = {"type": "point", "position": [0.3, 2.0, 0.4], "intensity": 30.0}
        scene = load({"block": medium, "lamp": lamp}, beam(5.0, bins=60, width=0.2), max_depth=3)
        histograms.append(runs(scene, count=8, spp=1 << 13)[1].reshape(8, -1))
    result = two_sample_z_test(*histograms, rounding=1e-6)
    assert result.passed and result.chi2_z < 4, str(result)
    assert np.count_nonzero(histograms[0].sum(0)) > 15
