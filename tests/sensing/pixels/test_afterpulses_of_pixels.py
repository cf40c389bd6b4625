"""Afterpulses inside pixels of several SPADs, and where none are left."""

from __future__ import annotations

import pytest
import torch

from torchtransient.sensing import (
    Afterpulsing,
    AfterpulsingSPAD,
    CoincidencePixel,
    MacroPixel,
    SynchronousSPAD,
)

LIGHT, CYCLES = 4e-3, 1000


def one(background=LIGHT * CYCLES):
    """Window of 16 bins in a period of 160, constant light outside of it."""
    afterpulsing = Afterpulsing(0.1, 30e-9, 5e-9, bin_width_s=1e-9, period_s=160e-9, background=background)
    return AfterpulsingSPAD(SynchronousSPAD(CYCLES, dead_time_s=5e-9, bin_width_s=1e-9), afterpulsing)


def light():
    return torch.full((1, 16, 1, 1), LIGHT, dtype=torch.float64)


@pytest.mark.slow
@pytest.mark.parametrize("weights", [[1 + 1e-4 * i for i in range(100)], [1.0] * 50 + [1.001] * 50])
def test_background_of_a_pixel_is_shared(weights):
    """SPADs whose shares hardly differ count what equal ones do."""
    equal = MacroPixel(one(), 100).expected(light())
    torch.testing.assert_close(MacroPixel(one(), 100, weights=weights).expected(light()), equal, rtol=1e-4, atol=0)
    assert float(equal.mean()) / (LIGHT * CYCLES) == pytest.approx(1 / 0.9, rel=2e-3)


def test_background_of_a_coincidence_pixel_is_shared():
    """One SPAD is enough, windows short: the counts of the macro-pixel."""
    found = CoincidencePixel(one(), 100, coincidence=1, window_s=1e-11, bin_width_s=1e-9).expected(light())
    torch.testing.assert_close(found, MacroPixel(one(), 100).expected(light()), rtol=1e-3, atol=0)


@pytest.mark.parametrize("tau_s", [1e-9, (1e-9, 2e-9)])
def test_all_carriers_are_set_free_during_the_dead_time(tau_s):
    p = 0.1 if isinstance(tau_s, float) else (0.1, 0.1)
    spad = SynchronousSPAD(100, dead_time_s=1.6e-6, bin_width_s=1e-7)
    afterpulsing = Afterpulsing(p, tau_s, 1.6e-6, counted_from="avalanche", bin_width_s=1e-7)
    x = torch.full((1, 16, 2, 2), 0.1, dtype=torch.float64)
    torch.testing.assert_close(AfterpulsingSPAD(spad, afterpulsing).expected(x), spad.expected(x), rtol=1e-12, atol=0)
    counts = spad.sample(x, torch.Generator().manual_seed(0))
    afterpulsing.grad = "straight_through"
    assert torch.equal(afterpulsing(counts, generator=torch.Generator().manual_seed(0)), counts)
