"""Captures and lengths that operators refuse, because a plausible volume would come of them: millimetres for metres,
seconds for metres of path, bins that do not count from time zero, light of another scan.
"""

from dataclasses import replace

import pytest
import torch

from support.grid_operators import SCAN
from torchtransient.axes import FrequencyAxis, TimeAxis
from torchtransient.capture import Capture
from torchtransient.errors import ShapeError
from torchtransient.reconstruction import (
    FK,
    lct,
)

FINE = TimeAxis(0.5, 0.125, 8)
RIGHT = TimeAxis(0.1, 0.04, 16)
LEGS = replace(SCAN, first_and_last_leg=True)
POINTS = torch.tensor([[0.0, 0.0, 0.2]])


def test_axes_are_those_of_the_operator_to_rounding():
    operator = FK(SCAN, time_axis=FINE)
    light = torch.ones(1, 8, 6, 5)
    for off, taken in ((1e-8, True), (1e-5, False)):
        for axis in (replace(FINE, start_opl=0.5 + off), replace(FINE, bin_width_opl=0.125 * (1 + off))):
            if taken:
                assert operator.reconstruct(Capture(light, axis, SCAN)).shape == (1, 8, 6, 5)
                continue
            with pytest.raises(ShapeError, match="expected a capture with TimeAxis"):
                operator.reconstruct(Capture(light, axis, SCAN))
    # Time zero that is one to rounding.
    FK(SCAN, time_axis=replace(FINE, start_opl=-1e-9))


def test_phasors_alone_are_no_transient():
    phasors = Capture(None, None, SCAN, phasor=torch.ones(1, 1, 6, 5, dtype=torch.complex64),
                      frequencies=FrequencyAxis((1.0,)))  # fmt: skip
    with pytest.raises(ShapeError, match="lct: expected a capture with a transient, got phasors alone"):
        lct(phasors)
