"""Scrambled Sobol's points: every dimension is stratified, every point uniform."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from torchtransient.plugins.sampling.point_sets import DIMENSIONS, _directions, sobol, unit_double, unit_float

VARIANT = "llvm_ad_mono"


def coordinates(first, count, dimension, seed=3):
    index = dr.arange(mi.UInt32, count) + dr.opaque(mi.UInt32, first)
    return np.array(unit_double(sobol(index, dimension, dr.opaque(mi.UInt32, seed))))


@pytest.mark.slow
@pytest.mark.parametrize("dimension", range(DIMENSIONS))
def test_blocks_have_a_point_in_every_interval(dimension):
    """Of 2^m indices from a multiple of 2^m on, and of the blocks next to each other, each interval has one."""
    for first, count in ((0, 256), (768, 256), (4096, 4096)):
        x = coordinates(first, count, dimension)
        assert sorted(np.floor(x * count).astype(int)) == list(range(count))
    x = np.concatenate([coordinates(256 * k, 256, dimension) for k in range(4)])
    assert sorted(np.floor(x * 1024).astype(int)) == list(range(1024))


def test_the_first_dimension_reverses_bits():
    assert _directions(0) == [2**31 >> i for i in range(32)]
    assert _directions(1)[:3] == [1 << 31, 3 << 30, 5 << 29]


def test_the_first_two_dimensions_are_a_net():
    x, y = (coordinates(0, 256, d) for d in (0, 1))
    for a in range(9):
        cells = np.floor(x * 2**a) * 2 ** (8 - a) + np.floor(y * 2 ** (8 - a))
        assert len(np.unique(cells)) == 256


def test_dimensions_integrate_products():
    """(x_0 - 1/2)(x_j - 1/2) and its like have mean zero: below a tenth of what independent numbers leave."""
    x = np.array([coordinates(0, 1 << 14, d) for d in range(DIMENSIONS)]) - 0.5
    correlation = x @ x.T / (1 << 14) * 12
    assert np.abs(correlation - np.eye(DIMENSIONS)).max() < 0.1 * 3 / 2**7


def test_each_point_is_uniform_over_seeds():
    seeds = np.arange(4096, dtype=np.uint32)
    for dimension in (0, 3, DIMENSIONS - 1):
        x = np.array(unit_float(sobol(mi.UInt32(5), dimension, mi.UInt32(seeds))))
        counts = np.bincount(np.floor(x * 16).astype(int), minlength=16)
        # Chi squared of 15 degrees of freedom: mean 15, standard deviation 5.5.
        assert ((counts - 256) ** 2 / 256).sum() < 15 + 4 * 5.5
