"""Chains: gradient policies, renderer outputs, data sets, adjoints."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import pytest
import torch

from torchtransient.axes import FrequencyAxis, TimeAxis
from torchtransient.errors import ArgumentError, ShapeError, UnitError
from torchtransient.sensing import (
    Compose,
    GaussianResponse,
    ImpulseResponse,
    ItofCorrelation,
    PixelElectronics,
    ScoreFunction,
    ShotNoise,
    SynchronousSPAD,
    adjoint,
    linearity_error,
    sine_code,
)

AXIS = TimeAxis(1.0, 0.1, 32)


@dataclass
class Rendered:
    """What a renderer returns, as far as chains look at it."""

    transient: Any = None
    steady: Any = None
    phasor: Any = None
    axis: Any = None
    frequencies: Any = None


@dataclass
class Gated(Rendered):
    """The same of a gated film."""

    gated: Any = None
    gates: Any = None


def chain(grad="expected", axis=AXIS):
    return Compose(
        [
            ImpulseResponse(GaussianResponse(300e-12), axis),
            ItofCorrelation(sine_code(4), 50e6, axis, contrast=0.8, background_e=10.0, electrons_per_unit=100.0),
            PixelElectronics(read_noise_e=2.0),
        ],
        grad=grad,
    )


def light(*lead):
    return torch.rand(*lead, 1, 32, 2, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize("policy", ["gaussian", "straight_through", "score"])
def test_policy_reaches_every_stage(policy):
    response, taps, electronics = chain().stages
    sensor = Compose([Compose([response]), taps, Compose([Compose([electronics])])]).set_grad(policy)
    assert {m.grad for m in sensor.modules() if hasattr(m, "grad") and isinstance(m.grad, str)} == {policy}
    with pytest.raises(ArgumentError, match="expected"):
        sensor.set_grad("none")


def test_score_through_a_chain():
    """Gradient of the expected square of a tap of noisy electrons, against the closed form."""
    sensor = chain("score")
    scale = torch.ones(60_000, dtype=torch.float64, requires_grad=True)
    x = torch.full((1, 1, 32, 1, 1), 0.02, dtype=torch.float64) * scale.reshape(-1, 1, 1, 1, 1)
    with ScoreFunction() as score:
        y = sensor(x, generator=torch.Generator().manual_seed(0))
        losses = y.square().sum((-4, -3, -2, -1))
    score.surrogate(losses, baseline="leave_one_out").sum().backward()
    m = sensor.expected(x[:1]).flatten().detach()
    slope = m - 10.0 / 4  # what grows with the scale
    exact = float(((2 * m + 1) * slope).sum())  # E y^2 = m^2 + m + read^2
    assert abs(float(scale.grad.mean()) - exact) < 5 * float(scale.grad.std()) / 60_000**0.5


def test_takes_a_renderer_output():
    sensor, x = chain(), light()
    assert torch.equal(sensor(Rendered(transient=x, axis=AXIS)), sensor(x))
    for other in (TimeAxis(1.0, 0.1, 33), TimeAxis(1.0, 0.11, 32), TimeAxis(1.2, 0.1, 32)):
        with pytest.raises(UnitError, match="axis of stage"):
            sensor(Rendered(transient=x, axis=other))
    with pytest.raises(UnitError, match="axis of stage"):
        Compose([ImpulseResponse(GaussianResponse(3e-10), bin_width_s=1e-12)])(Rendered(transient=x, axis=AXIS))
    with pytest.raises(ShapeError, match="expected a tensor"):
        sensor([1, 2])


def test_takes_a_phasor_image():
    sensor = Compose([ItofCorrelation(sine_code(4), 50e6, AXIS), PixelElectronics()])
    frequencies = FrequencyAxis.from_hertz([50e6])
    z = torch.tensor([[[[0.3 - 0.4j]]]], dtype=torch.complex64)
    y = sensor(Rendered(phasor=z, steady=torch.full((1, 1, 1), 2.0), frequencies=frequencies))
    torch.testing.assert_close(y.flatten(), (2 + torch.tensor([0.3, 0.4, -0.3, -0.4])) / 4)
    with pytest.raises(ShapeError, match=r"phasor image, which ItofCorrelation alone takes.*time_axis="):
        chain()(Rendered(phasor=z, steady=torch.ones(1, 1, 1), frequencies=frequencies))
    with pytest.raises(ShapeError, match="not in a chain"):
        Compose([sensor])(Rendered(phasor=z, steady=torch.ones(1, 1, 1), frequencies=frequencies))


@pytest.mark.parametrize("length", [(), (3,)])
def test_adjoint(length):
    """<A x, y> = <x, A^T y>, the offset of the background left out."""
    sensor, x = chain(), light(*length)
    offset = sensor.expected(torch.zeros_like(x))
    ax = sensor.expected(x) - offset
    y = torch.rand(ax.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    back = adjoint(sensor, y, x.shape)
    assert back.shape == x.shape
    torch.testing.assert_close((ax * y).sum(), (x * back).sum(), rtol=1e-12, atol=0)
    with torch.no_grad():
        torch.testing.assert_close(adjoint(sensor, y, x.shape), back)
    assert linearity_error(sensor, x) < 1e-12
    saturating = Compose([PixelElectronics(full_well_e=0.5)])
    assert linearity_error(saturating, light()) > 0.1
    assert linearity_error(sensor, 0 * light()) == 0.0


# ------------------------------------------------------------------------------------------------ gated films


STAGES = {"spad": [SynchronousSPAD(10)], "shot": [ShotNoise()], "chain": list(chain().stages)}


@pytest.mark.parametrize("stages", STAGES.values(), ids=STAGES)
def test_gates_are_no_bins(stages):
    """A detector would take gates for moments: they are refused, whatever the stages, and the way out is said."""
    images, sensor = light(), Compose(stages)
    for output in (
        Gated(gated=images, gates=("a", "b"), steady=images.sum(-3)),
        Gated(transient=images, gates=("a", "b"), steady=images.sum(-3)),  # as outputs of earlier versions
    ):
        for run in (sensor, sensor.expected, sensor.sample):
            with pytest.raises(ShapeError, match=r"2 time gates.*GatedIntegration.*out\.gated"):
                run(output)
    # what follows a gate takes the tensor
    after = Compose([PixelElectronics(read_noise_e=2.0)])
    assert after.expected(images).shape == images.shape


def test_phasors_are_no_transient():
    with pytest.raises(UnitError, match=r"phasor.*time_axis="):
        ShotNoise()(torch.ones(1, 2, 1, 1, dtype=torch.complex64))
