"""Scrambled points: a net for powers of two, unbiased for all numbers."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from torchtransient.plugins.sampling.point_sets import plane_points

VARIANT = "llvm_ad_mono"


def points(count, seed):
    x, y = plane_points(count, dr.opaque(mi.UInt32, seed))
    return np.array(x), np.array(y, dtype=float)


@pytest.mark.parametrize("seed", [0, 1, 12345])
def test_a_power_of_two_is_a_net(seed):
    """Every box of area 1 / 256 with edges of powers of two holds one of 256 points."""
    x, y = points(256, seed)
    for bits in range(9):
        box = np.floor(x * 2**bits) * 2 ** (8 - bits) + np.floor(y * 2 ** (8 - bits))
        assert sorted(box) == list(range(256))
    assert np.all(np.diff(x) > 0) and x.min() > 0 and x.max() < 1 and y.min() > 0 and y.max() < 1


@pytest.mark.parametrize("count", [1, 7, 64])
def test_every_point_is_uniform_and_means_are_unbiased(count):
    """Over seeds: the mean of a function that no grid gets right."""
    values = []
    for seed in range(400):
        x, y = points(count, seed)
        values.append(np.mean(np.sqrt(x) * y**3 + (x > 0.3) * (y < 0.7)))
    error = np.std(values, ddof=1) / 20
    assert abs(np.mean(values) - (2 / 3 / 4 + 0.7 * 0.7)) < 4 * error


@pytest.mark.slow
def test_seeds_that_follow_each_other_are_independent():
    """Kolmogorov's test of both coordinates of one point, over consecutive seeds: 1 % of all exceed 1.63."""
    count = 2048
    drawn = np.array([points(1, seed) for seed in range(count)])[..., 0]
    for x in (*drawn.T, (drawn[:, 0] + drawn[:, 1]) % 1, (drawn[1:, 0] - drawn[:-1, 0]) % 1):
        assert np.abs(np.sort(x) - np.arange(len(x)) / len(x)).max() * len(x) ** 0.5 < 1.63
