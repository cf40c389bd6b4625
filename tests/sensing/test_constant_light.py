"""Constant light stays constant: every preset, every stage with a window; orders that would starve edges are errors."""

from __future__ import annotations

import pytest
import torch

from torchtransient import TimeAxis, sensing
from torchtransient.errors import UnitError

PS = 1e-12
AXIS = TimeAxis.from_seconds(0.0, 50 * PS, 64)
TRANSIENTS = sorted(name for name, d in sensing.DEVICES.items() if d.num_bins is not None and "kinect" not in name)


def budget(axis=AXIS, **keywords):
    given = {"ambient_rate_hz": 1e3, "quantum_efficiency": 0.5, **keywords}
    light = {"pulse_energy_j": 1e-9, "wavelength_m": 532e-9, "repetition_rate_hz": 1e6, "cycles": 1000}
    return sensing.PhotonBudget(sensing.Optics(f_number=2.0), **light, axis=axis, **given)


def response():
    return sensing.emg_response(120 * PS, 200 * PS)


def flatness(y):
    """Largest relative deviation of the time bins from their middle."""
    rows = y.movedim(-3, 0).flatten(1)
    middle = rows[len(rows) // 2]
    return float(((rows - middle) / middle).abs().max())


def faint(preset):
    """The preset with so little background (1 a second) that pile-up stays below 1e-6 of the counts, else as it is."""
    kinds = [s["kind"] for s in preset.stages]
    if "PhotonBudget" not in kinds:
        return preset
    return preset.changed("PhotonBudget", ambient_rate_hz=1.0, dark_count_rate_hz=0.0)


@pytest.mark.parametrize("name", TRANSIENTS)
def test_constant_light_through_every_preset(name):
    """Ambient light behind a budget, or an even rate without one, over the width of each code."""
    preset = faint(sensing.device(name))
    sensor = preset.sensor()
    light = 0.0 if any(isinstance(s, sensing.PhotonBudget) for s in sensor.stages) else 1e-9
    if isinstance(sensor.stages[0], sensing.StreakCamera):
        light = 10.0
    x = torch.full((1, preset.num_bins, 5, 5), light, dtype=torch.float64)
    stages = list(sensor.stages)
    y = sensing.Compose(stages).expected(x)[..., 2:3, 2:3]  # crosstalk and blur have the rim of the sensor
    for converter in (s for s in stages if isinstance(s, sensing.TDC)):
        y = y / converter.code_widths.view(-1, 1, 1)
    assert flatness(y) < 1e-6


@pytest.mark.parametrize(
    "stage",
    [
        sensing.ImpulseResponse(response(), AXIS, boundary="periodic"),
        sensing.DetectionJitter(response(), AXIS),
        sensing.DetectionJitter(response(), AXIS, within_bin="center"),
        sensing.SweepJitter(400 * PS, AXIS),
        sensing.PixelSkew(torch.tensor([[730 * PS, -25e-9]]), AXIS),
        sensing.TDC(torch.ones(64), dither=True, offset_bins=1.7, sliding_scale=3),
        sensing.TDC(torch.ones(64), dither=True, offset_bins=-70.2, acts_on="rates"),
        sensing.StreakCamera(AXIS, time_fwhm_s=300 * PS, jitter_fwhm_s=200 * PS, spatial_fwhm_px=0),
    ],
    ids=lambda s: f"{type(s).__name__}",
)
def test_constant_light_through_every_stage(stage):
    x = torch.full((1, 64, 1, 2), 3.0, dtype=torch.float64)
    assert flatness(stage.expected(x)) < 1e-12
    assert float(stage.expected(x).sum()) == pytest.approx(float(x.sum()), rel=1e-12)


def test_a_sweep_keeps_constant_light_in_every_draw():
    x = torch.full((5, 1, 64, 2, 2), 3.0, dtype=torch.float64)
    y = sensing.SweepJitter(400 * PS, AXIS, sweeps=2, grad="straight_through")(
        x, generator=torch.Generator().manual_seed(0)
    )
    assert flatness(y) < 1e-12


def test_the_order_of_the_pages_keeps_ambient_light():
    """Both ends of the window in 5 bins over the middle: 1 behind the budget; less than 0.75 the other way round."""
    x = torch.zeros(1, 64, 1, 1, dtype=torch.float64)
    shape = response()
    chain = sensing.Compose(
        [
            sensing.ImpulseResponse(shape, AXIS),
            budget(),
            sensing.SynchronousSPAD(1000),
            sensing.DetectionJitter(shape, AXIS),
        ]
    )
    assert flatness(chain.expected(x)) < 1e-6
    starved = sensing.ImpulseResponse(response(), AXIS).expected(budget().expected(x)).flatten()
    assert float(starved[:5].mean() / starved[32]) < 0.75


def zero():
    return sensing.ImpulseResponse(response(), AXIS)


@pytest.mark.parametrize(
    "stages",
    [
        lambda: [budget(), zero()],
        lambda: [torch.nn.Sequential(budget(), torch.nn.Identity()), zero()],
        lambda: [budget(ambient_rate_hz=0.0, dark_count_rate_hz=torch.eye(2)), zero()],
        lambda: [budget(), sensing.SynchronousSPAD(1000), sensing.DetectionJitter(response(), AXIS, boundary="zero")],
        lambda: [budget(), sensing.TDC(torch.ones(64), boundary="zero")],
        lambda: [budget(), sensing.PixelSkew(torch.full((2, 2), 90 * PS), AXIS, boundary="zero")],
    ],
)
def test_constant_light_in_front_of_a_closed_window_is_refused(stages):
    with pytest.raises(UnitError, match=r"boundary='zero' behind the background.*starve"):
        sensing.Compose(stages())


def test_gates_that_leave_the_window_see_less_ambient_light():
    """Half a gate before the first bin: an image at half the ambient light, which no scene has."""
    inside = sensing.GatedIntegration([600 * PS, 1200 * PS], 1e-9, AXIS, rise_s=100 * PS, electrons_per_unit=1000)
    x = torch.zeros(1, 64, 1, 1, dtype=torch.float64)
    assert flatness(sensing.Compose([budget(), inside]).expected(x)) < 1e-6
    for delay in (-500 * PS, 2.9e-9, 0.0):
        leaving = sensing.GatedIntegration([600 * PS, delay], 1e-9, AXIS, rise_s=100 * PS, electrons_per_unit=1000)
        with pytest.raises(UnitError, match=r"gates inside the window.*gate 1"):
            sensing.Compose([budget(), leaving])
        assert sensing.Compose([budget(ambient_rate_hz=0.0), leaving]).expected(x).shape == (1, 2, 1, 1)
