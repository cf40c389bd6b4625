"""Shapes over time: densities, units, sums of independent delays."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import norm

from torchtransient.errors import UnitError
from torchtransient.gates import Gate
from torchtransient.pulses import Pulse, cumulative_of_sum, transform
from torchtransient.units import SPEED_OF_LIGHT

MEASURED = Pulse.tabulated((-0.1, 0.0, 0.05, 0.3), (0.0, 2.0, 1.0, 0.0))
PULSES = [
    Pulse.gaussian(0.2),
    Pulse.gaussian(0.03, center_opl=-0.4),
    Pulse.rectangular(0.25),
    Pulse.rectangular(0.1, center_opl=0.7),
    MEASURED,
    MEASURED.shifted(1.5),
]


@pytest.mark.parametrize("pulse", PULSES, ids=str)
def test_density_has_unit_mass_on_its_support(pulse):
    low, high = pulse.support_opl
    assert low < high
    np.testing.assert_array_equal(pulse.cumulative([low - 1, high + 1]), [0, 1])
    inside = pulse.cumulative(np.linspace(low, high, 4001))
    assert np.all(np.diff(inside) >= 0) and inside[0] <= 1e-12 and inside[-1] >= 1 - 1e-12
    assert pulse.cumulative(low + 0.01 * (high - low)) > 0


def test_gaussian_is_the_cut_normal_distribution():
    pulse, s = Pulse.gaussian(0.2, center_opl=0.1), 0.2 / 2.3548200450309493
    x = np.linspace(0.1 - 3.9 * s, 0.1 + 3.9 * s, 100)
    expected = (norm.cdf(x, 0.1, s) - norm.cdf(-4)) / (1 - 2 * norm.cdf(-4))
    np.testing.assert_allclose(pulse.cumulative(x), expected, atol=1e-12)


def test_table_is_linear_between_its_values():
    x = np.linspace(-0.2, 0.4, 60001)
    density = np.interp(x, MEASURED.opl, MEASURED.values, left=0, right=0)
    sums = np.concatenate([[0], np.cumsum(0.5 * (density[1:] + density[:-1]) * np.diff(x))])
    np.testing.assert_allclose(MEASURED.cumulative(x), sums / sums[-1], atol=1e-8)


def test_seconds():
    assert Pulse.gaussian_s(1e-9, 2e-9) == Pulse.gaussian(1e-9 * SPEED_OF_LIGHT, 2e-9 * SPEED_OF_LIGHT)
    assert Pulse.rectangular_s(1e-9).width_opl == pytest.approx(0.299792458)
    assert Pulse.tabulated_s([0, 1e-9], [1, 1]).opl == (0.0, pytest.approx(0.299792458))


def test_every_time_is_turned_into_a_length():
    """Both numbers of every constructor in seconds."""
    c = SPEED_OF_LIGHT
    assert Pulse.rectangular_s(1e-9, -2e-9) == Pulse.rectangular(1e-9 * c, -2e-9 * c)
    assert Pulse.tabulated_s([0, 1e-9], [1, 2], 3e-9) == Pulse.tabulated([0, 1e-9 * c], [1, 2], 3e-9 * c)
    assert Gate.rectangular_s(1e-9, 4e-9) == Gate.rectangular(1e-9 * c, 4e-9 * c)
    assert Gate.gaussian_s(3e-9, 1e-10) == Gate.gaussian(3e-9 * c, 1e-10 * c)


@pytest.mark.parametrize("first", [Pulse.gaussian(0.2), Pulse.rectangular(0.25), MEASURED], ids=lambda p: p.kind)
def test_one_pulse_alone_is_exact(first):
    start, values = cumulative_of_sum([first], 1e-3)
    at = (start + np.arange(values.size)) * 1e-3
    np.testing.assert_allclose(values, first.cumulative(at), atol=1e-12)


@pytest.mark.parametrize("count", [2, 3])
def test_sum_of_gaussians_has_the_sum_of_variances(count):
    widths = np.array([0.2, 0.35, 0.1])[:count]
    pulses = [Pulse.gaussian(w, center_opl=0.05 * (k + 1)) for k, w in enumerate(widths)]
    start, values = cumulative_of_sum(pulses, 5e-4)
    at = (start + np.arange(values.size)) * 5e-4
    s = np.sqrt((widths**2).sum()) / 2.3548200450309493
    # each is cut at 4 standard deviations
    np.testing.assert_allclose(values, norm.cdf(at, 0.05 * count * (count + 1) / 2, s), atol=1e-4)


def test_sum_of_two_boxes_is_a_trapezium():
    h = 1e-3
    start, values = cumulative_of_sum([Pulse.rectangular(0.2), Pulse.rectangular(0.1, center_opl=0.3)], h)
    at = (start + np.arange(values.size)) * h
    fine = np.linspace(0, 1, 20001)
    expected = np.clip((at[:, None] - (0.3 + 0.1 * (fine - 0.5))) / 0.2 + 0.5, 0, 1).mean(1)
    # of second order in the step: h^2 / 24 times the largest slope of the density, 1 / (0.2 * 0.1)
    np.testing.assert_allclose(values, expected, atol=50 * h**2)
    assert values[0] == 0 and values[-1] == 1
    assert (start * h, at[-1]) == (pytest.approx(0.15), pytest.approx(0.45))  # and no node beyond


def test_transform():
    nu = np.array([0.0, 0.5, 3.0, -3.0])
    s = 0.2 / 2.3548200450309493
    gaussian = np.exp(-2 * (np.pi * s * nu) ** 2 - 2j * np.pi * nu * 0.1)
    # the Gaussian is cut at 4 standard deviations
    np.testing.assert_allclose(transform(Pulse.gaussian(0.2, center_opl=0.1), nu), gaussian, atol=2e-4)
    box = np.sinc(nu * 0.25) * np.exp(-2j * np.pi * nu * 0.7)
    np.testing.assert_allclose(transform(Pulse.rectangular(0.25, center_opl=0.7), nu), box, atol=1e-9)
    # Frequencies of many cycles in a pulse, a saw tooth around zero: 2 / u^2 (exp(-i u) (1 + i u) - 1) from its start,
    # with u = 2 pi nu width.
    saw, u = Pulse.tabulated([-0.5, 0.5], [0.0, 1.0]), 2 * np.pi * np.array([7.3, 2000.3])
    tooth = 2 / u**2 * (np.exp(-1j * u) * (1 + 1j * u) - 1) * np.exp(0.5j * u)
    np.testing.assert_allclose(transform(saw, u / (2 * np.pi)), tooth, rtol=5e-3)
    assert transform(MEASURED, 0.0) == pytest.approx(1) and transform(MEASURED, 40.0).shape == (1,)


@pytest.mark.parametrize(
    "make",
    [
        lambda: Pulse.rectangular(99e-9),  # seconds
        lambda: Pulse.tabulated([0.0, 1e-10], [0.0, 1.0]),
        lambda: Pulse.gaussian_s(0.06),  # nanoseconds
        lambda: Pulse.gaussian_s(1e-9, center_s=-0.5),
        lambda: Pulse.tabulated_s([0.0, 50.0], [0.0, 1.0]),
        lambda: Gate.rectangular(10e-9, 14e-9),
        lambda: Gate.rectangular_s(1e-9, 14.0),
        lambda: Gate.gaussian_s(0.02, 4e-9),
    ],
)
def test_numbers_of_another_unit_are_told(make):
    with pytest.raises(UnitError, match=r"expected .* got .*(Seconds\?|in metres)"):
        make()
