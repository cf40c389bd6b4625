"""Losses of coarser records: sums of bins, likelihoods that stay likelihoods, from how far they pull."""

import functools
import math

import pytest
import torch

from torchtransient import losses
from torchtransient.errors import ArgumentError
from torchtransient.sensing import SynchronousSPAD


def record(*values):
    return torch.tensor(values, dtype=torch.float64).reshape(1, -1, 1, 1)


def test_scales_by_hand():
    """Three bins, scales 1 and 2: coarse bins begin at 0 (a + b, c) and at -1 (a, b + c), four of them, two places."""
    a, b, c = 1.0, 3.0, 7.0
    x, y = record(a, b, c), record(0.0, 0.0, 0.0)
    one, two = (a**2 + b**2 + c**2) / 3, ((a + b) ** 2 + c**2 + a**2 + (b + c) ** 2) / 2 / 3
    assert float(losses.multiscale_loss(x, y, dim=-3)) == pytest.approx((one + two) / 2)
    assert float(losses.multiscale_loss(x[:, :2], y[:, :2], dim=-3)) == pytest.approx((a**2 + b**2) / 2)


def test_coarse_first_photons_are_those_of_coarser_detectors():
    """The mean over scales of log-probabilities by `SynchronousSPAD` of records summed by hand."""
    g = torch.Generator().manual_seed(3)
    rate = 0.3 * torch.rand(1, 12, 2, 2, generator=g, dtype=torch.float64)
    counts = SynchronousSPAD(500)(rate, generator=g)
    compare = functools.partial(losses.first_photon_nll, cycles=500)
    found = 12 * losses.multiscale_loss(rate, counts, compare, reduction="none")

    def coarse(x, scale, place):
        padded = torch.nn.functional.pad(x, (0, 0, 0, 0, place, -(12 + place) % scale))
        return padded.unflatten(1, (-1, scale)).sum(2)

    def at(scale):
        pairs = [(coarse(rate, scale, place), coarse(counts, scale, place)) for place in range(scale)]
        each = [losses.first_photon_nll(r, n, 500, dim=-3, reduction="none").sum(1) for r, n in pairs]
        return torch.stack(each).mean(0)

    torch.testing.assert_close(found, sum(at(scale) for scale in (1, 2, 4, 8)) / 4)


def test_squares_of_many_scales_pull_from_their_largest():
    """A pulse 60 bins off: no slope at scale one, a steady one as long as scales reach."""
    t = torch.arange(128, dtype=torch.float64)
    still = torch.exp(-0.5 * (t - 30) ** 2).reshape(1, -1, 1, 1)
    for offset in (5.0, 20.0, 60.0, -20.0):
        at = torch.tensor(30 + offset, dtype=torch.float64, requires_grad=True)
        moved = torch.exp(-0.5 * (t - at) ** 2).reshape(1, -1, 1, 1)
        (fine,) = torch.autograd.grad(losses.squared_loss(moved, still), at, retain_graph=True)
        (many,) = torch.autograd.grad(losses.multiscale_loss(moved, still), at)
        assert math.copysign(1, offset) * float(many) > 1e-4
        assert abs(offset) == 5 or abs(float(fine)) < 1e-12


def test_dimension_of_time_held_by_the_loss_that_compares():
    """By the partial, by the argument, by both: the same; two dimensions are refused."""
    g = torch.Generator().manual_seed(2)
    x = 0.1 + torch.rand(2, 5, 9, 4, generator=g, dtype=torch.float64)
    y = torch.poisson(3 * x, generator=g)
    held = functools.partial(losses.first_photon_nll, cycles=100, dim=-2)
    wanted = losses.multiscale_loss(x, y, functools.partial(losses.first_photon_nll, cycles=100), dim=-2)
    for dim in (None, -2, 2):
        torch.testing.assert_close(losses.multiscale_loss(x, y, held, dim=dim), wanted)
    with pytest.raises(ArgumentError, match="dim=-3, and dim=-2 held"):
        losses.multiscale_loss(x, y, held, dim=-3)


@pytest.mark.parametrize("masked", [False, True])
def test_light_of_bins_adds_up(masked):
    """A background that is held is that which the record could have in its bins: the same exact likelihood."""
    g = torch.Generator().manual_seed(3)
    x = torch.rand(2, 3, 9, 4, 5, generator=g, dtype=torch.float64)
    y = torch.poisson(3 * x, generator=g)
    mask = torch.rand(x.shape, generator=g) < 0.7 if masked else None
    for level in (0.3, torch.tensor(0.3), 0.1 + torch.rand(9, 1, 1, generator=g, dtype=torch.float64),
                  0.1 + torch.rand(2, 1, 1, 4, 5, generator=g, dtype=torch.float64)):  # fmt: skip
        for loss, name in ((losses.poisson_nll, "floor"), (losses.log_ratio_loss, "background")):
            tiny = 0.0 if name == "floor" else 1e-300
            added = y if name == "floor" else y + level
            wanted = losses.multiscale_loss(x + level, added, functools.partial(loss, **{name: tiny}), mask=mask)
            found = losses.multiscale_loss(x, y, functools.partial(loss, **{name: level}), mask=mask)
            torch.testing.assert_close(found, wanted)


def of_a_record(input, target, *, mask, reduction):
    return (input - target).square().sum(2)


NO_COMPARES = {
    "bin_width_opl=": functools.partial(losses.wasserstein_loss, bin_width_opl=0.1),
    "a value for each bin": of_a_record,
}


@pytest.mark.parametrize("match", NO_COMPARES)
def test_options_that_mean_something_else_at_each_scale(match):
    x = torch.rand(1, 8, 2, 2)
    with pytest.raises(ArgumentError, match=f"^multiscale_loss: expected compare.*{match}"):
        losses.multiscale_loss(x, x, NO_COMPARES[match])
