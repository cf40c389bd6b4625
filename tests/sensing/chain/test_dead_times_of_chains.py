"""The dead time of a chain: one of a detector, that of its afterpulses too, and over before the next cycle begins."""

from __future__ import annotations

import pytest
import torch

from torchtransient import TimeAxis, sensing
from torchtransient.errors import UnitError

PS, NS = 1e-12, 1e-9
AXIS = TimeAxis.from_seconds(0.0, 100 * PS, 128)


def budget(rate_hz=10e6, **given):
    given = {"pulse_energy_j": 1e-9, "wavelength_m": 532e-9, **(given or {"axis": AXIS})}
    return sensing.PhotonBudget(sensing.Optics(f_number=2.0), repetition_rate_hz=rate_hz, cycles=1000, **given)


def module(dead_ns, period_s=100 * NS, **bins):
    return sensing.Afterpulsing(0.01, 30 * NS, dead_ns * NS, period_s=period_s, **(bins or {"axis": AXIS}))


def test_the_dead_time_of_afterpulses_is_the_detectors():
    """A module that is dead for longer than a period misses cycles: a detector of one detection per cycle cannot."""
    spad, again = sensing.SynchronousSPAD(1000), "armed again before the next cycle"
    for dead_ns in (88, 150, 1000):
        with pytest.raises(UnitError, match=rf"'2' \(Afterpulsing\).*{again}.*FreeRunningSPAD"):
            sensing.Compose([budget(), spad, module(dead_ns)])
        with pytest.raises(UnitError, match=rf"Afterpulsing.*{again}"):  # without a budget
            sensing.Compose([spad, module(dead_ns)])
        with pytest.raises(UnitError, match=rf"Afterpulsing.*{again}"):
            sensing.counting_chain(budget(), sensing.AfterpulsingSPAD(spad, module(dead_ns)))
        with pytest.raises(UnitError, match=rf"Afterpulsing.*{again}"):
            sensing.Compose([budget(), sensing.MacroPixel(spad, 4), module(dead_ns)])
    # the window of light is not known before there is some
    open_window = sensing.Compose([budget(bin_width_s=100 * PS, pulse_energy_j=1e-9, wavelength_m=532e-9), spad,
                                   module(88, bin_width_s=100 * PS)])  # fmt: skip
    assert open_window.expected(torch.zeros(1, 120, 1, 1)).isfinite().all()  # 12 and 88 ns are a period
    with pytest.raises(UnitError, match=again):
        open_window.expected(torch.zeros(1, 121, 1, 1))
    assert len(sensing.Compose([budget(), spad, module(87.2)]).stages) == 3
    free = sensing.FreeRunningSPAD(1000, 150 * NS, axis=AXIS)
    sensing.Compose([budget(rate_hz=1 / 12.8e-9), free, module(150, 12.8 * NS)])


@pytest.mark.parametrize("nested", [False, True])
def test_one_detector_has_one_dead_time(nested):
    def wrapped(detector):
        return sensing.MacroPixel(detector, 4) if nested else detector

    synchronous = wrapped(sensing.SynchronousSPAD(1000, dead_time_s=5 * NS, axis=AXIS))
    free = wrapped(sensing.FreeRunningSPAD(1000, 5 * NS, axis=AXIS))
    for detector, rate_hz, period in ((synchronous, 10e6, 100 * NS), (free, 1 / 12.8e-9, 12.8 * NS)):
        for dead_ns in (0, 4.9, 30):
            with pytest.raises(UnitError, match=r"expected the dead time of .*5e-09 s, in stage '2' \(Afterpulsing\)"):
                sensing.Compose([budget(rate_hz=rate_hz), detector, module(dead_ns, period)])
        assert len(sensing.Compose([budget(rate_hz=rate_hz), detector, module(5, period)]).stages) == 3


def test_pixels_with_dead_times_of_their_own():
    dead = torch.tensor([[5.0, 7.0]])

    def spads(d):
        return sensing.SynchronousSPAD(1000, dead_time_s=d * NS, axis=AXIS)

    groups = sensing.PixelGroups.by_value(dead, spads)
    own = sensing.PixelGroups.by_value(dead, lambda d: module(d))
    assert len(sensing.Compose([budget(), groups, own]).stages) == 3
    both = sensing.PixelGroups.by_value(dead, lambda d: sensing.AfterpulsingSPAD(spads(d), module(d)))
    assert len(sensing.Compose([budget(), both]).stages) == 2
    for wrong in (module(5), sensing.PixelGroups.by_value(dead, lambda d: module(d + 1))):
        with pytest.raises(UnitError, match="One detector has one dead time"):
            sensing.Compose([budget(), groups, wrong])
