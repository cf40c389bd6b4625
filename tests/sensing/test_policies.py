"""Each gradient policy against finite differences of the expected loss, with the bias that it documents."""

from __future__ import annotations

import pytest
import torch

from torchtransient.errors import GradientError, ShapeError
from torchtransient.sensing import ScoreFunction, ShotNoise, gaussian_noise

DRAWS = 40_000
MEANS = (0.3, 2.0, 9.0)


def mean_gradient(policy, f, baseline=None):
    """Mean gradient over DRAWS independent draws of f(counts) in the mean, per MEANS, and its standard error."""
    theta = torch.tensor(MEANS, dtype=torch.float64).expand(DRAWS, 3).clone().requires_grad_()
    x = theta.reshape(DRAWS, 3, 1, 1, 1)  # 3 independent "channels"
    with ScoreFunction() as score:
        y = ShotNoise(grad=policy)(x, generator=torch.Generator().manual_seed(2))
        losses = f(y).reshape(DRAWS, 3, 1, 1)
    if policy == "score":
        losses = score.surrogate(losses, baseline=baseline)
    losses.sum().backward()
    return theta.grad.mean(0), theta.grad.std(0) / DRAWS**0.5


def finite_difference(f, h=1e-4):
    """d/dm of the exact E f(n), summed over the Poisson distribution."""
    n = torch.arange(200, dtype=torch.float64)

    def value(m):
        return (f(n) * torch.exp(torch.distributions.Poisson(m).log_prob(n))).sum()

    ms = torch.tensor(MEANS, dtype=torch.float64)
    return torch.stack([(value(m + h) - value(m - h)) / (2 * h) for m in ms])


def linear(y):
    return 3.0 * y


def square(y):
    return y**2


def rough(y):
    return torch.where(y > 2, 1.0, 0.0)


@pytest.mark.parametrize("f", [linear, square])
@pytest.mark.parametrize("policy", ["gaussian", "score"])
def test_unbiased_up_to_second_order(policy, f):
    found, error = mean_gradient(policy, f)
    # gaussian_noise is short of the variance by 2 sqrt(e)/sqrt(v) relatively
    softened = 0.02 * finite_difference(f).abs() if policy == "gaussian" else 0.0
    assert bool(((found - finite_difference(f)).abs() <= 4.5 * error + softened + 1e-9).all())


def test_score_is_unbiased_for_a_step():
    found, error = mean_gradient("score", rough)
    wanted = finite_difference(rough)
    assert bool(((found - wanted).abs() <= 4.5 * error).all())
    assert float(wanted.max()) > 0.2  # where every pathwise gradient is 0
    better, smaller = mean_gradient("score", rough, baseline="leave_one_out")
    assert bool(((better - wanted).abs() <= 4.5 * smaller).all())
    assert float(smaller[2] / error[2]) < 0.6  # P(n > 2) is nearly 1 there: the baseline takes most of the variance


def test_straight_through_is_exact_for_linear_and_short_by_one_for_squares():
    found, _ = mean_gradient("straight_through", linear)
    torch.testing.assert_close(found, finite_difference(linear), rtol=1e-6, atol=1e-6)
    found, error = mean_gradient("straight_through", square)
    bias = found - finite_difference(square)
    assert bool(((bias + 1.0).abs() <= 4.5 * error + 1e-4).all())


def test_expected_lacks_half_the_curvature_times_the_variance():
    m = torch.tensor(MEANS, dtype=torch.float64, requires_grad=True)
    square(ShotNoise().expected(m.reshape(1, 3, 1, 1))).sum().backward()
    torch.testing.assert_close(m.grad + 1.0, finite_difference(square), rtol=1e-6, atol=1e-5)


def test_score_outside_its_context_says_so():
    x = torch.ones(1, 4, 1, 1, requires_grad=True)
    with pytest.raises(GradientError, match="ScoreFunction"):
        ShotNoise(grad="score")(x)
    with torch.no_grad():
        assert ShotNoise(grad="score")(x).shape == x.shape
    assert ShotNoise(grad="score")(x.detach()).shape == x.shape


def test_score_shapes():
    x = torch.ones(5, 2, 4, 3, 3, requires_grad=True)
    with ScoreFunction() as score:
        y = ShotNoise(grad="score")(x)
    for dims in ((-4, -3, -2, -1), (-3,), (0, 1, 2, 3, 4)):
        losses = y.sum(dims)
        surrogate = score.surrogate(losses)
        assert torch.equal(surrogate, losses)
        (gradient,) = torch.autograd.grad(surrogate.sum(), x, retain_graph=True)
        assert bool(gradient.abs().sum() > 0)
    with pytest.raises(ShapeError, match="leave_one_out"):
        score.surrogate(y.sum(), baseline="leave_one_out")
    with pytest.raises(ShapeError, match="begins"):
        score.surrogate(y.sum((1, 2)))
    with pytest.raises(GradientError, match="nothing to differentiate"):
        ScoreFunction().surrogate(y.sum())


def test_two_random_stages_add_their_scores():
    """n1 ~ Poisson(m), n2 ~ Poisson(2 n1): d E[n2]/dm = 2."""
    m = torch.full((DRAWS,), 1.5, dtype=torch.float64, requires_grad=True)
    stage = ShotNoise(grad="score")
    g = torch.Generator().manual_seed(4)
    with ScoreFunction() as score:
        n2 = stage(2 * stage(m.reshape(-1, 1, 1, 1, 1), generator=g), generator=g)
        losses = n2.flatten()
    score.surrogate(losses, baseline="leave_one_out").sum().backward()
    error = m.grad.std() / DRAWS**0.5
    assert abs(float(m.grad.mean()) - 2.0) < 4.5 * float(error)


def test_gaussian_noise_has_the_variance_it_says():
    v = torch.tensor([0.0, 0.05, 1.0, 100.0], dtype=torch.float64).expand(200_000, 4)
    z = gaussian_noise(v, torch.Generator().manual_seed(0))
    assert float(z[:, 0].abs().max()) == 0.0
    wanted = ((v[0] + 1e-4).sqrt() - 1e-2) ** 2
    assert bool(((z.var(0) - wanted).abs() <= 5 * wanted * (2 / 200_000) ** 0.5).all())
    assert abs(float(z[:, 2].var()) - 1) < 0.03
