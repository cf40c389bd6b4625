"""Pixel electronics: every noise against its closed form, saturation against sampling."""

from __future__ import annotations

import math

import pytest
import torch

from torchtransient import sensing
from torchtransient.errors import UnitError
from torchtransient.sensing import PixelElectronics, ScoreFunction, fixed_pattern, ktc_noise

COUNT = 200_000


def pixels(mean):
    return torch.full((1, 1, 1, COUNT), mean, dtype=torch.float64)


def drawn(mean, **parts):
    return PixelElectronics(**parts).sample(pixels(mean), torch.Generator().manual_seed(1))


def test_ktc_noise():
    assert abs(ktc_noise(10e-15, 300.0) - 40.2) < 0.05
    with pytest.raises(UnitError, match="expected"):
        ktc_noise(10.0)  # femtofarads given as farads


@pytest.mark.parametrize("m", [-4.0, 0.0, 3.0, 9.0, 14.0, 40.0])
def test_clipped_normal(m):
    """A charge with read noise of 2 electrons in a converter from 0 to 15, against quadrature over the density."""
    x = torch.linspace(-12, 12, 400_001, dtype=torch.float64)
    p = torch.exp(-0.5 * x * x)
    values = (m + math.sqrt(4 + 1e-4) * x).clamp(0, 15)
    pixel = PixelElectronics(shot_noise=False, read_noise_e=2.0, gain_e_per_dn=1.0, bits=4)
    assert float(pixel.expected(light(m))) == pytest.approx(float((values * p).sum() / p.sum()), abs=1e-9)


def test_means_have_gradients_at_every_limit():
    pixel = PixelElectronics(full_well_e=12.0, read_noise_e=1.5, excess_noise=1.2, gain_e_per_dn=0.5, bits=4)
    assert torch.autograd.gradcheck(pixel.expected, light(0.3, 7.4, 9.9, 11.9, 30.0).requires_grad_())
    assert torch.autograd.gradcheck(pixel.variance, light(0.3, 7.4, 9.9, 11.9, 30.0).requires_grad_())


@pytest.mark.parametrize(
    "mean, parts, variance",
    [
        (50.0, {}, 50.0),
        (50.0, {"read_noise_e": 6.0, "ktc_noise_e": 8.0}, 150.0),
        (50.0, {"dark_e": 20.0}, 70.0),
        (400.0, {"excess_noise": 2.0}, 800.0),
        (400.0, {"gain_e_per_dn": 12.0, "bits": 10, "black_level_dn": 64.0}, 412.0),
    ],
)
def test_variances_add(mean, parts, variance):
    y = drawn(mean, **parts)
    wanted = mean + parts.get("dark_e", 0.0)
    assert abs(float(y.mean()) - wanted) < 5 * (variance / COUNT) ** 0.5
    assert abs(float(y.var()) / variance - 1) < 0.02
    model = PixelElectronics(**parts)
    assert abs(float(model.expected(pixels(mean)[..., :1])) - wanted) < 1e-9
    assert abs(float(model.variance(pixels(mean)[..., :1])) - variance) < 1e-9


@pytest.mark.parametrize("mean", [985.0, 1000.0, 1200.0])
def test_saturation(mean):
    """The expectation of a full well near its limit, within 5 standard errors and the skewness left out (0.01 e)."""
    parts = {"full_well_e": 1000.0, "read_noise_e": 3.0}
    y = drawn(mean, **parts)
    model = PixelElectronics(**parts)
    found = float(model.expected(pixels(mean)[..., :1]))
    assert abs(float(y.mean()) - found) < 5 * float(y.std()) / COUNT**0.5 + 0.1
    assert abs(float(y.var()) / float(model.variance(pixels(mean)[..., :1])) - 1) < 0.05
    assert found < min(mean, 1000.0) + 1e-9


def test_converter_reports_its_steps_and_range():
    parts = {"gain_e_per_dn": 4.0, "bits": 8, "black_level_dn": 10.0, "read_noise_e": 30.0}
    y = drawn(20.0, **parts)
    assert float((y / 4.0 - (y / 4.0).round()).abs().max()) == 0.0
    assert PixelElectronics(**parts).range_e == (-40.0, 980.0)
    assert float(y.min()) == -40.0
    assert float(drawn(5000.0, **parts).max()) == 980.0
    # A third of the draws below: the mean of what is left is the clipped mean, with rounding to 1 e.
    model = PixelElectronics(**parts)
    assert abs(float(y.mean()) - float(model.expected(pixels(20.0)[..., :1]))) < 0.3


@pytest.mark.parametrize("policy", ["gaussian", "score"])
def test_gradient_of_a_linear_loss(policy):
    """d E[y] / dm against finite differences of the expectation, in the middle and at the edge of the full well."""
    for mean in (60.0, 100.0):
        model = PixelElectronics(full_well_e=100.0, read_noise_e=2.0, gain_e_per_dn=0.5, bits=12, grad=policy)
        m = torch.full((COUNT,), mean, dtype=torch.float64, requires_grad=True)
        with ScoreFunction() as score:
            y = model(m.reshape(-1, 1, 1, 1, 1), torch.Generator().manual_seed(0)).flatten()
        loss = score.surrogate(y, baseline=mean) if policy == "score" else y
        loss.sum().backward()
        h = 1.0
        up, down = (float(model.expected(pixels(mean + s)[..., :1])) for s in (h, -h))
        error = 5 * float(m.grad.std()) / COUNT**0.5
        assert abs(float(m.grad.mean()) - (up - down) / (2 * h)) < error + 0.01


def test_fixed_pattern_is_fixed():
    g = torch.Generator().manual_seed(3)
    gain = fixed_pattern((4, 8, 8), 0.02, center=1.0, generator=g)
    offset = fixed_pattern((4, 8, 8), 5.0, generator=g)
    model = PixelElectronics(gain_map=gain, offset_map_e=offset)
    x = torch.full((2, 1, 4, 8, 8), 1000.0)
    torch.testing.assert_close(model.expected(x), 1000 * gain.expand(2, 1, 4, 8, 8) + offset)
    assert abs(float(gain.std()) - 0.02) < 0.004


def light(*values):
    return torch.tensor(values, dtype=torch.float64).reshape(1, -1, 1, 1)


def flat(x):
    return x.flatten().tolist()


# ------------------------------------------------------------------------------------------------------ electronics


def test_the_order_of_a_pixel():
    """Gain, dark electrons, full well, offset, black level, rounding, range: one after the other."""
    gain = torch.tensor([[[2.0]], [[0.5]], [[1.0]], [[1.0]]], dtype=torch.float64)
    offset = torch.tensor([[[3.0]], [[-4.0]], [[7.0]], [[0.0]]], dtype=torch.float64)
    pixel = sensing.PixelElectronics(shot_noise=False, dark_e=5.0, full_well_e=60.0, gain_e_per_dn=4.0, bits=4,
                                     black_level_dn=2.0, gain_map=gain, offset_map_e=offset)  # fmt: skip
    x = light(10.0, 8.0, 90.0, 20.0)
    # 25 + 3 = 28; 9 - 4 = 5; 60 + 7 = 67, of at most 13 steps; 25
    assert flat(pixel.collected(x)) == [25.0, 9.0, 95.0, 25.0]
    assert flat(pixel.sample(x)) == [28.0, 4.0, 52.0, 24.0]
    assert pixel.range_dn == (0.0, 15.0) and pixel.range_e == (-8.0, 52.0)
    signed = sensing.PixelElectronics(shot_noise=False, gain_e_per_dn=4.0, bits=4, signed=True, black_level_dn=2.0)
    assert signed.range_dn == (-8.0, 7.0) and signed.range_e == (-40.0, 20.0)
    bare = sensing.PixelElectronics(full_well_e=60.0)
    assert bare.range_e == (-math.inf, 60.0) and sensing.PixelElectronics().range_e == (-math.inf, math.inf)
    for black in (-0.01, 15.01):
        with pytest.raises(UnitError, match="black_level_dn"):
            sensing.PixelElectronics(gain_e_per_dn=4.0, bits=4, black_level_dn=black)
    sensing.PixelElectronics(gain_e_per_dn=4.0, bits=4, black_level_dn=15.0)


@pytest.mark.parametrize("policy", ["gaussian", "score"])
def test_gradients_through_a_converter(policy):
    """One where the code is inside of the range, zero beyond it, whatever the rounding."""
    pixel = sensing.PixelElectronics(shot_noise=False, gain_e_per_dn=4.0, bits=4, grad=policy)
    x = light(-9.0, 13.0, 30.5, 90.0).requires_grad_()
    y = pixel(x, generator=torch.Generator().manual_seed(0))
    assert flat(y) == [0.0, 12.0, 32.0, 60.0]
    assert flat(torch.autograd.grad(y.sum(), x)[0]) == [0.0, 1.0, 1.0, 0.0]


# ---------------------------------------------------------------------------------------------------------- budgets
