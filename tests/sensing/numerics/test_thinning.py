"""Binomial draws against the binomial distribution: every count, share and mixture of them."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy import stats

from support.sweeps import together
from torchtransient.sensing.draws import LagTable, halve, thin

DRAWS = 25_000


def chi_square_is_small(found, n, p):
    """Frequencies of `found` against binomial(n, p): chi2 as large as once in 1e7, nothing impossible."""
    counts = np.bincount(found.astype(int), minlength=n + 1)
    assert counts.size == n + 1, f"more than {n} events"
    expected = stats.binom.pmf(np.arange(n + 1), n, p) * found.size
    assert counts[expected == 0].sum() == 0
    often = expected > 8
    rest, rest_expected = counts[~often].sum(), expected[~often].sum()
    assert rest <= rest_expected + 6 * rest_expected**0.5 + 3, f"{rest} in the tails, {rest_expected:.2f} expected"
    if often.sum() > 1:
        chi2 = ((counts - expected)[often] ** 2 / expected[often]).sum()
        bound = stats.chi2.isf(1e-7, often.sum() - 1)  # some 700 cases are looked at
        assert chi2 < bound, f"n = {n}, p = {p}: chi2 = {chi2:.1f}, expected below {bound:.1f}"


def dense(events, like):
    out = torch.zeros(like.numel(), dtype=like.dtype)
    out[events.place] = events.number
    assert bool((events.place[1:] > events.place[:-1]).all())
    return out.view(like.shape)


SLOW = pytest.mark.slow
CASES = [
    (n, p)
    for n in (0, 1, 2, 3, 7, 25, 31, 32, 62, 63, 400)
    for p in (0.0, 1e-3, 0.02, 0.3, 0.45, 0.497, 0.5, 0.503, 0.6, 0.9, 1.0)
]


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [torch.float32, pytest.param(torch.float64, marks=SLOW)], ids=str)
@pytest.mark.parametrize("draw", ["thin", "halve"])
def test_frequencies(draw, dtype):
    """All cases shuffled into one tensor, so that every block holds all of them."""
    order = torch.randperm(len(CASES) * DRAWS, generator=torch.Generator().manual_seed(0))
    case = torch.arange(len(CASES)).repeat_interleave(DRAWS)[order]
    n = torch.tensor([float(n) for n, _ in CASES], dtype=dtype)[case]
    p = torch.tensor([p for _, p in CASES], dtype=torch.float64).to(dtype)[case]
    g = torch.Generator().manual_seed(1)
    found = dense(thin(n, p, g), n) if draw == "thin" else halve(n, p, g)
    assert found.dtype == dtype
    for k, (number, share) in enumerate(CASES):
        exact = float(torch.tensor(share).to(dtype)) if share not in (0.0, 1.0) else share
        chi_square_is_small(found[case == k].numpy(), number, exact)


@pytest.mark.slow
@together("n, p", CASES)
def test_frequencies_of_equal_entries(n, p):
    """Every case alone: blocks take the way that suits all of their entries."""
    counts = torch.full((200, 250), float(n))
    g = torch.Generator().manual_seed(2)
    chi_square_is_small(dense(thin(counts, p, g), counts).flatten().numpy(), n, p)
    share = torch.full_like(counts, p, dtype=torch.float64).to(counts.dtype)
    exact = float(share.flatten()[0].double()) if 0 < p < 1 else p
    chi_square_is_small(halve(counts, share, g).flatten().numpy(), n, exact)


@pytest.mark.parametrize("p", [1e-7, 1e-4])
def test_very_rare_events(p):
    """Probabilities far below the steps of the first comparison."""
    counts = torch.full((3_000_000,), 3.0)
    number = thin(counts, p, torch.Generator().manual_seed(0)).number.sum()
    mean = 9e6 * p
    assert abs(float(number) - mean) < 5 * mean**0.5 + 3
    many = torch.full((400_000,), 1e6, dtype=torch.float64)
    number = thin(many, p, torch.Generator().manual_seed(0)).number.sum()
    assert abs(float(number) - 4e11 * p) < 5 * (4e11 * p) ** 0.5


def test_neighbouring_entries_are_independent():
    counts = torch.full((2_000_000,), 10.0)
    x = dense(thin(counts, 0.05, torch.Generator().manual_seed(0)), counts).double() - 0.5
    y = halve(counts, torch.full_like(counts, 0.52), torch.Generator().manual_seed(0)).double() - 5.2
    for draws in (x, y):
        for lag in (1, 2, 3, 4, 8):
            correlation = float((draws[lag:] * draws[:-lag]).mean() / draws.var())
            assert abs(correlation) < 5 / 2_000_000**0.5


def test_a_sum_of_many_draws_has_the_variance_of_a_binomial():
    """Small differences from the distribution add up in sums: 2e6 draws of 60 with share 0.47 each."""
    n, p, size = 60, 0.47, 2_000_000
    x = halve(torch.full((size,), float(n)), torch.full((size,), p), torch.Generator().manual_seed(6)).double()
    p = float(torch.tensor(p).double())
    assert abs(float(x.mean()) - n * p) < 5 * (n * p * (1 - p) / size) ** 0.5
    assert abs(float(x.var()) / (n * p * (1 - p)) - 1) < 5 * (2 / size) ** 0.5


def test_lags_follow_their_distribution():
    """Also where a lag is much rarer than a cell of the table, and where it is impossible."""
    k = torch.arange(3000, dtype=torch.float64)
    p = torch.exp(-k / 300) * (k % 7 != 3)
    p[2500:] *= 1e-2
    p = p / p.sum()
    found = LagTable(p).draw(torch.empty(1_000_000), torch.Generator().manual_seed(0))
    counts = torch.bincount(found, minlength=3000).double()
    assert counts.numel() == 3000
    assert float(counts[p == 0].sum()) == 0
    often = p * 1e6 > 8
    chi2 = float(((counts - 1e6 * p) ** 2 / (1e6 * p))[often].sum())
    assert chi2 < stats.chi2.isf(1e-7, int(often.sum()) - 1)
    rest = float(p[~often].sum() * 1e6)
    assert abs(float(counts[~often].sum()) - rest) < 6 * rest**0.5 + 3
