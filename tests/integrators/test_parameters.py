"""Every parameter of `transient_path`, against closed forms and Mitsuba's `path`."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from support.marks import long
from support.plain_scenes import camera, check, load, mitsuba_runs
from support.runs import T, runs
from torchtransient import plugins
from torchtransient.errors import GradientError, SceneError, VariantError

VARIANT = "llvm_ad_rgb"


def room():
    """Walls, floor and a lamp (a mesh), with a mirror, glass, plastic, a picture on the wall and a sky through the open
    front.
    """
    picture = np.random.default_rng(1).uniform(0.1, 0.9, (6, 6, 3)).astype(np.float32)
    sky = np.random.default_rng(2).uniform(0.1, 0.6, (4, 8, 3)).astype(np.float32)
    textured = {"type": "diffuse", "reflectance": {"type": "bitmap", "data": mi.TensorXf(picture)}}
    painted = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.2, 0.5, 0.7]}}
    gold = {"type": "roughconductor", "material": "Au", "alpha": 0.2}
    radiance = {"type": "rgb", "value": [4.0, 3.0, 2.0]}
    return {
        "sky": {"type": "envmap", "bitmap": mi.Bitmap(sky)},
        "back": {"type": "rectangle", "to_world": T().translate([0, 0, -1]).scale(1.4), "bsdf": textured},
        "floor": {
            "type": "rectangle", "to_world": T().translate([0, -1, 0]).rotate([1, 0, 0], -90).scale(1.4),
            "bsdf": painted,
        },
        "lamp": {
            "type": "cube", "to_world": T().translate([0.3, 1.0, 0.2]).scale([0.4, 0.05, 0.4]),
            "emitter": {"type": "area", "radiance": radiance},
        },
        "glass": {"type": "sphere", "center": [0.5, -0.6, 0.3], "radius": 0.35, "bsdf": {"type": "dielectric"}},
        "gold": {"type": "cube", "to_world": T().translate([-0.6, -0.6, -0.1]).rotate([0, 1, 0], 30).scale(0.3),
                 "bsdf": gold},
        "ball": {"type": "sphere", "center": [0.0, -0.75, 0.8], "radius": 0.22,
                 "bsdf": {"type": "roughplastic", "alpha": 0.15}},
        "steel": {"type": "sphere", "center": [-0.5, 0.3, -0.2], "radius": 0.25,
                  "bsdf": {"type": "conductor", "material": "Al"}},
    }  # fmt: skip


@pytest.mark.parametrize("variant", long(["llvm_ad_mono", "llvm_ad_spectral"], ["llvm_ad_mono"]))
def test_steady_image_is_that_of_path(variant):
    mi.set_variant(variant)
    plugins.sync()
    steady, transient = runs(load(camera(bin_width=0.2), room(), max_depth=6), 8, 256)
    check(steady, mitsuba_runs(camera(transient=False), room(), 8, 256, max_depth=6))
    np.testing.assert_allclose(transient.sum(3), steady, atol=1e-5 * steady.max())


def lit_wall(**lamp):
    """A wall at z = 0 and a square lamp at z = 2 (a mesh) in front of its left half, seen from z = 4."""
    return {
        "wall": {"type": "rectangle", "to_world": T().scale(3), "bsdf": {"type": "diffuse", "reflectance": 0.5}},
        "lamp": {
            "type": "cube",
            "to_world": T().translate([-0.5, 0, 2]).scale([0.4, 0.4, 1e-3]),
            "emitter": {"type": "area", "radiance": 3.0},
        },
        **lamp,
    }


@pytest.mark.slow
@pytest.mark.parametrize("depth", [0, 1, -1])
def test_max_depth(depth):
    steady, transient = runs(load(camera(), lit_wall(), max_depth=depth), 6, 128)
    np.testing.assert_allclose(transient.sum(3), steady, atol=1e-5)
    if depth == 0:
        assert not steady.any()
    else:
        check(steady, mitsuba_runs(camera(transient=False), lit_wall(), 6, 128, max_depth=depth))


@pytest.mark.slow
def test_roulette_does_not_change_the_mean():
    """In glass the chance goes by the square of the index."""
    box = mi.cornell_box()
    box["small-box"]["bsdf"] = {"type": "dielectric"}
    objects = {k: v for k, v in box.items() if k not in ("type", "integrator", "sensor")}
    sensor = camera(fov=39, origin=(0, 0, 3.9), bin_width=0.4, bins=60)
    scenes = [load(sensor, objects, max_depth=12, rr_depth=depth) for depth in (1, 1000)]
    early, late = (runs(scene, 12, 256, seed=100 * k)[1].mean((1, 2, 4)) for k, scene in enumerate(scenes))
    # bins of the whole picture, which hold enough events to be normally distributed
    check(early, late)
    # the roulette was at work: the same seed no longer draws the same paths
    a, b = (runs(scene, 1, 16)[0] for scene in scenes)
    assert np.abs(a - b).max() > 1e-3


def test_what_lies_behind_a_hidden_light_is_seen_at_its_own_distance():
    # rectangles take their hit point from the distance along the ray, so a wrong distance would be a wrong time
    lamp = {
        "lamp": {
            "type": "rectangle",
            "to_world": T().translate([0, 0, 2]).scale(0.5),
            "emitter": {"type": "area", "radiance": 3.0},
        }
    }
    wall = {
        "wall": {"type": "rectangle", "to_world": T().scale(3), "bsdf": {"type": "diffuse", "reflectance": 0.5}},
        "point": {"type": "point", "position": [0.0, 0.0, 1.0], "intensity": 5.0},
    }
    sensor = camera(fov=5, width=1, height=1, bins=4, bin_width=0.04, start=4.98)
    hidden = load(sensor, wall | lamp, hide_emitters=True, max_depth=2)
    steady, transient = hidden.integrator().render(hidden, spp=256)
    bins = np.array(transient)[0, 0, :, 0]
    # 4 m to the wall and 1 m to the point light; the lamp is off its own axis, hence dark itself at depth 2 from the
    # front
    assert bins[0] > 0.5 * np.array(steady)[0, 0, 0]
    assert hidden.sensors()[0].film().energy_before == 0.0


def test_camera_unwarp_shifts_by_the_last_leg():
    objects = {
        "wall": {"type": "rectangle", "to_world": T().scale(3), "bsdf": {"type": "diffuse", "reflectance": 0.5}},
        "point": {"type": "point", "position": [0.3, 0.0, 4.0], "intensity": 5.0},
    }
    sensor = camera(fov=8, width=1, height=1, bins=6000, bin_width=1e-3, start=3.0, near_clip=1.5)
    spectra = []
    for unwarp in (False, True):
        scene = load(sensor, objects, max_depth=2, camera_unwarp=unwarp)
        bins = np.array(scene.integrator().render(scene, spp=1 << 14)[1], dtype=float)[0, 0, :, 0]
        spectra.append((np.arange(6000) + 0.5) @ bins / bins.sum() * 1e-3 + 3.0)
    # mean distance to the wall over the pixel, from a dense grid
    half = 4 * np.tan(np.radians(4))
    u = (np.arange(400) + 0.5) / 400 * 2 - 1
    x, y = np.meshgrid(u * half, u * half)
    cosine = 4 / np.sqrt((x - 0.3) ** 2 + y**2 + 16)
    weight, near = cosine**3, np.sqrt(x**2 + y**2 + 16)
    expected = (near * weight).sum() / weight.sum()
    noise = 4 * np.std(near) / 128
    assert noise < 2e-4
    assert spectra[0] - spectra[1] == pytest.approx(expected, abs=noise)
    assert spectra[1] == pytest.approx((4 / cosine * weight).sum() / weight.sum(), abs=noise)


def test_scene_of_mitransient_loads():
    scene = load(camera(), lit_wall(), temporal_filter="box", gaussian_stddev=2.0, camera_unwarp=False)
    assert scene.integrator().render(scene, spp=1)[1].shape == (6, 8, 200, 3)
    load(camera(), lit_wall(), temporal_filter="", gaussian_stddev=2.0)


@pytest.mark.parametrize(("name", "value"), [("max_depth", -2), ("temporal_filter", "exponential")])
def test_wrong_settings(name, value):
    with pytest.raises(SceneError, match=name):
        load(camera(), {}, **{name: value})


def test_gradients_need_a_bound_on_the_depth():
    scene = load(camera(), lit_wall(), max_depth=-1)
    params = mi.traverse(scene)
    shape = scene.sensors()[0].film().cube_shape()
    with pytest.raises(GradientError, match="max_depth"):
        scene.integrator().render_backward(scene, params, (None, mi.TensorXf(np.ones(shape))), spp=1)


def test_scalar_variant_is_refused():
    scene = load(camera(), lit_wall())
    integrator = scene.integrator()
    with mi.variant_context("scalar_rgb"), pytest.raises(VariantError, match="llvm_ad_rgb"):
        integrator.render(scene)


def test_participating_media_are_refused():
    fog = {"type": "homogeneous", "albedo": 0.5, "sigma_t": 1.0}
    cloud = {"type": "cube", "bsdf": {"type": "null"}, "interior": fog}
    integrator = {"type": "transient_path"}
    scene = mi.load_dict({"type": "scene", "integrator": integrator, "sensor": camera(), "cloud": cloud})
    with pytest.raises(SceneError, match="participating media"):
        scene.integrator().render(scene, spp=1)
