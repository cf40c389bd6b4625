"""Jitter of detections against detections that are moved one by one, and chains against their stages."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy import stats

from torchtransient import sensing
from torchtransient.errors import GradientError

PS, WIDTH = 1e-12, 20e-12


def tails(**keywords):
    return sensing.TailedResponse(50 * PS, [90 * PS], [0.3], delay_s=7 * PS, **keywords)


def jitter(**keywords):
    return sensing.DetectionJitter(tails(), bin_width_s=WIDTH, **keywords)


def column(values):
    return torch.as_tensor(values, dtype=torch.float64).reshape(1, -1, 1, 1)


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize("boundary", ["periodic", "zero"])
def test_mean_is_that_of_detections_with_delays_of_their_own(boundary):
    """Event by event, in numpy: evenly in the bin, a normal and at times an exponential delay."""
    rng, bins, number = np.random.default_rng(0), 24, 400_000
    start = np.where(rng.random(number) < 0.3, 2, 21)
    delay = 7 + 50 / 2.3548200450309493 * rng.standard_normal(number)
    delay += rng.exponential(90, number) * (rng.random(number) < 0.3)
    stamp = np.floor(start + rng.random(number) + delay / 20).astype(int)
    stamp = stamp % bins if boundary == "periodic" else stamp[(stamp >= 0) & (stamp < bins)]
    seen = np.bincount(stamp, minlength=bins)
    counts = column(np.bincount(start, minlength=bins))
    module = jitter(boundary=boundary)
    mean = module.expected(counts).flatten().numpy()
    drawn = module.sample(counts, generator()).flatten().numpy()
    for found in (seen, drawn):
        assert np.abs((found - mean) / np.sqrt(mean + 1)).max() < 4.5
    assert (drawn.sum() == number) == (boundary == "periodic") and np.array_equal(drawn, drawn.round())


def test_means_and_rates_stay_means():
    x = column(torch.rand(16, dtype=torch.float64))
    for policy in ("expected", "straight_through", "score"):
        module = jitter(grad=policy)
        assert torch.equal(module(x, generator=generator()), module.expected(x))
    assert torch.equal(jitter().sample(x), jitter().expected(x))


def test_score_of_a_learnable_response():
    """Gradient of E sum(y^2) in the width of the response: score of drawn delays against the closed form."""
    counts = column([0, 0, 3, 0, 0, 0, 0, 0])
    module = sensing.DetectionJitter(sensing.GaussianResponse(40 * PS, learnable=True), bin_width_s=WIDTH)
    _, kernel = module.response.kernel(WIDTH)
    # of n counts of one bin: E sum y^2 = n + n (n - 1) sum p^2
    exact = torch.autograd.grad(3 + 6 * kernel.square().sum(), module.response.log_fwhm_s)[0]
    module.grad = "score"
    repeats = 20_000
    found = []
    for seed in range(4):
        with sensing.ScoreFunction() as score:
            y = module(counts.expand(repeats // 4, 1, 8, 1, 1), generator=generator(seed))
            losses = y.square().sum((-4, -3, -2, -1))
        surrogate = score.surrogate(losses, baseline="leave_one_out").mean()
        found.append(torch.autograd.grad(surrogate, module.response.log_fwhm_s)[0])
    # the score of a width has a variance of 2 for each of 3 counts; losses spread by about 3
    assert abs(float(torch.stack(found).mean() - exact)) < 5 * 3 * (2 * 3 / repeats) ** 0.5
    assert abs(float(exact)) > 3 * 5 * 3 * (2 * 3 / repeats) ** 0.5


def test_straight_through_and_gaussian_reach_the_response():
    x = column(torch.poisson(torch.full((20,), 9.0), generator=generator())).requires_grad_()
    for policy in ("straight_through", "gaussian"):
        module = sensing.DetectionJitter(tails(learnable=True), bin_width_s=WIDTH, grad=policy)
        y = module(x, generator=generator())
        weights = torch.linspace(0, 1, 20, dtype=torch.float64).view(-1, 1, 1).square()
        gradients = torch.autograd.grad((y * weights).sum(), [x, *module.parameters()])
        wanted = torch.autograd.grad((module.expected(x) * weights).sum(), [x, *module.parameters()])
        for got, exact in zip(gradients, wanted, strict=True):
            if policy == "straight_through":
                torch.testing.assert_close(got, exact)
            assert bool(torch.isfinite(got).all()) and float(got.abs().max()) > 0


# --- chains ------------------------------------------------------------------------------------------------------


def bright(bins=40, total=6.0):
    t = torch.arange(bins, dtype=torch.float64)
    shape = torch.exp(-0.5 * ((t - 18) / 2) ** 2) / 5 + 0.4 / bins
    return column(total * shape / shape.sum())


def counter(grad="straight_through", **keywords):
    converter = sensing.TDC(sensing.random_code_widths(40, 0.2, generator(4)))
    return sensing.Compose([sensing.SynchronousSPAD(500, **keywords), jitter(), converter], grad=grad)


def test_jitter_behind_pile_up_is_where_the_detections_are():
    """Six photons a cycle: a detection lies where its photon was, plus the mean delay; in front it comes early."""
    x = bright()
    x = torch.nn.functional.pad(x * (x > 0.1), (0, 0, 0, 0, 0, 100))  # the pulse alone, far from both ends
    place = torch.arange(140, dtype=torch.float64).view(-1, 1, 1)

    def centre(y):
        return float((y * place).sum() / y.sum())

    spad = sensing.SynchronousSPAD(500)
    right = sensing.Compose([spad, jitter()]).expected(x)
    assert centre(right) == pytest.approx(centre(spad.expected(x)) + (7 + 0.3 * 90) / 20, abs=1e-3)
    early = sensing.Compose([sensing.ImpulseResponse(tails(), bin_width_s=WIDTH), spad]).expected(x)
    assert centre(right) - centre(early) > 1.0


def test_first_photons_and_moves_are_drawn_at_once():
    """Mean and covariance of the multinomial with moved probabilities, and of the stages one after another."""
    x, chain, repeats = bright(), counter(), 2000
    mean = chain.expected(x).flatten()
    p = mean / 500
    covariance = 500 * (torch.diag(p) - p.outer(p))
    spread = ((covariance.square() + covariance.diag().outer(covariance.diag())) / repeats).sqrt()
    many = x.expand(repeats, 1, 40, 1, 1)
    at_once = chain.sample(many, generator())
    one_by_one, g = many, generator(5)
    for stage in chain.stages:
        one_by_one = stage.sample(one_by_one, g)
    surrogates = counter("gaussian")(many, generator=generator(2)), counter().gaussian(many, generator(3))
    for y in (at_once, one_by_one, *surrogates):
        y = y.flatten(1)
        assert float(((y.mean(0) - mean) / (covariance.diag() / repeats).sqrt()).abs().max()) < 5
        assert float(((y.T.cov() - covariance) / (spread + 1e-3)).abs().max()) < 6
    assert torch.equal(at_once, at_once.round()) and bool((at_once.sum(-3) <= 500).all())


def test_gradients_of_what_is_drawn_at_once():
    x = bright().requires_grad_()
    chain = counter()
    y = chain(x, generator=generator())
    weights = torch.linspace(0, 1, 40, dtype=torch.float64).view(-1, 1, 1).square()
    wanted = torch.autograd.grad((chain.expected(x) * weights).sum(), x)[0]
    torch.testing.assert_close(torch.autograd.grad((y * weights).sum(), x)[0], wanted)
    with torch.no_grad():
        assert not chain(x, generator=generator()).requires_grad
    # score: E of the loss's gradient, for a loss that is not linear
    scale = torch.ones(4000, dtype=torch.float64, requires_grad=True)
    with sensing.ScoreFunction() as score:
        counts = counter("score")(bright(total=1.0) * scale.view(-1, 1, 1, 1, 1), generator=generator(1))
        losses = counts[..., 18:22, :, :].sum((-4, -3, -2, -1)).square()
    score.surrogate(losses, baseline="leave_one_out").sum().backward()
    one = torch.ones((), dtype=torch.float64, requires_grad=True)
    p = counter().expected(bright(total=1.0) * one)[:, 18:22].sum() / 500
    (exact,) = torch.autograd.grad(500 * p * (1 - p) + (500 * p) ** 2, one)
    assert abs(float(scale.grad.mean() - exact)) < 5 * float(scale.grad.std()) / 4000**0.5


def test_log_probability_of_multinomial_counts():
    """First photons that a converter moves nowhere: shares 0.2, 0 and 0.3 of twelve cycles."""
    chain = sensing.Compose([sensing.SynchronousSPAD(12), sensing.TDC(torch.ones(3))])
    x = column([-math.log(0.8), 0.0, math.log(0.8 / 0.5)]).requires_grad_()
    value = chain.log_prob(column([3, 0, 5]), x)
    exact = stats.multinomial(12, [0.2, 0.0, 0.3, 0.5]).logpmf([3, 0, 5, 4])
    assert float(value.detach()) == pytest.approx(float(exact), rel=1e-12)
    value.sum().backward()
    assert bool(torch.isfinite(x.grad).all())
    assert float(chain.log_prob(column([4, 1, 6]), x)) == -float("inf")


def test_likelihood_of_a_chain():
    """That of its last stages, and highest in expectation where the light is right."""
    x = bright(total=2.0)
    chain = counter()
    counts = chain.sample(x.expand(200, 1, 40, 1, 1), generator())
    found = [float(chain.log_prob(counts, f * x).mean()) for f in (0.9, 1.0, 1.1)]
    assert found[1] > max(found[0], found[2])
    whole = sensing.Compose(
        [
            sensing.ImpulseResponse(sensing.GaussianResponse(30 * PS), bin_width_s=WIDTH),
            sensing.Compose(list(chain.stages)),
        ]
    )
    assert whole.log_prob(counts, x).shape == (200, 1, 1, 1)
    alone = sensing.Compose([sensing.SynchronousSPAD(500)])
    assert torch.equal(alone.log_prob(counts, x), sensing.SynchronousSPAD(500).log_prob(counts, x))
    leaf = x.clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda v: chain.log_prob(counts[0], v), leaf, fast_mode=True)
    with pytest.raises(GradientError, match="one detector that draws"):
        sensing.Compose([sensing.ShotNoise(), jitter()]).log_prob(counts, x)
    with pytest.raises(GradientError, match="one detector that draws"):
        counter(dead_time_s=100 * PS, bin_width_s=WIDTH).log_prob(counts, x)
