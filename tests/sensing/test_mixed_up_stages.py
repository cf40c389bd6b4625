"""What does not belong together is refused: bins, cycles, periods, units; and counts that a dtype cannot hold."""

from __future__ import annotations

import inspect
from copy import deepcopy

import pytest
import torch

from torchtransient import TimeAxis, sensing
from torchtransient.errors import ShapeError

PS, NS = 1e-12, 1e-9
AXIS = TimeAxis.from_seconds(0.0, 100 * PS, 128)
SHORT = TimeAxis.from_seconds(0.0, 100 * PS, 64)


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def budget(cycles=1000, rate_hz=10e6, **given):
    given = given or {"axis": AXIS}
    return sensing.PhotonBudget(
        sensing.Optics(f_number=2.0),
        pulse_energy_j=1e-9,
        wavelength_m=532e-9,
        repetition_rate_hz=rate_hz,
        cycles=cycles,
        **given,
    )


# ------------------------------------------------------------------------------------------------------------- bins

# every sensor that can be made with an axis, made with one
ON_AN_AXIS = {
    "ImpulseResponse": lambda axis: sensing.ImpulseResponse(sensing.GaussianResponse(300 * PS), axis),
    "PhotonBudget": lambda axis: budget(axis=axis),
    "SynchronousSPAD": lambda axis: sensing.SynchronousSPAD(100, dead_time_s=1 * NS, axis=axis),
    "FreeRunningSPAD": lambda axis: sensing.FreeRunningSPAD(100, 1 * NS, axis=axis),
    "Afterpulsing": lambda axis: sensing.Afterpulsing(0.01, 1 * NS, 1 * NS, axis=axis),
    "SweepJitter": lambda axis: sensing.SweepJitter(300 * PS, axis),
    "StreakCamera": lambda axis: sensing.StreakCamera(axis, time_fwhm_s=300 * PS, jitter_fwhm_s=300 * PS),
    "GatedIntegration": lambda axis: sensing.GatedIntegration([2 * NS], 1 * NS, axis),
    "ItofCorrelation": lambda axis: sensing.ItofCorrelation(sensing.sine_code(4), 80e6, axis),
}


def sensors_with_an_axis():
    classes = {c for c in vars(sensing).values() if inspect.isclass(c) and issubclass(c, sensing.Sensor)}
    return {c.__name__ for c in classes if "axis" in inspect.signature(c.__init__).parameters}


def test_no_sensor_with_an_axis_is_left_out():
    assert set(ON_AN_AXIS) == sensors_with_an_axis()


@pytest.mark.parametrize("make", ON_AN_AXIS.values(), ids=ON_AN_AXIS)
def test_bins_are_those_of_the_axis(make):
    """64 bins into a stage that was made for 128: of plain tensors too, alone, in a chain, and as a copy."""
    sensor = make(AXIS)
    assert sensor.expected(torch.zeros(1, 128, 2, 2)).isfinite().all()
    for made in (sensor, sensing.Compose([sensor]), sensing.Compose([sensing.Compose([deepcopy(sensor)])])):
        calls = [made.expected, made.forward]
        calls += [made.sample] if hasattr(made, "sample") else []
        for call in calls:
            for bins in (64, 127, 129):
                with pytest.raises(ShapeError, match=rf"expected .*128.* got .*{bins}.*Make "):
                    call(torch.zeros(1, bins, 2, 2))


def test_a_width_takes_any_number_of_bins():
    response = sensing.ImpulseResponse(sensing.GaussianResponse(300 * PS), bin_width_s=100 * PS)
    for bins in (1, 64, 128):
        assert response(torch.ones(1, bins, 1, 1)).shape == (1, bins, 1, 1)


# --------------------------------------------------------------------------------------- counts that halves cannot hold

# sensors that count, of a light of 1 a bin; what comes is beyond 65504, the largest number of float16
COUNTING = {
    "SynchronousSPAD": sensing.SynchronousSPAD(10**6 + 1),
    "SynchronousSPAD, gate": sensing.SynchronousSPAD(10**6 + 1, gate=torch.ones(4)),
    "SynchronousSPAD, dead time": sensing.SynchronousSPAD(10**6 + 1, dead_time_s=2 * NS, bin_width_s=1 * NS),
    "FreeRunningSPAD": sensing.FreeRunningSPAD(10**6 + 1, 2 * NS, bin_width_s=1 * NS),
    "paralyzable": sensing.FreeRunningSPAD(10**6 + 1, 2 * NS, bin_width_s=1 * NS, kind="paralyzable"),
    "BinaryFrames": sensing.BinaryFrames(10**6 + 1),
    "GatedIntegration": sensing.GatedIntegration(
        [-1 * NS], 9 * NS, TimeAxis.from_seconds(0, 1 * NS, 4), electrons_per_unit=1e5
    ),
    "ItofCorrelation": sensing.ItofCorrelation(
        sensing.sine_code(3), 80e6, TimeAxis.from_seconds(0, 1 * NS, 4), electrons_per_unit=1e5
    ),
}


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16], ids=str)
@pytest.mark.parametrize("sensor", COUNTING.values(), ids=COUNTING)
def test_no_count_is_infinite_or_rounded(sensor, dtype):
    light = torch.ones(1, 4, 2, 2, dtype=dtype)
    mean = sensor.expected(light)
    assert float(mean.max()) > 65504 and bool(mean.isfinite().all())
    torch.testing.assert_close(mean.double(), sensor.expected(light.double()), rtol=1e-6, atol=0)
    if hasattr(sensor, "sample"):
        counts = sensor.sample(light, generator())
        assert float(counts.max()) > 65504 and torch.equal(counts, counts.round())
        # 7 and 10 bits of the two would leave multiples of 512 and more
        assert bool((counts % 256 != 0).any())


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16], ids=str)
def test_functions_that_count(dtype):
    """Each of half-precision numbers is that of the same numbers in float32."""
    x = torch.linspace(0.1, 1.0, 8).view(1, 8, 1, 1).to(dtype)
    many, far = (x * 1e4).round(), 700 + x
    kernel = sensing.afterpulse_kernel(2 * NS, 1 * NS, 1 * NS, 8)
    for call in (
        lambda v: sensing.sample_detections(v, 10**6, generator=generator()),
        lambda v: sensing.poisson(many.to(v.dtype), generator()),
        lambda v: sensing.first_photon_probabilities(v)[0],
        lambda v: sensing.nonparalyzable_histogram(v, 2.5),
        lambda v: sensing.paralyzable_histogram(v, 2.5),
        lambda v: sensing.coates(many.to(v.dtype), 10**5).rate,
        lambda v: sensing.add_afterpulses(many.to(v.dtype), 0.3, kernel),
        lambda v: sensing.add_crosstalk(many.to(v.dtype), 0.2),
        lambda v: sensing.frames_to_rate(many.to(v.dtype), 10**6),
        lambda v: sensing.equi_depth_edges(v, 4),
        lambda v: sensing.peak_position(v),
        lambda v: sensing.soft_argmax(v),
        lambda v: sensing.centre_of_mass(v),
        lambda v: sensing.first_return(v, 0.5).position,
        lambda v: sensing.distance_of_position(far.to(v.dtype), AXIS),
        lambda v: sensing.adjoint(sensing.BinaryFrames(10**6), v, v.shape),
    ):
        found = call(x)
        assert found.dtype == torch.float32
        assert torch.equal(found, call(x.float()))
