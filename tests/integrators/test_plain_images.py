"""Integrators that know nothing of time, Mitsuba's and those of users, on films of this library: an image, as on an
``hdrfilm``.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import torchtransient as tt
from support.mitsuba_room import as_mitsuba
from tools.small_room import GREY, make_room
from tools.small_room import VARIANT as VARIANT
from torchtransient.errors import SceneError

SLOW = pytest.mark.slow
SIZE = {"width": 6, "height": 5, "crop_width": 4, "crop_height": 3, "crop_offset_x": 1, "crop_offset_y": 2}
FILMS = {
    "transient": {"type": "transient_hdr_film", "temporal_bins": 24, "start_opl": 6.0, "bin_width_opl": 0.25},
    "phasor": {"type": "phasor_hdr_film", "frequencies": "0 1"},
    "gated": {"type": "gated_hdr_film", "gates": "rectangular 1 20"},
}
HDR = {"type": "hdrfilm", "pixel_format": "rgb", "component_format": "float32"}
INTEGRATORS = {
    "path": {"type": "path", "max_depth": 3},
    "prb": {"type": "prb", "max_depth": 3},
    "direct": {"type": "direct"},
    "aov": {"type": "aov", "aovs": "depth:depth,normal:sh_normal", "inner": {"type": "direct"}},
    "volpath": {"type": "volpath", "max_depth": 3},
}


def load(film, rfilter="gaussian"):
    room = make_room()
    room["sensor"]["film"] = film | SIZE | {"rfilter": {"type": rfilter}}
    return mi.load_dict(as_mitsuba(room))


def image(scene, integrator, **more):
    return np.array(mi.render(scene, integrator=integrator, spp=4, seed=1, **more))


@pytest.mark.parametrize("name", ["aov", *(pytest.param(n, marks=SLOW) for n in ("path", "volpath"))])
def test_the_image_is_that_of_an_hdrfilm(name):
    integrator = mi.load_dict(INTEGRATORS[name])
    found, expected = (image(load(film), integrator) for film in (FILMS["transient"], HDR))
    assert found.shape[:2] == (3, 4) and expected.any()
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-6 * expected.max())


@pytest.mark.parametrize("name", ["transient", *(pytest.param(n, marks=SLOW) for n in ("phasor", "gated"))])
def test_images_and_renders_through_time_take_turns(name):
    """Each forgets what was before it."""
    scene = load(FILMS[name], "box")
    before = [np.array(part) for part in mi.render(scene, spp=4, seed=1)]
    seen = image(scene, mi.load_dict(INTEGRATORS["path"]))
    after = [np.array(part) for part in mi.render(scene, spp=4, seed=1)]
    assert seen.shape == (3, 4, 3) and seen.any()
    assert np.array_equal(seen, image(scene, mi.load_dict(INTEGRATORS["path"])))
    for one, other in zip(before, after, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5)


@pytest.mark.slow
def test_derivatives_of_images():
    found = []
    for film in (FILMS["transient"], HDR):
        scene = load(film)
        params = mi.traverse(scene)
        dr.enable_grad(params[GREY])
        params.update()
        integrator = mi.load_dict(INTEGRATORS["prb"])
        dr.backward(dr.sum(mi.render(scene, params, integrator=integrator, spp=4, seed=1), axis=None))
        found.append(np.array(dr.grad(params[GREY])))
    assert found[1].all()
    np.testing.assert_allclose(found[0], found[1], rtol=1e-4)


def distance():
    class Distance(mi.SamplingIntegrator):
        """How far away the first surface is, and a channel of one beside it."""

        def sample(self, scene, sampler, ray, medium=None, active=True):
            si = scene.ray_intersect(ray, active)
            return mi.Color3f(dr.select(si.is_valid(), si.t, 0)), si.is_valid(), [mi.Float(1)]

        def aov_names(self):
            return ["one"]

    return Distance(mi.Properties())


def test_an_integrator_of_ones_own():
    found = image(load(FILMS["transient"], "box"), integrator := distance())
    assert found.shape == (3, 4, 4) and np.all(found[..., 3] == 1)
    np.testing.assert_allclose(found[..., 0], image(load(HDR, "box"), integrator)[..., 0], rtol=1e-5)
    assert 1 < found[..., 0].min() < 6


def test_bitmaps_and_files_are_of_the_image_or_of_the_steady_image(tmp_path):
    scene = load(FILMS["transient"], "box")
    film = scene.sensors()[0].film()
    with pytest.raises(SceneError, match="nothing was rendered yet"):
        film.bitmap()
    steady = np.array(mi.render(scene, spp=4, seed=1)[0])
    film.write(tmp_path / "steady.exr")
    with tt.threads(2):  # one alone waits for ever for what Mitsuba reads
        read = np.array(mi.Bitmap(str(tmp_path / "steady.exr")))
    assert np.array_equal(read, steady)
    seen = image(scene, mi.load_dict(INTEGRATORS["direct"]))
    assert np.array_equal(np.array(film.bitmap()), seen)


