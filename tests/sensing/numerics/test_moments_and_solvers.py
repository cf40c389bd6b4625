"""Moments of exponentials to the last digits, rows of equations by GMRES, constant light with losses, sums."""

from __future__ import annotations

import math

import mpmath
import pytest
import torch

from torchtransient.sensing.dead_time.renewal import ConstantLight, RenewalChain, moments, second_moment
from torchtransient.sensing.time_convolution import sum_before

BELOW = math.nextafter(1.0, 0.0)
SMALL = [0.0, 1e-12, 1e-3, 0.4, BELOW, 1.0]
LARGE = [math.nextafter(1.0, 2.0), 1.5, 7.0, 60.0, 900.0]


def decayed(power, x):
    """Integral over z from 0 to 1 of z^power exp(-x z), in 50 digits."""
    with mpmath.workdps(50):
        x = mpmath.mpf(x)
        return mpmath.gammainc(power + 1, 0, x) / x ** (power + 1) if x else mpmath.mpf(1) / (power + 1)


def caught(power, x):
    """... of z^power (1 - exp(-x z)) / x."""
    with mpmath.workdps(50):
        return (mpmath.mpf(1) / (power + 1) - decayed(power, x)) / mpmath.mpf(x) if x else mpmath.mpf(1) / (power + 2)


def slope_of_caught(power, x):
    with mpmath.workdps(50):
        if x == 0:
            return -mpmath.mpf(1) / (2 * (power + 3))
        return (decayed(power + 1, x) - caught(power, x)) / mpmath.mpf(x)


def close(found, wanted, rtol):
    wanted = torch.tensor([float(w) for w in wanted], dtype=torch.float64)
    torch.testing.assert_close(found, wanted, rtol=rtol, atol=0)


@pytest.mark.parametrize(
    ("values", "largest"),
    [(SMALL[:4], 0.4), (SMALL[:3], 1e-3), (SMALL + LARGE, None), (SMALL + LARGE, 900.0), ([0.0, 0.0], None)],
)  # fmt: skip
def test_moments_and_their_slopes(values, largest):
    """Of all rates, with and without a bound that is known: few roundings of the number itself."""
    x = torch.tensor(values, dtype=torch.float64, requires_grad=True)
    found = moments(x, largest)
    for power in (0, 1):
        close(found.decay[power].detach(), [decayed(power, v) for v in values], 4e-15)
        close(found.hit[power].detach(), [caught(power, v) for v in values], 4e-15)
        (slope,) = torch.autograd.grad(found.decay[power].sum(), x, create_graph=True)
        close(slope.detach(), [-decayed(power + 1, v) for v in values], 2e-13)
        (slope,) = torch.autograd.grad(slope.sum(), x, retain_graph=True)
        close(slope.detach(), [decayed(power + 2, v) for v in values], 2e-11)
        (slope,) = torch.autograd.grad(found.hit[power].sum(), x, retain_graph=True)
        close(slope, [slope_of_caught(power, v) for v in values], 2e-12)
    close(second_moment(x).detach(), [decayed(2, v) for v in values], 1e-14)
    (slope,) = torch.autograd.grad(second_moment(x).sum(), x)
    close(slope, [-decayed(3, v) for v in values], 2e-12)


# ------------------------------------------------------------------------------------------------------------ solvers


def random(*shape, seed=0):
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize(("bins", "whole"), [(6, 2), (7, 17)])
def test_constant_light_with_losses_is_inverted(bins, whole):
    """1 - kept F, and its transpose: nothing is left to a rank-one term."""
    rate = torch.tensor([[0.05], [0.8], [6.0]], dtype=torch.float64)
    kept, part = torch.tensor([[0.9], [0.4], [0.97]], dtype=torch.float64), torch.tensor(0.35, dtype=torch.float64)
    chain = RenewalChain(rate.expand(3, bins).contiguous(), whole, part)
    inverse = ConstantLight(1 / rate, bins, whole, part, kept)
    x = random(3, 2 * bins)
    torch.testing.assert_close(inverse.solve(x - kept * chain.step(x)), x, rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(inverse.solve_transposed(x - kept * chain.transposed(x)), x, rtol=1e-10, atol=1e-10)


# --------------------------------------------------------------------------------------------------------------- sums


@pytest.mark.parametrize("image", [(2, 3), (7, 9), (8, 8), (5, 13)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_sums_before_of_small_and_large_images(image, dtype):
    """One by one, in float64; gradients are sums behind, in the dtype of what is summed."""
    x = torch.rand(2, 5, *image, generator=torch.Generator().manual_seed(0)).to(dtype).requires_grad_()
    found = sum_before(x)
    assert found.dtype == torch.float64
    wanted = torch.stack([x.detach().double()[:, :k].sum(1) for k in range(5)], 1)
    torch.testing.assert_close(found.detach(), wanted, rtol=1e-14, atol=1e-15)
    weights = torch.rand(found.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    (slope,) = torch.autograd.grad((found * weights).sum(), x)
    behind = torch.stack([weights[:, k + 1 :].sum(1) for k in range(5)], 1)
    assert slope.dtype == dtype
    torch.testing.assert_close(slope, behind.to(dtype))
    tangent = torch.func.jvp(sum_before, (x.detach(),), (2 * x.detach(),))[1]
    torch.testing.assert_close(tangent, 2 * wanted, rtol=1e-6, atol=0)
    for dim in (0, 2, 3):
        many = torch.func.vmap(sum_before, in_dims=dim)(torch.stack([x.detach(), 3 * x.detach()], dim))
        torch.testing.assert_close(many, torch.stack([wanted, 3 * wanted]), rtol=1e-6, atol=0)
