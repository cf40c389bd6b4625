"""Numbers of pixels: maps of the budget, ambient light of a scene in the sun, pixels that are late."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from torchtransient import TimeAxis, sensing
from torchtransient.errors import ArgumentError, UnitError

AXIS = TimeAxis.from_seconds(0.0, 100e-12, 32)
AXIS_4 = TimeAxis.from_seconds(0.0, 100e-12, 4)
LENS = sensing.Optics(f_number=2.0, pixel_area_m2=1e-10, transmission=0.8)


def budget(**changes):
    light = {"pulse_energy_j": 1e-9, "wavelength_m": 905e-9, "repetition_rate_hz": 10e6}
    return sensing.PhotonBudget(LENS, **({**light, "cycles": 1000, "axis": AXIS} | changes))


def uniform(*shape, seed=0):
    return torch.rand(shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


# --- the budget -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(), (3, 1), (2, 3, 4), (5, 2, 3, 4)])
@pytest.mark.parametrize("name", ["quantum_efficiency", "ambient_rate_hz", "dark_count_rate_hz"])
def test_a_map_is_a_budget_for_every_pixel(name, shape):
    """Pixel by pixel the map gives what the number gives, and the report adds up to the light."""
    x, numbers = uniform(5, 2, 32, 3, 4), 0.1 + 0.8 * uniform(*shape)
    found = budget(**{"ambient_rate_hz": 0.7, "dark_count_rate_hz": 0.2, name: numbers})(x)
    whole = numbers.expand(5, 2, 3, 4)
    for index in [(0, 0, 0, 0), (4, 1, 2, 3), (2, 0, 1, 3)]:
        one = budget(**{"ambient_rate_hz": 0.7, "dark_count_rate_hz": 0.2, name: float(whole[index])})
        b, c, i, j = index
        single = x[b : b + 1, c : c + 1, :, i : i + 1, j : j + 1]
        torch.testing.assert_close(found[b, c, :, i, j], one(single).flatten(), rtol=1e-12, atol=0)
    report = budget(**{"ambient_rate_hz": 0.7, "dark_count_rate_hz": 0.2, name: numbers}).report(x)
    total = report.signal_per_cycle + report.background_per_cycle
    torch.testing.assert_close(found.sum(-3), total, rtol=1e-12, atol=0)
    assert report.signal_to_background.shape == report.piles_up.shape == (5, 2, 3, 4)


def test_maps_are_learnt_and_handed_in():
    x = uniform(1, 32, 2, 2)
    ambient = torch.nn.Parameter(torch.full((2, 2), 1e6, dtype=torch.float64))
    learnt = budget(ambient_rate_hz=ambient, quantum_efficiency=0.25)
    assert dict(learnt.named_parameters())["ambient_rate_hz"] is ambient
    learnt(x).sum().backward()
    torch.testing.assert_close(ambient.grad, torch.full((2, 2), 32 * 0.25 * 100e-12, dtype=torch.float64))
    buffered = budget(ambient_rate_hz=torch.zeros(2, 2))
    from_network = torch.full((2, 2), 3e6, dtype=torch.float64, requires_grad=True)
    y = torch.func.functional_call(buffered, {"ambient_rate_hz": from_network}, x)
    torch.testing.assert_close(y, budget(ambient_rate_hz=3e6)(x))
    assert y.requires_grad


def test_ambient_light_in_closed_form():
    """Radiance E B albedo / pi through pi A / (4 F^2 + 1), in photons: pi cancels."""
    given = {"spectral_irradiance_w_m2_nm": 0.9, "filter_bandwidth_m": 20e-9, "wavelength_m": 905e-9}
    wanted = 0.9 * 20 * 0.5 * 1e-10 * 0.8 / 17 / sensing.photon_energy_j(905e-9)
    assert sensing.ambient_photon_rate(LENS, 0.5, **given) == pytest.approx(wanted, rel=1e-12)
    albedo = uniform(2, 3).requires_grad_()
    rate = sensing.ambient_photon_rate(LENS, albedo, illumination=torch.full((2, 3), 0.25).double(), **given)
    torch.testing.assert_close(rate, albedo * wanted / 2)
    # an integral over the cone of the lens: L cos over solid angle, times area
    theta = torch.linspace(0, math.atan(1 / 4), 20001, dtype=torch.float64)
    cone = torch.trapezoid(2 * math.pi * theta.sin() * theta.cos(), theta)
    radiance = 0.9 * 20 * 0.5 / math.pi
    assert wanted == pytest.approx(radiance * float(cone) * 1e-10 * 0.8 / sensing.photon_energy_j(905e-9), rel=1e-6)
    sensor = budget(ambient_rate_hz=torch.nn.Parameter(rate.detach()))
    counts = sensor(torch.zeros(1, 32, 2, 3)).detach()
    torch.testing.assert_close(counts[0, 0].double(), rate.detach() * 1e-10, rtol=1e-6, atol=0)
    with pytest.raises(UnitError, match="filter_bandwidth_m"):
        sensing.ambient_photon_rate(LENS, 0.5, **(given | {"filter_bandwidth_m": 20.0}))
    with pytest.raises(UnitError, match="albedo"):
        sensing.ambient_photon_rate(LENS, 1.5, **given)


# --- delays ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("boundary", ["periodic", "zero"])
@pytest.mark.parametrize("delay", [0.0, 0.3, 2.0, -1.7, 31.5, -40.25, 100.0])
def test_light_that_is_spread_evenly_moves_as_photons_do(boundary, delay):
    """Against the integral of the moved density over every bin, by cumulative sums."""
    x = uniform(1, 32, 1, 1)
    light = x.flatten().numpy()
    periods = np.tile(light, 50) if boundary == "periodic" else np.pad(light, (32 * 20, 32 * 29))
    sums = np.concatenate([[0.0], np.cumsum(periods)])
    at = np.interp(np.arange(33) - delay + 32 * 20, np.arange(sums.size), sums)
    found = sensing.shift_time(x, delay, boundary=boundary).flatten().numpy()
    np.testing.assert_allclose(found, np.diff(at), rtol=1e-11, atol=1e-12)


def test_every_pixel_has_its_own_delay_and_keeps_its_counts():
    delay_s = (uniform(2, 3, 4, seed=1) - 0.5) * 5e-9
    x = uniform(6, 2, 32, 3, 4)
    y = sensing.PixelSkew(delay_s, AXIS)(x)
    torch.testing.assert_close(y.sum(-3), x.sum(-3))
    for c, i, j in [(0, 0, 0), (1, 2, 3), (1, 0, 2)]:
        one = sensing.shift_time(x[:, c : c + 1, :, i : i + 1, j : j + 1], float(delay_s[c, i, j]) / 100e-12)
        torch.testing.assert_close(y[:, c, :, i, j], one.flatten(1))


def test_draws_move_whole_counts_one_by_one():
    n, images, part = 12, 40_000, 0.3
    x = torch.zeros(images, 1, 6, 1, 1)
    x[:, :, 5] = n  # the late ones come round
    x[:, :, 2] = 3
    y = sensing.DetectionSkew(part * 100e-12, bin_width_s=100e-12).sample(x, torch.Generator().manual_seed(0))
    assert torch.equal(y, y.round()) and torch.equal(y.sum(2), x.sum(2))
    late = y[:, 0, 0, 0, 0].double()
    assert float(late.mean()) == pytest.approx(n * part, abs=5 * (n * part * (1 - part) / images) ** 0.5)
    assert float(late.var()) == pytest.approx(n * part * (1 - part), rel=5 * (2 / images) ** 0.5)
    # a multinomial of two cells: what is late is not early
    assert torch.equal(y[:, 0, 0] + y[:, 0, 5], x[:, 0, 0] + x[:, 0, 5])


def test_gaussian_policy_has_the_covariance_of_the_draws():
    images = 40_000
    x = torch.full((images, 1, 5, 1, 1), 20.0, dtype=torch.float64)
    sensor = sensing.DetectionSkew(140e-12, bin_width_s=100e-12, grad="gaussian")
    drawn = sensor.sample(x, torch.Generator().manual_seed(0)).view(images, 5)
    normal = sensor(x, torch.Generator().manual_seed(1)).view(images, 5)
    # entries of a covariance of variance 9.6 are known to 9.6 sqrt(2 / images) and better
    assert float((drawn.T.cov() - normal.T.cov()).abs().max()) < 6 * 9.6 * (2 / images) ** 0.5
    assert float(normal.var(0).mean()) == pytest.approx(float(sensor.variance(x[:1]).mean()), rel=0.02)


def test_scores_of_moved_counts():
    """Behind a SPAD under "score", with a delay that is learnt: d/d delay of E (counts of a bin)^2."""
    draws = 60_000
    x = torch.full((draws, 1, 4, 1, 1), 6.0, dtype=torch.float64)
    sensor = sensing.DetectionSkew(130e-12, AXIS_4, learnable=True, grad="score")
    with sensing.ScoreFunction() as score:
        losses = sensor(x, torch.Generator().manual_seed(0))[:, 0, 1, 0, 0].sub(6).square()
    score.surrogate(losses, baseline="leave_one_out").mean().backward()
    # the mean stays 6, the variance is 2 * 6 f (1 - f) at f = 0.3; its slope in picoseconds, with an error of 0.0014
    wanted = 12 * (1 - 2 * 0.3) / 100
    assert float(sensor.delays.delay_ps.grad) == pytest.approx(wanted, abs=0.006)
    rate = (0.05 * uniform(300, 1, 32, 1, 1)).requires_grad_()
    chain = sensing.Compose([sensing.SynchronousSPAD(100), sensing.DetectionSkew(30e-12, AXIS)], grad="score")
    with sensing.ScoreFunction() as score:
        loss = chain(rate, torch.Generator().manual_seed(0)).sum((1, 2, 3, 4))
    score.surrogate(loss, baseline="leave_one_out").sum().backward()
    mean = rate.detach().requires_grad_()
    chain.expected(mean).sum().backward()
    assert float(rate.grad.sum()) == pytest.approx(float(mean.grad.sum()), rel=0.2)


# ------------------------------------------------------------------------------------ what is learnt keeps its range

RANGES = {"quantum_efficiency": (1.7, -0.2), "ambient_rate_hz": (-1.0,), "dark_count_rate_hz": (-1.0,)}


@pytest.mark.parametrize("name, value", [(n, v) for n, many in RANGES.items() for v in (*many, float("nan"))])
@pytest.mark.parametrize("shape", [(), (2, 3)], ids=["number", "map"])
def test_a_learnt_number_that_left_its_range_is_told(name, value, shape):
    """A step of an optimizer may go anywhere: light of 1.7 photons for each that came was measured without a word."""
    learnt = torch.nn.Parameter(torch.full(shape, 0.5, dtype=torch.float64))
    stage = budget(**{name: learnt})
    x = uniform(1, 32, 2, 3)
    assert stage(x).requires_grad
    with torch.no_grad():
        learnt.view(-1)[-1:] = value
    calls = [lambda: stage(x), lambda: stage.report(x), lambda: stage.background_counts]
    calls += [lambda: stage.signal(x)] if name == "quantum_efficiency" else []
    for call in calls:
        with pytest.raises(UnitError, match=rf"expected every {name} in \[0, .*got {value:g}\. .*tt.param"):
            call()
    swapped = budget(**{name: torch.full((2, 3), 0.5)})
    with pytest.raises(UnitError, match=name):
        torch.func.functional_call(swapped, {name: torch.full((2, 3), value, dtype=torch.float64)}, (x,))


def test_learnt_probabilities_keep_their_range():
    """Above a sum of 1 afterpulses of afterpulses have no end, and the mean went below zero."""
    x = uniform(1, 32, 2, 3)
    after = sensing.Afterpulsing([0.2, 0.2], [1e-9, 3e-9], 1e-9, bin_width_s=1e-9, learnable=True)
    across = sensing.Crosstalk(0.2, learnable=True)
    for stage, logit in ((after, 0.0), (across, -1.0)):
        assert stage.expected(x).isfinite().all()
        with torch.no_grad():
            stage.logit_probability.fill_(logit + 0.1)
        for call in (stage.expected, stage.forward, lambda v, s=stage: s.sample(v.round())):
            with pytest.raises(UnitError, match=r"expected .*probability in .*learnt"):
                call(x)
    period = sensing.Afterpulsing(
        0.2, 1e-9, 1e-9, bin_width_s=1e-9, period_s=1e-7, background=torch.nn.Parameter(torch.ones(2, 3))
    )
    assert period.expected(x).requires_grad
    with torch.no_grad():
        period.background[0, 0] = -1.0
    with pytest.raises(UnitError, match="Afterpulsing: expected every background"):
        period.expected(x)


LIDAR_AXIS = TimeAxis.from_seconds(0.0, 16e-12, 100)


def lidar(**changes):
    arguments = {
        "pulse_energy_j": 1e-9,
        "wavelength_m": 532e-9,
        "repetition_rate_hz": 10e6,
        "cycles": 100_000,
        "quantum_efficiency": 0.4,
        "ambient_rate_hz": 1e6,
        "dark_count_rate_hz": 100.0,
        "axis": LIDAR_AXIS,
    }
    return sensing.PhotonBudget(
        sensing.Optics(f_number=2.0, pixel_area_m2=1e-10, transmission=0.8), **(arguments | changes)
    )


def test_by_hand():
    x = torch.full((1, 100, 2, 3), 0.25, dtype=torch.float64)
    per_unit = 1e-9 / 3.7339e-19 * (math.pi / 17 * 1e-10 * 0.8) * 0.4
    background = (1e6 * 0.4 + 100) * 16e-12
    torch.testing.assert_close(lidar()(x), 0.25 * per_unit + background + 0 * x, rtol=1e-4, atol=0)
    report = lidar().report(x)
    assert report.signal_per_cycle.shape == (1, 2, 3)
    assert float(report.signal_per_cycle[0, 0, 0]) == pytest.approx(25 * per_unit, rel=1e-4)
    assert report.ambient_per_cycle == pytest.approx(0.4 * 1.6e-3)
    assert report.dark_per_cycle == pytest.approx(1.6e-7)
    assert report.exposure_s == pytest.approx(0.01)
    total = report.signal_per_cycle + report.background_per_cycle
    torch.testing.assert_close(lidar()(x).sum(-3), total, rtol=1e-9, atol=0)
    torch.testing.assert_close(
        report.signal_to_background, report.signal_per_cycle / (0.4 * 1.6e-3 + 1.6e-7), rtol=1e-12, atol=0
    )
    assert bool(report.piles_up.all()) == (25 * per_unit > 0.05)


def test_window_longer_than_a_period():
    with pytest.raises(UnitError, match="laser period"):
        lidar(repetition_rate_hz=1e9)(torch.zeros(1, 100, 1, 1))
    with pytest.raises(ArgumentError, match="either f_number"):
        sensing.Optics()
