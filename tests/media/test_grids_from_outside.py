"""Grids whose shape reaches farther than they do: lines enter the density from the shape's empty part."""

from __future__ import annotations

import numpy as np
import pytest

from support.marks import long_rows
from support.media_scenes import film, homogeneous, load, volume
from support.runs import T, runs
from torchtransient.accuracy import two_sample_z_test, z_test

VARIANT = "llvm_ad_mono"
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
    for block in (shape(cloud(albedo=0.9)), shape(homogeneous(SIGMA, 0.9), half=1.0)):
        lamp = {"type": "point", "position": [0.3, 2.0, 0.4], "intensity": 30.0}
        scene = load({"block": block, "lamp": lamp}, beam(5.0, bins=60, width=0.2), max_depth=3)
        histograms.append(runs(scene, count=8, spp=1 << 13)[1].reshape(8, -1))
    result = two_sample_z_test(*histograms, rounding=1e-6)
    assert result.passed and result.chi2_z < 4, str(result)
    assert np.count_nonzero(histograms[0].sum(0)) > 15
