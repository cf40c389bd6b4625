"""Arrivals at the edges of bins and of the window, and sums of very many small contributions in one bin."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.film_storage import storage
from support.media_scenes import camera, load

VARIANT = "llvm_ad_mono"
BINS = 16


def put(opl, width, filter="box"):
    """Histograms (n, T) of single arrivals at ``opl`` metres after the start, and the fractions before and after the
    window.
    """
    film = mi.load_dict(
        {"type": "transient_hdr_film", "temporal_bins": BINS, "bin_width_opl": width, "temporal_filter": filter}
    )
    n = len(opl)
    # guards on both sides: an index that wrapped would land there
    cube = storage(film, (n + 2) * BINS)
    base = (dr.arange(mi.UInt32, n) + 1) * BINS
    before, after = film.put(0, base, mi.Float64(opl), [mi.Float(1)], mi.Bool(True))
    cube = np.array(cube).reshape(n + 2, BINS)
    assert not cube[0].any() and not cube[-1].any()
    return cube[1:-1], np.array(before), np.array(after)


@pytest.mark.parametrize(("width", "eps"), [(0.25, 1e-6), (0.003, 1e-9), (0.1, 1e-12)])
def test_half_open_bins(width, eps):
    """Guards against bins in single precision, where an arrival flips to the neighbour within 1e-7 of an edge."""
    k = np.arange(1, BINS)
    above, _, _ = put(k * width * (1 + eps), width)
    below, _, _ = put(k * width * (1 - eps), width)
    np.testing.assert_array_equal(above.argmax(1), k)
    np.testing.assert_array_equal(below.argmax(1), k - 1)
    assert np.all(above.sum(1) == 1) and np.all(below.sum(1) == 1)


def test_an_edge_belongs_to_the_bin_that_it_opens():
    cube, before, after = put(np.arange(BINS + 1) * 0.25, 0.25)  # exact in binary
    np.testing.assert_array_equal(cube[:-1], np.eye(BINS))
    assert not cube[-1].any() and after[-1] == 1 and before.sum() == 0


@pytest.mark.parametrize("filter", ["box", "tent", "gaussian"])
def test_outside_is_dropped_not_clamped(filter):
    """Guards against negative bins that wrap to large unsigned ones, and against clamping into the first or the last
    bin.
    """
    near, wrapped = [-1e-3 - 8, BINS + 8.0], [-(2.0**32) - 5, -(2.0**32) * 3 + 1.5, 2.0**32 + 3, 2.0**33 + 1]
    far = np.array([*near, *wrapped, -(2.0**31), 2.0**31, -1e18, 1e18])
    cube, before, after = put(far, 1.0, filter)
    assert not cube.any()
    np.testing.assert_allclose(before, far < 0, atol=1e-6)
    np.testing.assert_allclose(after, far > 0, atol=1e-6)
    just = np.array([-1e-12, BINS - 1e-12])
    cube, before, after = put(just, 1.0, "box")
    assert before[0] == 1 and not cube[0].any() and cube[1, -1] == 1 and after[1] == 0


@pytest.mark.parametrize("filter", ["box", "tent", "gaussian"])
def test_not_a_number_is_dropped(filter):
    cube, _, _ = put(np.array([np.nan, np.inf, -np.inf]), 1.0, filter)
    assert not cube.any()


def test_rendered_light_before_and_after_the_window():
    """Guards against a window that opens late and shows the early light in its first bin."""
    objects = {"wall": {"type": "rectangle"}, "light": {"type": "point", "position": [0.0, 0.0, 4.0]}}
    for start, side in ((8.5, "before"), (4.0, "after")):
        scene = load(objects, camera(fov=5, start=start, bins=8, bin_width=0.25), "transient_path")
        steady, transient = (np.array(v, dtype=float) for v in scene.integrator().render(scene, spp=64))
        film = scene.sensors()[0].film()
        energy = {"before": film.energy_before, "after": film.energy_after}
        assert not transient.any() and steady.min() > 0
        assert energy.pop(side) == pytest.approx(steady.sum(), rel=1e-5)
        assert list(energy.values()) == [0.0]


# ----------------------------------------------------------------------------------------------------------- large jobs


LANES = "torchtransient.plugins.integrators.job.MAX_LANES"


def mass(samples, count, packets=True):
    """Sum of ``count`` equal terms that are one together, in the storage for ``samples`` samples per pixel."""
    film = mi.load_dict(
        {"type": "transient_hdr_film", "width": 1, "height": 1, "temporal_bins": 4, "bin_width_opl": 1.0}
    )
    film.start_render(samples)
    # 1.3: not a power of two, so that every addition rounds
    value = dr.opaque(mi.Float, np.float32(1 / (1.3 * count)))
    index = dr.arange(mi.UInt32, count)
    x = mi.Float64(index & 3) + 0.5 if not packets else dr.full(mi.Float64, 0.5, count)
    film.put(0, mi.UInt32(0), x, [value], mi.Bool(True))
    film.finish_render()
    total = np.array(film.bands[0][2], dtype=float).sum()
    return total / (float(np.array(value)[0]) * count) - 1


@pytest.mark.parametrize("packets", [True, False])
def test_sixteen_million_terms_keep_their_mass(packets):
    """Guards against single precision sums that stall: once the sum is 2^24 times a term, terms are no longer counted
    at all, and long before they are rounded to few digits (0.3 % lost or won at 2^24 terms, even though processors add
    up packets first).
    """
    count = 1 << 24
    # the result itself is single precision
    assert abs(mass(count, count, packets)) < 1e-7


@pytest.mark.parametrize("packets", [True, False])
def test_bound_of_single_precision(packets):
    """Up to the number of samples that is summed in single precision, rounding stays below 2e-4, under the noise."""
    count = 1 << 16
    assert abs(mass(count, count, packets)) < 2e-4


def glow(size, start=0.0):
    """A wall of radiance 1 / 1.3, which fills the view."""
    wall = {"type": "rectangle", "emitter": {"type": "area", "radiance": 1 / 1.3}}
    sensor = camera((0, 0, 1), fov=1, width=size, height=size, start=start, bins=2, bin_width=10.0)
    return load({"wall": wall}, sensor, "transient_path", max_depth=1)


def test_render_of_many_samples(monkeypatch):
    """The same through a render of several passes: the storage is chosen by the total."""
    spp = 1 << 20
    monkeypatch.setattr(LANES, spp // 8)
    scene = glow(1)
    for tensor in scene.integrator().render(scene, spp=spp):
        assert dr.type_v(tensor) == dr.type_v(mi.Float)
        assert np.array(tensor, dtype=float).sum() == pytest.approx(1 / 1.3, rel=2e-7)


def test_energy_outside_of_many_pixels():
    """Guards against one sum over all pixels, into which 2^22 small terms vanish (and for which every thread waits)."""
    scene = glow(256, start=5.0)
    scene.integrator().render(scene, spp=64)
    film = scene.sensors()[0].film()
    assert film.energy_before == pytest.approx(256 * 256 / 1.3, rel=1e-6)
    assert film.energy_after == 0.0
