"""Free-running detection from dim to blinding light: closed forms, dense matrices, exponential clocks, scores."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from support.sensing.event_driven import compare, dense_limit, detect, total_variation
from torchtransient.errors import TorchTransientError
from torchtransient.sensing import FreeRunningSPAD, ScoreFunction, nonparalyzable_histogram
from torchtransient.sensing.dead_time import free_running
from torchtransient.sensing.dead_time.clocked_counts import StepProbabilities, draw_steps
from torchtransient.sensing.dead_time.free_running import stationary_steps
from torchtransient.sensing.free_running import state_image

BINS = 32


def slow(*values):
    return pytest.param(*values, marks=pytest.mark.slow)


def double(value):
    return torch.as_tensor(value, dtype=torch.float64)


def shapes(bins=BINS):
    """Rows (4, T) with sum 1: a pulse in ambient light, one bright bin, a wave, light in the midst of darkness."""
    t = torch.arange(bins, dtype=torch.float64)
    rows = torch.stack(
        [
            0.5 / bins + 0.1 * torch.exp(-0.5 * ((t - 0.4 * bins) / 2) ** 2),
            torch.where(t == bins // 3, 0.5, 0.5 / bins),
            1 + 0.9 * torch.cos(2 * torch.pi * t / bins),
            ((t >= bins // 3) & (t < bins // 3 + 4)).double(),
        ]
    )
    return rows / rows.sum(-1, keepdim=True)


def image(rows):
    return rows.T.reshape(1, rows.shape[1], 1, -1)


def rows_of(image_):
    return image_.flatten(2).squeeze(0).T


@pytest.mark.parametrize("flux", [0.01, 3.0, 300.0, 3000.0])
@pytest.mark.parametrize("periods", [1, 3])
def test_dead_time_of_whole_periods(flux, periods):
    """Armed or dead does not depend on the phase: detections are the light, R of them in 1 + periods R periods."""
    light = flux * shapes()
    found = rows_of(nonparalyzable_histogram(image(light), periods * BINS))
    torch.testing.assert_close(found, light / (1 + periods * flux), rtol=1e-9, atol=1e-12 * flux / (1 + flux))


@pytest.mark.slow
@pytest.mark.parametrize("flux, bound", [(1.0, 1e-5), (30.0, 5e-3), (100.0, 1e-2)])
@pytest.mark.parametrize("dead", [12.8, 45.3])
def test_against_the_dense_limit(flux, bound, dead):
    """Bins of 0.03 to 50 photons; the bounds are those of docs/photon_counting.md."""
    light = flux * shapes()[:3]
    found = rows_of(nonparalyzable_histogram(image(light), dead)).numpy()
    for row, here in zip(light.numpy(), found, strict=True):
        wanted, error = dense_limit(row, dead, 8)
        assert total_variation(here, wanted) < bound + error * BINS / wanted.sum()
        assert here.sum() == pytest.approx(wanted.sum(), rel=bound + error * BINS / wanted.sum())


def test_third_order_in_the_width_of_bins():
    light = 4 * shapes()[:1]

    def cut(pieces):
        finer = (light / pieces).repeat_interleave(pieces, -1)
        return rows_of(nonparalyzable_histogram(image(finer), 12.8 * pieces)).view(BINS, pieces).sum(-1)

    limit = cut(16)
    errors = [float((cut(pieces) - limit).abs().sum()) for pieces in (1, 2, 4)]
    assert errors[0] > 6 * errors[1] > 36 * errors[2] > 0


def test_a_phase_locked_at_the_edge_of_a_bin(monkeypatch):
    """60 photons, half in one bin, dead a tenth of a bin less than a period: nearly all detections in one bin."""
    light = 60 * shapes()[1:2]
    found = rows_of(nonparalyzable_histogram(image(light), 31.9))[0]
    finer = (light / 8).repeat_interleave(8, -1)
    limit = rows_of(nonparalyzable_histogram(image(finer), 31.9 * 8))[0].view(BINS, 8).sum(-1)
    assert float(found.min()) >= 0
    assert total_variation(found.numpy(), limit.numpy()) < 1e-2
    assert float(limit.max() / limit.sum()) > 0.9
    monkeypatch.setattr(free_running, "_FINEST", 2)
    with pytest.raises(TorchTransientError, match="narrower bins"):
        nonparalyzable_histogram(image(light), 31.9)


@pytest.mark.slow
def test_gradients_in_bright_light():
    x = image(40.0 * shapes(12)[:3]).clone().requires_grad_()
    d = torch.tensor(12.4, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(nonparalyzable_histogram, (x, d), rtol=1e-4, fast_mode=True, check_forward_ad=True)


FANO_CASES = [(3, 0.1, 20.3), (2, 10.0, 5.8), slow(0, 10.0, 1.3), slow(2, 100.0, 32.0), slow(0, 30.0, 100.7)]


@pytest.mark.parametrize("which, flux, dead", FANO_CASES)
def test_draws_are_those_of_one_detector(which, flux, dead):
    """Mean, variance of bins and of totals of a train of a hundred periods; totals of independent periods are wider."""
    row, periods, repeats = (flux * shapes()[which]).numpy(), 100, 400
    x = image(double(row)[None])
    spad = FreeRunningSPAD(periods, dead * 1e-10, bin_width_s=1e-10)
    events = detect(np.random.default_rng(2), row, repeats, periods, dead, free_running=True, warm_up=30)
    h = spad.sample(x.expand(repeats, *x.shape), torch.Generator().manual_seed(0)).view(repeats, BINS)
    assert torch.equal(h, h.round()) and float(h.min()) >= 0
    agreement = compare(events, h.mean(0).numpy() / periods)
    # two noises of the same size
    assert agreement.within(1.5 * 2**0.5, exact=1e-3), agreement
    wanted, found = events.counts.sum(1).var(ddof=1), float(h.sum(1).var())
    # whole numbers add a quarter to a total; a phase that is locked still knows after 100 periods where it began
    assert abs(found - wanted) < 5 * 2 * wanted / repeats**0.5 + (0.3 if dead != 32.0 else 1.5)
    ratio = (h.var(0).numpy() + 0.1) / (events.variance() + 0.1)
    assert abs(np.median(ratio) - 1) < 0.15 and ratio.min() > 0.5 and ratio.max() < 2.0


RESONANT = [
    (10.0, 10.3, 10), (100.0, 31.68, 200), slow(5.0, 10.3, 3), slow(20.0, 30.4, 200),
    *(slow(r, d, n) for r in (1.0, 100.0) for d in (15.7, 31.68, 96.0) for n in (1, 100, 2000)),
]  # fmt: skip


@pytest.mark.parametrize("flux, dead, periods", RESONANT)
def test_draws_near_resonance(flux, dead, periods):
    """Dead time and wait make up a period, or half of one; few periods. Constant light: every bin has the same mean."""
    row, repeats = np.full(BINS, flux / BINS), 600
    spad = FreeRunningSPAD(periods, dead * 1e-10, bin_width_s=1e-10)
    x = image(double(row)[None]).expand(1, BINS, 20, 30).contiguous()
    h = spad.sample(x, torch.Generator().manual_seed(0))[0].flatten(1).T.numpy()
    totals, mean = h.sum(1), periods * BINS * flux / (BINS + dead * flux)
    wanted = detect(np.random.default_rng(2), row, repeats, periods, dead, free_running=True, warm_up=40).counts
    wanted = wanted.sum(1).var(ddof=1)
    # by a renewal train: variances of 600 numbers, and what whole numbers may add to a total
    assert abs(totals.mean() - mean) < 4.5 * ((wanted + 0.25) / repeats) ** 0.5
    assert abs(totals.var(ddof=1) - wanted) < 4.5 * 2 * (wanted + 0.05) / repeats**0.5 + 0.25 * (mean > 1000)
    assert totals.max() <= np.ceil(periods * BINS / dead) + (mean > 1000)
    assert h.min() >= 0 and np.array_equal(h, h.round())
    far = np.abs(h.mean(0) - mean / BINS) / (h.var(0) / repeats + mean / BINS / repeats**2 + 1e-3 / repeats) ** 0.5
    assert far.max() < 5.5


@pytest.mark.slow
def test_a_phase_that_is_remembered():
    """Two bright bins, each of which leads back to itself: a train stays with the one where it began."""
    row = np.full(16, 1e-3)
    row[3] = row[11] = 20.0
    spad = FreeRunningSPAD(1200, 15.5e-10, bin_width_s=1e-10)
    x = double(row).view(1, 16, 1, 1).expand(1, 16, 3, 3).contiguous()
    h = spad.sample(x, torch.Generator().manual_seed(0))[0].flatten(1)
    assert float(h.sum(0).max()) <= np.ceil(1200 * 16 / 15.5)
    first = h[2:4].sum(0) / h.sum(0)
    assert bool(((first > 0.99) | (first < 0.01)).all()) and 0 < float(first.mean()) < 1


def test_totals_in_saturation():
    """Renewal theory: a Fano factor of 1/(1 + n d)^2, 0.010 where independent periods have 0.41."""
    n, dead, periods = 1.5, 6.0, 10_000
    x = torch.full((200, 1, 64, 1, 1), n, dtype=torch.float64)
    spad = FreeRunningSPAD(periods, dead * 1e-10, bin_width_s=1e-10)
    for grad in ("straight_through", "gaussian"):
        spad.grad = grad
        totals = spad(x, generator=torch.Generator().manual_seed(0)).sum((1, 2, 3, 4))
        assert float(totals.mean()) == pytest.approx(periods * 64 * n / (1 + n * dead), rel=1e-4)
        assert float(totals.var() / totals.mean()) == pytest.approx(1 / (1 + n * dead) ** 2, rel=0.3)


@pytest.mark.slow
@pytest.mark.parametrize("kind, dead", [("non_paralyzable", 7.5), ("paralyzable", 2.3)])
def test_score_is_unbiased(kind, dead):
    """Two loss functions that no pathwise gradient sees; differences of their means over as many draws again."""
    shape = double([0.1, 0.2, 0.6, 0.3, 0.1, 0.1]).view(1, 6, 1, 1)
    draws, many = 4000, 200_000
    spad = FreeRunningSPAD(3, dead * 1e-10, bin_width_s=1e-10, kind=kind, grad="score")

    def losses(h):
        """(N, 6) counts to (N, 2)."""
        return torch.stack([h.sum(1) > 1.5, h[:, 2] > 0], 1).double()

    def mean(scale, seed):
        g, x = torch.Generator().manual_seed(seed), scale * shape
        if kind == "paralyzable":
            h = spad.sample(x.expand(many, 1, 6, 1, 1), g).view(many, 6)
        else:  # one solution for all draws
            one = stationary_steps(x, state_image(x, double(dead)))
            wide = [v.expand(*v.shape[:-1], many) for v in (one.begin, one.fire, one.soon, one.late)]
            h = draw_steps(StepProbabilities(*wide, one.whole), 3, g).counts.view(6, many).T
        return losses(h).mean(0)

    step = 0.1
    wanted = (mean(1 + step, 1) - mean(1 - step, 2)) / (2 * step)
    scale = torch.ones(draws, dtype=torch.float64, requires_grad=True)
    with ScoreFunction() as score:
        counts = spad(scale.view(-1, 1, 1, 1, 1) * shape, torch.Generator().manual_seed(3))
    for which in range(2):
        value = score.surrogate(losses(counts.view(draws, 6))[:, which], baseline="leave_one_out").sum()
        (gradient,) = torch.autograd.grad(value, scale, retain_graph=True)
        error = float(gradient.std()) / draws**0.5 + (2 * 0.25 / many) ** 0.5 / (2 * step)
        # third derivatives are of the size of the first at most: the difference is short by step^2 / 6 of it
        assert abs(float(gradient.mean() - wanted[which])) < 4.5 * error + 0.01 * abs(float(wanted[which]))
        assert 4.5 * error < 0.15
    assert float(wanted.abs().max()) > 0.2


def test_bins_are_cut_where_light_changes():
    """A pulse of 30 photons a bin in which detectors are armed again, beside the same light in bins cut in 64."""
    rate = 1e-3 + 30 * torch.exp(-0.5 * ((torch.arange(64, dtype=torch.float64) - 20) / 6) ** 2).view(1, -1, 1, 1)
    fine = nonparalyzable_histogram((rate / 64).repeat_interleave(64, 1), 64 * 3.3).view(64, 64).sum(1)
    found = nonparalyzable_histogram(rate, 3.3).flatten()
    assert float((found - fine).abs().sum() / fine.sum() / 2) < 1e-3
