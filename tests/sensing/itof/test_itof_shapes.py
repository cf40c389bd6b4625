"""Phases by the shape of a code: plateaus, corners, noise beside the curve, and light at phase zero."""

from __future__ import annotations

import math

import pytest
import torch

from torchtransient import sensing
from torchtransient.sensing.itof import codes as itof_codes
from torchtransient.sensing.itof import reading as itof_reading

TURN = 2 * math.pi


@pytest.mark.parametrize("readout", ["single", "differential"])
def test_shapes_of_codes_with_plateaus_and_corners(readout):
    """Noise beside the curve of shapes: the phase is that of the best match, to twice the pitch of the table."""
    g = torch.Generator().manual_seed(3)
    x = torch.arange(64, dtype=torch.float64) / 64
    for code in (sensing.square_code(3), sensing.square_code(4, 0.1), sensing.hamiltonian_code(3)):
        steps = torch.randn(1, 1, code.num_taps, 20, 20, generator=g, dtype=torch.float64)
        found = itof_reading._by_shape(steps, code, 64, readout)[0].flatten() / TURN
        shapes = itof_reading._unit_shapes(code, x, readout == "single")
        scores = steps.movedim(2, -1).reshape(-1, code.num_taps) @ shapes.T
        best = scores >= scores.amax(-1, keepdim=True) - 1e-9  # all of a plateau
        off = torch.where(best, ((found.unsqueeze(-1) - x + 0.5) % 1 - 0.5).abs(), 1.0).amin(-1)
        assert float(off.max()) <= 2 / 64 + 1e-12


def test_phases_at_which_all_taps_agree_are_no_match():
    """Short openings and shorter light: between them nothing is seen, and no phase is found there."""
    code = itof_codes.binary_code(0.05, [[(0.0, 0.2)], [(0.3, 0.5)], [(0.6, 0.8)]])
    shapes = itof_reading._unit_shapes(code, torch.tensor([0.1, 0.22], dtype=torch.float64), True)
    assert float(shapes[1].norm()) < 0.01 and float(shapes[0].norm()) == pytest.approx(1)
    x = torch.tensor([0.1, 0.4, 0.7], dtype=torch.float64)
    phases = sensing.decode_code((3 + code.evaluate(x)).reshape(1, 3, 1, 3), code).flatten() / TURN
    # what a tap sees alone has one shape: from where light comes in to where it has gone, 0.25 turns
    assert bool((((phases - x + 0.025 + 0.5) % 1 - 0.5).abs() <= 0.126).all())


def test_phases_of_shapes_are_below_a_turn():
    """Whatever rounding leaves of light at phase zero; and what is found is near zero, from either side."""
    loud = torch.linspace(1, 7, 500, dtype=torch.float64).view(1, 1, 1, -1)
    for code in (sensing.sine_code(4), sensing.square_code(3), sensing.hamiltonian_code(3)):
        steps = code.evaluate(torch.zeros(1, dtype=torch.float64)).reshape(1, -1, 1, 1)
        for kind in (torch.float64, torch.float32):
            phase = sensing.decode_code((steps * loud).to(kind), code)
            assert bool(((phase >= 0) & (phase < TURN)).all())
            assert float(torch.minimum(phase, TURN - phase).max()) < 1e-2


def test_frames_of_less_than_numbers_hold_are_dark():
    for readout in ("single", "differential"):
        faint = torch.full((1, 3, 1, 1), 1e-41)
        faint[:, 0] = 3e-41
        assert float(sensing.decode_code(faint, sensing.square_code(3), readout=readout)) == 0.0
