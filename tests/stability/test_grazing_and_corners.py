"""Grazing views, corners and lights next to a surface: finite values, finite gradients, exact lengths."""

import numpy as np
import pytest
import torch

import torchtransient as tt
from support.marks import long
from support.media_scenes import camera, film
from torchtransient.scenes import look_at, rotate, scale, translate

VARIANT = "llvm_ad_mono"
pytestmark = pytest.mark.filterwarnings("ignore::torchtransient.errors.GradientWarning")  # of edges outside of the view


def renderer_of(sensor, objects, keys=(), max_depth=6, **settings):
    integrator = {"type": "transient_path", "max_depth": max_depth, "rr_depth": 100}
    scene = tt.load({"type": "scene", "integrator": integrator, "sensor": sensor, **objects}, variant=VARIANT)
    return tt.TransientRenderer(scene, list(keys), boundary=False, physics="ignore", **settings)


def floor(bsdf=None):
    return {"type": "rectangle", "to_world": scale(20), "bsdf": bsdf or {"type": "diffuse", "reflectance": 0.5}}


def point(position, intensity=5.0):
    return {"type": "point", "position": list(position), "intensity": intensity}


def check_finite(sensor, objects, keys, lit=True):
    """Values, and gradients of a wavy loss in reverse mode."""
    renderer = renderer_of(sensor, objects, keys, spp=256)
    out = renderer(seed=0)
    assert bool(torch.isfinite(out.steady).all()) and bool(torch.isfinite(out.transient).all())
    assert out.steady.min().item() >= 0 and (not lit or out.steady.max().item() > 0)
    wave = torch.arange(out.transient.shape[-3]).sin()[:, None, None]
    slopes = torch.autograd.grad(out.steady.sum() + (out.transient * wave).sum(), list(renderer.parameters()))
    assert all(bool(torch.isfinite(slope).all()) for slope in slopes)
    assert not lit or any(bool(slope.any()) for slope in slopes)


MATERIALS = {
    "diffuse": ({"type": "diffuse", "reflectance": 0.5}, "floor.bsdf.reflectance.value"),
    "rough conductor": ({"type": "roughconductor", "alpha": 0.05}, "floor.bsdf.alpha.value"),
    "rough plastic": ({"type": "diff_rough_plastic", "alpha": 0.1}, "floor.bsdf.alpha"),
}


@pytest.mark.parametrize("material", long(MATERIALS, ["rough plastic"]))
def test_grazing_view_and_light(material):
    """Guards against 1 / cos and against microfacet terms of 0 / 0 where camera and light skim the surface."""
    (bsdf, key), height = MATERIALS[material], 1e-4
    sensor = camera(fov=0.5, filter="tent") | {"to_world": look_at([0, -4, height], [0, 0, 0], [0, 0, 1])}
    check_finite(sensor, {"floor": floor(bsdf), "light": point([0.0, 4, height])}, [key, "floor.to_world"])


def test_corner():
    """Guards against segments of no length: paths in the corner of two walls bounce between points that nearly
    coincide.
    """
    wall = {"type": "rectangle", "to_world": rotate([0, 1, 0], 90) @ scale(20)}
    check_finite(
        camera([2, 0, 2], fov=0.05, filter="tent"), {"floor": floor(), "wall": wall, "light": point([2, 1, 2])},
        ["floor.to_world", "wall.to_world", "light.position"],
    )  # fmt: skip


@pytest.mark.parametrize("height", [1e-6, 0.0])
def test_light_next_to_the_surface(height):
    """Guards against 1 / d^2 of no distance: a point light next to the wall, and one on it."""
    objects, keys = {"floor": floor(), "light": point([0.011, 0.007, height])}, ["light.position", "floor.to_world"]
    check_finite(camera([0, 0, 2], fov=20, filter="tent"), objects, [*keys, "light.intensity.value"], lit=False)


@pytest.mark.slow
def test_area_light_on_the_surface():
    lamp = {"type": "rectangle", "to_world": scale(0.2), "emitter": {"type": "area", "radiance": 2.0}}
    pose = translate([1, 0, 1]) @ rotate([0, 1, 0], -60)
    other = {"type": "rectangle", "to_world": pose, "bsdf": {"type": "diffuse"}}
    keys = ["lamp.emitter.radiance.value", "floor.to_world", "lamp.to_world", "other.to_world"]
    view = camera([0, 0, 4], fov=20, filter="tent")
    check_finite(view, {"floor": floor(), "lamp": lamp, "other": other}, keys)


@pytest.mark.parametrize("angle", [0.0, 89.0])
def test_length_is_that_between_hit_points(angle):
    """Guards against shadow rays and paths measured from origins that were lifted off the surface: 1e-4 m and more at
    these distances, in the direction of the normal.
    """
    a = np.radians(angle)
    origin = np.float32([np.sin(a) * 3, 0, np.cos(a) * 3]).astype(float)
    light = np.float32([0.4, 0.3, 1.7]).astype(float)
    expected, width = np.linalg.norm(origin) + np.linalg.norm(light), 1e-6
    window = film(1, 1, start=expected - 50 * width, bins=100, bin_width=width)
    objects = {"floor": floor(), "light": point(light.tolist())}
    out = renderer_of(camera(origin, fov=1e-5) | {"film": window}, objects, max_depth=2, spp=64)(seed=0)
    bins = out.transient.flatten().double().numpy()
    assert bins.sum() == pytest.approx(float(out.steady), rel=1e-5) and bins.sum() > 0
    assert ((np.arange(100) + 0.5) @ bins / bins.sum() - 50) * width == pytest.approx(0, abs=1e-5)
