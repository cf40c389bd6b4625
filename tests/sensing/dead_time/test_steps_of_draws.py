"""Draws of a period step by step: their means, their probabilities, and where they leave every detector."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import distributions

from torchtransient.errors import UnitError
from torchtransient.sensing.dead_time import clocked_counts as draws
from torchtransient.sensing.dead_time.clocked_counts import (
    _cycle_steps,
    armed_time,
    check_cycles,
    cycles_log_prob,
    draw_cycle_steps,
)
from torchtransient.sensing.dead_time.free_running import (
    FreeRunningState,
    _armed_in_the_light,
    _solve_cut,
    _solve_settled,
    clamped_state,
    detections_per_period,
    first_armed,
    stationary_state,
    stationary_steps,
)
from torchtransient.sensing.dead_time.renewal import RenewalChain, stationary_phases

BINS, PERIODS = 5, 40


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def rates(pixels=3, high=0.6, bins=BINS, seed=0):
    return 0.05 + high * torch.rand(pixels, bins, generator=generator(seed), dtype=torch.float64)


def number(x):
    return torch.tensor(x, dtype=torch.float64)


def free_running_steps(rate, dead):
    """Chances (T, P, 1) of a detector that runs free."""
    state = stationary_state(rate, number(dead))
    columns = [v.T.unsqueeze(-1) for v in (rate, state.detected, state.armed, state.late)]
    placed = type(state)(columns[1], columns[2], columns[3], state.whole)
    return stationary_steps(columns[0], placed)


def mean_of(many, chance, generator):
    return many * chance


def steps_by_distributions(path, chances, periods):
    """The sum of what torch says of every step, by pixel."""
    total = 0.0
    if path.begin is not None:
        whole = torch.cat([path.begin, periods - path.begin.sum(-3, keepdim=True)], -3)
        p = torch.cat([chances.begin, 1 - chances.begin.sum(-3, keepdim=True)], -3).clamp_min(0)
        begins = distributions.Multinomial(periods, p.movedim(-3, -1), validate_args=False)
        total = begins.log_prob(whole.movedim(-3, -1))
    for hits, trials, chance in ((path.fired, path.armed, chances.fire), (path.soon, path.back, chances.soon),
                                 (path.late, path.fired + path.soon, chances.late)):  # fmt: skip
        inner = chance.clamp(1e-300, 1 - 1e-16)
        total = total + distributions.Binomial(trials, inner, validate_args=False).log_prob(hits).sum(-3)
    return total


@pytest.mark.parametrize("dead", [2.0, 7.6])
def test_scores_of_detectors_that_run_free(dead):
    """Derivatives of the log-probability of the steps, beginning included; nobody is lost on the way."""
    rate = rates().requires_grad_()
    chances = free_running_steps(rate, dead)
    with torch.no_grad():
        path = draws.draw_steps(chances, PERIODS, generator())
    weights = number([1.0, 2.0, -0.5]).unsqueeze(-1)
    found = (draws.steps_log_prob(path, chances, PERIODS) * weights).sum()
    wanted = (steps_by_distributions(path, chances, PERIODS) * weights).sum()
    slopes = [torch.autograd.grad(v, rate, retain_graph=True)[0] for v in (found, wanted)]
    torch.testing.assert_close(slopes[0], slopes[1], rtol=1e-7, atol=1e-7)
    # those that are dead all period long stay so
    torch.testing.assert_close(path.end + path.wrapped.sum(-3), path.begin.sum(-3))
    assert torch.equal(path.counts, path.fired + path.soon)
    starts = torch.cat([path.armed.narrow(-3, 0, 1), path.back], -3)
    began = path.begin.sum(-3) + path.counts.sum(-3) - path.wrapped.sum(-3)
    torch.testing.assert_close(starts.sum(-3), began)
    # of 7.6 bins in a period of 5 all come back after one start of a period, or after two
    rounds = (path.missed / path.wrapped.sum(-3).clamp_min(1)).flatten().tolist()
    assert all(1 <= r <= 2 if dead > BINS else r == 1 for r in rounds)
    assert chances.whole == math.floor(dead)
    assert bool((chances.begin.sum(-3) <= 1 + 1e-12).all())


@pytest.mark.parametrize("dead", [0.6, 1.3, 3.0])
def test_scores_of_cycles(dead):
    rate = rates(3, 2.0).requires_grad_()
    counts, drawn = draw_cycle_steps(rate, number(dead), PERIODS, generator())
    assert sum(len(one.rows) if one.rows is not None else 3 for one in drawn) == 3
    found = cycles_log_prob(drawn, rate, number(dead), PERIODS)
    wanted = torch.zeros(3, dtype=torch.float64)
    for one in drawn:
        rows = torch.arange(3) if one.rows is None else one.rows
        chances = _cycle_steps(rate[rows], number(dead), one.pieces).chances
        wanted = wanted.index_copy(0, rows, steps_by_distributions(one.path, chances, PERIODS).flatten())
    weights = number([1.0, 2.0, -0.5])
    slopes = [torch.autograd.grad((v * weights).sum(), rate, retain_graph=True)[0] for v in (found, wanted)]
    torch.testing.assert_close(slopes[0], slopes[1], rtol=1e-7, atol=1e-7)
    assert bool((counts.sum(-1) > 0).all())


@pytest.mark.parametrize("dead", [0.6, 1.3, 2.7, 9.0])
def test_the_mean_of_all_steps_is_the_mean(dead):
    """Each step taken by its share: detections, those that come back, those that are armed."""
    rate = rates(3, 2.0)
    for pieces in (2, 4):
        steps = _cycle_steps(rate, number(dead), pieces)
        path = draws.draw_steps(steps.chances, 1, None, draw=mean_of)
        torch.testing.assert_close(path.counts, steps.count)
        torch.testing.assert_close(path.back, steps.back)
        torch.testing.assert_close(path.armed, steps.armed, rtol=1e-5, atol=1e-7)
        torch.testing.assert_close(path.end + path.wrapped.sum(-3), torch.ones(3, 1).double())
    chances = free_running_steps(rates(), max(dead, 1.0))
    begin = draws.StepProbabilities(None, chances.fire, chances.soon, chances.late, chances.whole)
    assert torch.equal(draws.draw_steps(begin, 7, None, draw=mean_of).armed[0], torch.full((3, 1), 7.0).double())


@pytest.mark.parametrize("dead", [1.3, 2.0, 6.4])
def test_a_state_from_finer_pieces_is_the_same(dead):
    """Bins of dim light, whole or cut: detected, armed and late ones agree to the third order of their photons."""
    rate = rates(2, 0.2)
    coarse, *others = (_solve_cut(rate, number(dead), pieces) for pieces in (1, 2, 3, 4))
    for finer in others:
        assert finer.whole == coarse.whole == math.floor(dead)
        for name in ("detected", "armed", "late"):
            torch.testing.assert_close(getattr(finer, name), getattr(coarse, name), rtol=5e-3, atol=1e-4)


@pytest.mark.parametrize("whole, part", [(1, 0.6), (9, 0.3)])
def test_places_where_detectors_begin(whole, part):
    """Armed with the chance that the state has; else after what is left of a dead time that began in its light."""
    many, rate = 40_000, rates(1, 1.2, 4)
    chain = RenewalChain(rate, whole, number(part))
    lines = detections_per_period(chain, stationary_phases(rate, number(part), whole))
    several = RenewalChain(rate.expand(many, -1), whole, number(part))
    state = clamped_state(several, lines.expand(many, -1))
    start = first_armed(state, number(part), generator()).flatten().numpy()
    armed = float(chain.at_start(chain.inflow(lines))[0, 0])
    assert np.mean(start == 0) == pytest.approx(armed, abs=5 * math.sqrt(armed * (1 - armed) / many))
    # a detection at time t < 0 arms again at t + dead: light of the last dead time, seen backwards
    dead = whole + part
    free = (np.arange(100_000) + 0.5) / 100_000 * dead
    at = (free - dead) % 4
    k, y = at.astype(int), at % 1
    density = lines[0, :4].numpy()[k] + math.sqrt(3) * lines[0, 4:].numpy()[k] * (2 * y - 1)
    mean = (free * density).sum() / density.sum()
    spread = math.sqrt((free**2 * density).sum() / density.sum() - mean**2)
    later = start[start > 0]
    assert later.max() <= dead
    # inside of a stretch the place is even: of second order in the slope of the light
    assert later.mean() == pytest.approx(mean, abs=5 * spread / math.sqrt(len(later)) + 0.01)


def test_lines_that_dip_below_zero_are_drawn_from_within_limits():
    """No detections below none, of which none to all are late; a chance to be armed from 0 to 1."""
    chain = RenewalChain(rates(2, 1.2, 4), 1, number(0.6))
    count = number([[0.5, -0.2, 0.3, 0.4], [9.0, 8.0, -30.0, 7.0]])
    slope = number([[2.0, 0.1, -2.0, 0.0], [0.0, 0.0, 0.0, 0.0]])
    lines = torch.cat([count, slope], -1)
    late = 0.6 * count + math.sqrt(3) * 0.4 * 0.6 * slope
    armed = chain.at_start(chain.inflow(lines))
    assert float(armed.min()) < 0 and float(armed.max()) > 1 and float(late[0, 0]) > 0.5 and float(late[0, 2]) < 0
    state = clamped_state(chain, lines)
    assert state.detected.tolist() == [[0.5, 0.0, 0.3, 0.4], [9.0, 8.0, 0.0, 7.0]] and state.whole == 1
    assert state.late.flatten().tolist() == pytest.approx([0.5, 0.0, 0.0, 0.24, 5.4, 4.8, 0.0, 4.2])
    assert torch.equal(state.armed, armed.clamp(0, 1))


@pytest.mark.slow
@pytest.mark.parametrize("dead", [1.3, 2.0, 11.7])
def test_stationary_states_in_bright_light_are_within_limits(dead):
    """Straight lines miss the edges of bins by up to a third of what is in them; no number of a state does."""
    rate = 10 ** (4 * torch.rand(40, 6, generator=generator(), dtype=torch.float64) - 2)
    bare, state = _solve_settled(rate, number(dead), 1), stationary_state(rate, number(dead))
    assert float(bare.armed.min()) < 0
    assert bool((state.detected >= 0).all() & (state.late >= 0).all() & (state.late <= state.detected).all())
    assert bool((state.armed >= 0).all() & (state.armed <= 1).all())


@pytest.mark.parametrize("dead", [1.3, 4.0])
def test_stationary_states_by_hand(dead):
    """Constant light n: n / (1 + n d) detected, the rest armed; of a flash all come back late but those of its first
    1 - part. In the dark all are armed, and what is detected are the photons."""
    rate = number([[0.4] * 6, [0.0] * 6, [1e-13, 0, 0, 0, 0, 0], [0, 0, 0.3, 0, 0, 0]])
    state, part = stationary_state(rate, number(dead)), dead % 1
    n = 0.4 / (1 + 0.4 * dead)
    assert state.detected[0].tolist() == pytest.approx([n] * 6)
    assert state.late[0].tolist() == pytest.approx([part * n] * 6)
    assert state.armed[0].tolist() == pytest.approx([1 - n * dead] * 6)
    assert torch.equal(state.detected[1:3], rate[1:3]) and state.late[1:3].abs().sum() == 0
    assert bool((state.armed[1:3] == 1).all())
    once = -math.expm1(-0.3)  # in a period
    assert float(state.detected[3, 2]) == pytest.approx(once, rel=1e-3)
    assert float(state.late[3, 2]) == pytest.approx(once - -math.expm1(-0.3 * (1 - part)), rel=2e-2, abs=1e-12)
    assert state.armed[3, 2:4].tolist() == pytest.approx([1.0, 1 - once], rel=1e-3)


def test_detections_that_end_being_dead_in_the_light():
    """All of bin 0 are armed again in bin 3, or those that are late in bin 4: whether it is bright there."""
    for late, place in ((0.0, 3), (0.9, 4)):
        detected = number([[0.9, 0, 0, 0, 0, 0]])
        state = FreeRunningState(detected, torch.ones_like(detected), detected * (late > 0), 3)
        for lit in range(6):
            rate = number([[0.1] * 6])
            rate[0, lit] = 20.0
            assert bool(_armed_in_the_light(rate, state)) == (lit == place)


def test_detectors_that_nothing_of_the_period_before_keeps_dead_begin_armed():
    """Light that is over one dead time before the end, beside light that is not."""
    count = number([[0.6, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.9]])
    state = FreeRunningState(count, number([[0.0, 1, 1, 1], [0.0, 0.5, 1, 1]]), 0 * count, 1)
    for seed in range(5):
        start = first_armed(state, number(0.4), generator(seed)).flatten()
        # the detection of the last piece lay in its first 0.6, and is felt for 1.4 pieces
        assert float(start[0]) == 0.0 and 0 < float(start[1]) <= 1.0


# ------------------------------------------------------------------------------------------ what a histogram tells


@pytest.mark.parametrize("dead", [0.6, 1.0, 1.3, 2.7])
def test_cycles_that_could_fire(dead):
    """Of detections that lie evenly in their bins: armed at the start, joining later, and for how long."""
    counts = number([5.0, 0.0, 7.0, 2.0, 4.0, 1.0]).reshape(1, 6, 1, 1)
    found = armed_time(counts, 50, dead)
    y = (np.arange(20_000) + 0.5) / 20_000
    armed, exposed = np.full(6, 50.0), np.full(6, 50.0)
    for k, n in enumerate(counts.flatten().tolist()):
        again = k + y + dead
        for b in range(6):
            if b > k:
                dead_at_start = (again > b).mean()
                armed[b] -= n * dead_at_start
                exposed[b] -= n * np.clip(again - b, 0, 1).mean()
            elif b == k:
                exposed[b] += n * np.clip(1 - (y + dead), 0, None).mean()  # back in the bin itself
    np.testing.assert_allclose(found.armed.flatten().numpy(), armed, atol=1e-3)
    np.testing.assert_allclose(found.exposed.flatten().numpy(), exposed, atol=1e-3)


def test_short_stays_saturate_less():
    """Of 8 that join evenly in a bin a share 1 - (1 - exp(-r)) / r fires; half of 1 - exp(-r) is counted without."""
    time = armed_time(number([8.0, 0.0, 0.0]).reshape(1, 3, 1, 1), 8, 1.0)
    for r in (0.01, 0.1, 0.4):
        rate = torch.full((1, 3, 1, 1), r, dtype=torch.float64).requires_grad_()
        (slope,) = torch.autograd.grad(time.short_exposures(rate).sum(), rate)
        fired = 1 - (1 - math.exp(-r)) / r
        rise = 8 * (fired / (1 - math.exp(-r)) - 0.5)
        assert float(slope[0, 1]) == pytest.approx(rise, rel=r / 6 + 1e-4)
        assert float(slope[0, 2]) == pytest.approx(0.0, abs=1e-12)
    flood = torch.full((1, 3, 1, 1), 1e7, dtype=torch.float64).requires_grad_()
    (slope,) = torch.autograd.grad(time.short_exposures(flood).sum(), flood)
    assert float(slope[0, 1]) == pytest.approx(8 * 0.5, rel=1e-5)
    dark = torch.zeros(1, 3, 1, 1, dtype=torch.float64)
    assert not bool(time.short_exposures(dark).any())


def test_cycles_that_are_left():
    """As many as are said, and not fewer."""
    check_cycles(number([-0.5, 3.0]), 10, -0.5, "here")
    with pytest.raises(UnitError, match="at most 10 cycles"):
        check_cycles(number([-0.51, 3.0]), 10, -0.5, "here")
