"""Speeds from the beat of a heterodyne camera, against exposures that are integrated numerically."""

from __future__ import annotations

import functools
import math

import numpy as np
import pytest
import torch

from torchtransient.sensing import heterodyne_speed
from torchtransient.units import SPEED_OF_LIGHT

HERTZ, EXPOSURE_S = (60e6, 20e6), 5e-3


def exposures(speed, beats, brightens=0.0):
    """Phasors (1, 2, 1, 1) with and without a beat of what comes nearer, and gets brighter by a share a second."""
    x, g = np.polynomial.legendre.leggauss(200)
    t = EXPOSURE_S / 2 * x
    turns = np.array(HERTZ)[:, None] * (-2 * (2.0 - speed * t) / SPEED_OF_LIGHT)
    light = np.exp(2j * math.pi * turns) * (1 + brightens * t) * g / 2
    both = (light * np.exp(2j * math.pi * beats * t / EXPOSURE_S)).sum(1), light.sum(1)
    return [torch.from_numpy(z).reshape(1, 2, 1, 1) for z in both]


@pytest.mark.parametrize("beats", [1, 2, 3])
@pytest.mark.parametrize("speed", [-200.0, -1.5, 0.0, 3.0, 1000.0])
def test_speeds_of_one_surface(speed, beats):
    found = heterodyne_speed(*exposures(speed, beats), HERTZ, duration_s=EXPOSURE_S, beats=beats)
    torch.testing.assert_close(found, torch.full_like(found, speed), rtol=1e-9, atol=1e-9)


def test_brightness_has_no_part():
    """To first order: of 3 m/s and a hundredth of brightness in an exposure, a product of both is left."""
    for brightens in (-2.0, 2.0):
        found = heterodyne_speed(*exposures(3.0, 1, brightens), HERTZ, duration_s=EXPOSURE_S)
        torch.testing.assert_close(found, torch.full_like(found, 3.0), rtol=1e-2, atol=0)


def test_gradients_and_darkness():
    beat, plain = exposures(3.0, 1)
    inputs = [z.requires_grad_() for z in (beat, plain)]
    speed = functools.partial(heterodyne_speed, frequencies_hz=HERTZ, duration_s=EXPOSURE_S)
    assert torch.autograd.gradcheck(lambda b, p: speed(b, p), inputs, atol=1e-3)
    assert bool(speed(0 * beat, 0 * plain).isnan().all())


def test_dark_pixels_leave_gradients_alone():
    beat, plain = (x.to(torch.complex64) for x in exposures(3.0, 1))
    shared = torch.tensor(1.0, requires_grad=True)
    lit = torch.tensor([1.0, 0.0, 1e-20]).reshape(3, *[1] * beat.ndim)
    found = heterodyne_speed(shared * lit * beat, lit * plain, HERTZ, duration_s=EXPOSURE_S)
    torch.testing.assert_close(found[2], found[0], rtol=1e-4, atol=0)
    assert found[1].isnan().all()
    found[found.isfinite()].sum().backward()
    assert shared.grad.isfinite() and shared.grad != 0
