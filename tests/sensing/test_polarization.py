"""Analyzers, mosaics and Stokes vectors back from them."""

from __future__ import annotations

import math

import pytest
import torch

from torchtransient import sensing
from torchtransient import stokes as light


def vectors(*shape, seed=0):
    """Physical Stokes vectors (*shape[:-4], 4, C, T, H, W)."""
    g = torch.Generator().manual_seed(seed)
    direction = torch.randn(*shape[:-4], 3, *shape[-4:], generator=g, dtype=torch.float64)
    direction = direction / direction.norm(dim=-5, keepdim=True)
    degree = torch.rand(*shape[:-4], 1, *shape[-4:], generator=g, dtype=torch.float64)
    power = 0.5 + torch.rand(*shape[:-4], 1, *shape[-4:], generator=g, dtype=torch.float64)
    return torch.cat([power, power * degree * direction], dim=-5)


def test_malus():
    """Light polarized at 0 behind an analyser at a: cos^2 a, and the extinction when crossed."""
    s = torch.tensor([1.0, 1.0, 0.0, 0.0], dtype=torch.float64).reshape(4, 1, 1, 1, 1)
    angles = torch.arange(0, 181, 15).tolist()
    ideal = sensing.analyze(s, sensing.linear_analyzers(angles)).flatten()
    cosine = torch.tensor([math.cos(math.radians(a)) ** 2 for a in angles], dtype=torch.float64)
    torch.testing.assert_close(ideal, cosine, rtol=0, atol=1e-12)
    real = sensing.analyze(s, sensing.linear_analyzers([0.0, 90.0], extinction_ratio=300.0, transmission=0.8)).flatten()
    torch.testing.assert_close(real, torch.tensor([0.8, 0.8 / 300], dtype=torch.float64))


def test_rows_are_those_of_mueller_matrices():
    """A quarter-wave plate at 45 degrees before a horizontal polarizer passes one handedness."""
    plate = light.linear_retarder(torch.tensor(math.pi / 4, dtype=torch.float64), math.pi / 2)
    chain = light.linear_polarizer(torch.tensor(0.0, dtype=torch.float64)) @ plate.double()
    rows = sensing.circular_analyzers()
    assert min(float((chain[0] - row).abs().max()) for row in rows) < 1e-7
    right = torch.tensor([1.0, 0.0, 0.0, 1.0], dtype=torch.float64).reshape(4, 1, 1, 1, 1)
    found = sensing.analyze(right, sensing.circular_analyzers(200.0)).flatten()
    torch.testing.assert_close(found, torch.tensor([1.0, 1 / 200], dtype=torch.float64))


@pytest.mark.parametrize("ratio", [math.inf, 300.0, 3.0])
def test_stokes_from_six_analysers(ratio):
    s = vectors(2, 1, 3, 4, 4)
    rows = torch.cat([sensing.linear_analyzers([0, 45, 90, 135], ratio), sensing.circular_analyzers(ratio)])
    torch.testing.assert_close(sensing.stokes_from(sensing.analyze(s, rows), rows), s)
    sensor = sensing.Analyzers(rows)
    torch.testing.assert_close(sensor.stokes(sensor.expected(s)), s)


def test_mosaic_gathers_the_analyser_of_every_pixel():
    s = vectors(2, 3, 2, 5, 7)
    sensor = sensing.PolarizationMosaic.polarsens(extinction_ratio=250.0)
    raw = sensor.expected(s)
    assert raw.shape == (2, 3, 2, 5, 7)
    for (i, j), angle in {(0, 0): 90.0, (0, 1): 45.0, (1, 0): 135.0, (1, 1): 0.0}.items():
        whole = sensing.analyze(s, sensing.linear_analyzers([angle], 250.0)).squeeze(-5)
        torch.testing.assert_close(raw[..., i::2, j::2], whole[..., i::2, j::2])


def test_constant_light_comes_back_exactly():
    s = vectors(1, 1, 2, 1, 1).expand(1, 4, 1, 2, 6, 9)
    s = torch.cat([s[:, :3], torch.zeros_like(s[:, 3:])], 1)
    sensor = sensing.PolarizationMosaic.polarsens(100.0)
    torch.testing.assert_close(sensor.stokes(sensor.expected(s)), s)


def test_demosaic_is_linear_interpolation():
    y, x = torch.meshgrid(torch.arange(8.0), torch.arange(10.0), indexing="ij")
    plane = (3 + 0.5 * y - 0.25 * x).double().reshape(1, 1, 8, 10)
    images = sensing.demosaic(plane)
    assert images.shape == (4, 1, 1, 8, 10)
    for k, image in enumerate(images):
        torch.testing.assert_close(image[..., 2:-2, 2:-2], plane[..., 2:-2, 2:-2])
        i, j = divmod(k, 2)
        torch.testing.assert_close(image[..., i::2, j::2], plane[..., i::2, j::2])
    torch.testing.assert_close(sensing.demosaic(torch.ones(1, 1, 7, 5), (3, 2)), torch.ones(6, 1, 1, 7, 5))


def test_noisy_camera_measures_the_angle():
    """Deviation of the angle in a flat field: S1 and S2 have the variance S0, hence sigma = 1 / (2 DoLP sqrt S0)."""
    count, s0, degree = 4000, 20_000.0, 0.5
    angle = torch.tensor(0.3, dtype=torch.float64)
    s = torch.stack([torch.ones_like(angle), degree * torch.cos(2 * angle), degree * torch.sin(2 * angle), 0 * angle])
    s = (s0 * s).reshape(4, 1, 1, 1, 1).expand(4, 1, 1, 2 * count, 2)
    mosaic = sensing.PolarizationMosaic(sensing.mosaic_rows(((0, 45), (90, 135))))
    raw = sensing.Compose([mosaic, sensing.PixelElectronics()]).sample(s, torch.Generator().manual_seed(0))
    blocks = torch.stack([raw[..., 0::2, 0:1], raw[..., 0::2, 1:2], raw[..., 1::2, 0:1], raw[..., 1::2, 1:2]])
    found = light.angle_of_linear_polarization(sensing.stokes_from(blocks, mosaic.rows.flatten(0, 1)), -5)
    assert abs(float(found.std()) * 2 * degree * math.sqrt(s0) - 1) < 0.05  # its standard error is 1.1 %
    assert abs(float(found.mean()) - 0.3) < 5 * float(found.std()) / count**0.5


def test_physicality():
    good, bad = vectors(1, 1, 3, 3), vectors(1, 1, 3, 3) * torch.tensor([1.0, 4.0, 4.0, 4.0]).reshape(4, 1, 1, 1, 1)
    assert float(sensing.unphysical_part(good).abs().max()) == 0.0
    assert torch.equal(sensing.project_physical(good), good)
    fixed = sensing.project_physical(bad)
    assert float(sensing.unphysical_part(fixed).max()) < 1e-12
    # The nearest point: the step is orthogonal to the point reached, and no random physical vector is closer.
    step = bad - fixed
    assert float((step * fixed).sum(0).abs().max()) < 1e-12
    for seed in range(20):
        other = vectors(1, 1, 3, 3, seed=seed + 1) * 2
        assert bool(((bad - other).norm(dim=0) >= step.norm(dim=0) - 1e-12).all())
    opposite = torch.tensor([-1.0, 0.2, 0.0, 0.0], dtype=torch.float64)
    assert float(sensing.project_physical(opposite, dim=0).abs().max()) == 0.0
    mixed = torch.cat([good, bad], dim=-1).requires_grad_()
    assert torch.autograd.gradcheck(sensing.project_physical, mixed)
    assert torch.autograd.gradcheck(sensing.unphysical_part, mixed)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_crossed_analysers_have_their_slope(dtype):
    """Whatever rounding leaves of light that no part of passes."""
    angles = torch.arange(0.0, 180, 10, dtype=torch.float64)
    for angle, row in zip(angles.tolist(), sensing.linear_analyzers(angles.tolist()), strict=True):
        turn = math.radians(2 * (angle + 90))
        crossed = torch.tensor([1.0, math.cos(turn), math.sin(turn), 0.0], dtype=dtype).view(4, 1, 1, 1, 1)
        for camera in (sensing.Analyzers(row[None]), sensing.PolarizationMosaic(row.view(1, 1, 4))):
            slope = torch.autograd.functional.jacobian(camera.expected, crossed)
            torch.testing.assert_close(slope.flatten(), row.to(dtype))
