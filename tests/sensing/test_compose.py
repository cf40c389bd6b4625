"""Chains: gradient policies, renderer outputs, data sets, adjoints."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

from torchtransient import sensing
from torchtransient.axes import FrequencyAxis, TimeAxis
from torchtransient.errors import ArgumentError, ShapeError, UnitError

AXIS = TimeAxis(1.0, 0.1, 32)


def rendered(**given):
    """What a renderer returns, as far as chains look at it."""
    return SimpleNamespace(**dict.fromkeys(("transient", "steady", "phasor", "axis", "frequencies")) | given)


def chain(grad="expected", axis=AXIS):
    return sensing.Compose(
        [
            sensing.ImpulseResponse(sensing.GaussianResponse(300e-12), axis),
            sensing.ItofCorrelation(
                sensing.sine_code(4), 50e6, axis, contrast=0.8, background_e=10.0, electrons_per_unit=100.0
            ),
            sensing.PixelElectronics(read_noise_e=2.0),
        ],
        grad=grad,
    )


def light(*lead):
    return torch.rand(*lead, 1, 32, 2, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize("policy", ["gaussian", "straight_through", "score"])
def test_policy_reaches_every_stage(policy):
    response, taps, electronics = chain().stages
    sensor = sensing.Compose(
        [sensing.Compose([response]), taps, sensing.Compose([sensing.Compose([electronics])])]
    ).set_grad(policy)
    assert {m.grad for m in sensor.modules() if hasattr(m, "grad") and isinstance(m.grad, str)} == {policy}
    with pytest.raises(ArgumentError, match="expected"):
        sensor.set_grad("none")


def test_score_through_a_chain():
    """Gradient of the expected square of a tap of noisy electrons, against the closed form."""
    sensor = chain("score")
    scale = torch.ones(60_000, dtype=torch.float64, requires_grad=True)
    x = torch.full((1, 1, 32, 1, 1), 0.02, dtype=torch.float64) * scale.reshape(-1, 1, 1, 1, 1)
    with sensing.ScoreFunction() as score:
        y = sensor(x, generator=torch.Generator().manual_seed(0))
        losses = y.square().sum((-4, -3, -2, -1))
    score.surrogate(losses, baseline="leave_one_out").sum().backward()
    m = sensor.expected(x[:1]).flatten().detach()
    slope = m - 10.0 / 4  # what grows with the scale
    exact = float(((2 * m + 1) * slope).sum())  # E y^2 = m^2 + m + read^2
    assert abs(float(scale.grad.mean()) - exact) < 5 * float(scale.grad.std()) / 60_000**0.5


def test_takes_a_renderer_output():
    sensor, x = chain(), light()
    assert torch.equal(sensor(rendered(transient=x, axis=AXIS)), sensor(x))
    for other in (TimeAxis(1.0, 0.1, 33), TimeAxis(1.0, 0.11, 32), TimeAxis(1.2, 0.1, 32)):
        with pytest.raises(UnitError, match="axis of stage"):
            sensor(rendered(transient=x, axis=other))
    with pytest.raises(UnitError, match="axis of stage"):
        sensing.Compose([sensing.ImpulseResponse(sensing.GaussianResponse(3e-10), bin_width_s=1e-12)])(
            rendered(transient=x, axis=AXIS)
        )
    with pytest.raises(ShapeError, match="expected a tensor"):
        sensor([1, 2])


def test_takes_a_phasor_image():
    sensor = sensing.Compose([sensing.ItofCorrelation(sensing.sine_code(4), 50e6, AXIS), sensing.PixelElectronics()])
    frequencies = FrequencyAxis.from_hertz([50e6])
    z = torch.tensor([[[[0.3 - 0.4j]]]], dtype=torch.complex64)
    y = sensor(rendered(phasor=z, steady=torch.full((1, 1, 1), 2.0), frequencies=frequencies))
    torch.testing.assert_close(y.flatten(), (2 + torch.tensor([0.3, 0.4, -0.3, -0.4])) / 4)
    with pytest.raises(ShapeError, match=r"phasor image, which ItofCorrelation alone takes.*time_axis="):
        chain()(rendered(phasor=z, steady=torch.ones(1, 1, 1), frequencies=frequencies))
    with pytest.raises(ShapeError, match="not in a chain"):
        sensing.Compose([sensor])(rendered(phasor=z, steady=torch.ones(1, 1, 1), frequencies=frequencies))


@pytest.mark.parametrize("length", [(), (3,)])
def test_adjoint(length):
    """<A x, y> = <x, A^T y>, the offset of the background left out."""
    sensor, x = chain(), light(*length)
    offset = sensor.expected(torch.zeros_like(x))
    ax = sensor.expected(x) - offset
    y = torch.rand(ax.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    back = sensing.adjoint(sensor, y, x.shape)
    assert back.shape == x.shape
    torch.testing.assert_close((ax * y).sum(), (x * back).sum(), rtol=1e-12, atol=0)
    with torch.no_grad():
        torch.testing.assert_close(sensing.adjoint(sensor, y, x.shape), back)
    assert sensing.linearity_error(sensor, x) < 1e-12
    saturating = sensing.Compose([sensing.PixelElectronics(full_well_e=0.5)])
    assert sensing.linearity_error(saturating, light()) > 0.1
    assert sensing.linearity_error(sensor, 0 * light()) == 0.0


# ------------------------------------------------------------------------------------------------ gated films


STAGES = {"spad": [sensing.SynchronousSPAD(10)], "shot": [sensing.ShotNoise()], "chain": list(chain().stages)}


@pytest.mark.parametrize("stages", STAGES.values(), ids=STAGES)
def test_gates_are_no_bins(stages):
    """A detector would take gates for moments: they are refused, whatever the stages, and the way out is said."""
    images, sensor = light(), sensing.Compose(stages)
    for run in (sensor, sensor.expected, sensor.sample):
        with pytest.raises(ShapeError, match=r"holds gated, steady, no transient.*out\.gated"):
            run(rendered(gated=images, gates=("a", "b"), steady=images.sum(-3)))
    # what follows a gate takes the tensor
    after = sensing.Compose([sensing.PixelElectronics(read_noise_e=2.0)])
    assert after.expected(images).shape == images.shape


def test_phasors_are_no_transient():
    with pytest.raises(UnitError, match=r"phasor.*time_axis="):
        sensing.ShotNoise()(torch.ones(1, 2, 1, 1, dtype=torch.complex64))
