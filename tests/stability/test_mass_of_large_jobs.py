"""Sums of very many small contributions in one bin."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

VARIANT = "llvm_ad_mono"
FILM = "torchtransient.plugins.films.base.MAX_SINGLE_PRECISION_SAMPLES"
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


def glow(width, height, start=0.0):
    film = {
        "type": "transient_hdr_film",
        "width": width,
        "height": height,
        "rfilter": {"type": "box"},
        "temporal_bins": 2,
        "bin_width_opl": 10.0,
        "start_opl": start,
    }
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "transient_path", "max_depth": 1},
            "sensor": {
                "type": "perspective",
                "fov": 1,
                "film": film,
                "to_world": mi.ScalarTransform4f().look_at([0, 0, 1], [0, 0, 0], [0, 1, 0]),
            },
            "wall": {"type": "rectangle", "emitter": {"type": "area", "radiance": 1 / 1.3}},
        }
    )


@pytest.mark.parametrize("passes", [1, 8])
def test_render_of_many_samples(monkeypatch, passes):
    """The same through a render, in one pass and in several: the storage is chosen by the total."""
    spp = 1 << 20
    monkeypatch.setattr(LANES, spp // passes)
    scene = glow(1, 1)
    for tensor in scene.integrator().render(scene, spp=spp):
        assert dr.type_v(tensor) == dr.type_v(mi.Float)
        assert np.array(tensor, dtype=float).sum() == pytest.approx(1 / 1.3, rel=2e-7)


def test_storage_follows_the_number_of_samples(monkeypatch):
    monkeypatch.setattr(FILM, 16)
    scene = glow(2, 2)
    reference = [np.array(t) for t in scene.integrator().render(scene, spp=16, seed=1)]
    doubled = [np.array(t) for t in scene.integrator().render(scene, spp=17, seed=1)]
    for a, b in zip(reference, doubled, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6)


def test_energy_outside_of_many_pixels():
    """Guards against one sum over all pixels, into which 2^22 small terms vanish (and for which every thread waits)."""
    scene = glow(256, 256, start=5.0)
    scene.integrator().render(scene, spp=64)
    film = scene.sensors()[0].film()
    assert film.energy_before == pytest.approx(256 * 256 / 1.3, rel=1e-6)
    assert film.energy_after == 0.0
