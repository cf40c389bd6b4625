"""The chain of detection phases as a matrix: against quadrature, its transpose, dense solutions and derivatives."""

from __future__ import annotations

import math

import mpmath
import numpy as np
import pytest
import torch
from torch.autograd import forward_ad

from torchtransient.errors import TorchTransientError
from torchtransient.sensing.dead_time import renewal
from torchtransient.sensing.dead_time.renewal import ConstantLight, RenewalChain, moments, second_moment
from torchtransient.sensing.time_convolution import sum_before

ROOT = math.sqrt(3.0)


def rates(bins, pixels=2, high=1.5, seed=0):
    g = torch.Generator().manual_seed(seed)
    return 0.05 + high * torch.rand(pixels, bins, generator=g, dtype=torch.float64)


def chain_of(rate, whole=2, part=0.3):
    return RenewalChain(rate, whole, torch.tensor(part, dtype=torch.float64))


def matrices(rate, whole, part, *, transposed=False):
    """(P, 2 T, 2 T): the step, or its transpose, applied to one after the other of all lines."""
    columns = []
    for line in torch.eye(2 * rate.shape[1], dtype=torch.float64):
        chain = chain_of(rate, whole, part)
        given = line.expand(rate.shape[0], -1)
        columns.append(chain.transposed(given) if transposed else chain.step(given))
    return torch.stack(columns, -1)


def step_by_quadrature(rate, whole, part, lines, number=400):
    """The step of one pixel by midpoint rules: (counts, slopes) and bins waited."""
    bins = len(rate)
    flux = np.concatenate([[0.0], np.cumsum(rate)])
    y = (np.arange(number) + 0.5) / number
    starts = (np.arange(bins)[:, None] + y).ravel()
    density = (lines[:bins, None] + ROOT * lines[bins:, None] * (2 * y - 1)).ravel() / number

    def until(t):
        return np.floor(t / bins) * flux[-1] + np.interp(t % bins, np.arange(bins + 1.0), flux)

    armed = starts + whole + part
    counts, slopes, waited = np.zeros(bins), np.zeros(bins), 0.0
    for k in range(60 * bins):
        begin, end = np.maximum(armed, k), k + 1.0
        inside = begin < end
        alive = density[inside] * np.exp(until(armed[inside]) - until(begin[inside]))
        length, r = end - begin[inside], rate[k % bins]
        fired = alive * -np.expm1(-r * length)
        # mean time to the detection among those that fire in the rest of the bin
        late = begin[inside] - k + 1 / r - length * np.exp(-r * length) / -np.expm1(-r * length)
        counts[k % bins] += fired.sum()
        slopes[k % bins] += (ROOT * fired * (2 * late - 1)).sum()
        waited += (alive * -np.expm1(-r * length) / r).sum()
    return np.concatenate([counts, slopes]), waited


@pytest.mark.parametrize("whole, part", [(0, 0.7), (1, 0.0), (3, 0.85)])
def test_a_step_against_quadrature(whole, part):
    """Any lines, those below zero too: exact in the light, whatever the place of the dead time in its bin."""
    rate = rates(3, 1)
    lines = torch.tensor([[0.2, 0.5, 0.3, 0.1, -0.2, 0.15]], dtype=torch.float64)
    chain = chain_of(rate, whole, part)
    counts, waited = step_by_quadrature(rate[0].numpy(), whole, part, lines[0].numpy())
    np.testing.assert_allclose(chain.step(lines)[0].numpy(), counts, atol=2e-5)
    assert float(chain.waiting(lines)) == pytest.approx(waited, rel=1e-5)
    assert float(chain.step(lines)[0, :3].sum()) == pytest.approx(1.0, rel=1e-12)  # nothing is lost


@pytest.mark.parametrize("bins, whole, part, high", [(3, 1, 0.3, 1.5), (5, 7, 0.8, 1.5), (4, 0, 0.6, 900.0)])
def test_the_transpose_is_one(bins, whole, part, high):
    """In several blocks, too, where the flux of a period is more than a double's exponent."""
    rate = rates(bins, high=high)
    forwards, back = (matrices(rate, whole, part, transposed=t) for t in (False, True))
    torch.testing.assert_close(back, forwards.mT, rtol=1e-11, atol=1e-13)


def solved(rate, part, whole):
    """Stationary lines, their derivatives in both modes by light and dead time, and what becomes of a change."""
    leaves = rate.clone().requires_grad_(), part.clone().requires_grad_()
    pi = renewal.stationary_phases(*leaves, whole)
    weights = torch.rand(pi.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    slopes = torch.autograd.grad((pi * weights).sum(), leaves)
    along = torch.ones_like(rate) / 7 + rate.square(), torch.full_like(part, 0.3)
    with forward_ad.dual_level():
        duals = [forward_ad.make_dual(*pair) for pair in zip((rate, part), along, strict=True)]
        dual = renewal.stationary_phases(*duals, whole)
        forwards = forward_ad.unpack_dual(dual).tangent.clone()
    total = sum((s * a).sum() for s, a in zip(slopes, along, strict=True))
    torch.testing.assert_close((forwards * weights).sum(), total, rtol=1e-7, atol=1e-9)
    change = weights.clone()
    change[:, 0] -= change[:, : rate.shape[1]].sum(-1)
    change[0] = 0.0  # one that does not change
    after = renewal.sum_of_detections(RenewalChain(rate, whole, part), pi.detach(), change)
    return [pi.detach(), *slopes, forwards, after]


def test_stationary_lines_are_those_of_the_matrix():
    rate, part = rates(5, 3), torch.tensor(0.3, dtype=torch.float64)
    pi, *_, after = solved(rate, part, 2)
    step = matrices(rate, 2, 0.3)
    torch.testing.assert_close((step @ pi.unsqueeze(-1)).squeeze(-1), pi, rtol=1e-9, atol=1e-11)
    torch.testing.assert_close(pi[:, :5].sum(-1), torch.ones(3, dtype=torch.float64))
    assert bool((after[0] == 0).all())
    # all that becomes of a change is the change and, a step later, all of it once more
    weights = torch.rand(pi.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    weights[:, 0] -= weights[:, :5].sum(-1)
    change = after - (step @ after.unsqueeze(-1)).squeeze(-1)
    torch.testing.assert_close(change[1:], weights[1:], rtol=1e-8, atol=1e-9)
    torch.testing.assert_close(after[:, :5].sum(-1), torch.zeros(3, dtype=torch.float64), rtol=0, atol=1e-10)


def test_rows_that_do_not_converge_are_solved_directly(monkeypatch):
    """Those alone: lines, derivatives and changes are the same, to what iterations leave."""
    rate, part = rates(6, 3), torch.tensor(0.4, dtype=torch.float64)
    wanted = solved(rate, part, 3)
    converging = renewal.gmres

    def stuck(operator, right, start, *others):
        found, residual = converging(operator, right, start, *others)
        found, residual = found.clone(), residual.clone()
        found[1:], residual[1:] = math.nan, 1e-3
        return found, residual

    monkeypatch.setattr(renewal, "gmres", stuck)
    for found, exact in zip(solved(rate, part, 3), wanted, strict=True):
        torch.testing.assert_close(found, exact, rtol=1e-7, atol=1e-9)
    monkeypatch.setattr(renewal, "solve_banded", lambda chain, right, *_, **__: right + 0.1)
    with pytest.raises(TorchTransientError, match="stationary_phases: expected a relative residual"):
        renewal.stationary_phases(rate, part, 3)


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
