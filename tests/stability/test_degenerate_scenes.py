"""Scenes with nothing to see: zeros where zeros belong, and never a NaN."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.marks import long

VARIANT = "llvm_ad_mono"


def load(objects, target=(0, 0, 0)):
    film = {
        "type": "transient_hdr_film",
        "width": 3,
        "height": 2,
        "rfilter": {"type": "gaussian"},
        "temporal_bins": 20,
        "bin_width_opl": 0.5,
        "start_opl": 0.0,
        "temporal_filter": "tent",
    }
    view = {
        "type": "perspective",
        "fov": 30,
        "film": film,
        "to_world": mi.ScalarTransform4f().look_at([0, 0, 4], list(target), [0, 1, 0]),
    }
    return mi.load_dict(
        {"type": "scene", "integrator": {"type": "transient_path", "max_depth": 4}, "sensor": view, **objects}
    )


def wall(reflectance=0.5):
    return {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": reflectance}}


LIGHT = {"type": "point", "position": [0.5, 0.0, 2.0], "intensity": 3.0}
DARK = {
    "nothing at all": ({}, (0, 0, 0)),
    "no light": ({"wall": wall()}, (0, 0, 0)),
    "black wall": ({"wall": wall(0.0), "light": LIGHT}, (0, 0, 0)),
    "camera looks away": ({"wall": wall(), "light": LIGHT}, (0, 0, 9)),
    "light of no intensity": (
        {"wall": wall(), "light": LIGHT | {"intensity": {"type": "uniform", "value": 0.0}}},
        (0, 0, 0),
    ),
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
    scene = load(*DARK[name])
    for tensor in scene.integrator().render(scene, spp=64):
        assert not np.array(tensor).any()
    reverse, forward = both_modes(scene)
    assert np.isfinite(reverse).all() and all(np.isfinite(f).all() for f in forward)
    if name != "black wall":  # whose albedo does have a derivative
        assert not reverse.any() and not any(f.any() for f in forward)
    else:
        assert reverse.any() and forward[1].any()


def test_adjoint_of_zeros():
    scene = load({"wall": wall(), "light": LIGHT})
    reverse, forward = both_modes(scene, scale=0.0)
    assert reverse.size > 1 and not reverse.any()
    assert all(np.isfinite(f).all() for f in forward) and forward[1].any()
    reverse, _ = both_modes(scene)
    assert np.isfinite(reverse).all() and reverse.any()


def test_no_adjoint_is_no_gradient():
    scene = load({"wall": wall(), "light": LIGHT})
    params, keys = attached(scene)
    scene.integrator().render_backward(scene, params, (None, None), spp=4)
    assert not any(flat(dr.grad(params[key])).any() for key in keys)
