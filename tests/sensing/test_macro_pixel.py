"""Pixels of several SPADs against events: every SPAD with its own dead time, sums, zones and coincidences."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from support.marks import long_rows
from support.sensing.event_driven import Events, compare, detect
from torchtransient.errors import GradientError
from torchtransient.sensing import (
    Afterpulsing,
    AfterpulsingSPAD,
    CoincidencePixel,
    FreeRunningSPAD,
    MacroPixel,
    ScoreFunction,
    SynchronousSPAD,
    ZoneSum,
)

WIDTH = 1e-10  # of a bin
BINS = 32


def detector(mode, dead, cycles=1, **keywords):
    if mode == "free":
        return FreeRunningSPAD(cycles, dead * WIDTH, bin_width_s=WIDTH, **keywords)
    if mode == "first":
        return SynchronousSPAD(cycles, **keywords)
    return SynchronousSPAD(cycles, dead_time_s=dead * WIDTH, bin_width_s=WIDTH, **keywords)


def light(total, kind="pulse"):
    k = np.arange(BINS)
    rate = {"constant": np.ones(BINS), "pulse": 0.3 / BINS + 0.3 * (np.abs(k - 12) < 2)}.get(kind)
    if rate is None:  # the last bin and the first
        rate = 0.2 / BINS + 0.4 * (k == 0) + 0.4 * (k == BINS - 1)
    return rate / rate.sum() * total


def image(rate):
    return torch.as_tensor(rate).view(1, -1, 1, 1)


RUNS = 40  # whose scatter is the noise


def zone(rng, mode, dead, rate, weights, cycles):
    """Detections of all SPADs of RUNS pixels on one clock, `cycles` periods each; those of a cycle do not leave it."""
    weights = np.asarray(weights, float) / np.sum(weights)
    times, runs = [], []
    for weight in weights:
        if mode == "free":
            events = detect(rng, rate * weight, RUNS, cycles, dead, free_running=True, warm_up=30)
        else:
            events = detect(rng, rate * weight, RUNS, cycles, None if mode == "first" else dead)
        times.append(events.times)
        runs.append(events.run)
    return Events(np.concatenate(times), np.concatenate(runs), RUNS, cycles, BINS)


def coincidences(events, k, window, in_step):
    """Those that bring the number of different SPADs within `window` up to `k`."""
    order = np.lexsort((events.times, events.run))
    t, run = events.times[order], events.run[order]
    period = np.floor(t / BINS) if in_step else 0
    # cycles and runs that know nothing of one another are far apart
    clock = t + run * 1e7 + period * 3 * BINS
    others = np.arange(t.size) - np.searchsorted(clock, clock - window, side="right")
    return Events(t, run, events.runs, events.periods, BINS).chosen(others == k - 1)


@pytest.mark.parametrize("mode, dead, total", [("first", 9.5, 30.0), ("several", 9.5, 10.0), ("free", 9.5, 60.0)])
def test_sums_are_those_of_events(mode, dead, total):
    """Total variation within 1.5 of its noise, and not that of one SPAD with all the light."""
    rate, weights, found = light(total), [1, 4, 4, 2], []
    mean = MacroPixel(detector(mode, dead), len(weights), weights=weights).expected(image(rate)).numpy()
    for seed in range(4):
        events = zone(np.random.default_rng(seed), mode, dead, rate, weights, 60)
        found.append(compare(events, mean))
    assert sum(a.total_variation for a in found) < 1.5 * sum(a.noise for a in found)
    assert compare(events, detector(mode, dead).expected(image(rate)).numpy()).ratio > 10


def test_draws_of_equal_spads_are_one_draw_of_more_cycles():
    x = image(light(5.0)).expand(10_000, 1, BINS, 1, 1)
    y = MacroPixel(SynchronousSPAD(3), 4).sample(x, torch.Generator().manual_seed(0))
    p = SynchronousSPAD(1).probabilities(x[:1] / 4).flatten()
    assert float(y.sum((1, 2, 3, 4)).max()) <= 12
    # multinomial of 12 trials
    cov = y.view(10_000, BINS).double().T.cov()
    wanted = 12 * (torch.diag(p) - torch.outer(p, p))
    assert float((cov - wanted).abs().max()) < 6 * float(wanted.max()) * (2 / 10_000) ** 0.5
    summed = sum(SynchronousSPAD(3).sample(x / 4, torch.Generator().manual_seed(s)) for s in range(1, 5))
    error = (y.mean(0) - summed.mean(0)).abs() / (2 * y.var(0) / 10_000 + 1e-12).sqrt()
    assert float(error.max()) < 5


@pytest.mark.slow
def test_totals_of_free_spads_vary_as_those_of_independent_ones():
    """50 photons a period on each, dead for 33.7 of 32 bins: one train of N times the periods varies N times less.

    The logarithm of a ratio of two variances of n has the standard deviation 2 / sqrt(n - 1) of normal totals.
    """
    number, spads = 100, 4
    x = image(light(50.0, "constant")).expand(number, 1, BINS, 1, 1)
    spad = detector("free", 33.7, 10, grad="gaussian")
    with ScoreFunction():
        alone = [spad(x, generator=torch.Generator().manual_seed(s)) for s in range(spads)]
        whole = MacroPixel(spad, spads)(x * spads, generator=torch.Generator().manual_seed(spads))
    ratio = whole.sum(2).var() / sum(alone).sum(2).var()
    assert abs(math.log(float(ratio))) < 5 * 2 / (number - 1) ** 0.5


@pytest.mark.parametrize("policy", ["expected", "gaussian", "straight_through", "score"])
def test_policies(policy):
    """d/da of E sum(counts) / cycles at a times the light, for two shares; exact for the mean, a linear loss."""
    module = MacroPixel(SynchronousSPAD(500), 3, weights=[1, 1, 2], grad=policy)
    a = torch.ones(600, dtype=torch.float64, requires_grad=True)
    x = image(light(2.0)) * a.view(-1, 1, 1, 1, 1)
    with ScoreFunction() as score:
        losses = module(x, generator=torch.Generator().manual_seed(0)).sum((2, 3, 4)) / 500  # one per channel
    if policy == "score":
        losses = score.surrogate(losses, baseline="leave_one_out")
    losses.sum().backward()
    # each SPAD fires in a share 1 - exp(-w a R) of its cycles
    wanted = sum(w * 2.0 * math.exp(-w * 2.0) for w in (0.25, 0.25, 0.5))
    slack = 5 * float(a.grad.std()) / 600**0.5
    assert float(a.grad.mean()) == pytest.approx(wanted, abs=slack + 1e-9)
    assert slack < 0.4 * wanted


def test_scores_of_sums():
    x = image(light(2.0))
    even, uneven = MacroPixel(SynchronousSPAD(5), 3), MacroPixel(SynchronousSPAD(5), 2, weights=[1, 2])
    counts = even.sample(x, torch.Generator().manual_seed(0))
    torch.testing.assert_close(even.log_prob(counts, x), SynchronousSPAD(15).log_prob(counts, x / 3))
    with pytest.raises(GradientError, match="equal shares"):
        uneven.log_prob(counts, x)


def test_afterpulses_of_every_spad():
    parts = Afterpulsing(0.05, 20 * WIDTH, 9.5 * WIDTH, bin_width_s=WIDTH)
    one = AfterpulsingSPAD(detector("first", 9.5, cycles=7), parts)
    x = image(light(20.0))
    torch.testing.assert_close(MacroPixel(one, 5)(x), 5 * one(x / 5))
    y = MacroPixel(one, 5).sample(x.expand(300, 1, BINS, 1, 1), torch.Generator().manual_seed(0))
    mean = 5 * one(x / 5)
    assert bool(((y.mean(0) - mean[0]).abs() < 5 * (y.var(0) / 300).sqrt() + 1e-3).all())
    assert one.detector.cycles == 7  # the one that was given stays what it was


def test_zones_are_sums_of_their_pixels():
    x = torch.arange(2 * 3 * 4 * 6, dtype=torch.float32).view(2, 3, 4, 6)
    y = ZoneSum(2, 3)(x)
    assert y.shape == (2, 3, 2, 2)
    assert float(y[1, 2, 1, 0]) == float(x[1, 2, 2:, :3].sum())


# --- coincidences ---------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("total, kind, k", [(10.0, "constant", 2), (30.0, "edges", 4), (30.0, "pulse", 1)])
@pytest.mark.parametrize("mode, dead", [("first", 9.5), ("several", 4.4), ("free", 41.2)])
def test_coincidences_of_events(mode, dead, total, kind, k):
    rate, found = light(total, kind), []
    for seed in range(3):
        events = zone(np.random.default_rng(seed), mode, dead, rate, [1] * 16, 300)
        seen = coincidences(events, k, 3.4, in_step=mode != "free")
        sensor = CoincidencePixel(detector(mode, dead), 16, coincidence=k, window_s=3.4 * WIDTH, bin_width_s=WIDTH)
        found.append(compare(seen, sensor.expected(image(rate)).numpy()))
    assert sum(a.total_variation for a in found) < 1.5 * sum(a.noise for a in found)


# Variance of totals: of independent bins four times that of events, five times, and one and a half times.
TOTALS = [
    ("first", 9.5, "pulse", 10.0, 4, "straight_through"),
    ("first", 9.5, "pulse", 10.0, 4, "gaussian"),
    ("free", 9.3, "edges", 10.0, 4, "straight_through"),
    ("several", 4.4, "constant", 30.0, 2, "straight_through"),
]


@pytest.mark.parametrize("mode, dead, kind, total, k, policy", long_rows(TOTALS, TOTALS[:1]))
def test_totals_of_coincidences_vary_as_those_of_events(mode, dead, kind, total, k, policy):
    """And so do bins; the logarithm of a variance of n totals has the standard deviation sqrt(2 / (n - 1))."""
    cycles, number = 60, 300
    rate, found = light(total, kind), []
    for seed in range(5):
        events = zone(np.random.default_rng(seed), mode, dead, rate, [1] * 16, cycles)
        found.append(coincidences(events, k, 3.4, in_step=mode != "free").counts)
    seen = np.concatenate(found)
    sensor = CoincidencePixel(
        detector(mode, dead, cycles), 16, coincidence=k, window_s=3.4 * WIDTH, bin_width_s=WIDTH, grad=policy
    )
    drawn = sensor(image(rate).expand(number, 1, BINS, 1, 1), generator=torch.Generator().manual_seed(0))
    drawn = drawn.view(number, BINS).numpy()
    slack = 5 * math.sqrt(2 / (len(seen) - 1) + 2 / (number - 1))
    assert abs(math.log(drawn.sum(1).var(ddof=1) / seen.sum(1).var(ddof=1))) < slack
    most = sensor.expected(image(rate)).numpy().ravel()  # binomials vary less than their mean
    assert (np.abs(drawn.mean(0) - seen.mean(0)) < 5 * np.sqrt(most / number + most / len(seen)) + 1e-3).all()


@pytest.mark.parametrize("mode, dead", [("several", 2.4), ("free", 2.0)])
def test_no_spad_coincides_with_itself(mode, dead):
    """A window of the whole dead time: the second SPAD is in the dark, then as bright; of 3e4 coincidences 3 %."""
    bright = image(np.full(BINS, 0.3))
    settings = {"coincidence": 2, "window_s": dead * WIDTH, "bin_width_s": WIDTH}
    alone = CoincidencePixel(detector(mode, dead, 2000), 2, weights=[1, 1e-12], **settings)
    assert float(alone.sample(bright, torch.Generator().manual_seed(0)).sum()) == 0
    both = CoincidencePixel(detector(mode, dead, 20_000), 2, **settings)
    drawn = float(both.sample(bright, torch.Generator().manual_seed(0)).sum())
    assert drawn == pytest.approx(float(both.expected(bright).sum()), rel=0.03)


@pytest.mark.parametrize("mode", ["first", "free"])
def test_a_dark_pixel_sees_no_coincidence_and_leaves_those_beside_it(mode):
    """Draws of pixels on both of its sides keep their means, bin by bin; binomials vary less than these."""
    x = torch.cat([image(rate) for rate in (light(10.0), np.zeros(BINS), light(10.0, "edges"))], -1)
    sensor = CoincidencePixel(detector(mode, 9.5, 5000), 4, coincidence=2, window_s=3.4 * WIDTH, bin_width_s=WIDTH)
    drawn, mean = sensor.sample(x, torch.Generator().manual_seed(0)), sensor.expected(x)
    assert not drawn[..., 1].any() and not mean[..., 1].any()
    assert bool(((drawn - mean).abs() <= 5 * mean.sqrt()).all()) and float(mean[..., 0].max()) > 100


@pytest.mark.parametrize(("mode", "dead"), long_rows([("first", 9.5), ("free", 9.3)], [("first", 9.5)]))
def test_scores_of_coincidences(mode, dead):
    """d/da of the mean total, and of its mean square by a difference quotient of draws, at a times the light."""
    cycles, number = 4, 10_000
    x = image(light(6.0)).expand(number, 1, BINS, 1, 1)
    sensor = CoincidencePixel(
        detector(mode, dead, cycles), 4, coincidence=2, window_s=3.4 * WIDTH, weights=[1, 1, 1, 2], bin_width_s=WIDTH,
        grad="score",
    )  # fmt: skip
    a = torch.ones(number, dtype=torch.float64, requires_grad=True)
    with ScoreFunction() as score:
        total = sensor(x * a.view(-1, 1, 1, 1, 1), generator=torch.Generator().manual_seed(0)).sum((1, 2, 3, 4))
    for power in (1, 2):
        (slopes,) = torch.autograd.grad(
            score.surrogate(total**power, baseline="leave_one_out").sum(), a, retain_graph=True
        )
        near = [
            sensor.sample(s * x, torch.Generator().manual_seed(1 + k)).sum((1, 2, 3, 4)) ** power
            for k, s in enumerate((0.9, 1.1))
        ]
        wanted = float(near[1].mean() - near[0].mean()) / 0.2
        noise = math.sqrt(float(slopes.var() + (near[0].var() + near[1].var()) / 0.04) / number)
        assert abs(float(slopes.mean()) - wanted) < 5 * noise + 0.02 * abs(wanted)  # and a third derivative
        assert noise < 0.1 * abs(wanted)


def test_the_score_of_a_learnt_dead_time_is_refused():
    spad = detector("free", 9.3, learnable=True)
    sensor = CoincidencePixel(spad, 4, coincidence=2, window_s=3 * WIDTH, bin_width_s=WIDTH, grad="score")
    with ScoreFunction(), pytest.raises(GradientError, match="a dead time that is not learnt"):
        sensor(image(light(1.0)))


@pytest.mark.parametrize("mode, window, k", [("first", 1.6, 1), ("first", 5.0, 2), ("free", 0.7, 3)])
def test_coincidences_of_three_spads_by_quadrature(mode, window, k):
    """One of them detects while k - 1 of the others have within the window: products, at each moment of each bin."""
    bins, weights, points = 5, [1.0, 2.0, 4.0], 1000
    rate = torch.tensor([[0.3, 2.5, 0.0, 1.2, 0.7], [1.1, 0.2, 0.9, 3.0, 0.1]], dtype=torch.float64)
    x = rate.T.reshape(1, bins, 1, 2)
    spad = detector(mode, 4.6, cycles=7)
    t = (np.arange(bins * points) + 0.5) / points
    for pixel in range(2):
        densities, fired = [], []
        for weight in weights:
            own = rate[pixel].numpy() * weight / 7
            if mode == "first":
                flux = np.interp(t, np.arange(bins + 1.0), np.append(0, own.cumsum()))
                before = np.interp(np.maximum(t - window, 0), np.arange(bins + 1.0), np.append(0, own.cumsum()))
                densities.append(np.repeat(own, points) * np.exp(-flux))
                fired.append(np.exp(-before) - np.exp(-flux))
            else:
                one = spad.probabilities(x * (weight / 7))[0, :, 0, pixel].numpy()
                edges = np.append(0, np.tile(one, 2).cumsum())
                densities.append(np.repeat(one, points))
                fired.append(np.interp(t + bins, np.arange(2 * bins + 1.0), edges)
                             - np.interp(t + bins - window, np.arange(2 * bins + 1.0), edges))  # fmt: skip
        wanted = np.zeros(bins * points)
        for i, density in enumerate(densities):
            a, b = (q for j, q in enumerate(fired) if j != i)
            chance = {1: (1 - a) * (1 - b), 2: a * (1 - b) + b * (1 - a), 3: a * b}[k]
            wanted += density * chance
        wanted = wanted.reshape(bins, points).mean(1)
        sensor = CoincidencePixel(
            spad, 3, coincidence=k, window_s=window * WIDTH, weights=weights, bin_width_s=WIDTH
        )  # fmt: skip
        p = sensor.probabilities(x)
        np.testing.assert_allclose(p[0, :, 0, pixel].numpy(), wanted, rtol=2e-6, atol=1e-12)
    torch.testing.assert_close(sensor.variance(x), 7 * p * (1 - p))
    torch.testing.assert_close(sensor.expected(x), 7 * p)
    n = torch.tensor([[0.0, 3, 1, 7, 2], [1, 0, 2, 5, 4]]).double().T.reshape(1, bins, 1, 2)
    seen = torch.where(rate.T.reshape(x.shape) > 0, n, 0.0)
    ways = torch.tensor([math.comb(7, int(v)) for v in seen.flatten()], dtype=torch.float64).view_as(p)
    logs = ways.log() + torch.xlogy(seen, p) + torch.xlogy(7 - seen, 1 - p)
    torch.testing.assert_close(sensor.log_prob(seen, x), logs.sum(-3), rtol=1e-9, atol=1e-9)


def test_detectors_that_skip_periods_do_so_independently():
    """A pulse that always fires an armed SPAD is seen every fourth time by one of 3.25 periods of dead time: two SPADs
    out of two agree in a sixteenth of the periods, in blocks of which each has phases of its own.
    """
    x = torch.zeros(1, BINS, 1, 1, dtype=torch.float64)
    x[0, 4] = 100.0
    cycles, dead = 16384, 3.25 * BINS
    pixel = CoincidencePixel(detector("free", dead, cycles), 2, coincidence=2, window_s=3 * WIDTH, bin_width_s=WIDTH)
    share = float(pixel.sample(x, torch.Generator().manual_seed(0)).sum()) / cycles
    # a quarter of the blocks, of 26 periods each, agree in a quarter of their periods
    assert abs(share - 1 / 16) < 4 * (1 / 4) * (1 / 4 * 3 / 4 / (cycles / 26)) ** 0.5 + 1e-3


@pytest.mark.parametrize("k", [1, 2, 5])
def test_many_spads_in_constant_light_are_a_poisson_process(k):
    """r (r w)^(k-1) exp(-r w) / (k-1)!, with 100 000 SPADs so that none fires twice; constant round the period."""
    per_bin, window = 0.4, 3.7
    sensor = CoincidencePixel(detector("free", 3.7), 100_000, coincidence=k, window_s=window * WIDTH, bin_width_s=WIDTH)
    y = sensor(torch.full((1, BINS, 1, 1), per_bin, dtype=torch.float64)).flatten()
    mean = per_bin * window
    wanted = per_bin * mean ** (k - 1) * math.exp(-mean) / math.factorial(k - 1)
    torch.testing.assert_close(y, torch.full_like(y, wanted), rtol=1e-3, atol=0)
    assert float(y.max() / y.min() - 1) < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("photons", [1e-3, 400.0, 1e15])
def test_coincidences_of_a_bin_with_any_number_of_photons(photons):
    """All light in bin 0, first photons, a window of a bin: one as soon as k of n SPADs have fired, none after that.

    Eight points for the bin lost them: .695 of 1 at 100 photons, .0072 at 400.
    """
    x = torch.zeros(1, BINS, 1, 1, dtype=torch.float64)
    x[:, 0] = photons
    for spads, k, window in ((1, 1, 1.0), (8, 2, 1.0), (8, 1, 1.37)):
        pixel = CoincidencePixel(SynchronousSPAD(3), spads, coincidence=k, window_s=window * WIDTH, bin_width_s=WIDTH)
        p = -math.expm1(-photons / spads)
        wanted = math.fsum(math.comb(spads, j) * p**j * (1 - p) ** (spads - j) for j in range(k, spads + 1))
        found = pixel.probabilities(x)
        assert float(found.sum()) == pytest.approx(wanted, rel=1e-6, abs=1e-12)
        if spads == 1:  # probabilities of one
            assert float(pixel.sample(x, torch.Generator().manual_seed(0)).max()) <= 3
            assert bool(pixel.log_prob(torch.round(3 * found), x).isfinite().all())
