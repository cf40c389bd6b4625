"""Numbers at the edges: layouts of memory, parts of other bins, sensors that come twice, delays of no size."""

from __future__ import annotations

import itertools

import pytest
import torch
from torch import nn

from support.sensing.all_entries import ENTRIES
from support.sensing.contract import parts
from torchtransient import TimeAxis, sensing
from torchtransient.errors import UnitError
from torchtransient.sensing import GRAD_POLICIES, ScoreFunction

PS, NS = 1e-12, 1e-9
AXIS = TimeAxis.from_seconds(0.0, 100 * PS, 64)


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


# ---------------------------------------------------------------------------------------------------------- layouts

LAYOUTS = {
    "expanded": lambda x: x[:1].expand(3, *x.shape[1:]),
    "transposed": lambda x: x.transpose(-1, -2).contiguous().transpose(-1, -2),
    "sliced": lambda x: x.repeat_interleave(2, -1)[..., ::2],
    "channels last": lambda x: x.movedim(1, -1).contiguous().movedim(-1, 1),
    "time last": lambda x: x.movedim(-3, -1).contiguous().movedim(-1, -3),
}


def same_in_every_layout(entry, policy):
    module = entry.module(**({"grad": policy} if policy else {}))
    for name, layout in LAYOUTS.items():
        x = layout(entry.x())

        def measured(light, module=module):
            light = light.detach().requires_grad_()
            with ScoreFunction() as score:
                found = parts(module(light, generator=generator(3)))[0]
                loss = found.abs().square().sum()
                if score._log_probs:
                    loss = score.surrogate(loss)
            gradient = torch.autograd.grad(loss, light)[0] if loss.requires_grad else torch.zeros(())
            return found.detach(), gradient

        for own, dense in zip(measured(x), measured(x.contiguous()), strict=True):
            torch.testing.assert_close(own, dense, rtol=1e-9, atol=1e-9, msg=lambda m, n=name: f"{n}: {m}")


@pytest.mark.slow
@pytest.mark.parametrize("entry", [e for e in ENTRIES if e.random], ids=lambda e: e.name)
def test_the_layout_of_memory_changes_nothing_under_any_policy(entry):
    for policy in entry.policies:
        same_in_every_layout(entry, policy)


def jitter():
    return sensing.DetectionJitter(sensing.GaussianResponse(200 * PS), AXIS)


def afterpulses():
    return sensing.Afterpulsing(0.02, 1 * NS, 0.5 * NS, axis=AXIS)


SPAD = {"dead_time_s": 0.5 * NS, "axis": AXIS}
# detectors whose counts are not dense in memory, and what acts on their detections
CHAINS = {
    "dead time": lambda: [sensing.SynchronousSPAD(1000, **SPAD), jitter()],
    "macro-pixel": lambda: [sensing.MacroPixel(sensing.SynchronousSPAD(1000, **SPAD), 3), jitter()],
    "free": lambda: [sensing.FreeRunningSPAD(1000, 0.5 * NS, axis=AXIS), jitter()],
    "coincidence": lambda: [sensing.CoincidencePixel(sensing.SynchronousSPAD(99), 4, coincidence=2, window_s=NS,
        axis=AXIS), jitter()],
    "afterpulses": lambda: [sensing.SynchronousSPAD(1000, **SPAD), afterpulses(), jitter()],
    "nested": lambda: [sensing.Compose([sensing.SynchronousSPAD(1000, **SPAD)]), sensing.Compose([jitter()])],
    "skew": lambda: [sensing.SynchronousSPAD(1000, **SPAD), sensing.DetectionSkew(30 * PS, AXIS), jitter()],
}


def same_in_a_chain(make, first, later):
    chain = sensing.Compose(make(), grad=later)
    for module in chain.stages[0].modules():
        if isinstance(module, sensing.RandomSensor):
            module.grad = first
    x = torch.full((2, 1, 64, 2, 2), 0.02, dtype=torch.float64)
    for layout in (lambda v: v[:1].expand(2, 1, 64, 2, 2), LAYOUTS["time last"]):
        with ScoreFunction():
            found = chain(layout(x), generator=generator())
            torch.testing.assert_close(found, chain(layout(x).contiguous(), generator=generator()))


@pytest.mark.parametrize("make", [CHAINS["dead time"]])
def test_jitter_draws_what_a_dead_time_gives(make):
    """`rest.view(-1)` of counts with time last in memory was an error under "score"."""
    same_in_a_chain(make, "score", "score")


@pytest.mark.slow
@pytest.mark.parametrize("make", CHAINS.values(), ids=CHAINS)
def test_chains_draw_in_every_layout(make):
    for first, later in itertools.product(GRAD_POLICIES, repeat=2):
        same_in_a_chain(make, first, later)


# ------------------------------------------------------------------------------------------------------------- parts

FINE = {"bin_width_s": 50 * PS}
DEAD = {"dead_time_s": 1 * NS}
OF_OTHER_BINS = {
    "coincidence": lambda: sensing.CoincidencePixel(
        sensing.SynchronousSPAD(9, **DEAD, bin_width_s=100 * PS), 4, coincidence=2, window_s=1 * NS, **FINE
    ),
    "coincidence, other T": lambda: sensing.CoincidencePixel(
        sensing.SynchronousSPAD(9, **DEAD, axis=AXIS), 4, coincidence=2, window_s=1 * NS,
            axis=TimeAxis.from_seconds(0.0, 100 * PS, 32)
    ),
    "afterpulses": lambda: sensing.AfterpulsingSPAD(
        sensing.SynchronousSPAD(9, **DEAD, axis=AXIS), sensing.Afterpulsing(0.3, 5 * NS, 1 * NS, bin_width_s=10 * PS)
    ),
    "groups": lambda: sensing.PixelGroups(
        [sensing.SynchronousSPAD(9, **DEAD, axis=AXIS), sensing.SynchronousSPAD(9, **DEAD, **FINE)],
        torch.tensor([[0, 1]]),
    ),
    "groups of chains": lambda: sensing.PixelGroups(
        [sensing.Compose([sensing.SynchronousSPAD(9, **DEAD, **bins)]) for bins in ({"axis": AXIS}, FINE)],
        torch.tensor([[0, 1]]),
    ),
    "macro-pixel in a chain": lambda: sensing.Compose(
        [sensing.MacroPixel(sensing.SynchronousSPAD(9, **DEAD, **FINE), 3), jitter()]
    ),
    "groups in a chain": lambda: sensing.Compose(
        [sensing.PixelGroups([sensing.SynchronousSPAD(9, **DEAD, **FINE)], torch.tensor([[0]])), jitter()]
    ),
}


@pytest.mark.parametrize("make", OF_OTHER_BINS.values(), ids=OF_OTHER_BINS)
def test_parts_of_other_bins_are_refused(make):
    with pytest.raises(UnitError, match="one time axis"):
        make()


def test_parts_without_bins_and_with_the_same_are_taken():
    alike = sensing.SynchronousSPAD(9, **DEAD, axis=AXIS)
    pixels = [
        sensing.CoincidencePixel(alike, 4, coincidence=2, window_s=1 * NS, bin_width_s=100 * PS),
        sensing.CoincidencePixel(sensing.SynchronousSPAD(9), 4, coincidence=2, window_s=1 * NS, axis=AXIS),
        sensing.AfterpulsingSPAD(alike, sensing.Afterpulsing(0.3, 5 * NS, 1 * NS, bin_width_s=100 * PS)),
        sensing.MacroPixel(alike, 3),
        sensing.PixelGroups([sensing.SynchronousSPAD(9), alike], torch.tensor([[0, 1]])),
    ]
    for pixel in pixels:
        assert (pixel.bin_width_s, pixel.num_bins) == (100 * PS, 64), pixel


# ------------------------------------------------------------------------------------------------------------- twice


def budget():
    return sensing.PhotonBudget(
        sensing.Optics(f_number=2.0),
        pulse_energy_j=1e-9,
        wavelength_m=532e-9,
        repetition_rate_hz=1 / (6.4 * NS),
        cycles=1000,
        axis=AXIS,
    )


def test_a_stage_that_comes_twice_is_looked_at_twice():
    """torch's `named_children` leaves out what it has seen."""
    light, spad, noise = budget(), sensing.SynchronousSPAD(1000), sensing.ShotNoise()
    again = sensing.Compose([light])
    for stages in ([light, light], [spad, spad], [light, spad, spad], [noise, noise], [light, again]):
        with pytest.raises(UnitError, match="expected"):
            sensing.Compose(stages)
        with pytest.raises(UnitError, match="expected"):
            sensing.Compose([nn.Sequential(*stages)])


def test_a_response_may_come_twice():
    response = sensing.ImpulseResponse(sensing.GaussianResponse(200 * PS), AXIS)
    x = torch.rand(1, 64, 1, 1, generator=generator())
    assert torch.equal(sensing.Compose([response, response]).expected(x), response(response(x)))


# ------------------------------------------------------------------------------------------------------------ delays


@pytest.mark.parametrize("delay_s", [-1e-30, -1e-27, 0.0, 1e-30, -300 * PS - 1e-27])
def test_a_delay_next_to_a_whole_bin_has_a_score(delay_s):
    """1 - 1e-30 is 1: the share that stays was 0, and its logarithm's slope times no count NaN."""
    skew = sensing.DetectionSkew(delay_s, AXIS, learnable=True, grad="score")
    x = torch.full((1, 64, 1, 1), 10.0)
    with ScoreFunction() as score:
        moved = skew(x, generator())
    (gradient,) = torch.autograd.grad(score.surrogate(moved.square().sum()), skew.delays.delay_ps)
    assert bool(torch.isfinite(gradient))
    assert torch.equal(moved, sensing.shift_time(x, delay_s / (100 * PS)))
