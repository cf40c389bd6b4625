"""Grazing views, corners and lights next to a surface: finite values, finite gradients, exact lengths."""

from __future__ import annotations

import itertools

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.marks import long_rows

VARIANT = "llvm_ad_mono"


def T():
    return mi.ScalarTransform4f()


def sensor(origin, target, fov=20.0, size=4, start=0.0, bins=100, width=0.1, filter="tent"):
    film = {
        "type": "transient_hdr_film",
        "width": size,
        "height": size,
        "rfilter": {"type": "box"},
        "temporal_bins": bins,
        "bin_width_opl": width,
        "start_opl": start,
        "temporal_filter": filter,
    }
    return {
        "type": "perspective",
        "fov": fov,
        "near_clip": 1e-3,
        "film": film,
        "to_world": T().look_at(origin, target, [0, 1, 0]),
    }


def load(view, objects, **arguments):
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "transient_path", "max_depth": 6, "rr_depth": 100} | arguments,
            "sensor": view,
            **objects,
        },
        optimize=False,
    )


def floor(bsdf=None):
    return {"type": "rectangle", "to_world": T().scale(20), "bsdf": bsdf or {"type": "diffuse", "reflectance": 0.5}}


def point(position, intensity=5.0):
    return {"type": "point", "position": list(position), "intensity": intensity}


def flat(value):
    return np.array(value.matrix if hasattr(value, "matrix") else value).ravel()


def gradients(scene, keys, spp=256):
    """Gradients of a wavy loss in reverse mode, flattened."""
    params = mi.traverse(scene)
    film = scene.sensors()[0].film()
    g = np.broadcast_to(np.sin(np.arange(film.temporal_bins))[:, None], film.cube_shape())
    for key in keys:
        dr.enable_grad(params[key])
    params.update()
    adjoint = (mi.TensorXf(np.ones((*film.cube_shape()[:2], 1))), mi.TensorXf(g.astype(np.float32)))
    scene.integrator().render_backward(scene, params, adjoint, spp=spp)
    return np.concatenate([flat(dr.grad(params[key])) for key in keys])


def check_finite(scene, keys, lit=True):
    steady, transient = (np.array(v, dtype=float) for v in scene.integrator().render(scene, spp=256))
    assert np.isfinite(steady).all() and np.isfinite(transient).all()
    assert steady.min() >= 0 and (steady.max() > 0) == lit
    g = gradients(scene, keys)
    assert np.isfinite(g).all()
    assert g.any() == lit


MATERIALS = {
    "diffuse": ({"type": "diffuse", "reflectance": 0.5}, ["floor.bsdf.reflectance.value", "floor.to_world"]),
    "rough conductor": ({"type": "roughconductor", "alpha": 0.05}, ["floor.bsdf.alpha.value", "floor.to_world"]),
    "rough plastic": ({"type": "diff_rough_plastic", "alpha": 0.1}, ["floor.bsdf.alpha", "floor.to_world"]),
}


@pytest.mark.parametrize(
    ("material", "height"),
    long_rows(itertools.product(MATERIALS, [1e-2, 1e-4]), [("rough plastic", 1e-4)]),
)
def test_grazing_view_and_light(material, height):
    """Guards against 1 / cos and against microfacet terms of 0 / 0 where camera and light skim the surface."""
    bsdf, keys = MATERIALS[material]
    view = sensor([0, -4, height], [0, 0, 0], fov=0.5)
    view["to_world"] = T().look_at([0, -4, height], [0, 0, 0], [0, 0, 1])
    check_finite(load(view, {"floor": floor(bsdf), "light": point([0.0, 4, height])}), keys)


def test_corner():
    """Guards against segments of no length: paths in the corner of two walls bounce between points that nearly
    coincide.
    """
    objects = {
        "floor": floor(),
        "wall": {"type": "rectangle", "to_world": T().rotate([0, 1, 0], 90).scale(20)},
        "light": point([2, 1, 2]),
    }
    check_finite(
        load(sensor([2, 0, 2], [0, 0, 0], fov=0.05), objects), ["floor.to_world", "wall.to_world", "light.position"]
    )


@pytest.mark.parametrize("height", [1e-6, 0.0])
def test_light_next_to_the_surface(height):
    """Guards against 1 / d^2 of no distance: a point light next to the wall, and one on it."""
    scene = load(sensor([0, 0, 2], [0, 0, 0]), {"floor": floor(), "light": point([0.011, 0.007, height])})
    steady, transient = (np.array(v) for v in scene.integrator().render(scene, spp=256))
    assert np.isfinite(steady).all() and np.isfinite(transient).all()
    assert np.isfinite(gradients(scene, ["light.position", "floor.to_world", "light.intensity.value"])).all()


@pytest.mark.slow
def test_area_light_on_the_surface():
    lamp = {"type": "rectangle", "to_world": T().scale(0.2), "emitter": {"type": "area", "radiance": 2.0}}
    other = {
        "type": "rectangle",
        "to_world": T().translate([1, 0, 1]).rotate([0, 1, 0], -60),
        "bsdf": {"type": "diffuse"},
    }
    scene = load(sensor([0, 0, 4], [0, 0, 0]), {"floor": floor(), "lamp": lamp, "other": other})
    check_finite(scene, ["lamp.emitter.radiance.value", "floor.to_world", "lamp.to_world", "other.to_world"])


@pytest.mark.parametrize("angle", [0.0, 89.0])
def test_length_is_that_between_hit_points(angle):
    """Guards against shadow rays and paths measured from origins that were lifted off the surface: 1e-4 m and more at
    these distances, in the direction of the normal.
    """
    a = np.radians(angle)
    origin = np.float32([np.sin(a) * 3, 0, np.cos(a) * 3]).astype(float)
    light = np.float32([0.4, 0.3, 1.7]).astype(float)
    expected = np.linalg.norm(origin) + np.linalg.norm(light)
    width = 1e-6
    view = sensor(
        list(origin), [0, 0, 0], fov=1e-5, size=1, start=expected - 50 * width, bins=100, width=width, filter="box"
    )
    scene = load(view, {"floor": floor(), "light": point(light)}, max_depth=2)
    steady, transient = scene.integrator().render(scene, spp=64)
    bins = np.array(transient, dtype=float)[0, 0, :, 0]
    assert bins.sum() == pytest.approx(float(steady.array[0]), rel=1e-5) and bins.sum() > 0
    assert ((np.arange(100) + 0.5) @ bins / bins.sum() - 50) * width == pytest.approx(0, abs=1e-5)
