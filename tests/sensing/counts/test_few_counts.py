"""Draws of few counts, each looked up by itself: the same distributions as those of many, which go by a tree."""

from __future__ import annotations

import pytest
import torch

from torchtransient.sensing import Moves, draws
from torchtransient.sensing import counts as moved_counts
from torchtransient.sensing.counts import move_counts


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
