"""Afterpulses by several exponentials, power laws and measured delays; and detectors whose dead time they obey."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from scipy import stats

from support.sensing.all_entries import ENTRIES
from support.sensing.event_driven import Afterpulse, compare, detect, exponential_delays, measured_delays
from support.sweeps import together
from torchtransient import sensing
from torchtransient.errors import UnitError

WIDTH = 1e-10  # of a bin
BINS = 40


def exponentials(dead, *parts, **keywords):
    """`parts`: (probability, mean delay in bins)."""
    p, tau = [q for q, _ in parts], [t * WIDTH for _, t in parts]
    return sensing.Afterpulsing(p, tau, dead * WIDTH, bin_width_s=WIDTH, **keywords)


@dataclass(frozen=True)
class Delays:
    """A law, the dead time in bins, and the formula of carriers that are left after t bins, in any scale."""

    law: Callable[[], sensing.AfterpulseDelays]
    dead: float
    left: Callable[[np.ndarray], np.ndarray]
    infinite: bool = False  # at delay 0


def power_law(dead, exponent, longest):
    def left(t):
        a = 1 - exponent
        return -np.log(t) if a == 0 else -np.expm1(a * np.log(t)) / a

    return Delays(lambda: sensing.PowerLawDelays(exponent, longest * WIDTH), dead, left, infinite=True)


def measured(dead, start=0.7):
    counts, width = [9.0, 40, 22, 13, 9, 6, 5], 5.3  # 4 of them are no afterpulses
    edges, sums = start + width * np.arange(8), np.cumsum([0, *(n - 4 for n in counts)])
    law = functools.partial(
        sensing.MeasuredDelays, torch.tensor(counts), width * WIDTH, start_s=start * WIDTH, floor=4.0
    )
    return Delays(law, dead, lambda t: sums[-1] - np.interp(t, edges, sums))


# Every law of delays: an entry here, and one of the contract of sensors.
DELAYS = {
    "power law": power_law(7.4, 1.3, 400.0),
    "power law with exponent 1": power_law(3.0, 1.0, 90.0),
    "power law with exponent nearly 1": power_law(3.0, 1 + 5e-7, 90.0),
    "flat power law": power_law(2.2, 0.6, 60.0),
    "steep power law": power_law(0.6, 2.5, 50.0),
    "measured": measured(7.4),
    "measured, behind its dead time": measured(2.0, start=6.5),
    "measured, without dead time": measured(0.0),
}


def of_delays(name):
    delays = DELAYS[name]
    return sensing.Afterpulsing(0.2, dead_time_s=delays.dead * WIDTH, delays=delays.law(), bin_width_s=WIDTH)


LAWS = {
    "two exponentials": lambda: exponentials(7.4, (0.06, 5.0), (0.14, 130.0)),
    "no dead time": lambda: exponentials(0.0, (0.1, 0.3), (0.1, 90.0)),
    **{name: functools.partial(of_delays, name) for name in DELAYS},
}
each_law = pytest.mark.parametrize("name", LAWS)


# --- laws -----------------------------------------------------------------------------------------------------------


def test_every_law_of_delays_is_compared():
    public = {
        law for law in vars(sensing).values() if isinstance(law, type) and issubclass(law, sensing.AfterpulseDelays)
    }
    laws = public - {sensing.AfterpulseDelays}
    here = {type(delays.law()) for delays in DELAYS.values()}
    assert here == laws, f"enter {laws - here} in DELAYS of tests/sensing/test_afterpulse_laws.py"
    in_contract = {type(delays) for entry in ENTRIES if (delays := getattr(entry.make(), "delays", None)) is not None}
    assert in_contract >= laws, f"give {laws - in_contract} an Entry in tests/support/sensing/entries_afterpulses.py"


@pytest.mark.parametrize("name", DELAYS)
def test_laws_against_quadrature(name):
    """What is yet to come, its mean over bins of three lengths, and drawn delays, by the formula of what is left."""
    law, dead, left = DELAYS[name].law(), DELAYS[name].dead, DELAYS[name].left
    dead_s, end = dead * WIDTH, law.end_s() / WIDTH
    assert math.isfinite(end)

    def yet(t):
        t = np.clip(t, dead, end)
        return (left(t) - left(end)) / (left(np.array(dead)) - left(end))

    t = torch.linspace(dead, end + 2, 50, dtype=torch.float64)
    np.testing.assert_allclose(law.yet_to_come(t, dead_s, WIDTH).numpy(), yet(t.numpy()), atol=1e-6)
    for width in (0.7, 3.0, 11.0):  # of a bin
        number = min(math.ceil(end / width) + 2, 40)
        inside = (np.arange(4000) + 0.5) / 4000
        wanted = yet((np.arange(-1.0, number)[:, None] + inside) * width).mean(1)
        found = law.shares(dead_s, width * WIDTH, first=0, number=number).numpy()
        np.testing.assert_allclose(found, wanted[:-1] - wanted[1:], atol=3e-4)
        assert float(law.kernel(dead_s, width * WIDTH, 7).sum()) == pytest.approx(1, rel=1e-9)
    drawn = law.draw(50_000, dead_s, torch.Generator().manual_seed(0)).numpy() / WIDTH
    assert drawn.min() >= dead * (1 - 1e-12) and drawn.max() <= end * (1 + 1e-12)
    assert stats.kstest(drawn, lambda t: 1 - yet(t)).pvalue > 1e-3
    if DELAYS[name].infinite:
        with pytest.raises(UnitError):
            law.released_after(dead_s)
    else:
        share = (left(np.array(dead)) - left(end)) / (left(np.array(0.0)) - left(end))
        assert float(law.released_after(dead_s)) == pytest.approx(float(share))
    for late in (end, end + 1):
        with pytest.raises(UnitError):
            law.shares(late * WIDTH, WIDTH, first=0, number=3)


@each_law
def test_every_afterpulse_has_its_bin(name):
    """Folded round a period the shares add up to the probability, whatever the period."""
    module = LAWS[name]()
    for period in (1, 7, BINS, 1000):
        assert float(module.kernel(period).sum()) == pytest.approx(0.2, rel=1e-9)
    folded, first = module.kernel(7), module.first_kernel(7 * 20_000)
    rest = 0.2 - float(first.sum())
    torch.testing.assert_close(folded, first.view(-1, 7).sum(0), rtol=1e-6, atol=rest + 1e-12)


@each_law
def test_constant_counts_stay_constant_and_grow_by_all_generations(name):
    x = torch.full((1, BINS, 2, 2), 3.0, dtype=torch.float64)
    torch.testing.assert_close(LAWS[name]()(x), x / (1 - 0.2), rtol=1e-9, atol=0)


@each_law
def test_draws_have_the_mean(name):
    module, pixels = LAWS[name](), 4096
    x = torch.zeros(1, BINS, 64, 64)
    x[:, 5], x[:, 39] = 60, 20
    added = (module.sample(x, torch.Generator().manual_seed(0)) - x).double().mean((0, 2, 3))
    mean = module.extra(x.double()).mean((0, 2, 3)).clamp_min(0)
    assert torch.equal(added * pixels, (added * pixels).round())
    assert bool(((added - mean).abs() < 5.5 * (1.5 * mean / pixels).sqrt() + 1e-3).all())


@each_law
@together("period", [BINS + 1, 75, 300])
def test_constant_counts_in_a_window_of_a_longer_period(name, period):
    """What goes on outside of the window triggers afterpulses inside: as in a window of the whole period."""
    whole = LAWS[name]()
    part = LAWS[name]()
    part.period_bins, part.background = period, 3.0
    x = torch.full((1, period, 2, 2), 3.0, dtype=torch.float64)
    x[:, 7] += 50.0
    torch.testing.assert_close(part(x[:, :BINS]), whole(x)[:, :BINS], rtol=1e-9, atol=0)
    constant = torch.full((1, BINS, 2, 2), 3.0, dtype=torch.float64)
    assert float(part(constant).max() / part(constant).min() - 1) < 1e-9


def test_draws_of_a_window_of_a_longer_period():
    """In each of 4096 pixels of every bin: the mean, and the variance of a Poisson number."""
    module = exponentials(5.0, (0.1, 30.0), period_s=90 * WIDTH, background=20.0)
    x = torch.full((1, BINS, 64, 64), 20.0)
    added = (module.sample(x, torch.Generator().manual_seed(0)) - x).double().mean((0, 2, 3))
    mean = float(module.extra(x.double()).mean())
    assert mean == pytest.approx(20 * 0.1 / 0.9, rel=1e-6)
    assert float((added - mean).abs().max()) < 5 * (1.2 * mean / 4096) ** 0.5


def test_a_measured_exponential_is_an_exponential():
    """Histogram of an exponential from the avalanche on, in bins of a tenth of its mean: what dies in the dead time."""
    tau, dead, width = 20.0, 13.7, 0.1
    edges = torch.arange(0, 4001, dtype=torch.float64) * width
    counts = torch.exp(-edges[:-1] / tau) - torch.exp(-edges[1:] / tau)
    law = sensing.MeasuredDelays(counts, width * WIDTH)
    given = {"dead_time_s": dead * WIDTH, "bin_width_s": WIDTH, "counted_from": "avalanche"}
    found = sensing.Afterpulsing(0.3, delays=law, **given).kernel(BINS)
    wanted = sensing.Afterpulsing(0.3, tau * WIDTH, **given).kernel(BINS)
    assert float(wanted.sum()) == pytest.approx(0.3 * math.exp(-dead / tau), rel=1e-9)
    # straight lines instead of a curve within bins of width/tau = 1/200: (1/200)^2 / 8 of what is yet to come
    torch.testing.assert_close(found, wanted, rtol=1e-5, atol=0.3 / 200**2 / 8)


# --- detectors ------------------------------------------------------------------------------------------------------


def detector(mode, dead, cycles=1, **keywords):
    if mode == "free":
        return sensing.FreeRunningSPAD(cycles, dead * WIDTH, bin_width_s=WIDTH, **keywords)
    if mode == "first":
        return sensing.SynchronousSPAD(cycles, **keywords)
    return sensing.SynchronousSPAD(cycles, dead_time_s=dead * WIDTH, bin_width_s=WIDTH, **keywords)


def light(total, kind):
    k = np.arange(BINS)
    rate = {"constant": np.ones(BINS), "pulse": 0.2 / BINS + 0.3 * (np.abs(k - 12) < 2)}.get(kind)
    if rate is None:  # the last bin and the first
        rate = 0.2 / BINS + 0.4 * (k == 0) + 0.4 * (k == BINS - 1)
    return rate / rate.sum() * total


def agreement(mode, dead, total, kind, parts, laws, seed=0, runs=300, periods=200, warm_up=15):
    rate = light(total, kind)
    events = detect(
        np.random.default_rng(seed), rate, runs, periods, None if mode == "first" else dead,
        free_running=mode == "free", afterpulses=laws, warm_up=warm_up,
    )  # fmt: skip
    sensor = sensing.AfterpulsingSPAD(detector(mode, dead), parts)
    return compare(events, sensor.expected(torch.as_tensor(rate).view(1, -1, 1, 1)).numpy())


def two(dead):
    parts = ((0.02, 9.0), (0.02, 120.0))
    return exponentials(dead, *parts), [Afterpulse(p, exponential_delays(t, after=dead)) for p, t in parts]


@pytest.mark.parametrize("mode, dead, total", [("first", 12.3, 10.0), ("free", 12.3, 10.0)])
def test_events(mode, dead, total):
    """As events do that walk through every carrier, dead times and all. One run's ratio scatters by some 0.3."""
    assert agreement(mode, dead, total, "pulse", *two(dead)).ratio < 1.5
    # what this stage is there for: counts that know nothing of the dead time are off
    sensor, laws = two(dead)
    x = torch.as_tensor(light(total, "pulse")).view(1, -1, 1, 1)
    events = detect(
        np.random.default_rng(0), x.flatten().numpy(), 300, 200, None if mode == "first" else dead,
        free_running=mode == "free", afterpulses=laws, warm_up=15,
    )  # fmt: skip
    assert compare(events, sensor.expected(detector(mode, dead).expected(x)).numpy()).ratio > 1.5


@pytest.mark.slow
@pytest.mark.parametrize("kind, total", [("constant", 100.0), ("pulse", 1.0), ("edges", 10.0)])
@pytest.mark.parametrize("mode, dead", [("first", 12.3), ("several", 1.3), ("several", 12.3), ("free", 55.7)])
def test_events_everywhere(mode, dead, total, kind):
    found = [agreement(mode, dead, total, kind, *two(dead), seed=s) for s in range(3)]
    assert sum(a.total_variation for a in found) < 1.5 * sum(a.noise for a in found)


@pytest.mark.slow
def test_events_of_measured_delays():
    """Carriers that are set free while the detector is dead are lost, and counted as such."""
    counts, own, dead = [20.0, 30, 11, 7, 5, 4, 2, 1], 9.7, 12.3
    law = sensing.MeasuredDelays(torch.tensor(counts), own * WIDTH)
    parts = sensing.Afterpulsing(
        0.06, dead_time_s=dead * WIDTH, delays=law, counted_from="avalanche", bin_width_s=WIDTH
    )
    laws = [Afterpulse(0.06, measured_delays(np.arange(9) * own, counts))]
    found = [agreement("free", dead, 30.0, "pulse", parts, laws, seed=s) for s in range(3)]
    assert sum(a.total_variation for a in found) < 1.5 * sum(a.noise for a in found)


@pytest.mark.slow
@pytest.mark.parametrize("tau", [0.3, 300.0])
@pytest.mark.parametrize("mode, dead", [("several", 1.3), ("free", 25.0)])
def test_frequent_afterpulses(mode, dead, tau):
    """Of 30 %, from delays below a bin to carriers that are trapped for many dead times: shape and total."""
    for total in (1.0, 100.0):
        parts = exponentials(dead, (0.3, tau))
        laws = [Afterpulse(0.3, exponential_delays(tau, after=dead))]
        for kind in ("constant", "pulse"):
            found = agreement(mode, dead, total, kind, parts, laws, runs=200, periods=60, warm_up=60)
            assert found.within(1.5), (total, kind, found)


@pytest.mark.parametrize(
    "dead, total, p", [(12.3, 0.1, 0.3), (55.7, 1.0, 0.04), (12.3, 10.0, 0.04), (55.7, 100.0, 0.3)]
)
def test_constant_light_stays_constant(dead, total, p):
    """Free-running, at n photons: 1/m = dead + (1 - p)/n + p/(n + 1/tau) of carriers gone with a dead time."""
    n, tau = total / BINS, 1.0
    light_ = torch.full((1, BINS, 1, 1), n, dtype=torch.float64)
    y = sensing.AfterpulsingSPAD(detector("free", dead), two(dead)[0])(light_)
    assert float(y.max() / y.min() - 1) < 1e-6
    y = sensing.AfterpulsingSPAD(detector("free", dead), exponentials(dead, (p, tau)))(light_)
    assert float(y.mean()) == pytest.approx(1 / (dead + (1 - p) / n + p / (n + 1 / tau)), rel=3e-6)


def test_dim_light_is_the_linear_stage():
    rate = torch.full((1, BINS, 1, 1), 1e-7, dtype=torch.float64)
    rate[0, 10] = 1e-6
    spad, parts = detector("free", 12.3), two(12.3)[0]
    torch.testing.assert_close(sensing.AfterpulsingSPAD(spad, parts)(rate), parts(spad(rate)), rtol=1e-4, atol=0)


def test_one_detection_a_cycle_has_afterpulses_in_later_cycles_only():
    """All light in the first bin: in its own cycle the detector is dead, the next is reached by what is late enough."""
    x = torch.zeros(1, BINS, 1, 1, dtype=torch.float64)
    x[0, 0] = 1e-4
    sensor = sensing.AfterpulsingSPAD(sensing.SynchronousSPAD(1), exponentials(2.0, (0.1, 5.0)))
    # of delays beyond 39 to 40 bins, the mean over the place in bin 0; none else
    late = 0.1 * 5 * math.exp(-(39 - 2) / 5) * (1 - math.exp(-1 / 5))
    alone = sensing.SynchronousSPAD(1)(x).sum()
    assert float(sensor(x).sum() / alone - 1) == pytest.approx(late, rel=1e-3)
    longer = sensing.AfterpulsingSPAD(sensing.SynchronousSPAD(1), exponentials(2.0, (0.1, 5.0), period_s=400 * WIDTH))
    assert float(longer(x).sum() / alone - 1) < 1e-12


def test_a_detector_in_a_window_of_a_longer_period():
    """Constant light that goes on outside: as dim light in a window of the whole period, constant to 1e-6."""
    level, period, cycles = 1e-8, 90, 1000
    parts = exponentials(12.3, (0.1, 30.0), period_s=period * WIDTH, background=level * cycles)
    sensor = sensing.AfterpulsingSPAD(detector("several", 12.3, cycles=cycles), parts)
    y = sensor(torch.full((1, BINS, 1, 1), level, dtype=torch.float64))
    assert float(y.max() / y.min() - 1) < 1e-6
    # the cycle's own pile-up is 4e-7 of it
    assert float(y.mean()) == pytest.approx(level * cycles / 0.9, rel=1e-6)
