"""Responses and counts that move, for numbers that can be worked out on paper."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy import stats

from torchtransient import TimeAxis, sensing
from torchtransient.axes import FrequencyAxis
from torchtransient.sensing.counts import move_counts

NS = 1e-9


def number(*values):
    return torch.tensor(values, dtype=torch.float64)


def flat(x):
    return x.flatten().tolist()


# ------------------------------------------------------------------------------------------------------- responses


def test_measured_responses_by_their_place():
    """(1, 2, 1, 0, 0) in bins of 1 ns: begins at its delay, or has its mean there; support without empty bins."""
    counts = number(0, 1, 2, 1, 0, 0)
    start = sensing.MeasuredResponse(counts, NS, 3 * NS, align="start", floor=False)
    assert start.support_s() == pytest.approx((4 * NS, 7 * NS))
    assert flat(start.cdf(number(3, 4.5, 5.5, 6.5, 9) * NS)) == pytest.approx([0, 0.125, 0.5, 0.875, 1])
    middle = sensing.MeasuredResponse(counts, NS, 3 * NS, floor=False)
    assert middle.support_s() == pytest.approx((1.5 * NS, 4.5 * NS))
    assert flat(middle.survival(number(1.5, 2.5, 3.0, 4.5) * NS)) == pytest.approx([1, 0.75, 0.5, 0])
    below, above = start.integrals(number(5.5) * NS)
    # mean of (t - T)+ over the delays, and of (T - t)+
    assert float(below) == pytest.approx((0.25 * 1.0 + 0.25 * 0.25) * NS)
    assert float(above) == pytest.approx((0.25 * 1.0 + 0.25 * 0.25) * NS)
    first, kernel = start.kernel(NS)
    assert first <= 4 and flat(kernel[4 - first : 8 - first]) == pytest.approx([0.125, 0.375, 0.375, 0.125])
    alone = sensing.ComposedResponse([middle])
    t = number(1.0, 2.2, 3.1, 4.4) * NS
    assert torch.equal(alone.survival(t), middle.survival(t)) and torch.equal(alone.cdf(t), middle.cdf(t))


def test_even_responses_by_hand():
    """2 ns wide around 1 ns: their cumulative, its integrals, and what bins of 1 ns hold of it."""
    even = sensing.UniformResponse(2 * NS, 1 * NS)
    assert even.support_s() == pytest.approx((0.0, 2 * NS))
    t = number(-1.0, 0.5, 1.0, 1.5, 4.0) * NS
    assert flat(even.cdf(t)) == pytest.approx([0, 0.25, 0.5, 0.75, 1])
    below, above = even.integrals(t)
    assert flat(below / NS) == pytest.approx([0, 0.0625, 0.25, 0.5625, 3.0])
    assert flat(above / NS) == pytest.approx([2.0, 0.5625, 0.25, 0.0625, 0])
    assert flat(even.mass(number(-1, 0, 0.5, 3) * NS)) == pytest.approx([0, 0.25, 0.75])
    first, kernel = even.kernel(NS)
    assert first == 0 and flat(kernel) == pytest.approx([0.25, 0.5, 0.25], abs=1e-12)
    first, kernel = even.kernel(NS, within_bin="center")
    assert first == 0 and flat(kernel) == pytest.approx([0.25, 0.5, 0.25])


def test_responses_of_tails_against_scipy():
    """0.5 normal, 0.3 and 0.2 with tails: cumulative, survival, support."""
    response = sensing.TailedResponse(0.3 * NS, [0.4 * NS, 1.5 * NS], [0.3, 0.2], delay_s=0.2 * NS)
    sigma = 0.3 / (2 * math.sqrt(2 * math.log(2)))
    t = np.linspace(-0.3, 5, 17)
    wanted = 0.5 * stats.norm.cdf(t, 0.2, sigma)
    for share, tail in ((0.3, 0.4), (0.2, 1.5)):
        wanted += share * stats.exponnorm.cdf(t, tail / sigma, loc=0.2, scale=sigma)
    np.testing.assert_allclose(response.cdf(torch.from_numpy(t) * NS).numpy(), wanted, atol=1e-10)
    np.testing.assert_allclose(response.survival(torch.from_numpy(t) * NS).numpy(), 1 - wanted, atol=1e-10)
    low, high = response.support_s()
    assert low == pytest.approx((0.2 - 6 * sigma) * NS)
    assert high == pytest.approx((0.2 + 6 * sigma + math.log(1e9) * 1.5) * NS)
    assert flat(response.fractions) == pytest.approx([0.3, 0.2]) and response.has_core
    normal = sensing.GaussianResponse(0.3 * NS, 0.2 * NS)
    assert normal.support_s() == pytest.approx(((0.2 - 6 * sigma) * NS, (0.2 + 6 * sigma) * NS))


# ----------------------------------------------------------------------------------------------------------- moves


@pytest.mark.parametrize("boundary", ["zero", "periodic"])
@pytest.mark.parametrize("many", [1, 400, 40_000])
@pytest.mark.parametrize("whole", [True, False])
def test_counts_that_move_add_up(boundary, many, whole):
    """By single counts, by halves and by rare lags: the mean, its spread, and how many took each way."""
    shares = number(0.1, 0.0, 0.55, 0.002, 0.348) if whole else number(0.1, 0.0, 0.45, 0.002, 0.248)
    moves, pixels = sensing.Moves(-1, shares, boundary), 600
    x = (number(3, 0, 1, 2) * many).reshape(1, 4, 1, 1).expand(1, 4, 1, pixels).contiguous()
    mean = moves.mean(x[..., :1])[0, :, 0, 0]
    for tally in (False, True):
        moved, tallies = move_counts(x, moves, torch.Generator().manual_seed(many), tally=tally)
        assert torch.equal(moved, moved.round()) and bool((moved >= 0).all())
        deviation = (mean.clamp_min(0.01) / pixels).sqrt()
        assert bool(((moved[0, :, 0].mean(-1) - mean).abs() <= 5 * deviation).all())
        if boundary == "periodic" and whole:
            assert bool((moved.sum(1) == 6 * many).all())
        if tally:
            ways = tallies[:, 0, 0].mean(-1)
            assert bool(((ways - 6 * many * shares).abs() <= 5 * (6 * many * shares / pixels).sqrt() + 1e-9).all())
            assert bool((tallies.sum(0) <= 6 * many).all()) and bool((tallies[1] == 0).all())
            wanted = (tallies[:, 0, 0] * shares.clamp_min(1e-300).log().unsqueeze(-1)).sum(0)
            torch.testing.assert_close(moves.log_prob(tallies)[0, 0], wanted)
        else:
            assert tallies is None
    empty, none = move_counts(x[..., :0], moves, None, tally=True)
    assert empty.shape == (1, 4, 1, 0) and none.shape == (5, 1, 1, 0)


@pytest.mark.parametrize("lost", [False, True])
def test_noise_of_moves_has_the_covariance_of_multinomials(lost):
    """n (diag p - p p^T) of each bin, put where its counts go: 40 000 draws know a variance to 0.7 %."""
    shares = number(0.3, 0.2, 0.4) if lost else number(0.3, 0.2, 0.5)
    moves, pixels = sensing.Moves(1, shares, "periodic"), 40_000
    x = number(90.0, 0.0, 40.0, 0.0, 0.0).reshape(1, 5, 1, 1).expand(1, 5, 1, pixels)
    noise = moves.noise(x, torch.Generator().manual_seed(0))[0, :, 0]
    found = noise @ noise.T / pixels
    wanted = torch.zeros(5, 5, dtype=torch.float64)
    for t, n in ((0, 90.0), (2, 40.0)):
        at = [(t + 1 + k) % 5 for k in range(3)]
        cover = n * (torch.diag(shares) - torch.outer(shares, shares))
        for i, a in enumerate(at):
            for j, b in enumerate(at):
                wanted[a, b] += cover[i, j]
    torch.testing.assert_close(found, wanted, rtol=0.04, atol=0.6)


AXIS = TimeAxis.from_seconds(0.0, 1e-9, 40)


def test_distributions_of_composed_responses():
    time = torch.linspace(-3e-9, 3e-9, 61, dtype=torch.float64)
    triangle = sensing.ComposedResponse([sensing.UniformResponse(1e-9), sensing.UniformResponse(1e-9)])
    u = (time / 1e-9).clamp(-1, 1)
    wanted = 0.5 + u - 0.5 * u * u.abs()
    torch.testing.assert_close(triangle.cdf(time), wanted, rtol=0, atol=2e-6)
    torch.testing.assert_close(triangle.survival(time), 1 - wanted, rtol=0, atol=2e-6)
    torch.testing.assert_close(triangle.mass(time), wanted.diff(), rtol=0, atol=4e-6)
    tailed = sensing.ComposedResponse([sensing.emg_response(3e-10, 4e-10, 1e-10), sensing.GaussianResponse(4e-10)])
    torch.testing.assert_close(
        tailed.cdf(time), sensing.emg_response(5e-10, 4e-10, 1e-10).cdf(time), rtol=1e-12, atol=1e-15
    )
    torch.testing.assert_close(tailed.cdf(time) + tailed.survival(time), torch.ones(61).double(), rtol=1e-12, atol=0)
    alone = sensing.ComposedResponse([sensing.UniformResponse(1e-9)])
    assert torch.equal(alone.cdf(time), sensing.UniformResponse(1e-9).cdf(time))


def camera(calibration=None, **others):
    return sensing.ItofCorrelation(sensing.sine_code(4), 20e6, AXIS, calibration=calibration, **others)


@pytest.mark.parametrize(
    "own, loaded",
    [
        (None, sensing.ItofCalibration(phase_offset_rad=0.7)),
        (sensing.ItofCalibration(phase_offset_rad=0.1), sensing.ItofCalibration(phase_map_rad=torch.rand(2, 3))),
        (
            sensing.ItofCalibration(phase_map_rad=torch.rand(2, 3)),
            sensing.ItofCalibration(phase_map_rad=torch.rand(2, 3)),
        ),
        (sensing.ItofCalibration(phase_map_rad=torch.rand(4, 3)), None),
        (
            sensing.ItofCalibration(direction=-1),
            sensing.ItofCalibration(phase_offset_rad=0.4, direction=-1, depth_map_m=torch.rand(2, 3)),
        ),
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
