"""Derivatives of renders of moving scenes by velocities, poses and albedos, in both modes."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import torchtransient as tt
from support.moving_scenes import (
    BEAT_HZ,
    EXPOSURE_S,
    FREQUENCIES,
    PER_METRE,
    corner,
    moving_scene,
    plate,
    wall,
    wall_phasor,
)
from tools.small_room import make_room
from torchtransient.testing import finite_differences

VARIANT = "llvm_ad_rgb"
HETERODYNE = tt.Exposure(EXPOSURE_S, beat_hz=BEAT_HZ)
ALBEDO, POSE = "wall.bsdf.reflectance.value", "wall.to_world"


def test_closed_forms_of_a_wall_in_both_modes():
    """Of the heterodyne phasor of a wall that comes nearer, by its velocity, its distance and its albedo. Derivatives
    are rounded as the phasors are, 260 times the signal.
    """
    scene = tt.load(moving_scene(wall=wall((0, 0, 2), (0, 0, 0))), variant=VARIANT)
    renderer = tt.TransientRenderer(scene, [POSE, ALBEDO], spp=64, frequencies=FREQUENCIES, boundary=False)
    pose, along = renderer.values[POSE].detach(), torch.zeros(4, 4)
    along[2, 3] = 1.0

    def image(velocity, shift, albedo):
        motion = tt.Motion(linear=velocity * torch.tensor([0.0, 0.0, 1.0]))
        values = {POSE: pose + shift * along, ALBEDO: albedo.expand(3)}
        return torch.view_as_real(tt.over_time(renderer, {"wall": motion}, HETERODYNE, values=values, seed=0).phasor)

    x, g = np.polynomial.legendre.leggauss(200)
    t = EXPOSURE_S / 2 * x
    z, weights = 2 - 10 * t, g / 2 * np.exp(2j * np.pi * BEAT_HZ * t)
    slope = wall_phasor(z) * (-2 / z - 4j * np.pi * PER_METRE)  # by the distance
    truth = [(weights * part).sum() for part in (slope * t, slope, wall_phasor(z) / 0.5)]
    at = (torch.tensor(-10.0), torch.tensor(0.0), torch.tensor(0.5))
    for k, expected in enumerate(truth):
        tangents = tuple(torch.ones(()) if k == n else torch.zeros(()) for n in range(3))
        _, forward = torch.func.jvp(image, at, tangents)
        numbers = torch.view_as_complex(forward).numpy()
        assert np.abs(numbers - expected).max() < 2e-3 * abs(expected)
        leaves = [x.clone().requires_grad_(True) for x in at]
        loss = (image(*leaves)[0, 0, 0, 0] * torch.tensor([0.3, 0.8])).sum()
        (reverse,) = torch.autograd.grad(loss, leaves[k])
        assert float(reverse) == pytest.approx(0.3 * expected.real + 0.8 * expected.imag, abs=2e-3 * abs(expected))


def of_a_corner(name):
    """(image(x, seed) as a tensor, step of differences) of the corner, along one direction through its unknowns."""
    scene, motion = corner()
    pose_key, albedo_key = "second.to_world", "second.bsdf.reflectance.value"
    loaded = tt.load(scene, variant=VARIANT)
    renderer = tt.TransientRenderer(loaded, [pose_key, albedo_key], spp=4096, frequencies=FREQUENCIES)
    pose = renderer.values[pose_key].detach()
    step = {"velocity": 4.0, "turn": 10.0, "pose": 0.01}[name]

    def image(x, seed):
        size = {key: torch.tensor(value) for key, value in motion.items()}
        values = {pose_key: pose, albedo_key: torch.full((3,), 0.5)}
        if name == "velocity":
            size["linear"] = size["linear"] + x * torch.tensor([1.0, -2.0, 0.5])
        elif name == "turn":
            size["angular"] = size["angular"] + x * torch.tensor([0.2, 1.0, -0.5])
        else:
            shift = torch.zeros(4, 4)
            shift[:3, 3] = torch.tensor([0.3, 0.1, -0.4])
            values[pose_key] = pose + x * shift
        out = tt.over_time(renderer, {"second": tt.Motion(**size)}, HETERODYNE, values=values, seed=seed)
        mean = out.phasor.mean()
        return 1e6 * (0.3 * mean.real + 0.8 * mean.imag)

    return image, step


@pytest.mark.parametrize(
    "name",
    [
        pytest.param("velocity", marks=pytest.mark.soak),
        pytest.param("turn", marks=pytest.mark.slow),
        pytest.param("pose", marks=pytest.mark.slow),
    ],
)
def test_differences_in_a_corner(name):
    image, step = of_a_corner(name)

    def gradient(seed):
        x = torch.tensor(0.0, requires_grad=True)
        return float(torch.autograd.grad(image(x, seed), x)[0])

    with torch.no_grad():
        found = finite_differences.central_difference(
            lambda x, seed: float(image(torch.tensor(float(x)), seed)), 0.0, step, range(12)
        )
    reverse = np.array([gradient(seed) for seed in range(100, 112)])
    error = np.hypot(float(found.standard_error), reverse.std(ddof=1) / 12**0.5)
    # Differences over a step are off by its square, 1e-3 of what they are.
    assert abs(reverse.mean() - float(found.mean)) < 3 * error + 1e-3 * abs(float(found.mean))
    assert error < 0.1 * abs(float(found.mean))
    forward = float(torch.func.jvp(lambda x: image(x, 100), (torch.tensor(0.0),), (torch.tensor(1.0),))[1])
    assert forward == pytest.approx(reverse[0], rel=2e-2)


@pytest.mark.slow
def test_differences_where_an_outline_crosses_pixels():
    """The light that the outline hides and uncovers is in the derivative by the velocity."""
    scene, motion = plate()
    loaded = tt.load(scene, variant=VARIANT)
    renderer = tt.TransientRenderer(loaded, ["front.to_world"], spp=2048, frequencies=FREQUENCIES)
    along = torch.tensor([1.0, 0.3, 0.5])
    weights = torch.randn(8, 8, generator=torch.Generator().manual_seed(0))

    def image(x, seed):
        moving = {"front": tt.Motion(linear=torch.tensor(motion["linear"]) + x * along)}
        out = tt.over_time(renderer, moving, HETERODYNE, seed=seed)
        return 1e4 * (weights * (0.3 * out.phasor.real + 0.8 * out.phasor.imag)).mean()

    def gradient(seed):
        x = torch.tensor(0.0, requires_grad=True)
        return float(torch.autograd.grad(image(x, seed), x)[0])

    with torch.no_grad():
        found = finite_differences.central_difference(
            lambda x, seed: float(image(torch.tensor(float(x)), seed)), 0.0, 1.0, range(12)
        )
    reverse = np.array([gradient(seed) for seed in range(100, 112)])
    error = np.hypot(float(found.standard_error), reverse.std(ddof=1) / 12**0.5)
    assert abs(reverse.mean() - float(found.mean)) < 3 * error
    assert error < 0.1 * abs(float(found.mean))


def test_velocities_of_a_rolling_shutter_by_vmap_and_reverse_mode():
    """Of several velocities at once, as of each; gradients of parameters of the renderer too."""
    settings = {"spp": 8, "grad_seed": "same", "boundary": False}
    renderer = tt.TransientRenderer(tt.load(make_room(), variant=VARIANT), ["box.to_world"], **settings)
    shutter = tt.RollingShutter(2e-3, poses=2)

    def light(velocity):
        out = tt.over_time(renderer, {"box": tt.Motion(linear=velocity)}, shutter, seed=0)
        return (out.transient * torch.linspace(0, 1, 24)[:, None, None]).sum()

    several = torch.tensor([[1.0, 0.0, 2.0], [0.0, -1.0, 3.0]])
    together = torch.func.vmap(torch.func.grad(light))(several)
    for velocity, found in zip(several, together, strict=True):
        leaf = velocity.clone().requires_grad_(True)
        alone, own = torch.autograd.grad(light(leaf), (leaf, renderer.values["box.to_world"]))
        torch.testing.assert_close(found, alone, rtol=1e-3, atol=1e-4)
        assert bool(alone.ne(0).all()) and bool(own[:3, 3].ne(0).all())
