"""Jobs of an integrator: mistakes in what is asked for, seeds, moments of rays, and arrays that films are lent."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.plain_scenes import camera, load
from support.walks import primary_rays
from torchtransient.errors import GradientError, SceneError, TorchTransientWarning, UnitError

VARIANT = "llvm_ad_mono"


LAMP = {"lamp": {"type": "point", "intensity": 1.0, "position": [0.3, 0.2, 2.0]}}


def test_mistakes_of_a_job():
    scene = load(camera(2, 2, bins=3), LAMP)
    integrator = scene.integrator()
    for index in (-1, 1):
        with pytest.raises(SceneError, match=f"has 1 sensors, got index {index}"):
            integrator.render(scene, sensor=index, spp=1)
    with pytest.raises(SceneError, match=r"kind of job, one of .*, got 'sideways'"):
        integrator.prepared(scene, spp=1, kind="sideways")
    plain = load(camera(2, 2, transient=False), LAMP)
    with pytest.raises(SceneError, match="a film of type transient_hdr_film, gated_hdr_film, phasor_hdr_film"):
        plain.integrator().render(plain, spp=1)
    pairs = camera(2, 2, bins=3)
    pairs["film"] |= {"exhaustive_scan": True, "laser_scan_width": 2, "laser_scan_height": 3}
    pairs = load(pairs, LAMP)
    with pytest.raises(SceneError, match="exhaustive_scan needs an integrator with a scanned laser"):
        pairs.integrator().render(pairs, spp=1)
    light = {"type": "rectangle", "emitter": {"type": "directionalarea", "radiance": 1.0, "id": "slide"}}
    untraceable = load(camera(2, 2, bins=3), {"screen": light})
    with pytest.raises(GradientError, match=r"'slide'.*cannot be asked for its light"):
        untraceable.integrator().render_forward(untraceable, None, spp=1)
    adjoint = mi.TensorXf(np.zeros((2, 2, 1, 3), dtype=np.float32))
    with pytest.raises(GradientError, match=r"\(2, 2, 3, 1\) expected, got \(2, 2, 1, 3\)"):
        integrator.render_backward(scene, mi.traverse(scene), (None, adjoint), spp=1)
    with pytest.raises(UnitError, match="whole number"):
        integrator.render(scene, seed=1.5, spp=1)


def test_seeds_count_modulo_two_to_the_32():
    scene = load(camera(2, 2, bins=3, bin_width=4.0), {**LAMP, "wall": {"type": "rectangle"}})
    integrator = scene.integrator()
    for seed, counted in ((2**32, 0), (-1, 2**32 - 1), (2**33 + 3, 3)):
        with pytest.warns(TorchTransientWarning, match=f"counts as {counted}"):
            found = np.array(integrator.render(scene, seed=seed, spp=4)[1])
        np.testing.assert_array_equal(found, np.array(integrator.render(scene, seed=counted, spp=4)[1]))
        assert found.any()


def test_a_shutter_spreads_the_moments_of_rays():
    scene = load(camera(4, 3, bins=3, shutter_open=2.0, shutter_close=5.0), LAMP)
    still = load(camera(4, 3, bins=3, shutter_open=2.0, shutter_close=2.0), LAMP)
    times = [np.array(primary_rays(one, 3, 64).rays.ray.time) for one in (scene, still)]
    assert times[0].min() >= 2 and times[0].max() < 5
    np.testing.assert_allclose(np.quantile(times[0], [0.25, 0.5, 0.75]), [2.75, 3.5, 4.25], atol=0.15)
    assert (times[1] == 2).all()


def test_a_lent_array_is_added_to_from_its_first_entry_on():
    scene = load(camera(3, 2, bins=5, bin_width=2.0), {**LAMP, "wall": {"type": "rectangle"}})
    film, integrator = scene.sensors()[0].film(), scene.integrator()
    expected = np.array(integrator.render(scene, seed=2, spp=8)[1]).ravel()
    storage = dr.zeros(mi.Float, 7 + expected.size + 4)
    film.lend((storage, 7))
    try:
        integrator.render(scene, seed=2, spp=8, develop=False)
        found = np.array(film.band_array(0))
    finally:
        film.lend(None)
    assert expected.sum() > 0
    np.testing.assert_allclose(found[7:-4], expected, rtol=1e-5)
    assert not found[:7].any() and not found[-4:].any()
