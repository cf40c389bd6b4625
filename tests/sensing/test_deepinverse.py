"""Sensors as physics of DeepInverse: what its two classes are asked for, with stand-ins of them."""

from __future__ import annotations

import sys
import types

import pytest
import torch

from torchtransient import TimeAxis, sensing
from torchtransient.errors import MissingPackageError, ShapeError, UnitError

AXIS = TimeAxis.from_seconds(0.0, 1e-10, 12)
MODULE = "torchtransient.sensing.deepinverse"


class Physics(torch.nn.Module):
    pass


class LinearPhysics(Physics):
    def __init__(self, img_size=None, **keywords):
        super().__init__()
        self.img_size, self.keywords = img_size, keywords


@pytest.fixture
def deepinv(monkeypatch):
    package, physics = types.ModuleType("deepinv"), types.ModuleType("deepinv.physics")
    physics.Physics, physics.LinearPhysics = Physics, LinearPhysics
    package.physics = physics
    monkeypatch.setitem(sys.modules, "deepinv", package)
    monkeypatch.setitem(sys.modules, "deepinv.physics", physics)
    forget()
    yield
    forget()


def forget():
    """The module is imported anew, with whatever package is there."""
    sys.modules.pop(MODULE, None)
    vars(sys.modules["torchtransient.sensing"]).pop("deepinverse", None)


def light(seed=0):
    return torch.rand(2, 1, 12, 2, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def camera(**keywords):
    return sensing.ItofCorrelation(sensing.sine_code(3), 2e9, AXIS, background_e=5.0, **keywords)


def test_a_linear_sensor(deepinv):
    """A is the mean less that of the dark, its transpose exact, and the measurement has the dark taken off."""
    physics = sensing.deepinv_physics(camera(), (1, 12, 2, 3))
    assert isinstance(physics, LinearPhysics) and physics.img_size == (1, 12, 2, 3)
    x, y = light(), torch.rand(2, 1, 3, 2, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    ours = camera()
    torch.testing.assert_close(physics.A(x), ours.expected(x) - 5 / 3)
    torch.testing.assert_close(physics.offset(x), torch.full_like(y, 5 / 3))
    torch.testing.assert_close((physics.A(x) * y).sum(), (x * physics.A_adjoint(y)).sum())
    torch.testing.assert_close(physics(x), ours.expected(x) - 5 / 3)
    noisy = sensing.deepinv_physics(sensing.ShotNoise(grad="straight_through"), (1, 12, 2, 3))
    drawn = noisy(10 * x, generator=torch.Generator().manual_seed(2))
    assert torch.equal(drawn, sensing.poisson(10 * x, torch.Generator().manual_seed(2)))


def test_ambient_light_and_dark_counts_are_the_offset(deepinv):
    """Of 0.25 x 2e6 ambient and 4e5 dark counts a second, in bins of 0.1 ns: 9e-5 per bin; the gain by hand."""
    optics = sensing.Optics(solid_angle_sr=0.5, pixel_area_m2=1e-10)
    ambient = torch.nn.Parameter(torch.tensor(2e6, dtype=torch.float64))
    budget = sensing.PhotonBudget(
        optics, pulse_energy_j=1e-9, wavelength_m=905e-9, repetition_rate_hz=1e7, cycles=100, ambient_rate_hz=ambient,
        dark_count_rate_hz=4e5, quantum_efficiency=0.25, axis=AXIS,
    )  # fmt: skip
    physics = sensing.deepinv_physics(budget, (1, 12, 2, 3))
    x = light()
    gain = 0.25 * 1e-9 * 0.5 * 1e-10 * 905e-9 / (6.62607015e-34 * 299792458.0)
    torch.testing.assert_close(physics.A(x), gain * x, rtol=1e-12, atol=1e-16)
    assert physics.offset().shape == (1, 1, 12, 2, 3)
    torch.testing.assert_close(physics.offset().double(), torch.full((1, 1, 12, 2, 3), 9e-5).double())
    torch.testing.assert_close(physics.A(x) + physics.offset(x), sensing.deepinv_physics(budget).A(x))
    # a background that is learnt is no part of A, and all of the offset
    (of_offset,) = torch.autograd.grad(physics.offset(x).sum(), ambient)
    torch.testing.assert_close(float(of_offset), x.numel() * 0.25e-10)
    (of_linear,) = torch.autograd.grad(physics.A(x).sum(), ambient)
    assert abs(float(of_linear)) < 1e-12 * x.numel() * 0.25e-10


def test_a_sensor_that_is_not_linear(deepinv):
    """A is the mean and A_vjp the transpose of its derivative, which can be differentiated where that is asked for."""
    spad = sensing.SynchronousSPAD(7)
    with pytest.raises(UnitError, match=r"linear sensor for img_size=\(1, 12, 2, 3\), got a deviation"):
        sensing.deepinv_physics(spad, (1, 12, 2, 3))
    physics = sensing.deepinv_physics(spad)
    assert isinstance(physics, Physics) and not isinstance(physics, LinearPhysics)
    x, v = light(), light(1)
    torch.testing.assert_close(physics.A(x), spad.expected(x))
    (wanted,) = torch.autograd.functional.vjp(spad.expected, x, v)[1:]
    found = physics.A_vjp(x, v)
    torch.testing.assert_close(found, wanted)
    assert not found.requires_grad and not x.requires_grad
    for leaf in (x.clone().requires_grad_(), v.clone().requires_grad_()):
        given = (leaf, v) if torch.equal(leaf, x) else (x, leaf)
        onwards = physics.A_vjp(*given)
        assert onwards.requires_grad
        assert bool((torch.autograd.grad(onwards.square().sum(), leaf)[0] != 0).any())
        with torch.no_grad():
            assert not physics.A_vjp(*given).requires_grad
    assert torch.equal(physics(x, generator=torch.Generator().manual_seed(0)), spad.expected(x))


def test_sizes_that_are_none(deepinv):
    with pytest.raises(ShapeError, match=r"LinearSensorPhysics: expected img_size \(C, T, H, W\), got \(12, 2, 3\)"):
        sensing.deepinv_physics(camera(), (12, 2, 3))


def test_without_the_package(monkeypatch):
    forget()
    monkeypatch.setitem(sys.modules, "deepinv", None)
    with pytest.raises(MissingPackageError, match=r"pip install 'torchtransient\[deepinv\]'"):
        sensing.deepinv_physics(camera())
