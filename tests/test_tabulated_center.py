"""The center of a tabulated pulse in seconds is held to the same range as those of the other pulses."""

from __future__ import annotations

import pytest

import torchtransient as tt
from torchtransient.errors import UnitError


def test_centers_in_metres_are_refused():
    with pytest.raises(UnitError, match="center_s"):
        tt.Pulse.tabulated_s([0.0, 1e-10, 2e-10], [0.0, 1.0, 0.0], center_s=0.5)
