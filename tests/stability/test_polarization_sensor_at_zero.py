"""Polarization cameras in the dark, without polarization, with full polarization, and with noise beyond it."""

from __future__ import annotations

import pytest
import torch

from torchtransient import stokes as light
from torchtransient.errors import UnitError
from torchtransient.sensing import (
    Compose,
    PixelElectronics,
    PolarizationMosaic,
    mosaic_rows,
    project_physical,
    unphysical_part,
)

FLAT = {
    "dark": (0.0, 0.0, 0.0, 0.0),
    "unpolarized": (1.0, 0.0, 0.0, 0.0),
    "horizontal": (1.0, 1.0, 0.0, 0.0),
    "diagonal": (1.0, 0.0, -1.0, 0.0),
    "faint": (1e-30, 1e-30, 0.0, 0.0),
    "tiny": (1e-42, 0.0, 1e-42, 0.0),
}


def flat(name, dtype=torch.float32):
    return torch.tensor(FLAT[name], dtype=dtype).reshape(4, 1, 1, 1, 1).expand(4, 1, 2, 6, 6).clone()


@pytest.mark.parametrize("name", FLAT)
@pytest.mark.parametrize("ideal", [True, False])
def test_degree_and_angle_behind_a_mosaic_have_finite_gradients(name, ideal):
    sensor = PolarizationMosaic.polarsens(float("inf") if ideal else 300.0)
    s = flat(name).requires_grad_()
    found = sensor.stokes(sensor.expected(s))
    measures = (
        light.degree_of_linear_polarization(found, -5),
        light.angle_of_linear_polarization(found, -5),
        light.normalized_components(found, -5),
        project_physical(found),
        unphysical_part(found),
    )
    for value in measures:
        (gradient,) = torch.autograd.grad(value.sum(), s, retain_graph=True)
        assert bool(torch.isfinite(value).all()) and bool(torch.isfinite(gradient).all())


@pytest.mark.parametrize("name", FLAT)
@pytest.mark.parametrize("policy", ["expected", "gaussian", "straight_through"])
def test_counting_behind_crossed_analysers(name, policy):
    """Fully polarized light behind a crossed, ideal analyser is zero or rounding below it: never refused, never NaN."""
    camera = Compose([PolarizationMosaic(mosaic_rows(((0, 45), (90, 135)))), PixelElectronics()], grad=policy)
    s = (1000 * flat(name)).requires_grad_()
    y = camera(s, torch.Generator().manual_seed(0))
    y.square().sum().backward()
    assert bool(torch.isfinite(y).all()) and bool(torch.isfinite(s.grad).all())


def test_rounding_does_not_go_below_zero():
    angle = torch.linspace(0, 3.2, 4000)
    s = torch.stack([torch.ones_like(angle), torch.cos(2 * angle), torch.sin(2 * angle), torch.zeros_like(angle)])
    raw = PolarizationMosaic(mosaic_rows(((0, 45), (90, 135)))).expected(s.reshape(4, 1, 1, 2, -1))
    assert float(raw.min()) >= 0.0


def test_light_that_cannot_be_is_refused_by_the_counting_and_mended_by_the_projection():
    s = torch.tensor([1.0, 3.0, 0.0, 0.0]).reshape(4, 1, 1, 1, 1).expand(4, 1, 1, 2, 2)
    camera = Compose([PolarizationMosaic.polarsens(), PixelElectronics()], grad="straight_through")
    with pytest.raises(UnitError, match="expected finite means >= 0"):
        camera(s)
    assert bool(torch.isfinite(camera(project_physical(s))).all())


def test_noise_makes_degrees_above_one():
    """Few photons: degrees of polarization above one come out as they are, and the projection ends at one."""
    mosaic = PolarizationMosaic.polarsens()
    s = 3 * flat("horizontal", torch.float64)
    raw = Compose([mosaic, PixelElectronics(read_noise_e=2.0)]).sample(s, torch.Generator().manual_seed(0))
    found = mosaic.stokes(raw)
    assert float(light.degree_of_linear_polarization(found, -5).max()) > 1
    mended = light.degree_of_linear_polarization(project_physical(found), -5)
    assert float(mended.max()) <= 1 + 1e-12
