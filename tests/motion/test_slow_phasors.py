"""Phasors at slow times: pulses of a radar, one after another."""

from __future__ import annotations

import math
import warnings

import pytest
import torch

import torchtransient as tt
from torchtransient.errors import PhysicsWarning
from torchtransient.scenes import look_at, scale

TIMES, FREQUENCIES = (-0.3, 0.0, 0.2), (0.0, 0.4, 1.0)
SPEED = 1.37


def scene(variant="llvm_ad_mono", **film):
    """A wall that comes nearer, seen and lit from 3 m."""
    kind = {"type": "transient_hdr_film", "width": 2, "height": 2, "rfilter": {"type": "box"}} | film
    description = {
        "type": "scene", "integrator": {"type": "transient_path", "max_depth": 2},
        "sensor": {"type": "perspective", "fov": 0.2, "to_world": look_at([0, 0, 3], [0, 0, 0]), "film": kind},
        "lamp": {"type": "point", "position": [0, 0, 3], "intensity": 1.0},
        "wall": {
            "type": "rectangle", "to_world": scale(4.0), "bsdf": {"type": "diffuse", "reflectance": 0.5},
            "velocity": {"type": "rigid_motion", "linear": [0, 0, SPEED]},
        },
    }  # fmt: skip
    return tt.load(description, variant=variant)


@pytest.mark.parametrize("variant", ["llvm_ad_mono", "llvm_ad_mono_polarized"])
def test_the_phase_of_each_pulse(variant):
    """That of a length of `6 - 2 v t`, and at t = 0 that of a phasor film."""
    moving = scene(variant)
    out = tt.render(moving, frequencies=FREQUENCIES, slow_times=TIMES, spp=16, seed=0)
    still = tt.render(moving, frequencies=FREQUENCIES, spp=16, seed=0).phasor
    torch.testing.assert_close(out.slow_phasor[..., 1, :, :, :], still, rtol=1e-5, atol=1e-6 * float(still.abs().max()))
    turns = torch.tensor([[f * (6 - 2 * SPEED * t) for f in FREQUENCIES] for t in TIMES], dtype=torch.float64)
    expected = torch.polar(torch.ones_like(turns), -2 * math.pi * turns)[..., None, None]
    light = out.steady[0] if out.polarized else out.steady
    found = out.slow_phasor[0] if out.polarized else out.slow_phasor
    # The view is 5 mm wide: lengths differ by 2e-5 m.
    torch.testing.assert_close((found / light[:, None, None]).to(torch.complex128), expected.expand_as(found).clone(),
                               rtol=0, atol=2e-4)  # fmt: skip


def test_derivative_by_the_velocity():
    key = "wall.velocity.linear"
    renderer = tt.TransientRenderer(scene(), [key], frequencies=FREQUENCIES, slow_times=TIMES, spp=16)
    out = renderer(seed=0)
    (out.slow_phasor[0, 0, 2] / out.steady[0]).imag.mean().backward()
    # exp(-2 pi i (6 - 2 v t)) by v at t = -0.3.
    phase = 2 * math.pi * (6 - 2 * SPEED * TIMES[0])
    expected = math.cos(phase) * 2 * math.pi * 2 * TIMES[0]
    gradient = renderer.values[key].grad
    assert abs(float(gradient[2]) - expected) < 1e-3 and gradient[:2].abs().max() < 1e-2


def test_motions_that_count_twice():
    """Of an exposure over poses that move on with the velocity that the phasors follow; frames do not."""
    renderer = tt.TransientRenderer(scene(), ["wall.to_world"], frequencies=FREQUENCIES, slow_times=TIMES, spp=4)
    moving = {"wall": tt.Motion(linear=(0.0, 0.0, SPEED))}
    with pytest.warns(PhysicsWarning, match="'wall' has a velocity"):
        tt.over_time(renderer, moving, tt.Exposure(0.1), seed=0)
    with warnings.catch_warnings():
        warnings.simplefilter("error", PhysicsWarning)
        frames = tt.over_time(renderer, moving, tt.Frames([0.0, 0.1]), seed=0).slow_phasor
    # A frame at 0.1 s has at its time 0 the phase that the first frame has at 0.1 s, and so on.
    lengths = torch.tensor([6 - 2 * SPEED * (frame + t) for frame in (0.0, 0.1) for t in TIMES]).reshape(2, -1)
    found = frames[:, 0, :, 1].mean((-2, -1))
    expected = torch.polar(torch.ones_like(lengths), -2 * math.pi * FREQUENCIES[1] * lengths)
    torch.testing.assert_close(found / found.abs(), expected, rtol=0, atol=1e-3)
