"""Phases by the shape of a code: plateaus, corners, noise beside the curve, and light at phase zero."""

from __future__ import annotations

import math

import torch

from torchtransient import sensing

TURN = 2 * math.pi


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
