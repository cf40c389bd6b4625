"""The chain of detection phases as a matrix: against quadrature, its transpose, dense solutions and derivatives."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch.autograd import forward_ad

from torchtransient.errors import TorchTransientError
from torchtransient.sensing.dead_time import free_running, renewal
from torchtransient.sensing.dead_time.renewal import RenewalChain, solve_banded

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

    def spied(chain, right, pinned, *, transposed):
        pins.append(pinned.tolist())
        return solve_banded(chain, right, pinned, transposed=transposed)

    pins = []
    monkeypatch.setattr(renewal, "gmres", stuck)
    monkeypatch.setattr(renewal, "solve_banded", spied)
    for found, exact in zip(solved(rate, part, 3), wanted, strict=True):
        torch.testing.assert_close(found, exact, rtol=1e-7, atol=1e-9)
    # each row is held where its own detections are: lines twice, both derivatives, and the change
    largest = wanted[0][1:, :6].argmax(-1).tolist()
    assert largest[0] != largest[1] and pins == [largest] * 5
    monkeypatch.setattr(renewal, "solve_banded", lambda chain, right, *_, **__: right + 0.1)
    with pytest.raises(TorchTransientError, match="stationary_phases: expected a relative residual"):
        renewal.stationary_phases(rate, part, 3)
    monkeypatch.setattr(renewal, "gmres", converging)
    leaf = rate.clone().requires_grad_()
    pi = renewal.stationary_phases(leaf, part, 3)
    monkeypatch.setattr(renewal, "gmres", stuck)
    with pytest.raises(TorchTransientError, match="relative residual"):
        torch.autograd.grad(pi[:, 0].sum(), leaf)


def test_which_trains_are_drawn_with_their_memory(monkeypatch):
    """A wait below half a period, and bins that three of the larger deviations would leave with too little."""
    waits = [1.99, 0.5, 2.0, 1.0, 3.0]
    per_bin = torch.tensor([[0.1, 0.2, 0.3, 0.4]], dtype=torch.float64).expand(5, -1)
    per_bin = per_bin * 4 / (torch.tensor(waits).double() + 1.5).unsqueeze(1) / per_bin.sum(-1, keepdim=True)
    asked, mean = [], 10 * per_bin
    # by how much the first bin would fall short, as a share of all counts
    short = torch.tensor([0.0101, 0.0099, 9.0, 0.02, 9.0], dtype=torch.float64)

    class State:
        def __init__(self):
            self.per_bin = per_bin

        def select(self, rows):
            asked.append(rows.tolist())
            return rows

    def periods(rows, number, generator, *, normal):
        assert number == 10 and normal
        more = 0.1 * mean[rows]
        half = rows.numel() // 2
        more[half:, 0] = -(mean[:, 0] + short * mean.sum(-1))[rows[half:]] / 3
        return None, more

    monkeypatch.setattr(free_running, "_independent_periods", periods)
    dead = torch.tensor(1.5, dtype=torch.float64)
    wide = free_running._remembers_phase(State(), per_bin, dead, 10)
    assert wide.tolist() == [True, False, False, True, False] and asked == [[0, 1, 3, 0, 1, 3]]
    assert not bool(free_running._remembers_phase(State(), per_bin, dead, 1).any()) and len(asked) == 1
