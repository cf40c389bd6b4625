"""Responses without a closed form know their distribution; cameras with other calibrations load each other's states."""

from __future__ import annotations

import pytest
import torch

from torchtransient import TimeAxis
from torchtransient.axes import FrequencyAxis
from torchtransient.sensing import (
    ComposedResponse,
    GaussianResponse,
    ItofCalibration,
    ItofCorrelation,
    UniformResponse,
    crlb,
    emg_response,
    sine_code,
)

AXIS = TimeAxis.from_seconds(0.0, 1e-9, 40)


@pytest.mark.parametrize("fwhm_s", [1e-12, 2e-11, 1e-9])
def test_bound_of_normal_delays_one_after_another(fwhm_s):
    """A return at the edge of a bin, where a response narrower than the bin is known best."""
    edge = 20e-9 * 299792458.0 / 2
    both = crlb(
        ComposedResponse([GaussianResponse(fwhm_s / 2**0.5)] * 2), AXIS, distance_m=edge, signal=1000.0, background=0.1
    )
    one = crlb(GaussianResponse(fwhm_s), AXIS, distance_m=edge, signal=1000.0, background=0.1)
    torch.testing.assert_close(both.distance_m, one.distance_m, rtol=1e-6, atol=0)
    torch.testing.assert_close(both.signal, one.signal, rtol=1e-6, atol=0)


def test_bound_of_a_response_from_a_table():
    """A normal delay and a uniform one that is a hundredth as long: hardly wider than the normal one alone."""
    edge = 20e-9 * 299792458.0 / 2
    both = crlb(
        ComposedResponse([GaussianResponse(1e-11), UniformResponse(1e-13)]),
        AXIS,
        distance_m=edge,
        signal=1000.0,
        background=0.1,
    )
    one = crlb(GaussianResponse(1e-11), AXIS, distance_m=edge, signal=1000.0, background=0.1)
    # 1/12 of 1e-2^2 beside 1/2.35^2 of the variance, and as much for the table
    torch.testing.assert_close(both.distance_m, one.distance_m, rtol=1e-3, atol=0)


def test_distributions_of_composed_responses():
    time = torch.linspace(-3e-9, 3e-9, 61, dtype=torch.float64)
    triangle = ComposedResponse([UniformResponse(1e-9), UniformResponse(1e-9)])
    u = (time / 1e-9).clamp(-1, 1)
    wanted = 0.5 + u - 0.5 * u * u.abs()
    torch.testing.assert_close(triangle.cdf(time), wanted, rtol=0, atol=2e-6)
    torch.testing.assert_close(triangle.survival(time), 1 - wanted, rtol=0, atol=2e-6)
    torch.testing.assert_close(triangle.mass(time), wanted.diff(), rtol=0, atol=4e-6)
    tailed = ComposedResponse([emg_response(3e-10, 4e-10, 1e-10), GaussianResponse(4e-10)])
    torch.testing.assert_close(tailed.cdf(time), emg_response(5e-10, 4e-10, 1e-10).cdf(time), rtol=1e-12, atol=1e-15)
    torch.testing.assert_close(tailed.cdf(time) + tailed.survival(time), torch.ones(61).double(), rtol=1e-12, atol=0)
    alone = ComposedResponse([UniformResponse(1e-9)])
    assert torch.equal(alone.cdf(time), UniformResponse(1e-9).cdf(time))


def camera(calibration=None, **others):
    return ItofCorrelation(sine_code(4), 20e6, AXIS, calibration=calibration, **others)


@pytest.mark.parametrize(
    "own, loaded",
    [
        (None, ItofCalibration(phase_offset_rad=0.7)),
        (ItofCalibration(phase_offset_rad=0.1), ItofCalibration(phase_map_rad=torch.rand(2, 3))),
        (ItofCalibration(phase_map_rad=torch.rand(2, 3)), ItofCalibration(phase_map_rad=torch.rand(2, 3))),
        (ItofCalibration(phase_map_rad=torch.rand(4, 3)), None),
        (ItofCalibration(direction=-1), ItofCalibration(phase_offset_rad=0.4, direction=-1, depth_map_m=torch.rand(2,
         3))),
    ],
)
def test_the_calibration_comes_with_the_state(own, loaded):
    """Taps of the transient and of its phasor follow, both."""
    wanted, found = camera(loaded), camera(own)
    found.load_state_dict(wanted.state_dict())
    x = torch.rand(1, 40, 2, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(found.expected(x), wanted.expected(x), rtol=1e-12, atol=0)
    axis = FrequencyAxis.from_hertz([0.0, 20e6])
    phasor = torch.randn(1, 2, 2, 3, dtype=torch.complex128, generator=torch.Generator().manual_seed(1))
    taps = found.expected_from_phasor(phasor, axis), wanted.expected_from_phasor(phasor, axis)
    torch.testing.assert_close(*taps, rtol=1e-12, atol=1e-12)
