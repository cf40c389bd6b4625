"""Scenes with nothing to see, and albedos of zero: zeros where zeros belong, slopes where they are, never a NaN."""

import pytest
import torch

import torchtransient as tt
from support.gradient_cases.problem import Case, Problem
from support.gradient_cases.scenes import room
from support.gradient_cases.unknowns import set_color
from support.marks import long
from support.media_scenes import camera, film

VARIANT = "llvm_ad_mono"


def wall(reflectance=0.5):
    return {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": reflectance}}


KEYS = {"wall": ["wall.to_world", "wall.bsdf.reflectance.value"], "light": ["light.position"]}
LIGHT = {"type": "point", "position": [0.5, 0.0, 2.0], "intensity": 3.0}
DARK = {
    "nothing at all": {},
    "black wall": {"wall": wall(0.0), "light": LIGHT},
    "light behind the wall": {"wall": wall(), "light": LIGHT | {"position": [0.0, 0.0, -1.0]}},
}


def both_modes(objects, scale=1.0):
    """Render, gradients of a random loss in reverse mode, and the derivative of the transient in forward mode."""
    smooth = film(3, 2, bins=20, bin_width=0.5, filter="tent") | {"rfilter": {"type": "gaussian"}}
    integrator, sensor = {"type": "transient_path", "max_depth": 4}, camera(fov=30) | {"film": smooth}
    scene = tt.load({"type": "scene", "integrator": integrator, "sensor": sensor, **objects}, variant=VARIANT)
    keys = [key for name in objects for key in KEYS[name]]
    renderer = tt.TransientRenderer(scene, keys, spp=64, boundary=False, physics="ignore")
    out = renderer(seed=0)
    weights = scale * torch.randn(out.transient.shape, generator=torch.Generator().manual_seed(0))
    if not keys:
        return out, torch.zeros(1), torch.zeros(1)
    loss = (out.transient * weights).sum() + scale * out.steady.sum()
    reverse = torch.autograd.grad(loss, list(renderer.parameters()))
    values = {key: renderer.values[key].detach() for key in keys}
    ones = {key: torch.ones_like(value) for key, value in values.items()}
    _, forward = torch.func.jvp(lambda given: renderer(given, seed=0).transient, (values,), (ones,))
    return out, torch.cat([slope.flatten() for slope in reverse]), forward


@pytest.mark.parametrize("name", long(DARK, ["black wall"]))
def test_dark_scenes(name):
    """Guards against 0 / 0 in weights of paths that carry nothing, and against null pointers to shapes and emitters."""
    out, reverse, forward = both_modes(DARK[name])
    assert not out.steady.any() and not out.transient.any()
    assert bool(torch.isfinite(reverse).all()) and bool(torch.isfinite(forward).all())
    # a black wall's albedo does have a derivative
    assert bool(reverse.any()) == bool(forward.any()) == (name == "black wall")


def test_adjoint_of_zeros():
    for scale in (0.0, 1.0):
        _, reverse, forward = both_modes({"wall": wall(), "light": LIGHT}, scale)
        assert bool(torch.isfinite(reverse).all()) and bool(reverse.any()) == (scale > 0)
        assert bool(torch.isfinite(forward).all()) and bool(forward.any())


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
