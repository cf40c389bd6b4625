"""Degrees and angle of polarization where they have no derivative, and polarization cameras there: in the dark, without
polarization, with full polarization, and with noise beyond it.
"""

import pytest
import torch

from support.sweeps import together
from torchtransient import stokes as st
from torchtransient.sensing import (
    Compose,
    PixelElectronics,
    PolarizationMosaic,
    mosaic_rows,
    project_physical,
    unphysical_part,
)

FUNCTIONS = {
    "dop": st.degree_of_polarization,
    "dolp": st.degree_of_linear_polarization,
    "docp": st.degree_of_circular_polarization,
    "aolp": st.angle_of_linear_polarization,
    "normalized": st.normalized_components,
}
TINY = torch.finfo(torch.float32).tiny
STATES = {
    "dark": (0.0, 0.0, 0.0, 0.0),
    "negative": (-1.0, 0.5, 0.1, 0.0),
    "unpolarised": (1.0, 0.0, 0.0, 0.0),
    "circular": (1.0, 0.0, 0.0, 1.0),
    "hardly polarised": (1.0, 1e-30, -1e-30, 1e-30),
    "denormal": (TINY / 4, TINY / 8, 0.0, 0.0),
    "faint": (4 * TINY, 4 * TINY, 0.0, 0.0),
    "bright": (1e30, 1e30, 1e25, 0.0),
}


@together("state", STATES)
@together("name", FUNCTIONS)
def test_value_and_gradient_are_finite(name, state):
    """Guards against sqrt'(0), 0 / 0 and atan2'(0, 0), and against a torch.where that hides them in the value but not
    in the gradient. Squares of 1e-30 and 1e30 leave the range of float32: they must not be formed.
    """
    s = torch.tensor(STATES[state]).requires_grad_()
    value = FUNCTIONS[name](s, 0)
    assert bool(torch.isfinite(value).all())
    value.sum().backward()
    assert bool(torch.isfinite(s.grad).all()), s.grad
    if state in ("dark", "negative", "denormal") and name != "aolp":
        assert not s.grad.any()
        assert not value.any()


def test_small_numbers_keep_their_digits():
    """Values do not depend on the scale of the light, down to the smallest normal numbers."""
    s = torch.tensor([5.0, 1.0, 2.0, 3.0])
    for scale in (1e-37, 1e-20, 1.0, 1e30):
        for function in FUNCTIONS.values():
            torch.testing.assert_close(function(s * scale, 0), function(s, 0), rtol=1e-5, atol=0)


def test_hardly_polarised_light_has_the_right_slope():
    """Just beside the kink the slope is one, not zero and not infinite."""
    for s1 in (1e-30, -1e-30):
        s = torch.tensor([1.0, s1, 0.0, 0.0], requires_grad=True)
        st.degree_of_polarization(s, 0).backward()
        assert s.grad[1].item() == pytest.approx(1.0 if s1 > 0 else -1.0, rel=1e-6)


# ------------------------------------------------------------------------------------------------------------ cameras

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
        st.degree_of_linear_polarization(found, -5),
        st.angle_of_linear_polarization(found, -5),
        st.normalized_components(found, -5),
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


def test_noise_makes_degrees_above_one():
    """Few photons: degrees of polarization above one come out as they are, and the projection ends at one."""
    mosaic = PolarizationMosaic.polarsens()
    s = 3 * flat("horizontal", torch.float64)
    raw = Compose([mosaic, PixelElectronics(read_noise_e=2.0)]).sample(s, torch.Generator().manual_seed(0))
    found = mosaic.stokes(raw)
    assert float(st.degree_of_linear_polarization(found, -5).max()) > 1
    mended = st.degree_of_linear_polarization(project_physical(found), -5)
    assert float(mended.max()) <= 1 + 1e-12
