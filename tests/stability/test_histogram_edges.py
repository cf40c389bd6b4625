"""Arrivals at, just before and just after the edges of bins and of the window."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.film_storage import storage

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


@pytest.mark.parametrize("width", [1.0, 0.25, 0.003, 0.1, 1e-4])
@pytest.mark.parametrize("eps", [1e-6, 1e-9, 1e-12])
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
    far = np.array(
        [
            -1e-3 - 8,
            -(2.0**31),
            -(2.0**32) - 5,
            -(2.0**32) * 3 + 1.5,
            -1e18,
            BINS + 8.0,
            2.0**31,
            2.0**32 + 3,
            2.0**33 + 1,
            1e18,
        ]
    )
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
    t = mi.ScalarTransform4f()
    for start, side in ((8.5, "before"), (4.0, "after")):
        film = {
            "type": "transient_hdr_film",
            "width": 2,
            "height": 2,
            "rfilter": {"type": "box"},
            "temporal_bins": 8,
            "bin_width_opl": 0.25,
            "start_opl": start,
        }
        scene = mi.load_dict(
            {
                "type": "scene",
                "integrator": {"type": "transient_path"},
                "sensor": {
                    "type": "perspective",
                    "fov": 5,
                    "film": film,
                    "to_world": t.look_at([0, 0, 4], [0, 0, 0], [0, 1, 0]),
                },
                "wall": {"type": "rectangle"},
                "light": {"type": "point", "position": [0.0, 0.0, 4.0]},
            }
        )
        steady, transient = (np.array(v, dtype=float) for v in scene.integrator().render(scene, spp=64))
        film = scene.sensors()[0].film()
        energy = {"before": film.energy_before, "after": film.energy_after}
        assert not transient.any() and steady.min() > 0
        assert energy.pop(side) == pytest.approx(steady.sum(), rel=1e-5)
        assert list(energy.values()) == [0.0]
