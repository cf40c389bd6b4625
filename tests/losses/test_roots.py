"""Counts on other scales: the variance of Anscombe's root, logarithms of ratios, values below zero."""

import functools
import math

import pytest
import torch

from torchtransient import losses
from torchtransient.errors import ShapeError, UnitError
from torchtransient.reconstruction import stabilized_root


def moments(mean, function):
    """Mean and variance of a function of Poisson counts, summed over all counts that matter."""
    n = torch.arange(int(mean + 20 * mean**0.5 + 40), dtype=torch.float64)
    p = torch.exp(n * math.log(mean) - mean - torch.lgamma(n + 1))
    value = function(n)
    first = float((p * value).sum())
    return first, float((p * value**2).sum()) - first**2


@pytest.mark.parametrize("mean", [4.0, 30.0, 300.0])
def test_anscombe_has_variance_one(mean):
    found, variance = moments(mean, losses.anscombe)
    assert abs(variance - 1) < 1 / (8 * mean)
    # Anscombe 1948: the mean is that of the mean less 1/(4 sqrt(m))
    assert found == pytest.approx(2 * math.sqrt(mean + 3 / 8) - 1 / (4 * math.sqrt(mean)), abs=1 / (4 * mean**1.5))


def test_anscombe_with_read_noise():
    """Counts and normal noise of two counts: variance one within 2 %, where the plain root has five times that."""
    generator = torch.Generator().manual_seed(0)
    m = torch.full((400_000,), 6.0, dtype=torch.float64)
    y = torch.poisson(m, generator=generator) + 2 * torch.randn(m.shape, generator=generator, dtype=torch.float64)
    # 400,000 draws know a variance to sqrt(2 / 4e5) = 0.22 %
    assert float(losses.anscombe(y, read_noise=2.0).var()) == pytest.approx(1.0, abs=0.02 + 4 * 0.0022)
    assert float(losses.anscombe(y).var()) > 1.5


def test_the_tangent_below_zero():
    x = torch.tensor([-3.0, -1e-9, 0.0, 1e-9], dtype=torch.float64, requires_grad=True)
    slope = torch.autograd.grad(losses.anscombe(x).sum(), x)[0]
    torch.testing.assert_close(slope, torch.full_like(x, 1 / math.sqrt(3 / 8)), rtol=1e-7, atol=0)


def test_other_roots():
    a, b = torch.tensor([0.0, 1.0, 4.0]), torch.tensor([2.0, 0.0, 9.0])
    found = losses.root_loss(a, b, root=stabilized_root, reduction="none")
    torch.testing.assert_close(found, (a / (a + 0.25).sqrt() - b / (b + 0.25).sqrt()) ** 2)
    noisy = functools.partial(losses.anscombe, read_noise=3.0)
    torch.testing.assert_close(
        losses.RootLoss(noisy)(a, b), (2 * (a + 9.375).sqrt() - 2 * (b + 9.375).sqrt()).square().mean()
    )
    with pytest.raises(ShapeError, match="keeps the shape"):
        losses.root_loss(a, b, root=torch.sum)
    with pytest.raises(UnitError, match="read_noise"):
        losses.anscombe(a, read_noise=-1.0)


def test_log_ratio():
    """A factor is the square of its logarithm, over twelve decades; below the background it fades."""
    y = 10 ** torch.linspace(-6, 6, 13, dtype=torch.float64)
    found = losses.log_ratio_loss(math.e * y, y, background=1e-12, reduction="none")
    torch.testing.assert_close(found, torch.ones_like(y), rtol=5e-6, atol=0)
    found = losses.log_ratio_loss(2 * y, y, background=y, reduction="none")
    torch.testing.assert_close(found, torch.full_like(y, math.log(1.5) ** 2))
    # far below it: the squared difference over the square of the background
    found = losses.log_ratio_loss(3 * y[:3], y[:3], background=100.0, reduction="none")
    torch.testing.assert_close(found, (2 * y[:3] / 100) ** 2, rtol=1e-5, atol=0)


def test_log_ratio_below_zero_and_in_the_dark():
    x = torch.tensor([-2.0, -1.0, 0.0, 5.0], requires_grad=True)
    value = losses.log_ratio_loss(x, torch.zeros(4), background=0.5, reduction="none")
    torch.testing.assert_close(value, torch.tensor([16.0, 4.0, 0.0, math.log(11) ** 2]))
    value.sum().backward()
    torch.testing.assert_close(x.grad, torch.tensor([-16.0, -8.0, 0.0, 2 * math.log(11) / 5.5]))
    # a dark target: 1e-3 of the input's mean
    found = losses.log_ratio_loss(torch.ones(4), torch.zeros(4))
    assert float(found) == pytest.approx(math.log(1001) ** 2, rel=1e-5)


# ------------------------------------------------------------------------------------------------------- expected roots


def over_counts(mean, function):
    """Mean of a function of Poisson counts of each mean (N,), summed over all counts that matter."""
    n = torch.arange(900, dtype=torch.float64)
    probability = (torch.xlogy(n, mean[:, None]) - mean[:, None] - torch.lgamma(n + 1)).exp()
    return (probability * function(n)).sum(1)


def test_expected_roots_are_means_over_counts():
    """From the dark over the end of the table, at 63.6, to 500 counts: values and slopes."""
    mean = torch.cat([torch.zeros(1), torch.logspace(-9, math.log10(500), 501), torch.linspace(63.5, 63.8, 31)])
    mean = mean.double().requires_grad_()
    found = losses.expected_anscombe(mean)
    torch.testing.assert_close(found, over_counts(mean, losses.anscombe), rtol=0, atol=1e-10)
    (slope,) = torch.autograd.grad(found.sum(), mean)
    wanted = over_counts(mean.detach(), lambda n: losses.anscombe(n + 1) - losses.anscombe(n))
    torch.testing.assert_close(slope, wanted, rtol=0, atol=1e-9)
    # single precision: four of its steps of the value; also one step before the end of the table
    end = torch.tensor([64 - 3 / 8], dtype=torch.float32).nextafter(torch.zeros(1))
    mean = torch.cat([mean.detach(), end.double()])
    found = losses.expected_anscombe(mean)
    single = losses.expected_anscombe(mean.float())
    torch.testing.assert_close(single.double(), found, rtol=4 * 2**-24, atol=4 * 2**-24)


def test_expected_roots_of_many_counts():
    """Anscombe's expansion, whose next term is 1/(64 m^1.5) of the root."""
    mean = torch.tensor([1e3, 1e5, 1e8], dtype=torch.float64)
    wanted = 2 * (mean + 3 / 8).sqrt() - 1 / (4 * mean.sqrt())
    torch.testing.assert_close(losses.expected_anscombe(mean), wanted, rtol=0, atol=1e-5)
    assert float(losses.expected_anscombe(torch.tensor(math.inf))) == math.inf
    assert math.isnan(float(losses.expected_anscombe(torch.tensor(math.nan))))


def test_expected_roots_below_zero_and_derivatives():
    x = torch.tensor([-2.0, -1e-3, 0.0, 1e-12, 0.3, 5.0, 63.6, 63.7, 100.0], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(losses.expected_anscombe, x)
    slope = 2 * (math.sqrt(11 / 8) - math.sqrt(3 / 8))
    torch.testing.assert_close(
        losses.expected_anscombe(x[:1]), torch.tensor([2 * math.sqrt(3 / 8) - 2 * slope], dtype=torch.float64)
    )
    for dtype in (torch.uint8, torch.int64, torch.float16):
        found = losses.expected_anscombe(torch.tensor([0, 3, 90]).to(dtype))
        torch.testing.assert_close(found, losses.expected_anscombe(torch.tensor([0.0, 3.0, 90.0])))


@pytest.mark.parametrize("mean", [0.05, 40.0])
def test_which_mean_is_best(mean):
    """On average over counts the expected root's loss is least at the right mean, the plain root's beside it."""
    truth = torch.tensor([mean], dtype=torch.float64)
    variance = float(over_counts(truth, lambda n: losses.anscombe(n) ** 2) - over_counts(truth, losses.anscombe) ** 2)

    def slope(root):
        m = truth.clone().requires_grad_()
        (root(m) - over_counts(truth, losses.anscombe)).square().backward()
        return float(m.grad) / variance

    assert abs(slope(losses.expected_anscombe)) < 1e-9
    # of the plain root: 2 (m^-1/2)(1/(4 sqrt m)) = 1/(2 m) to first order
    assert slope(losses.anscombe) > 0.2 / max(mean, 1)
