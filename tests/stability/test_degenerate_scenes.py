"""Scenes with nothing to see, and albedos of zero: zeros where zeros belong, slopes where they are, never a NaN."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.gradient_cases.problem import Case, Problem
from support.gradient_cases.scenes import room
from support.gradient_cases.unknowns import set_color
from support.marks import long
from support.media_scenes import camera, film, load

VARIANT = "llvm_ad_mono"


def scene_of(objects, target=(0, 0, 0)):
    smooth = film(3, 2, bins=20, bin_width=0.5, filter="tent") | {"rfilter": {"type": "gaussian"}}
    return load(objects, camera(target=target, fov=30) | {"film": smooth}, "transient_path", max_depth=4)


def wall(reflectance=0.5):
    return {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": reflectance}}


LIGHT = {"type": "point", "position": [0.5, 0.0, 2.0], "intensity": 3.0}
DARK = {
    "nothing at all": ({}, (0, 0, 0)),
    "no light": ({"wall": wall()}, (0, 0, 0)),
    "black wall": ({"wall": wall(0.0), "light": LIGHT}, (0, 0, 0)),
    "camera looks away": ({"wall": wall(), "light": LIGHT}, (0, 0, 9)),
    "light of no intensity": ({"wall": wall(), "light": LIGHT | {"intensity": 0.0}}, (0, 0, 0)),
    "light behind the wall": ({"wall": wall(), "light": LIGHT | {"position": [0.0, 0.0, -1.0]}}, (0, 0, 0)),
}


def attached(scene):
    params = mi.traverse(scene)
    keys = [k for k, _ in params if k in ("wall.to_world", "wall.bsdf.reflectance.value", "light.position")]
    for key in keys:
        dr.enable_grad(params[key])
    params.update()
    return params, keys


def flat(value):
    return np.array(value.matrix if hasattr(value, "matrix") else value).ravel()


def both_modes(scene, scale=1.0, spp=64):
    """Gradients in reverse mode, and the derivative of the transient in forward mode."""
    film = scene.sensors()[0].film()
    shape = film.cube_shape()
    rng = np.random.default_rng(0)
    adjoint = (mi.TensorXf(scale * rng.normal(size=(2, 3, shape[-1]))), mi.TensorXf(scale * rng.normal(size=shape)))
    params, keys = attached(scene)
    scene.integrator().render_backward(scene, params, adjoint, spp=spp)
    reverse = [flat(dr.grad(params[key])) for key in keys]
    params, keys = attached(scene)
    for key in keys:
        dr.set_grad(params[key], 1)
        dr.enqueue(dr.ADMode.Forward, params[key])
    dr.traverse(dr.ADMode.Forward, dr.ADFlag.ClearEdges)
    forward = [np.array(t) for t in scene.integrator().render_forward(scene, params, spp=spp)]
    return np.concatenate([np.zeros(1), *reverse]), forward


@pytest.mark.parametrize("name", long(DARK, ["black wall"]))
def test_dark_scenes(name):
    """Guards against 0 / 0 in weights of paths that carry nothing, and against null pointers to shapes and emitters."""
    scene = scene_of(*DARK[name])
    for tensor in scene.integrator().render(scene, spp=64):
        assert not np.array(tensor).any()
    reverse, forward = both_modes(scene)
    assert np.isfinite(reverse).all() and all(np.isfinite(f).all() for f in forward)
    if name != "black wall":  # whose albedo does have a derivative
        assert not reverse.any() and not any(f.any() for f in forward)
    else:
        assert reverse.any() and forward[1].any()


def test_adjoint_of_zeros():
    scene = scene_of({"wall": wall(), "light": LIGHT})
    reverse, forward = both_modes(scene, scale=0.0)
    assert reverse.size > 1 and not reverse.any()
    assert all(np.isfinite(f).all() for f in forward) and forward[1].any()
    reverse, _ = both_modes(scene)
    assert np.isfinite(reverse).all() and reverse.any()


def test_no_adjoint_is_no_gradient():
    scene = scene_of({"wall": wall(), "light": LIGHT})
    params, keys = attached(scene)
    scene.integrator().render_backward(scene, params, (None, None), spp=4)
    assert not any(flat(dr.grad(params[key])).any() for key in keys)


# --------------------------------------------------------------------------------------------------- albedos of zero

SIDE, WALL = "side.bsdf.reflectance.value", "wall.bsdf.reflectance.value"


def problem(key, value, scene):
    return Problem(Case("albedo", "", scene, set_color(key), value, 0.05, spp=512, fd_spp=512))


@pytest.mark.parametrize(("key", "albedo"), [(SIDE, 0.0), (SIDE, 1e-8), (WALL, 0.0)])
def test_gradient_by_an_albedo_of_zero(key, albedo):
    """Guards against dividing the light beyond a vertex by its BSDF value: at zero that gives 0 (or 0 / 0) although the
    derivative is not zero, and just above it an amplification by up to 1e8.

    Same seed, same paths, and a polynomial in the albedo: central differences with Richardson's correction are exact to
    rounding.
    """
    scene = (
        (lambda: room(side_reflectance=albedo))
        if key == SIDE
        else (lambda: room(bsdf={"type": "diffuse", "reflectance": albedo}, side_reflectance=0.8))
    )
    p = problem(key, albedo, scene)
    h = p.case.step
    for seed in (1, 2):
        near, far = ((p.loss(albedo + s, seed) - p.loss(albedo - s, seed)) / (2 * s) for s in (h / 2, h))
        expected = (4 * near - far) / 3
        assert abs(expected) > 1e-3
        assert p.reverse(seed) == pytest.approx(expected, rel=2e-3)
        assert p.forward(seed) == pytest.approx(expected, rel=2e-3)


def test_two_black_surfaces():
    """With the wall black too, no light comes by way of the side: its derivative is zero, and finite."""
    black = problem(SIDE, 0.0, lambda: room(bsdf={"type": "diffuse", "reflectance": 0.0}, side_reflectance=0.0))
    assert black.reverse(1) == 0.0
