"""`transient_path` against exact transients, bin by bin."""

import mitsuba as mi
import numpy as np
import pytest

from torchtransient import scenes
from torchtransient.accuracy.statistics import pool_small_bins, z_test
from torchtransient.testing import closed_forms as cf

VARIANT = "llvm_ad_mono"
RUNS = 12


def build(node):
    """The description with its arrays turned into Mitsuba transforms."""
    if isinstance(node, np.ndarray):
        return mi.ScalarTransform4f(node)
    return {key: build(value) for key, value in node.items()} if isinstance(node, dict) else node


def edges_of(description, film=None):
    film = film or description["sensor"]["film"]
    return film["start_opl"] + film["bin_width_opl"] * np.arange(film["temporal_bins"] + 1)


def runs(description, runs=RUNS, seed=0):
    """Independent renders: mean over pixels of steady (K,) and transient (K, T)."""
    scene = mi.load_dict(build(description))
    steady, transient = [], []
    for k in range(runs):
        s, t = scene.integrator().render(scene, seed=seed + k)
        steady.append(np.array(s, dtype=np.float64).mean())
        transient.append(np.array(t, dtype=np.float64).mean(axis=(0, 1, 3)))
    return np.array(steady), np.array(transient), scene.sensors()[0].film()


def check_bins(transient, expected, minimum, one_group_until=0):
    starts = pool_small_bins(expected, minimum)
    starts = np.concatenate([[0], starts[starts >= max(one_group_until, 1)]])
    # float32 sums of up to 2^14 terms: 1e-5 of a bin
    result = z_test(
        np.add.reduceat(transient, starts, axis=-1),
        exact := np.add.reduceat(expected, starts),
        rounding=1e-5 * exact.max(),
    )
    assert result.passed, str(result)
    assert abs(result.chi2_z) < 4.5, str(result)
    return result


def test_furnace_bins():
    description = scenes.furnace(
        1.0, 0.8, 2.0, num_bins=400, start_opl=0.025, bin_width_opl=0.05, spp=2048, max_depth=48
    )
    steady, transient, film = runs(description)
    edges = edges_of(description)
    expected = cf.furnace(edges, 1.0, 0.8, 2.0, max_bounces=47)
    first = int((1.0 - 0.025) / 0.05)
    assert np.all(transient[:, :first] == 0)
    assert np.all(transient[:, first] > 2.0 * (1 - 1e-6))  # the emission itself, and the shortest of the chords
    # Mitsuba lifts the origin of a ray off the wall, 1.8e-4 of the radius here; a grazing chord is then never shorter
    # than 0.019 radii, which empties the part of the first bin that is not the delta.
    check_bins(transient, expected, minimum=0.02, one_group_until=first + 5)
    # the comparison would notice a half percent more of reflectance
    brighter = cf.furnace(edges, 1.0, 0.804, 2.0, max_bounces=47)
    with pytest.raises(AssertionError, match="chi2"):
        check_bins(transient, brighter, minimum=0.02, one_group_until=first + 5)
    # whatever arrives is in the window or counted outside of it
    assert film.energy_before == 0.0
    in_window = transient.sum(axis=1)
    np.testing.assert_allclose(steady, 2.0 * (1 - 0.8**48) / 0.2, rtol=1e-5)
    outside = film.energy_after / 4  # pixels of the last run
    np.testing.assert_allclose(in_window[-1] + outside, steady[-1], rtol=1e-5)


def test_integrating_sphere_bins():
    description = scenes.integrating_sphere(
        1.0, 0.8, 3.0, num_bins=300, start_opl=0.025, bin_width_opl=0.05, spp=2048, max_depth=48
    )
    _, transient, _ = runs(description)
    check_bins(
        transient, cf.integrating_sphere_radiance(edges_of(description), 1.0, 0.8, 3.0, max_bounces=47), 0.01, 45
    )  # see furnace


@pytest.mark.slow
def test_parallel_plates_bins():
    description = scenes.parallel_plates(
        1.0, 0.7, 1.0, num_bins=200, start_opl=0.025, bin_width_opl=0.05, spp=4096, max_depth=32
    )
    _, transient, _ = runs(description)
    expected = cf.parallel_plates(edges_of(description), 1.0, 0.7, 1.0, max_bounces=31)
    check_bins(transient, expected, minimum=0.01)


def test_light_over_plane_bins():
    description = scenes.light_over_plane(1.0, 0.6, 2.0, num_bins=100, start_opl=0.0125, bin_width_opl=0.05, spp=32768)
    _, transient, _ = runs(description)
    expected = cf.light_over_plane(edges_of(None, description["meter"]["sensor"]["film"]), 1.0, 0.6, 2.0)
    # the light hangs 1e-4 below the meter: 3e-4 of the energy
    scale = transient.sum() / RUNS / expected.sum()
    assert abs(scale - 1) < 3e-3
    check_bins(transient, expected, minimum=3e-3)


