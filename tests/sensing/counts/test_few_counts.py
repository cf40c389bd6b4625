"""Draws of few counts, each looked up by itself: the same distributions as those of many, which go by a tree."""

from __future__ import annotations

import pytest
import torch

from torchtransient.sensing import counts as moved_counts
from torchtransient.sensing import draws
from torchtransient.sensing.counts import Moves, move_counts


def fits(found, expected, draws_of_each):
    """Chi square of numbers whose expectation is known, by its degrees of freedom."""
    live = expected > 0
    assert bool((found[~live] == 0).all())
    chi = ((found - expected)[live].square() / expected[live]).sum()
    degrees = float(live.sum())
    assert abs(float(chi) - degrees) < 5 * (2 * degrees) ** 0.5 + 0.02 * draws_of_each**0.5


@pytest.mark.parametrize("few", [True, False])
@pytest.mark.parametrize("kind", ["multinomial", "first photons"])
def test_first_photons_of_few_and_of_many_counts(monkeypatch, few, kind):
    monkeypatch.setattr(draws, "_FEW_COUNTS", 1 << 30 if few else 0)
    g = torch.Generator().manual_seed(3)
    weights = torch.rand(1, 9, 1, 4, generator=g, dtype=torch.float64) * 0.15
    weights[:, 3:5, :, 1] = 0.0
    weights[:, -2:, :, 2] = 0.0
    weights[..., 3] = 0.0
    trials, repeats = 40, 400
    images = weights.repeat(repeats, 1, 1, 1).unsqueeze(1)
    if kind == "multinomial":
        weights, images = weights / 2, images / 2
        counts, p = draws.sample_multinomial(trials, images, g), weights
    else:
        counts = draws.sample_first_photons(trials, images, g)
        p = -torch.expm1(-weights) * torch.exp(weights - weights.cumsum(1))
    assert torch.equal(counts, counts.round())
    assert float(counts.sum(-3).max()) <= trials
    fits(counts.sum((0, 1))[..., 0, :], trials * repeats * p[0, :, 0], repeats)
    # neighbours take counts from each other
    pair = counts[:, 0, :2, 0, 0]
    covariance = float(torch.cov(pair.T)[0, 1])
    expected = -trials * float(p[0, 0, 0, 0] * p[0, 1, 0, 0])
    assert abs(covariance - expected) < 5 * float(pair.var(0).prod().sqrt()) / repeats**0.5


@pytest.mark.parametrize("block", [1, 9, 10, 12])
@pytest.mark.parametrize("bins", [13, 16])
def test_counts_are_parted_block_by_block(monkeypatch, block, bins):
    """As many pairs of bins at a time as fit into a block, one at least, and the last few; odd ones stay."""
    monkeypatch.setattr(draws, "_FEW_COUNTS", 0)
    monkeypatch.setattr(draws, "_PAIRS", block)
    shares = 1 + torch.rand(bins, 1, 3, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    shares[5, :, 1], shares[-1, :, 2] = 0.0, 0.0
    shares = shares / shares.sum(0)
    trials = 1_000_000
    counts = draws.sample_multinomial(trials, shares * (1 - 1e-12), torch.Generator().manual_seed(0))
    assert counts.sum(0).flatten().tolist() == [float(trials)] * 3  # all but one of 1e6
    spread = (trials * shares * (1 - shares)).sqrt()
    assert bool(((counts - trials * shares).abs() <= 5 * spread).all())
    assert bool((counts != (trials * shares).round()).any())


@pytest.mark.parametrize("boundary", ["periodic", "zero"])
@pytest.mark.parametrize("lost", [0.0, 0.3])
@pytest.mark.parametrize("first", [-2, 0, 9])
def test_moves_of_few_and_of_many_counts(monkeypatch, boundary, lost, first):
    shares = torch.tensor([0.1, 0.0, 0.6, 0.3], dtype=torch.float64) * (1 - lost)
    moves = Moves(first, shares, boundary)
    counts = torch.zeros(400, 1, 7, 2, 1)
    counts[..., 0, :, :], counts[..., 4, 1, :], counts[..., 6, 0, :] = 11.0, 3.0, 2.0
    expected = 400 * moves.mean(counts[:1].double())[0, 0, :, :, 0]
    for most in (1 << 30, -1):
        monkeypatch.setattr(moved_counts, "_SINGLE", most)
        moved, _ = move_counts(counts, moves, torch.Generator().manual_seed(5))
        assert moved.dtype == counts.dtype
        assert torch.equal(moved, moved.round())
        found = moved.sum((0, 1)).double()[..., 0]
        assert bool(((found - expected).abs() <= 5 * expected.sqrt()).all())
        if boundary == "periodic" and not lost:
            assert torch.equal(moved.sum((1, 2)), counts.sum((1, 2)))
        elif expected.sum() > 0:
            assert float(moved.sum()) <= float(counts.sum())
    alone, _ = move_counts(counts * 0, moves, torch.Generator().manual_seed(5))
    assert not bool(alone.any())


@pytest.mark.parametrize("pixels", [1, 1 << 13, 1 << 14])
def test_the_largest_random_number_stays_in_its_column(pixels, monkeypatch):
    def largest(shape, **_):
        return torch.full(shape, 1 - 2.0**-53, dtype=torch.float64)

    monkeypatch.setattr(draws.torch, "rand", largest)
    chances = torch.tensor([[0.25], [0.5], [0.5]], dtype=torch.float64).expand(-1, pixels)
    counts = draws._one_by_one(torch.ones(pixels, dtype=torch.float64), chances, None)
    assert torch.equal(counts, torch.tensor([[0.0], [1.0], [0.0]], dtype=torch.float64).expand(-1, pixels))


@pytest.mark.parametrize("tally", [False, True])
def test_bins_whose_counts_go_by_lags_of_their_own(tally):
    """Lags that a bin does not use get none of its counts, whichever are looked at together."""
    shares = torch.zeros(4, 4, dtype=torch.float64)
    shares[:2, 0], shares[2:, 1] = 0.5, 0.5
    shares[0, 2], shares[3, 3] = 1.0, 1.0
    for level in (3.0, 1000.0):
        counts = torch.full((1, 4, 2, 3), level, dtype=torch.float64)
        g = torch.Generator().manual_seed(0)
        moved, tallies = move_counts(counts, Moves(0, shares, "periodic"), g, tally=tally)
        # bin 0 goes to 0 and 1, bin 1 to 3 and 0, bin 2 to itself, bin 3 to 2
        assert bool((moved.sum(1) == 4 * level).all())
        assert bool((moved[:, 0] + moved[:, 1] + moved[:, 3] == 2 * level).all())
        assert bool((moved[:, 2] == 2 * level).all()) and 0 < float(moved[:, 1].mean()) < level
        if tallies is not None:
            assert bool((tallies[:2].sum(0) == 2 * level).all()) and bool((tallies[3] >= level).all())


def test_shares_that_rounding_puts_below_none_or_above_all():
    """Draws, tallies and noise are those of none and of all."""
    x = torch.full((1, 3, 40, 50), 7.0, dtype=torch.float64)
    below = Moves(-1, torch.tensor([-1e-17, 0.6, 0.4], dtype=torch.float64), "periodic")
    above = Moves(0, torch.tensor([[0.5, 0.3, 0.2], [0.1, 0.7 + 3e-16, 0.8 + 3e-16]], dtype=torch.float64), "periodic")
    assert float(above.shares.sum(0).max()) > 1 and float(above.shares.sum(0).min()) < 1
    for moves in (below, above):
        assert bool(torch.isfinite(moves.noise(x, torch.Generator().manual_seed(0))).all())
        moved, tallies = move_counts(x, moves, torch.Generator().manual_seed(0), tally=True)
        assert bool((moved >= 0).all()) and tallies is not None and bool((tallies >= 0).all())
        assert moved.mean((0, 2, 3)).tolist() == pytest.approx(moves.mean(x).mean((0, 2, 3)).tolist(), abs=0.3)
    assert float(move_counts(x, below, torch.Generator().manual_seed(0), tally=True)[1][0].sum()) == 0
