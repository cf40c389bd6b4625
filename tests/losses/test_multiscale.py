"""Losses of coarser records: which sums they see, likelihoods that stay likelihoods, from how far they pull."""

from __future__ import annotations

import functools
import itertools
import math

import pytest
import torch

from torchtransient import losses
from torchtransient.errors import ArgumentError
from torchtransient.sensing import SynchronousSPAD


def record(*values):
    return torch.tensor(values, dtype=torch.float64).reshape(1, -1, 1, 1)


def test_scales_by_hand():
    """Three bins, scale 2: coarse bins begin at 0 (a + b, c) and at -1 (a, b + c), four of them, over two places."""
    a, b, c = 1.0, 3.0, 7.0
    x, y = record(a, b, c), record(0.0, 0.0, 0.0)
    one, two = (a**2 + b**2 + c**2) / 3, ((a + b) ** 2 + c**2 + a**2 + (b + c) ** 2) / 2 / 3
    assert float(losses.multiscale_loss(x, y, scales=[1], dim=-3)) == pytest.approx(one)
    assert float(losses.multiscale_loss(x, y, scales=[2], dim=-3)) == pytest.approx(two)
    assert float(losses.multiscale_loss(x, y, dim=-3)) == pytest.approx((one + two) / 2)  # 1 and 2 are below 3
    whole = ((a + b + c) ** 2 + (a + b) ** 2 + a**2 + (b + c) ** 2 + c**2) / 3 / 3
    assert float(losses.multiscale_loss(x, y, scales=[3], dim=-3)) == pytest.approx(whole)
    wide = ((a + b + c) ** 2 * 5 + (a + b) ** 2 + a**2 + (b + c) ** 2 + c**2) / 7 / 3
    assert float(losses.multiscale_loss(x, y, scales=[7], dim=-3)) == pytest.approx(wide)


def test_every_layout_of_places():
    """Batches, channels and places do not mix: each pixel alone has the same value."""
    g = torch.Generator().manual_seed(0)
    x, y = (torch.rand(2, 3, 9, 4, 5, generator=g, dtype=torch.float64) for _ in range(2))
    whole = losses.multiscale_loss(x, y, losses.poisson_nll, reduction="none")
    assert whole.shape == (2, 3, 4, 5)
    fixed = functools.partial(losses.poisson_nll, floor=1e-2)
    places = ((0, 0, 0, 0), (1, 2, 3, 4), (1, 0, 2, 3))
    for loss, (i, c, j, k) in itertools.product((losses.poisson_nll, fixed), places):
        whole = losses.multiscale_loss(x, y, loss, reduction="none")
        alone = losses.multiscale_loss(*(t[i, c, None, :, j, k, None, None] for t in (x, y)), loss)
        torch.testing.assert_close(alone, whole[i, c, j, k])


@pytest.mark.parametrize("scale", [1, 2, 3])
def test_coarse_first_photons_are_those_of_a_coarser_detector(scale):
    """Scale s where coarse bins begin at 0: the log-probability by `SynchronousSPAD` of records summed by hand."""
    g = torch.Generator().manual_seed(3)
    rate = 0.3 * torch.rand(1, 12, 2, 2, generator=g, dtype=torch.float64)
    counts = SynchronousSPAD(500)(rate, generator=g)
    compare = functools.partial(losses.first_photon_nll, cycles=500)
    found = 12 * losses.multiscale_loss(rate, counts, compare, scales=[scale], reduction="none")

    def coarse(x, place):
        padded = torch.nn.functional.pad(x, (0, 0, 0, 0, place, -(12 + place) % scale))
        return padded.unflatten(1, (-1, scale)).sum(2)

    each = [
        losses.first_photon_nll(
            coarse(rate, p), coarse(counts, p), 500, dim=-3, reduction="none"
        ).sum(1)
        for p in range(scale)
    ]  # fmt: skip
    torch.testing.assert_close(found, torch.stack(each).mean(0))


def pulse(at, light, sigma, bins=96, width=0.02, background=1e-3):
    edges = torch.arange(bins + 1, dtype=torch.float64) * width
    steps = 0.5 * (1 + torch.erf((edges - at[:, None]) / (sigma * math.sqrt(2)))).diff()
    return (light[:, None] * steps + background).reshape(1, -1, bins, 1).movedim(1, -1)  # (1, T, 1, N)


def fitted(compare, offset, sigma, histogram, steps=60):
    """Distances from the truth, metres, of places that Adam finds together with the light, from `offset` metres off."""
    number = histogram.shape[-1]
    at = torch.full((number,), 0.96 + offset, dtype=torch.float64, requires_grad=True)
    light = torch.full((number,), math.log(0.15), dtype=torch.float64, requires_grad=True)
    optimizer = torch.optim.Adam([at, light], 0.05)
    for k in range(steps):
        optimizer.param_groups[0]["lr"] = 0.05 * (1 - k / steps) ** 0.7
        optimizer.zero_grad()
        compare(pulse(at, light.exp(), sigma), histogram).backward()
        optimizer.step()
    return (at.detach() - 0.96).abs()


@pytest.mark.slow
def test_first_photons_come_home_from_ten_centimetres():
    """Pulses of 1 cm in bins of 2 cm, 0.3 photons a cycle, 1000 cycles, background: from 10 and 50 cm.

    The spread of the place is about sigma / sqrt(260 photons) with bins of twice that: 1.3 mm. 5 mm is home.
    """
    truth = torch.full((16,), 0.96, dtype=torch.float64)
    rate = pulse(truth, torch.full((16,), 0.3, dtype=torch.float64), 0.01)
    histogram = SynchronousSPAD(1000)(rate, generator=torch.Generator().manual_seed(0))
    likelihood = functools.partial(losses.first_photon_nll, cycles=1000, dim=-3, reduction="sum")
    many = functools.partial(
        losses.multiscale_loss,
        compare=functools.partial(losses.first_photon_nll, cycles=1000),
        reduction="sum",
        dim=-3,
    )
    for offset in (-0.1, 0.1, 0.5):
        assert float((fitted(many, offset, 0.01, histogram) < 0.005).double().mean()) >= 0.9, offset
    assert float((fitted(likelihood, 0.5, 0.01, histogram) < 0.005).double().mean()) < 0.2


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


def test_where_time_is_may_be_said_by_what_is_compared():
    """Held by the partial, by the loss, by both: the same; two places are refused."""
    g = torch.Generator().manual_seed(2)
    x = 0.1 + torch.rand(2, 5, 9, 4, generator=g, dtype=torch.float64)
    y = torch.poisson(3 * x, generator=g)
    for loss in (functools.partial(losses.first_photon_nll, cycles=100), losses.poisson_nll, losses.log_ratio_loss):
        held = functools.partial(loss, dim=-2)
        wanted = losses.multiscale_loss(x[..., None], y[..., None], loss, reduction="none")[..., 0]
        for compare, dim in ((loss, -2), (held, -2), (held, 2), (held, None)):
            found = losses.multiscale_loss(x, y, compare, dim=dim, reduction="none")
            torch.testing.assert_close(found, wanted)
            torch.testing.assert_close(losses.MultiscaleLoss(compare, dim=dim)(x, y), wanted.mean())
        with pytest.raises(ArgumentError, match=r"^multiscale_loss: expected time in one .*dim=-3, and dim=-2 held"):
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
    "bin_width_opl=0.1": functools.partial(losses.wasserstein_loss, bin_width_opl=0.1),
    "dead_bins=3": functools.partial(losses.first_photon_nll, cycles=100, dead_bins=3.0),
    "the module SquaredLoss": losses.SquaredLoss(),
    "a value for each bin": of_a_record,
}


@pytest.mark.parametrize("match", NO_COMPARES)
def test_options_that_mean_something_else_at_each_scale(match):
    x = torch.rand(1, 8, 2, 2)
    with pytest.raises(ArgumentError, match=f"^multiscale_loss: expected compare.*{match}"):
        losses.multiscale_loss(x, x, NO_COMPARES[match])
