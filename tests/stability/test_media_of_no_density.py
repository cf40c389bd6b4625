"""Hard case: light and derivatives of media of no density at all, of grids that are their majorant, and of media whose
transmittance underflows behind rough glass.
"""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.media_scenes import block, camera, clouds, film, homogeneous, load, volume
from support.runs import runs
from torchtransient.accuracy import z_test

VARIANT = "llvm_ad_mono"


def meter():
    return {"type": "radiancemeter", "origin": [0, 0, 4], "direction": [0, 0, -1], "film": film(1, 1, filter="tent")}


def loss_weights(shape):
    return np.broadcast_to(np.sin(0.3 * np.arange(shape[2]))[:, None], shape)


def value(scene, seed, spp):
    _, transient = scene.integrator().render(scene, seed=seed, spp=spp)
    transient = np.array(transient, dtype=float)
    return (transient * loss_weights(transient.shape)).sum()


def gradient(scene, key, seed, spp):
    """Reverse mode: the derivative of :func:`value` by a parameter."""
    params = mi.traverse(scene)
    leaf = params[key]
    dr.enable_grad(leaf)
    params[key] = leaf
    params.update()
    adjoint = loss_weights(scene.sensors()[0].film().cube_shape()).astype(np.float32)
    scene.integrator().render_backward(scene, params, (None, mi.TensorXf(adjoint)), seed=seed, spp=spp)
    result = np.array(dr.grad(params[key]), dtype=float)
    dr.disable_grad(params[key])
    return result


@pytest.mark.slow
def test_no_density_is_air():
    """In time and in brightness."""
    _, a = runs(load(block(homogeneous(0.0, 0.9)), camera()), count=8)
    air = block(homogeneous())
    del air["block"]
    _, b = runs(load(air, camera(), integrator="transient_path"), count=8, seed=50)
    result = z_test(a.sum((1, 2, 3)), b.sum((1, 2, 3)).mean(0), rounding=3 * b.sum((1, 2, 3)).std() / np.sqrt(8))
    assert result.passed, str(result)
    lit = [x.sum((0, 1, 2, 4)) > 0 for x in (a, b)]
    assert np.array_equal(*[np.flatnonzero(x)[[0, -1]] for x in lit])


@pytest.mark.slow
def test_dense_behind_rough_glass():
    """An optical depth of 20000: transmittances are zero in single precision, which must stay a number."""
    bsdf = {"type": "diff_rough_dielectric", "alpha": 0.3}
    scene = load(block(homogeneous(1e4, 0.9), bsdf), camera(bins=60, filter="tent"))
    steady, transient = runs(scene, count=2, spp=64)
    assert np.isfinite(steady).all() and np.isfinite(transient).all() and steady.sum() > 0
    for key in ("sigma_t.value.value", "albedo.value.value"):
        assert np.isfinite(gradient(scene, f"block.interior_medium.{key}", 1, 64)).all()


@pytest.mark.slow
@pytest.mark.parametrize("grid", [None, 1.0])
def test_gradient_by_a_density_of_zero(grid):
    """The first medium to come: one-sided differences of second order, since there is nothing on the other side."""

    def scene(density):
        if grid is None:
            return load(block(homogeneous(density, 0.9)), meter(), max_depth=4)
        # Among empty cells there may be dense ones, which set the rate of collisions.
        cells = np.zeros((3, 3, 3))
        cells[::2, :, 1] = grid
        cloud = clouds(sigma_t=volume(cells + density), scale=1.0, albedo=0.9)
        return load(block(cloud), meter(), max_depth=4)

    key = "block.interior_medium.sigma_t." + ("value.value" if grid is None else "data")
    empty = scene(0.0)
    reverse = np.array([gradient(empty, key, 10 + seed, 1 << 14).sum() for seed in range(6)])
    h, seeds = 0.02, range(8)
    steps = [[value(s, seed, 1 << 17) for seed in seeds] for s in (empty, scene(h), scene(2 * h))]
    at = np.array(steps)
    differences = (-3 * at[0] + 4 * at[1] - at[2]) / (2 * h)
    error = np.sqrt(reverse.var(ddof=1) / 6 + differences.var(ddof=1) / 8)
    assert abs(reverse.mean() - differences.mean()) < 3 * error
    assert error < 0.15 * abs(differences.mean())


def test_gradients_of_an_empty_grid_reach_every_cell():
    cloud = clouds(sigma_t=volume(np.zeros((3, 3, 3))), scale=1.0)
    scene = load(block(cloud), camera(filter="tent"))
    derivative = gradient(scene, "block.interior_medium.sigma_t.data", 3, 256)
    assert np.isfinite(derivative).all() and (derivative != 0).all()


@pytest.mark.slow
def test_grid_that_touches_its_majorant():
    """Where the density is the majorant, nothing is let through by chance and the derivative is still there."""
    density = np.zeros((2, 2, 2))
    density[:, :, 1] = 1.0
    cloud = clouds(sigma_t=volume(density) | {"filter_type": "nearest"}, scale=1.0, albedo=0.0)
    objects = block(cloud)
    objects["floor"]["emitter"] = {"type": "area", "radiance": 1.0}
    del objects["lamp"]
    ray = {"origin": [0.5, 0.3, 4], "direction": [0, 0, -1]}
    scene = load(objects, {"type": "radiancemeter", **ray, "film": film(1, 1, bins=80, filter="tent")}, max_depth=2)
    params = mi.traverse(scene)
    key = "block.interior_medium.sigma_t.data"
    dr.enable_grad(params[key])
    params.update()
    adjoint = mi.TensorXf(np.ones(scene.sensors()[0].film().cube_shape(), dtype=np.float32))
    scene.integrator().render_backward(scene, params, (None, adjoint), seed=1, spp=1 << 14)
    derivative = np.array(dr.grad(params[key])).reshape(-1)
    # Two cells are crossed, each over a length of one.
    assert derivative.sum() == pytest.approx(-2 * np.exp(-2.0), rel=0.08)
