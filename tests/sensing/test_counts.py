"""Draws of few counts, each looked up by itself: the same distributions as those of many, which go by a tree."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy import stats

from torchtransient import TimeAxis, sensing
from torchtransient.sensing import counts as moved_counts
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


CASES = [
    (n, p)
    for n in (0, 1, 2, 3, 7, 25, 31, 32, 62, 63, 400)
    for p in (0.0, 1e-3, 0.02, 0.3, 0.45, 0.497, 0.5, 0.503, 0.6, 0.9, 1.0)
]


@pytest.mark.slow
@pytest.mark.parametrize("draw, dtype", [("thin", torch.float32), ("halve", torch.float64)], ids=str)
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
    for drawn in (x, y):
        for lag in (1, 2, 3, 4, 8):
            correlation = float((drawn[lag:] * drawn[:-lag]).mean() / drawn.var())
            assert abs(correlation) < 5 / 2_000_000**0.5


def test_a_sum_of_many_draws_has_the_variance_of_a_binomial():
    """Small differences from the distribution add up in sums: 2e6 draws of 60 with share 0.47 each."""
    n, p, size = 60, 0.47, 2_000_000
    x = halve(torch.full((size,), float(n)), torch.full((size,), p), torch.Generator().manual_seed(6)).double()
    p = float(torch.tensor(p).double())
    assert abs(float(x.mean()) - n * p) < 5 * (n * p * (1 - p) / size) ** 0.5
    assert abs(float(x.var()) / (n * p * (1 - p)) - 1) < 5 * (2 / size) ** 0.5


def test_many_trials_and_photons():
    """More trials than tables have, and means past the whole numbers of single precision."""
    size, g = 40_000, torch.Generator().manual_seed(2)
    shared = halve(torch.full((size,), 1000.0), torch.full((size,), 0.25), g)
    photons = moved_counts.poisson(torch.full((size,), 3e7), g)
    for found, mean, variance in ((shared, 250.0, 187.5), (photons, 3e7, 3e7)):
        found = found.double() - mean
        assert abs(float(found.mean())) < 5 * (variance / size) ** 0.5
        assert abs(float(found.square().mean()) / variance - 1) < 5 * (2 / size) ** 0.5


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


BINS = 16
AXIS = TimeAxis.from_seconds(0.0, 1e-10, BINS)
MOVES = {
    "DetectionJitter": lambda grad="expected": sensing.DetectionJitter(
        sensing.GaussianResponse(3e-10, learnable=True), AXIS, grad=grad
    ),
    "DetectionSkew": lambda grad="expected": sensing.DetectionSkew(130e-12, AXIS, learnable=True, grad=grad),
    "DetectionSkew of a map": lambda grad="expected": sensing.DetectionSkew(
        torch.tensor([[0.0, -70e-12]]), AXIS, learnable=True, grad=grad
    ),
    "TDC": lambda grad="expected": sensing.TDC(torch.ones(BINS), dither=True, grad=grad),
}
ADDS = {
    "Afterpulsing": lambda grad="expected": sensing.Afterpulsing(0.1, 1e-9, 1e-10, axis=AXIS, grad=grad),
    "Crosstalk": lambda grad="expected": sensing.Crosstalk(0.05, grad=grad),
}


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def three_items(dtype=torch.float64):
    """Counts, means, counts so many that none is followed by itself."""
    counts = torch.poisson(torch.full((1, 1, BINS, 1, 2), 5.0, dtype=dtype), generator=generator())
    return torch.cat([counts, torch.full_like(counts, 0.5), counts * 1000])


@pytest.mark.parametrize("make", MOVES.values(), ids=MOVES)
@pytest.mark.parametrize("policy", ["straight_through", "score"])
def test_moves_of_an_item_do_not_depend_on_what_is_beside_it(make, policy):
    sensor, x = make(policy), three_items().requires_grad_()
    with sensing.ScoreFunction() as score:
        y = sensor(x, generator=generator())
    for found in (y, sensor.sample(x, generator(1))):
        assert torch.equal(found[[0, 2]], found[[0, 2]].round())
        torch.testing.assert_close(found[[0, 2]].sum(2), x[[0, 2]].sum(2))
        torch.testing.assert_close(found[1], sensor.expected(x[1]))
        assert not torch.equal(found[0], sensor.expected(x[0]))
    parameters = [p for p in sensor.parameters() if p.requires_grad]
    if policy == "score" and parameters:
        # the item of means pulls at the parameters by its mean alone, those of counts by their ways
        weight = torch.arange(BINS, dtype=torch.float64).square().view(-1, 1, 1)
        of_mean = torch.autograd.grad((y * weight)[1].sum(), parameters, retain_graph=True)
        alone = torch.autograd.grad((sensor.expected(x[1:2]) * weight).sum(), parameters)
        torch.testing.assert_close(of_mean, alone)
        of_ways = torch.autograd.grad(score.log_prob(()), parameters, retain_graph=True)
        assert all(bool((g != 0).any()) for g in of_ways)
    (slope,) = torch.autograd.grad(y.sum(), x)
    torch.testing.assert_close(slope, torch.ones_like(x))


@pytest.mark.parametrize("make", ADDS.values(), ids=ADDS)
def test_what_is_added_to_an_item_does_not_depend_on_what_is_beside_it(make):
    """Single events of whole counts, which are known by their numbers: the same as of the item alone."""
    sensor, x = make(), three_items()
    beside = torch.cat([x[:1], x[1:2], x[:1] * 10_000])
    for batch in (x[:1], beside):
        y = sensor.sample(batch.expand(len(batch), 1, BINS, 1, 2), generator())
        assert torch.equal(y[0], y[0].round())
    # an item in the dark can get nothing, next to bright ones, of whose events a list would not fit into memory
    dark = torch.cat([torch.zeros_like(x[:1]), x[1:2], x[2:] * 1e10])
    y = sensor.sample(dark, generator())
    assert float(y[0].abs().max()) == 0 and bool((y[1] >= dark[1]).all()) and bool((y[2] > dark[2]).any())


@pytest.mark.parametrize("make", MOVES.values(), ids=MOVES)
def test_draws_at_the_end_of_single_precision_are_those_of_double(make):
    """Rounded once, at the end: what is above 2^24 has no odd numbers there."""
    x = torch.full((2, 1, BINS, 1, 2), 2.0**24 - 1)
    single, double = (make().sample(v, generator()) for v in (x, x.double()))
    assert torch.equal(double.sum(2), x.double().sum(2))
    assert torch.equal(single, double.float())
