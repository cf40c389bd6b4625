"""Synchronous detection against photons drawn one by one, closed forms, and its own inverse."""

from __future__ import annotations

import itertools
import math

import mpmath
import pytest
import torch
from scipy import stats

from torchtransient import sensing
from torchtransient.errors import ShapeError, UnitError

BINS = 48


def pulse(total=1.2, bins=BINS):
    t = torch.arange(bins, dtype=torch.float64)
    shape = 0.3 / bins + torch.exp(-0.5 * ((t - 0.6 * bins) / 3) ** 2) / 10
    return total * shape / shape.sum()


def as_image(row):
    return row.view(1, -1, 1, 1)


def test_probabilities_of_first_photons():
    row = pulse(3.0)
    p, none = sensing.first_photon_probabilities(as_image(row))
    assert float(p.sum() + none) == pytest.approx(1, abs=1e-14)
    by_hand = [(1 - torch.exp(-row[k])) * torch.exp(-row[:k].sum()) for k in range(BINS)]
    torch.testing.assert_close(p.flatten(), torch.stack(by_hand))


def test_gaussian_surrogate_has_the_covariance_of_the_multinomial():
    rate, cycles = pulse(2.0, 12), 1000
    x = as_image(rate).unsqueeze(0).expand(20_000, 1, 12, 1, 1)
    spad = sensing.SynchronousSPAD(cycles, grad="gaussian")
    y = spad(x, generator=torch.Generator().manual_seed(0)).squeeze()
    p = spad.probabilities(as_image(rate)).flatten()
    covariance = cycles * (torch.diag(p) - torch.outer(p, p))
    scale = torch.outer(covariance.diag(), covariance.diag()).sqrt()
    assert bool(((torch.cov(y.T) - covariance).abs() <= 5 * scale / 20_000**0.5 * 2 + 0.02).all())


def test_multinomial_of_many_trials():
    """1e8 cycles and odd numbers of bins, first photons alone and moved; totals never exceed the cycles."""
    rate = torch.tensor([0.7, 0.6, 0.0, 1.5, 0.3], dtype=torch.float64).view(1, 5, 1, 1).expand(1, 5, 40, 40)
    spad = sensing.SynchronousSPAD(10**8)
    p = spad.probabilities(rate)
    for sensor in (spad, sensing.Compose([spad, sensing.TDC(torch.ones(5))])):
        h = sensor.sample(rate, torch.Generator().manual_seed(0))
        z = (h - 1e8 * p) / (1e8 * p * (1 - p)).clamp_min(1).sqrt()
        assert float(z.abs().max()) < 5.5
        assert float(h[:, 2].max()) == 0 and float(h.sum(1).max()) <= 1e8
        assert sensor.sample(rate.float(), torch.Generator().manual_seed(0)).dtype == torch.float32


@pytest.mark.parametrize("bins", [1, 5, 97])
def test_first_photons_are_the_multinomial_of_their_probabilities(bins):
    """Chi-square over bins and "none", for weak light, strong light and a flood, without any running sum."""
    g, cycles = torch.Generator().manual_seed(4), 200
    spad = sensing.SynchronousSPAD(cycles)
    shape = torch.rand(1, bins, 1, 1, dtype=torch.float64, generator=g) ** 4
    # large images by a tree of bins, few counts each by itself
    for total, side in itertools.product((0.01, 1.0, 6.0, 80.0), (60, 5)):
        rate = (total * shape / shape.sum()).expand(1, bins, side, side)
        p, none = sensing.first_photon_probabilities(rate[..., :1, :1])
        seen = spad.sample(rate, g).sum((-2, -1)).flatten()
        trials = side**2 * cycles
        expected = trials * torch.cat([p.flatten(), none.flatten()])
        seen = torch.cat([seen, trials - seen.sum(0, keepdim=True)])
        often = expected > 8
        assert float(seen[~often].sum()) <= float(expected[~often].sum()) * 1.0 + 40
        chi2 = float(((seen - expected) ** 2 / expected)[often].sum())
        dof = int(often.sum()) - 1
        if dof > 0:
            assert chi2 < stats.chi2.isf(1e-7, dof), f"{total} photons: chi2/dof = {chi2 / dof:.2f}"
    dark = spad.sample(torch.zeros(1, bins, 4, 4), g)
    assert float(dark.sum()) == 0


@pytest.mark.parametrize("dead_bins", [None, 8.5])
def test_coates_undoes_the_expectation(dead_bins):
    rate, cycles = pulse(3.0), 10_000
    spad = sensing.SynchronousSPAD(
        cycles, dead_time_s=None if dead_bins is None else dead_bins * 1e-10, bin_width_s=1e-10
    )
    estimate = spad.inverse(spad(as_image(rate)))
    torch.testing.assert_close(estimate.rate, as_image(rate), rtol=1e-10, atol=1e-12)
    assert bool(estimate.valid.all())


def test_gate():
    rate, cycles = pulse(3.0), 1000
    gate = torch.zeros(BINS)
    gate[20:25] = torch.tensor([0.25, 0.5, 1.0, 1.0, 1.0])
    gate[25:] = 1.0
    spad = sensing.SynchronousSPAD(cycles, gate=gate)
    y = spad(as_image(rate)).flatten()
    assert not y[:20].any()
    inside, _ = sensing.first_photon_probabilities(as_image((rate * gate)[20:]))
    torch.testing.assert_close(y[20:], inside.flatten() * cycles)
    assert float(y.sum()) > 0
    estimate = spad.inverse(y.view(1, -1, 1, 1))
    torch.testing.assert_close(estimate.rate.flatten()[20:], rate[20:], rtol=1e-9, atol=1e-12)
    assert not estimate.valid.flatten()[:20].any()
    with pytest.raises(ShapeError, match="as in gate"):
        spad(torch.ones(1, 7, 1, 1))
    with pytest.raises(UnitError, match="between 0 and 1"):
        sensing.SynchronousSPAD(10, gate=torch.tensor([2.0]))


def test_log_prob_is_that_of_the_multinomial():
    rate, cycles = pulse(1.5, 5), 20
    h = torch.tensor([3.0, 0, 5, 1, 2], dtype=torch.float64)
    p, none = sensing.first_photon_probabilities(as_image(rate))
    probabilities = torch.cat([p.flatten(), none.flatten()])
    wanted = torch.distributions.Multinomial(cycles, probabilities).log_prob(torch.cat([h, (cycles - h.sum()).view(1)]))
    found = sensing.SynchronousSPAD(cycles).log_prob(as_image(h), as_image(rate))
    torch.testing.assert_close(found.squeeze(), wanted)


@pytest.mark.parametrize("policy, f", [("straight_through", "linear"), ("gaussian", "square"), ("score", "step")])
def test_policies_against_finite_differences(policy, f):
    """Gradient in the brightness of the pulse, of a loss on the peak bin; pile-up makes it negative."""
    rate, cycles, draws = pulse(1.0, 8), 30, 20_000
    brightness = torch.full((draws, 1, 1, 1, 1), 1.6, dtype=torch.float64, requires_grad=True)
    losses = {
        "linear": lambda y: y[:, 0, 6],
        "square": lambda y: y[:, 0, 6] ** 2,
        "step": lambda y: (y[:, 0, 6] > 3) * 1.0,
    }
    spad = sensing.SynchronousSPAD(cycles, grad=policy)
    with sensing.ScoreFunction() as score:
        y = spad(brightness * rate.view(-1, 1, 1), generator=torch.Generator().manual_seed(1))
        values = losses[f](y).reshape(draws)
    if policy == "score":
        values = score.surrogate(values, baseline="leave_one_out")
    values.sum().backward()
    found = brightness.grad.mean()
    error = brightness.grad.std() / draws**0.5

    def moment(b):
        p = sensing.first_photon_probabilities(as_image(b * rate))[0].flatten()[6]
        n = torch.arange(cycles + 1, dtype=torch.float64)
        weights = torch.exp(torch.distributions.Binomial(cycles, p).log_prob(n))
        return (weights * losses[f](n.view(-1, 1, 1).expand(-1, 1, 8))).sum()

    exact = (moment(1.6 + 1e-4) - moment(1.6 - 1e-4)) / 2e-4
    softened = 0.02 * abs(float(exact)) * (policy == "gaussian")
    assert abs(float(found - exact)) <= 4.5 * float(error) + softened + 1e-7


@pytest.mark.parametrize("make", [sensing.SynchronousSPAD, sensing.BinaryFrames])
def test_likelihood_of_certain_detections_keeps_its_digits(make):
    """All fire: log(1 - exp(-r)) is -exp(-r) for large r and log r for small. 1e-14 is some 30 roundings."""
    cycles = 1000
    rates = torch.tensor([1e-300, 1e-20, 1e-3, 0.69, 0.7, 1, 5, 20, 35, 40, 100, 700], dtype=torch.float64)
    with mpmath.workdps(500):
        wanted = [float(mpmath.log(-mpmath.expm1(-mpmath.mpf(float(r))))) for r in rates]
        slopes = [float(1 / mpmath.expm1(mpmath.mpf(float(r)))) for r in rates]
    x = rates.view(1, 1, 1, -1).requires_grad_()
    value = make(cycles).log_prob(torch.full_like(x, cycles), x)
    value.sum().backward()
    assert value.flatten().tolist() == pytest.approx([cycles * v for v in wanted], rel=1e-14, abs=0)
    assert x.grad.flatten().tolist() == pytest.approx([cycles * v for v in slopes], rel=1e-14, abs=0)
    none = make(cycles).log_prob(torch.zeros_like(x), torch.zeros_like(x))
    assert none.tolist() == torch.zeros_like(none).tolist()


@pytest.mark.slow
@pytest.mark.parametrize("dead", [None, 2.0, 2.5])
def test_where_counts_tell_the_rate(dead):
    """Up to a share of 1 - 1/2N of what is armed, half a cycle is none; those that come back are armed anew."""
    pixels = [[9.0, 0.0, 0.0, 0.0], [9.5, 0.0, 0.0, 0.0], [9.75, 0.25, 0.0, 0.0], [10.0, 0.0, 0.0, 0.0],
              [4.0, 5.0, 0.95, 0.0], [4.0, 5.0, 0.96, 0.0]]  # fmt: skip
    found = sensing.coates(torch.tensor(pixels, dtype=torch.float64).T.reshape(1, 4, 1, 6), 10, dead)
    first = [[True, True], [True, False], [False, False], [False, False], [True, True], [True, True]]
    late = [[True, True], [False, False], [False, False], [False, False], [True, False], [False, False]]
    if dead is not None:
        late = [[True, True]] * 6
    assert found.valid[0, :, 0].T.tolist() == [a + b for a, b in zip(first, late, strict=True)]
    most, rates = math.log(20), found.rate[0, :, 0].T
    wanted = [[math.log(10), 0.0], [most, 0.0], [most, 0.0], [most, 0.0], [-math.log(0.6), math.log(6)]]
    assert rates[:5, :2].flatten().tolist() == pytest.approx([r for row in wanted for r in row])
    assert rates[:4, 2:].tolist() == [[0.0, 0.0]] * 4
    if dead is None:
        assert rates[4:, 2].tolist() == pytest.approx([most, most])
    else:  # more than 500 photons in a bin are not told from one another
        flood = sensing.coates(torch.tensor([1000.0, 0.0, 900.0, 0.0]).double().reshape(1, 4, 1, 1), 1000, 2.0)
        assert float(flood.rate.flatten()[2]) == 500.0 and flood.valid.flatten().tolist() == [False, False, False, True]
