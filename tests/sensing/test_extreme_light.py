"""Broken numbers, extreme light, states that travel, and half precision."""

from __future__ import annotations

import math

import pytest
import torch

import torchtransient as tt
from support.sweeps import together
from torchtransient import sensing
from torchtransient.errors import GradientError, UnitError

PS = 1e-12


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def light(*shape, dtype=torch.float64, seed=0):
    return torch.rand(shape, dtype=dtype, generator=generator(seed))


def with_nan(shape=(1, 1, 12, 2, 3), value=math.nan):
    x = 0.1 + light(*shape)
    x[..., 5, 0, 0] = value
    return x


# --------------------------------------------------------------------------------------------- NaN is never a number


SATURATING = {
    "first photon": lambda: sensing.SynchronousSPAD(50),
    "dead time": lambda: sensing.SynchronousSPAD(50, dead_time_s=70 * PS, bin_width_s=20 * PS),
    "free": lambda: sensing.FreeRunningSPAD(50, 70 * PS, bin_width_s=20 * PS),
    "paralyzable": lambda: sensing.FreeRunningSPAD(50, 70 * PS, bin_width_s=20 * PS, kind="paralyzable"),
    "frames": lambda: sensing.BinaryFrames(50),
    "coincidence": lambda: sensing.CoincidencePixel(
        sensing.SynchronousSPAD(50), 4, coincidence=2, window_s=70 * PS, bin_width_s=20 * PS
    ),
    "macro-pixel": lambda: sensing.MacroPixel(sensing.SynchronousSPAD(50), 3),
    "afterpulses": lambda: sensing.AfterpulsingSPAD(
        sensing.SynchronousSPAD(50, dead_time_s=70 * PS, bin_width_s=20 * PS),
        sensing.Afterpulsing(0.05, 90 * PS, 70 * PS, bin_width_s=20 * PS),
    ),
    "groups": lambda: sensing.PixelGroups([sensing.SynchronousSPAD(50)], torch.zeros(2, 3)),
}


@together("value", [math.nan, math.inf, -0.1])
@together("make", SATURATING.values())
def test_no_mean_of_what_is_no_rate(make, value):
    """Formulas of saturation give plausible counts of negative light."""
    sensor, x = make(), with_nan(value=value)
    methods = [sensor.expected, sensor.variance, sensor.sample, sensor.gaussian]
    if hasattr(sensor, "probabilities"):
        methods.append(sensor.probabilities)
    for method in methods:
        with pytest.raises(UnitError, match="expected finite"):
            method(x)
    try:
        assert bool(sensor.log_prob(torch.zeros_like(x), with_nan(value=0.1)).isfinite().all())
    except GradientError:
        return
    with pytest.raises(UnitError, match="expected finite"):
        sensor.log_prob(torch.zeros_like(x), x)


@pytest.mark.parametrize("policy", ["straight_through", "score"])
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_no_added_counts_of_what_is_no_count(policy, value):
    for make in (
        lambda: sensing.Crosstalk(0.05, grad=policy),
        lambda: sensing.Afterpulsing(0.05, 90 * PS, 50 * PS, bin_width_s=20 * PS, grad=policy),
    ):
        with pytest.raises(UnitError, match="expected finite counts"), sensing.ScoreFunction():
            make()(with_nan(value=value), generator())


@pytest.mark.parametrize(
    "estimate",
    [
        sensing.peak_position,
        lambda h: sensing.ml_position(h, sensing.GaussianResponse(40 * PS), bin_width_s=20 * PS),
        sensing.soft_argmax,
        sensing.center_of_mass,
        lambda h: sensing.center_of_mass(h, half_width_bins=2),
        lambda h: sensing.first_return(h, 5.0).position.squeeze(-3),
        lambda h: sensing.multi_return(h, 1, threshold=0.1).position.squeeze(-3),
        lambda h: sensing.coates(h, 1000).rate.sum(-3),
    ],
    ids=["peak", "likeliest", "soft", "mass", "mass near", "first", "multi", "coates"],
)
def test_depth_of_nan_is_nan(estimate):
    found = estimate(with_nan())
    assert bool(found[..., 0, 0].isnan().all())
    assert int(found.isnan().sum()) == 1


@pytest.mark.parametrize("code", [None, sensing.hamiltonian_code(3)], ids=["fourier", "by shape"])
def test_phase_of_nan_is_nan(code):
    taps = 0.1 + light(1, 3, 2, 3)
    taps[0, 1, 0, 0] = math.nan
    reading = sensing.read_itof(taps, (40e6,), 3, code=code)
    for value in (reading.phase, reading.amplitude, reading.depth_std_m, reading.depth_m):
        assert bool(value[..., 0, 0].isnan().all())
        assert int(value.isnan().sum()) == 1


# ------------------------------------------------------------------------------------------------------ extreme light


def test_paralyzable_detector_in_floods_of_light():
    """Rates that fall by 1e3 from one bin to the next; against the integral by 2e4 midpoints."""
    rate = torch.tensor([2000.0, 3.0, 0.5, 0.0, 0.01, 800.0, 1.0, 0.2], dtype=torch.float64)
    dead = 2.3
    fine = (torch.arange(8 * 20000, dtype=torch.float64) + 0.5) / 20000
    edges = torch.nn.functional.pad(rate.cumsum(0), (1, 0))
    total = float(edges[-1])

    def flux(t):
        turn = torch.floor(t / 8)
        t = t - 8 * turn
        k = t.floor().long().clamp(0, 7)
        return turn * total + edges[k] + (t - k) * rate[k]

    density = rate[fine.floor().long()] * torch.exp(-(flux(fine) - flux(fine - dead)))
    wanted = density.view(8, 20000).mean(1)
    x = rate.view(1, 8, 1, 1).clone().requires_grad_()
    found = sensing.paralyzable_histogram(x, dead)
    torch.testing.assert_close(found.flatten().detach(), wanted, rtol=1e-4, atol=1e-6)
    found.sum().backward()
    assert bool(torch.isfinite(x.grad).all())


def pulse_of_a_nanosecond(x):
    return sensing.apply_pulse(x, tt.TimeAxis.from_seconds(0.0, 10 * PS, 600), tt.Pulse.gaussian_s(1e-9))


def afterpulses_of_a_window(x):
    return sensing.add_afterpulses(x, 1.0, sensing.Afterpulsing(0.1, 3e-10, 1e-9, bin_width_s=1e-11).kernel(600))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("convolve", [pulse_of_a_nanosecond, afterpulses_of_a_window])
def test_convolutions_by_transforms_are_those_of_sums(convolve, dtype):
    """Against the matrix of single impulses: not negative for light, linear for signed operands, and in the derivative,
    where the value is 0 by rounding too.
    """
    x = torch.zeros(1, 600, 1, 2, dtype=dtype)
    x[0, 50], x[0, 300, 0, 1] = 1.0, 1e6
    found = convolve(x)
    assert float(found.min()) >= 0 and bool(torch.isfinite(found.sqrt()).all())
    torch.testing.assert_close(convolve(x - x.flip(-1)), found - found.flip(-1), rtol=1e-6, atol=1e-9)
    # all bins of the result weigh the same: the derivative by a bin is the light that stays in the window
    leaf = x.clone().requires_grad_()
    (slope,) = torch.autograd.grad(convolve(leaf).sum(), leaf)
    for t in (0, 50, 590):
        impulse = torch.zeros_like(x)
        impulse[:, t] = 1.0
        torch.testing.assert_close(slope[0, t, 0, 0], convolve(impulse)[..., 0].sum(), rtol=1e-6, atol=0)


def test_a_billion_frames():
    """Mean and variance of N = 1e9 binary frames in float32: 2e4 draws know the variance to 1 %, 5 sigma are 5 %."""
    frames, mean = 10**9, 0.4
    p = -math.expm1(-mean)
    counts = sensing.BinaryFrames(frames).sample(torch.full((1, 20000, 1, 1), mean), generator()).double()
    sigma = math.sqrt(frames * p * (1 - p))
    assert abs(float(counts.mean()) - frames * p) < 5 * sigma / math.sqrt(20000) + 2**-24 * frames
    assert abs(float(counts.var()) / sigma**2 - 1) < 5 * math.sqrt(2 / 20000)


def test_empty_batches_pass():
    axis = tt.TimeAxis.from_seconds(0.0, 20 * PS, 12)
    x = torch.zeros(0, 1, 12, 2, 3)
    for sensor in (
        sensing.ImpulseResponse(sensing.GaussianResponse(50 * PS), axis),
        sensing.Afterpulsing(0.05, 90 * PS, 50 * PS, axis=axis),
        sensing.FreeRunningSPAD(10, 70 * PS, axis=axis),
    ):
        assert sensor(x).shape == x.shape
    reading = sensing.read_itof(torch.zeros(0, 1, 3, 2, 2), (40e6,), 3, code=sensing.hamiltonian_code(3))
    assert reading.depth_m.shape == (0, 1, 2, 2)


# --------------------------------------------------------------------------------------------------- states and chains


def test_state_of_a_converter_travels_whole():
    """Widths whose band begins elsewhere: the share matrix and its place follow."""
    wide, narrow = torch.full((12,), 1.5), torch.full((12,), 0.6)
    x = light(1, 12, 2, 2)
    source, target = sensing.TDC(wide), sensing.TDC(narrow)
    target.load_state_dict(source.state_dict())
    assert torch.equal(target(x), source(x))
    assert target.first == source.first


def test_transpose_can_be_trained_through():
    """Gradients of |A^T y|^2 in y and in the width of the response, against finite differences."""
    axis = tt.TimeAxis.from_seconds(0.0, 20 * PS, 16)
    sensor = sensing.ImpulseResponse(sensing.GaussianResponse(60 * PS, learnable=True), axis)
    y = light(1, 16, 1, 1).requires_grad_()

    def energy(y, *_):
        return sensing.adjoint(sensor, y, (1, 16, 1, 1)).square().sum()

    assert torch.autograd.gradcheck(energy, (y, sensor.response.log_fwhm_s), rtol=1e-4)
    with torch.no_grad():
        assert not sensing.adjoint(sensor, y, (1, 16, 1, 1)).requires_grad
    with torch.inference_mode():
        inside = sensing.adjoint(sensor, y.clone(), (1, 16, 1, 1))
    torch.testing.assert_close(inside, sensing.adjoint(sensor, y, (1, 16, 1, 1)).detach())


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_half_precision_leaves_physical_numbers_alone(dtype):
    """A model goes to half precision as a whole: its network does, times and rates do not."""
    response = sensing.GaussianResponse(60 * PS, delay_s=3333 * PS, learnable=True)
    budget = sensing.PhotonBudget(
        sensing.Optics(f_number=2.0),
        pulse_energy_j=1e-9,
        wavelength_m=532e-9,
        repetition_rate_hz=1e6,
        cycles=10,
        dark_count_rate_hz=1e5,
        bin_width_s=50 * PS,
    )
    network = torch.nn.Conv3d(1, 1, 1)
    chain = sensing.Compose([sensing.ImpulseResponse(response, bin_width_s=50 * PS), budget, network])
    model = torch.nn.Sequential(chain, sensing.FreeRunningSPAD(10, 75e-9, bin_width_s=1e-9)).to(dtype)
    assert network.weight.dtype == dtype
    assert float(response.fwhm_s.detach()) == pytest.approx(60e-12, rel=1e-12)
    assert float(response.delay_s.detach()) == pytest.approx(3333e-12, rel=1e-12)
    assert float(budget.dark_count_rate_hz) == 1e5
    assert float(model[1].dead_time_s) == pytest.approx(75e-9, rel=1e-12)
    response.float()
    assert response.log_fwhm_s.dtype == torch.float32
