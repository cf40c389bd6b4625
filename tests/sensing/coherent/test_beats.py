"""Speckle and noise of the local oscillator: distributions in closed form, gradients with the same draws."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy import stats

from torchtransient import Chirps
from torchtransient.errors import ShapeError, UnitError
from torchtransient.sensing import BeatNoise, Compose, ShotNoise, Speckle

DRAWS = 20_000


def draws(sensor, power, seed=0):
    """Draws of one bin."""
    x = torch.full((DRAWS, 1, 1, 1, 1), power, dtype=torch.float64)
    return sensor.sample(x, torch.Generator().manual_seed(seed)).flatten().numpy()


def follows(found, law):
    """Of a right sampler, the Kolmogorov-Smirnov test fails once in a thousand seeds."""
    assert stats.kstest(found, law.cdf).pvalue > 1e-3


@pytest.mark.parametrize("looks", [1, 2.5, 16])
def test_speckle_is_a_gamma_distribution(looks):
    found = draws(Speckle(looks), 3.0)
    follows(found, stats.gamma(looks, scale=3.0 / looks))
    # The standard error of a contrast is below (1 + 1 / looks) / sqrt(2 n) times it, or twice that for one look.
    assert found.std() / found.mean() == pytest.approx(looks**-0.5, rel=8 / (2 * DRAWS) ** 0.5)
    x = torch.full((1, 1, 1, 1), 3.0)
    assert Speckle(looks).expected(x).item() == 3.0
    assert Speckle(looks).variance(x).item() == pytest.approx(9 / looks)


@pytest.mark.parametrize("looks", [1, 4, 2.5])
@pytest.mark.parametrize("photons", [0.0, 0.3, 25.0])
def test_noise_is_a_noncentral_chi_squared_distribution(looks, photons):
    sensor = BeatNoise(5.0, looks)
    found = draws(sensor, photons / 5, seed=1)
    law = stats.ncx2(2 * looks, 2 * looks * photons) if photons else stats.chi2(2 * looks)
    follows(2 * looks * found, law)
    x = torch.full((1, 1, 1, 1), photons / 5, dtype=torch.float64)
    assert sensor.expected(x).item() == pytest.approx(photons + 1)
    assert sensor.variance(x).item() == pytest.approx((1 + 2 * photons) / looks)
    error = (sensor.variance(x).item() / DRAWS) ** 0.5
    assert found.mean() == pytest.approx(photons + 1, abs=4 * error)


@pytest.mark.parametrize("looks", [1, 4])
def test_noise_of_speckled_light_is_a_gamma_distribution(looks):
    """Two Gaussian fields added are one: `looks` fields of variance n + 1."""
    found = draws(Compose([Speckle(looks), BeatNoise(2.0, looks)]), 3.5, seed=2)
    follows(found, stats.gamma(looks, scale=(7.0 + 1) / looks))


@pytest.mark.parametrize("policy", ["gaussian", "straight_through"])
@pytest.mark.parametrize("sensor", [Speckle(2), BeatNoise(3.0, 2)], ids=lambda s: type(s).__name__)
def test_gradients_with_the_same_draws(sensor, policy):
    sensor = Compose([sensor], grad=policy)
    x = (0.1 + torch.rand(1, 5, 2, 2, generator=torch.Generator().manual_seed(5), dtype=torch.float64)).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: sensor(x, torch.Generator().manual_seed(6)).square(), x)


def test_gradients_of_a_mean_are_those_of_the_moments():
    """Of the squared measurement, in closed form: E y^2 = x^2 (1 + 1/L), and (n + 1)^2 + (1 + 2 n) / L."""
    pairs = ((Speckle(2, grad="gaussian"), 2 * 0.7 * 1.5), (BeatNoise(1.0, 2, grad="gaussian"), 2 * 1.7 + 1))
    for sensor, wanted in pairs:
        x = torch.full((DRAWS, 1, 1, 1, 1), 0.7, dtype=torch.float64, requires_grad=True)
        sensor(x, torch.Generator().manual_seed(7)).square().sum().backward()
        slopes = x.grad.flatten()
        assert slopes.mean().item() == pytest.approx(wanted, abs=4 * slopes.std().item() / DRAWS**0.5)


def test_no_power_has_a_finite_gradient():
    x = torch.zeros(1, 500, 1, 1, requires_grad=True)
    BeatNoise(1.0, 1, grad="gaussian")(x, torch.Generator().manual_seed(8)).sum().backward()
    # 1 + noise / 100 photons^(1/2): the noise has a variance of 1/2
    assert x.grad.std().item() == pytest.approx(2 * 100 * 0.5**0.5, rel=0.2)


def test_density_of_speckle():
    sensor = Speckle(2.5)
    y, x = torch.rand(2, 3, 4, 1, 1, generator=torch.Generator().manual_seed(9), dtype=torch.float64) + 0.1
    wanted = stats.gamma.logpdf(y.numpy(), 2.5, scale=x.numpy() / 2.5).sum(-3)
    torch.testing.assert_close(sensor.log_prob(y, x), torch.from_numpy(wanted))
    assert torch.autograd.gradcheck(lambda x: sensor.log_prob(y, x), x.clone().requires_grad_())
    dark = torch.cat([x, torch.zeros_like(x)], -3)
    torch.testing.assert_close(sensor.log_prob(torch.cat([y, torch.zeros_like(y)], -3), dark), torch.from_numpy(wanted))


@pytest.mark.parametrize("looks", [1, 2.5, 12, 24, 30, 60])
def test_density_of_shot_noise(looks):
    """Noncentral chi-squared, from no light to bright lines, with derivatives."""
    sensor = BeatNoise(3.0, looks)
    x = torch.tensor([0.0, 1e-3, 0.2, 4.0, 60.0, 900.0], dtype=torch.float64).reshape(1, 6, 1, 1)
    for factor in (0.3, 1.0, 2.5):
        y = factor * sensor.expected(x)
        wanted = stats.ncx2.logpdf(2 * looks * y.numpy(), 2 * looks, 6 * looks * x.numpy()) + np.log(2 * looks)
        central = stats.chi2.logpdf(2 * looks * y[:, :1].numpy(), 2 * looks) + np.log(2 * looks)
        total = torch.from_numpy(np.concatenate([central, wanted[:, 1:]], 1).sum(1))
        torch.testing.assert_close(sensor.log_prob(y, x), total, rtol=1e-8, atol=1e-6)
    assert torch.autograd.gradcheck(lambda x: sensor.log_prob(y, x), (x + 0.01).requires_grad_())
    dark = torch.zeros(1, 3, 1, 1, requires_grad=True)
    sensor.log_prob(torch.full((1, 3, 1, 1), 2.0), dark).sum().backward()
    # At no light by looks (y - 1) of the photons.
    torch.testing.assert_close(dark.grad, torch.full_like(dark, 3.0 * looks))


def test_scores_of_shot_noise():
    """The mean of the slope of the likelihood is zero, its mean square the Fisher information of the power."""
    sensor, n = BeatNoise(1.0, 2), torch.full((20 * DRAWS, 1, 1, 1), 3.0, dtype=torch.float64, requires_grad=True)
    y = sensor.sample(n, torch.Generator().manual_seed(11))
    (slope,) = torch.autograd.grad(sensor.log_prob(y, n).sum(), n)
    slope = slope.flatten()
    error = float(slope.std()) / len(slope) ** 0.5
    assert abs(float(slope.mean())) < 4 * error
    # Fisher information by differences of the mean log-likelihood.
    h = 0.05
    ahead, here, behind = (float(sensor.log_prob(y, n.detach() + s * h).mean()) for s in (1, 0, -1))
    assert float(slope.square().mean()) == pytest.approx(-(ahead - 2 * here + behind) / h**2, rel=0.05)


@pytest.mark.parametrize("wrong", [-1e-3, float("nan"), float("inf")])
@pytest.mark.parametrize("sensor", [Speckle(), BeatNoise()], ids=lambda s: type(s).__name__)
def test_no_power_is_negative(sensor, wrong):
    x = torch.ones(1, 3, 1, 1)
    x[0, 1] = wrong
    with pytest.raises(UnitError, match="finite power"):
        sensor.sample(x)


def test_chains_take_the_beats_of_an_output():
    axis = Chirps(1e9, 10e-6, 1550e-9).time_axis((0.0, 1.0))
    beats = torch.rand(1, 2, axis.num_bins, 2, 2)
    out = SimpleNamespace(transient=None, phasor=None, beats=beats, axis=axis)
    chain = Compose([Speckle(4), BeatNoise(100.0, 4)])
    torch.testing.assert_close(chain(out), 100 * beats + 1)
    with pytest.raises(ShapeError, match="spectra of beats"):
        Compose([ShotNoise()])(out)
