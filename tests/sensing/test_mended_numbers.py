"""Numbers at the edges: layouts of memory, parts of other bins, sensors that come twice, delays of no size."""

from __future__ import annotations

import pytest
import torch

from torchtransient import TimeAxis, sensing
from torchtransient.errors import UnitError
from torchtransient.sensing import ScoreFunction

PS, NS = 1e-12, 1e-9
AXIS = TimeAxis.from_seconds(0.0, 100 * PS, 64)


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


# ---------------------------------------------------------------------------------------------------------- layouts


def jitter():
    return sensing.DetectionJitter(sensing.GaussianResponse(200 * PS), AXIS)


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
