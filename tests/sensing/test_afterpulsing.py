"""Afterpulses against detections followed one by one, crosstalk against plain loops, gradients by policy."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from support.marks import long
from torchtransient import TimeAxis, sensing
from torchtransient.errors import UnitError

BINS = 40


def kernel_of(tau, dead, period=BINS):
    """Delays of one afterpulse, in bins."""
    return sensing.Afterpulsing(0.5, tau * 1e-10, dead * 1e-10, bin_width_s=1e-10).kernel(period) / 0.5


@pytest.mark.parametrize("tau, dead", [(7.0, 3.2), (300.0, 55.0), (0.01, 2.0), (25.0, 0.0)])
def test_kernel_against_random_delays(tau, dead):
    kernel = kernel_of(tau, dead)
    assert float(kernel.sum()) == pytest.approx(1, abs=1e-12)
    rng = np.random.default_rng(0)
    delays = rng.random(400_000) + dead + rng.exponential(tau, 400_000)
    seen = np.bincount(np.floor(delays).astype(int) % BINS, minlength=BINS)
    expected = 400_000 * kernel.numpy()
    use = expected > 5
    assert (((seen - expected) ** 2 / np.maximum(expected, 1))[use]).sum() / use.sum() < 1 + 5 * (2 / BINS) ** 0.5 + (
        use.sum() < 5
    )
    assert seen[~use].sum() <= 20


def test_geometric_sum_against_a_branching_process():
    rng, p, tau, dead, counts = np.random.default_rng(1), 0.2, 6.0, 4.0, 300_000
    h = np.zeros(BINS)
    h[5] = counts
    total, times = h.copy(), np.full(counts, 5)
    while times.size:
        # as in the model, every generation is spread evenly over its bin
        times = np.floor(times[rng.random(times.size) < p])
        times = times + rng.random(times.size) + dead + rng.exponential(tau, times.size)
        total += np.bincount(np.floor(times).astype(int) % BINS, minlength=BINS)
    kernel = kernel_of(tau, dead)
    found = sensing.add_afterpulses(torch.as_tensor(h).view(1, -1, 1, 1), p, kernel).flatten().numpy()
    assert found.sum() == pytest.approx(counts / (1 - p), rel=1e-12)
    z = (total - found)[found < counts] / np.sqrt(found[found < counts])
    assert np.abs(z).max() < 5


def test_long_periods_are_wrapped_round_the_window():
    """A period longer than two windows is not transformed whole; the means are those of the whole period."""
    x = torch.rand(1, 16, 2, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    for period in (16, 32, 33, 40, 100):
        kernel = kernel_of(70, 20, period)
        whole = sensing.add_afterpulses(torch.nn.functional.pad(x, (0, 0, 0, 0, 0, period - 16)), 0.3, kernel)
        torch.testing.assert_close(sensing.add_afterpulses(x, 0.3, kernel), whole[:, :16])


def test_crosstalk_against_loops():
    x = torch.rand(2, 1, 3, 4, 5, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    wanted = x.clone()
    for i in range(4):
        for j in range(5):
            for di in (-1, 0, 1):
                for dj in (-1, 0, 1):
                    weight = (0, 0.03, 0.01)[abs(di) + abs(dj)]
                    if 0 <= i + di < 4 and 0 <= j + dj < 5 and (di or dj):
                        wanted[..., i, j] += weight * x[..., i + di, j + dj]
    torch.testing.assert_close(sensing.add_crosstalk(x, 0.03, 0.01), wanted)


@pytest.mark.parametrize(
    "make, policy",
    [
        (lambda **k: sensing.Afterpulsing(0.05, 30e-10, 20e-10, bin_width_s=1e-10, learnable=True, **k), "gaussian"),
        (lambda **k: sensing.Crosstalk(0.05, learnable=True, **k), "score"),
    ],
    ids=["afterpulsing", "crosstalk"],
)
def test_policies_keep_the_gradient_of_what_passes(make, policy):
    """Loss: square of one bin. Exact: 2 y + (variance of what is added)', in the probability's logit."""
    module, draws = make(grad=policy), 30_000
    x = torch.full((draws, 1, 4, 2, 2), 40.0, dtype=torch.float64, requires_grad=True)
    with sensing.ScoreFunction() as score:
        y = module(x, generator=torch.Generator().manual_seed(0))
        losses = y[:, 0, 1, 0, 0] ** 2
    total = score.surrogate(losses, baseline="leave_one_out") if policy == "score" else losses
    (in_x, in_logit) = torch.autograd.grad(total.sum() / draws, [x, module.logit_probability], retain_graph=True)
    value = x[:1].detach().requires_grad_()
    extra = module.extra(value)[:, 0, 1, 0, 0]
    exact = ((value[:, 0, 1, 0, 0] + extra) ** 2 + extra).sum()
    wanted_x, wanted_logit = torch.autograd.grad(exact, [value, module.logit_probability])
    assert float(in_logit) == pytest.approx(float(wanted_logit), rel=0.06)
    assert float(in_x.sum(0)[0, 1, 0, 0]) == pytest.approx(float(wanted_x[0, 0, 1, 0, 0]), rel=0.02)


def test_hot_pixels():
    rates = sensing.hot_pixel_rates(
        200, 200, median_hz=50.0, hot_fraction=0.02, generator=torch.Generator().manual_seed(0)
    )
    assert float(rates.median()) == pytest.approx(50.0, rel=0.03)
    assert float((rates > 1000).double().mean()) == pytest.approx(0.02, abs=0.004)
    with pytest.raises(UnitError, match="hot_fraction"):
        sensing.hot_pixel_rates(2, 2, median_hz=1.0, hot_fraction=2.0)


def test_crosstalk_is_a_binomial_number_of_every_neighbour():
    """Each of 4 neighbours is triggered with its own probability, independently; the rim sends nothing back."""
    n, p, ratio, images = 40, 0.2, 0.5, 30_000
    x = torch.zeros(images, 1, 1, 3, 3)
    x[..., 1, 1] = n
    x[..., 0, 2] = 7
    module = sensing.Crosstalk(p, diagonal_ratio=ratio)
    added = (module.sample(x, torch.Generator().manual_seed(0)) - x).double().view(images, 9)
    edges = {1: (n, 7), 5: (n, 7), 3: (n, 0), 7: (n, 0)}
    for pixel, (near, other) in edges.items():
        variance = (near + other) * p * (1 - p)
        assert float(added[:, pixel].mean()) == pytest.approx((near + other) * p, abs=5 * (variance / images) ** 0.5)
        # a Poisson number would have a variance larger by 1/(1 - p), 25 %
        assert float(added[:, pixel].var()) == pytest.approx(variance, rel=5 * (2 / images) ** 0.5)
    assert float(added[:, 0].var()) == pytest.approx(n * 0.1 * 0.9, rel=5 * (2 / images) ** 0.5)
    correlation = torch.corrcoef(added[:, [0, 3, 6, 7, 8]].T) - torch.eye(5)
    assert float(correlation.abs().max()) < 5 / images**0.5
    assert float(added[:, 4].mean()) == pytest.approx(7 * 0.1, rel=0.05)
    torch.testing.assert_close(module.variance(x)[0].flatten()[1], torch.tensor((n + 7) * p * (1 - p)))


def test_afterpulses_are_followed_one_by_one():
    """Mean of every bin, and the variance of the total: a geometric number per detection, p / (1 - p)^2."""
    n, p, pixels = 300, 0.3, 16_384
    x = torch.zeros(1, BINS, 128, 128)
    x[:, 5] = n
    x[:, 20] = 50
    module = sensing.Afterpulsing(p, 6e-10, 4e-10, bin_width_s=1e-10, period_s=BINS * 1e-10)
    added = (module.sample(x, torch.Generator().manual_seed(0)) - x).double()
    assert float(added.min()) >= 0
    mean = module.extra(x.double()).mean((0, 2, 3)).clamp_min(0)
    assert bool(((added.mean((0, 2, 3)) - mean).abs() < 5.5 * (1.5 * mean / pixels).sqrt() + 1e-3).all())
    total = added.sum(1)
    assert float(total.mean()) == pytest.approx((n + 50) * p / (1 - p), rel=2e-3)
    assert float(total.var()) == pytest.approx((n + 50) * p / (1 - p) ** 2, rel=5 * (2 / pixels) ** 0.5)


def test_long_periods_are_placed_exactly():
    """Periods too long for single precision, and delays of many periods."""
    x = torch.zeros(1, 8, 64, 64)
    x[:, 0] = 100
    module = sensing.Afterpulsing(0.2, 1e-6, 1e-8, bin_width_s=1e-12, period_s=3e-7)
    added = module.sample(x, torch.Generator().manual_seed(0)) - x
    assert float(added.sum()) == pytest.approx(
        float(module.extra(x).sum()), abs=5 * float(module.extra(x).sum()) ** 0.5
    )
    assert torch.equal(added, added.round())


@pytest.mark.parametrize(
    "make", [lambda: sensing.Crosstalk(0.05), lambda: sensing.Afterpulsing(0.05, 30e-10, 0.0, bin_width_s=1e-10)]
)
def test_means_and_floods_take_poisson_numbers(make):
    """Counts that are not whole, and too many to follow, still get whole numbers of the right mean."""
    for level in (0.7, 1e6):
        x = torch.full((1, BINS, 16, 16), level)
        added = make().sample(x, torch.Generator().manual_seed(0)).double() - x
        mean = make().extra(x.double())
        assert float(added.sum()) == pytest.approx(float(mean.sum()), abs=5 * float(mean.sum()) ** 0.5 + 1)


@pytest.mark.slow
@pytest.mark.parametrize(
    "make", [lambda: sensing.Crosstalk(0.02), lambda: sensing.Afterpulsing(0.05, 30e-10, 20e-10, bin_width_s=1e-10)]
)
def test_draws_do_not_depend_on_the_number_of_threads(make):
    x = torch.poisson(torch.full((1, BINS, 64, 64), 5.0), generator=torch.Generator().manual_seed(1))
    threads, results = torch.get_num_threads(), []
    try:
        for n in (1, 2, 3):
            torch.set_num_threads(n)
            results.append(make().sample(x, torch.Generator().manual_seed(0)))
    finally:
        torch.set_num_threads(threads)
    assert torch.equal(results[0], results[1]) and torch.equal(results[0], results[2])


PART_BINS, WIDTH = 5, 100e-12
AXIS = TimeAxis.from_seconds(0.0, WIDTH, PART_BINS)
GATE = torch.tensor([0.0, 0.3, 1.0, 0.6, 0.0])


def light(high=0.4, pixels=2):
    g = torch.Generator().manual_seed(0)
    return 0.02 + high * torch.rand(1, PART_BINS, 1, pixels, generator=g, dtype=torch.float64)


def obeyed(detector, tau_s=400e-12, dead_time_s=150e-12, axis=AXIS, probability=0.2):
    return sensing.AfterpulsingSPAD(detector, sensing.Afterpulsing(probability, tau_s, dead_time_s, axis=axis))


def spad(axis=AXIS, gate=None, cycles=100):
    return sensing.SynchronousSPAD(cycles, gate=gate, dead_time_s=150e-12, axis=axis)


def test_a_gate_dims_photons_and_carriers_alike():
    """Nothing where it is shut; half open it sees half of each, as of half the light and half the carriers."""
    x = light()
    found = obeyed(spad(gate=GATE))(x)
    assert bool((found[:, GATE == 0] == 0).all()) and bool((found[:, GATE > 0] > 0).all())
    halves = obeyed(spad(gate=torch.full((PART_BINS,), 0.5)), probability=0.2)(x)
    without = sensing.SynchronousSPAD(100, dead_time_s=150e-12, axis=AXIS)
    plain = without(0.5 * x)
    more = halves - plain
    whole = obeyed(spad(), probability=0.1)(0.5 * x) - plain
    torch.testing.assert_close(more.sum(1), whole.sum(1), rtol=0.03, atol=0)


@pytest.mark.parametrize("kind", long(["cycles", "gated", "free"], ["gated"]))
def test_bins_in_parts_are_finer_bins(kind):
    """Carriers of a part of a bin are followed in parts of bins: as where the bins are cut by hand."""
    gated, free = kind == "gated", kind == "free"
    x, parts, tau = (light(0.4, 1), 2, 60e-12) if free else (light(0.4, 1), 4, 30e-12)
    fine_axis = TimeAxis.from_seconds(0.0, WIDTH / parts, PART_BINS * parts)
    gate = GATE if gated else None
    fine_gate = GATE.repeat_interleave(parts) if gated else None
    if free:
        detectors = [sensing.FreeRunningSPAD(100, 150e-12, axis=a) for a in (AXIS, fine_axis)]
    else:
        detectors = [spad(AXIS, gate), spad(fine_axis, fine_gate)]
    coarse, fine = (obeyed(d, tau_s=tau, axis=a) for d, a in zip(detectors, (AXIS, fine_axis), strict=True))
    assert coarse._steps() > 1
    by_hand = fine((x / parts).repeat_interleave(parts, 1)).view(1, PART_BINS, parts, 1, 1).sum(2)
    # detections are taken to be even in their bins, which are narrower by hand
    torch.testing.assert_close(coarse(x), by_hand, rtol=6e-3, atol=1e-4)
    torch.testing.assert_close(coarse.probabilities(x) * 100, coarse(x), rtol=1e-10, atol=0)
    drawn = coarse.sample(x.expand(1, PART_BINS, 20, 1), torch.Generator().manual_seed(0)).mean(2, keepdim=True)
    assert bool(((drawn - coarse(x)).abs() < 5 * (coarse(x) / 20).sqrt() + 0.5).all())


LIGHT, CYCLES = 4e-3, 1000


def one(background=LIGHT * CYCLES):
    """Window of 16 bins in a period of 160, constant even_light outside of it."""
    afterpulsing = sensing.Afterpulsing(0.1, 30e-9, 5e-9, bin_width_s=1e-9, period_s=160e-9, background=background)
    return sensing.AfterpulsingSPAD(sensing.SynchronousSPAD(CYCLES, dead_time_s=5e-9, bin_width_s=1e-9), afterpulsing)


def even_light():
    return torch.full((1, 16, 1, 1), LIGHT, dtype=torch.float64)


@pytest.mark.slow
def test_background_of_a_pixel_is_shared():
    """SPADs whose shares hardly differ count what equal ones do."""
    weights = [1.0] * 50 + [1.001] * 50
    equal = sensing.MacroPixel(one(), 100).expected(even_light())
    torch.testing.assert_close(
        sensing.MacroPixel(one(), 100, weights=weights).expected(even_light()), equal, rtol=1e-4, atol=0
    )
    assert float(equal.mean()) / (LIGHT * CYCLES) == pytest.approx(1 / 0.9, rel=2e-3)


def test_background_of_a_coincidence_pixel_is_shared():
    """One SPAD is enough, windows short: the counts of the macro-pixel."""
    found = sensing.CoincidencePixel(one(), 100, coincidence=1, window_s=1e-11, bin_width_s=1e-9).expected(even_light())
    torch.testing.assert_close(found, sensing.MacroPixel(one(), 100).expected(even_light()), rtol=1e-3, atol=0)


@pytest.mark.parametrize("tau_s", [1e-9, (1e-9, 2e-9)])
def test_all_carriers_are_set_free_during_the_dead_time(tau_s):
    p = 0.1 if isinstance(tau_s, float) else (0.1, 0.1)
    spad = sensing.SynchronousSPAD(100, dead_time_s=1.6e-6, bin_width_s=1e-7)
    afterpulsing = sensing.Afterpulsing(p, tau_s, 1.6e-6, counted_from="avalanche", bin_width_s=1e-7)
    x = torch.full((1, 16, 2, 2), 0.1, dtype=torch.float64)
    torch.testing.assert_close(
        sensing.AfterpulsingSPAD(spad, afterpulsing).expected(x), spad.expected(x), rtol=1e-12, atol=0
    )
    counts = spad.sample(x, torch.Generator().manual_seed(0))
    afterpulsing.grad = "straight_through"
    assert torch.equal(afterpulsing(counts, generator=torch.Generator().manual_seed(0)), counts)


def test_hardly_any_afterpulses_in_bright_light():
    """Hundreds of photons a bin, in a step and in pulses: the counts of the detector alone."""
    rate = torch.full((1, 60, 1, 2), 1e-3, dtype=torch.float64)
    rate[0, 5:, 0, 0], rate[0, ::7, 0, 1] = 80.0, 300.0
    alone = sensing.SynchronousSPAD(100, dead_time_s=20.3e-10, bin_width_s=1e-10)
    afterpulsing = sensing.Afterpulsing(1e-9, 30e-10, 20.3e-10, bin_width_s=1e-10)
    found = sensing.AfterpulsingSPAD(alone, afterpulsing).expected(rate)
    torch.testing.assert_close(found, alone.expected(rate), rtol=0, atol=1e-7)


def test_dark_pixels_have_the_slope_of_dim_ones():
    """The first photons of a free-running detector have afterpulses, too."""
    law = sensing.Afterpulsing(0.2, 90e-12, 70e-12, bin_width_s=20e-12)
    spad = sensing.AfterpulsingSPAD(sensing.FreeRunningSPAD(500, 70e-12, bin_width_s=20e-12), law)
    dark, dim = (
        torch.autograd.functional.jacobian(spad.expected, torch.full((1, 8, 1, 1), level, dtype=torch.float64))
        for level in (0.0, 1e-7)
    )
    torch.testing.assert_close(dark, dim, rtol=1e-4, atol=1e-3)


def test_gradients_in_a_flood():
    """Bins in which next to no detector is armed any more, behind others without light."""
    light = [0.0, 8.3, 17.4, 30.6, 0.0, 0.0, 14.7, 0.0, 4.5, 6.7, 0.0, 2.2]
    x = torch.tensor(light, dtype=torch.float64).view(1, -1, 1, 1).requires_grad_()
    law = sensing.Afterpulsing([0.03, 0.02], [90e-12, 700e-12], 70e-12, bin_width_s=20e-12)
    spad = sensing.AfterpulsingSPAD(sensing.SynchronousSPAD(500, dead_time_s=70e-12, bin_width_s=20e-12), law)
    (found,) = torch.autograd.grad(spad.expected(x).sum(), x)
    with torch.no_grad():
        near, far = (spad.expected(x + step).sum() for step in (1e-6, 2e-6))
        wanted = (4 * near - far - 3 * spad.expected(x).sum()) / 2e-6
    assert float(found.sum()) == pytest.approx(float(wanted), rel=1e-4)
