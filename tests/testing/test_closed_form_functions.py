"""Closed forms against other ways to the same numbers: polynomials, moments, totals, sampling, sums of patches."""

import itertools
import math
from fractions import Fraction

import numpy as np
import pytest
from scipy import integrate

from support.marks import long
from torchtransient.errors import ArgumentError, ShapeError, UnitError
from torchtransient.testing import closed_forms as cf
from torchtransient.testing.closed_forms import confocal_plane, hidden_patch


def masses(law, edges, count, start=0.0):
    return np.array(list(itertools.islice(cf.flight_masses(law, edges, start), count + 1)))


def exact_cdf(n, x):
    """P(sum of n variates of density 2u on [0, 1] < x), in rational numbers, from the Laplace transform.

    (2 [s^-2 - e^-s (s^-1 + s^-2)])^n / s expanded: e^(-ks) s^-(m+1) is (x - k)_+^m / m!.
    """
    total = Fraction(0)
    for k in range(n + 1):
        if x > k:
            for j in range(k + 1):
                m = 2 * n - j
                total += (-1) ** k * math.comb(n, k) * math.comb(k, j) * (x - k) ** m / math.factorial(m)
    return total * 2**n


@pytest.mark.parametrize("n", [1, 2, 7, 25])
def test_sphere_flights_against_exact_polynomials(n):
    edges = [Fraction(k * n, 23) for k in range(24)]
    got = masses(cf.sphere_chord(0.5), [float(e) for e in edges], n)[n]
    expected = [float(exact_cdf(n, b) - exact_cdf(n, a)) for a, b in itertools.pairwise(edges)]
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-13)


@pytest.mark.parametrize("n", long([1, 12, 100], [1, 12]))
def test_sphere_flights_have_their_moments(n):
    radius = 1.7
    edges = np.linspace(0.0, 2 * radius * n * 1.0001, 40_001)
    mass = list(itertools.islice(cf.flight_masses(cf.sphere_chord(radius), edges), n + 1))[n]
    centers = (edges[1:] + edges[:-1]) / 2
    mean = (mass * centers).sum()
    variance = (mass * centers**2).sum() - mean**2
    width = edges[1] - edges[0]
    np.testing.assert_allclose(mass.sum(), 1.0, rtol=1e-12)
    np.testing.assert_allclose(mean, n * 4 * radius / 3, rtol=1e-6)
    # within-bin variance w^2/12 is missing from the binned moment
    np.testing.assert_allclose(variance + width**2 / 12, n * 2 * radius**2 / 9, rtol=1e-5)
    assert mass.min() > -1e-14


def test_plate_flights_against_sampling():
    rng = np.random.default_rng(0)
    edges = np.array([0.0, 1.0, 2.5, 4.0, 5.5, 8.0, 12.0, 20.0])
    lengths = 1.0 / np.sqrt(rng.random((4, 500_000)))
    got = masses(cf.plate_gap(1.0), edges, 4)
    for n in range(1, 5):
        counts = np.histogram(lengths[:n].sum(axis=0), edges)[0]
        error = np.sqrt(np.maximum(got[n] * (1 - got[n]), 1e-12) / lengths.shape[1])
        z = (counts / lengths.shape[1] - got[n]) / error
        assert np.abs(z).max() < 4.5, (n, z)


def test_plate_single_flight_and_convergence():
    edges = np.linspace(0.0, 30.0, 301)
    got = masses(cf.plate_gap(0.7), edges, 1)[1]
    r = np.maximum(edges, 0.7)
    np.testing.assert_allclose(got, -np.diff(0.49 / r**2), rtol=0, atol=1e-13)


def test_refining_the_bins_keeps_the_energy():
    edges = np.linspace(0.0, 20.0, 401)
    fine = cf.furnace(edges, 1.0, 0.8, 2.0)
    coarse = cf.furnace(edges[::8], 1.0, 0.8, 2.0)
    np.testing.assert_allclose(fine.reshape(-1, 8).sum(axis=1), coarse, rtol=0, atol=1e-13)


@pytest.mark.parametrize("reflectance, decay", [(0.5, 2.0), (0.98, 66.08)])
def test_sphere_decay_table(reflectance, decay):
    np.testing.assert_allclose(cf.integrating_sphere_decay(1.0, reflectance), decay, rtol=1e-4)
    np.testing.assert_allclose(cf.integrating_sphere_decay(3.0, reflectance), 3 * decay, rtol=1e-4)


def test_furnace_decays_at_that_rate():
    edges = np.linspace(60.0, 70.0, 11)  # the other poles of the renewal equation have died out
    tail = cf.furnace(edges, 1.0, 0.8, 1.0)
    ratios = tail[1:] / tail[:-1]
    np.testing.assert_allclose(ratios, math.exp(-1.0 / cf.integrating_sphere_decay(1.0, 0.8)), rtol=1e-9)


def test_steady_totals():
    edges, reflectance = np.linspace(0.0, 250.0, 501), 0.8
    np.testing.assert_allclose(cf.furnace(edges, 1.0, reflectance, 3.0).sum(), 3.0 / (1 - reflectance), rtol=1e-10)
    np.testing.assert_allclose(
        cf.integrating_sphere_irradiance(edges, 1.0, reflectance, 5.0).sum(),
        5.0 / (4 * math.pi * (1 - reflectance)),
        rtol=1e-10,
    )
    np.testing.assert_allclose(
        cf.integrating_sphere_radiance(edges, 1.0, reflectance, 2.0).sum(),
        reflectance * 2.0 / (math.pi * (1 - reflectance)),
        rtol=1e-10,
    )


def test_truncated_series():
    edges = np.linspace(0.0, 250.0, 501)
    total = cf.furnace(edges, 1.0, 0.8, 1.0, max_bounces=5).sum()
    np.testing.assert_allclose(total, (1 - 0.8**6) / 0.2, rtol=1e-12)
    np.testing.assert_allclose(cf.furnace(edges, 1.0, 0.8, 1.0, max_bounces=0), cf.delta_mass(edges, 1.0))
    one = cf.integrating_sphere_radiance(edges, 1.0, 0.5, math.pi, max_bounces=1)
    np.testing.assert_allclose(one, 0.5 * cf.delta_mass(edges, 2.0))
    # reflectance 1: the sum over flights is the renewal density, one flight per mean length
    late = cf.furnace(np.linspace(40.0, 50.0, 11), 1.0, 1.0, 1.0)
    np.testing.assert_allclose(late, 3 / 4, rtol=1e-9)


def test_delta_mass_is_half_open():
    edges = [0.0, 1.0, 2.0]
    np.testing.assert_array_equal(cf.delta_mass(edges, 1.0), [0, 1])
    np.testing.assert_array_equal(cf.delta_mass(edges, np.nextafter(1.0, 0)), [1, 0])
    np.testing.assert_array_equal(cf.delta_mass(edges, 2.0), [0, 0])
    np.testing.assert_array_equal(cf.delta_mass(edges, -0.1), [0, 0])


def test_light_over_plane_against_quadrature():
    edges = np.linspace(3.0, 9.0, 7)
    got = cf.light_over_plane(edges, 2.0, 0.5, 3.0)

    def density(tau):
        return 3.0 * 0.5 * 8.0 / (tau / 2) ** 6 if tau >= 4 else 0.0

    expected = [integrate.quad(density, a, b)[0] for a, b in itertools.pairwise(edges)]
    np.testing.assert_allclose(got, expected, rtol=1e-9)
    np.testing.assert_allclose(cf.light_over_plane([0.0, 1e6], 2.0, 0.5, 3.0), 2 * 3.0 * 0.5 / 20.0, rtol=1e-12)


@pytest.mark.parametrize("index", [1.0 + 1e-6, 1.33, 1.5, 2.4])
def test_etalon_totals(index):
    r = ((index - 1) / (index + 1)) ** 2
    reflected = sum(order.fraction for order in cf.etalon_orders(0.5, index, "reflected"))
    transmitted = sum(order.fraction for order in cf.etalon_orders(0.5, index, "transmitted"))
    np.testing.assert_allclose(reflected, 2 * r / (1 + r), rtol=1e-12)
    np.testing.assert_allclose(transmitted, (1 - r) / (1 + r), rtol=1e-12)
    np.testing.assert_allclose(reflected + transmitted, 1.0, rtol=1e-12)


def test_etalon_arrivals():
    edges = np.linspace(0.0, 8.0, 161)
    bins = cf.etalon_slab(edges, 0.51, 1.5, 2.0, 2.0, "transmitted")
    hit = np.flatnonzero(bins)
    expected = [int((2.0 + 0.765 * k) / 0.05) for k in (1, 3, 5, 7)]
    np.testing.assert_array_equal(hit, expected)
    np.testing.assert_allclose(bins[hit[:2]], [2 * 0.96**2, 2 * 0.96**2 * 0.04**2], rtol=1e-12)


def test_etalon_absorption_and_obliquity():
    orders = cf.etalon_orders(0.5, 1.5, "transmitted", incidence_deg=56.309932474020215, polarization="p")
    assert len(orders) == 1 and math.isclose(orders[0].fraction, 1.0)  # Brewster: nothing is reflected
    cos_t = math.sqrt(1 - (math.sin(math.radians(56.309932474020215)) / 1.5) ** 2)
    assert math.isclose(orders[0].opl, 0.75 / cos_t)
    absorbed = cf.etalon_orders(0.5, 1.5, "reflected", absorption_per_m=2.0)
    assert math.isclose(absorbed[1].fraction, 0.96**2 * 0.04 * math.exp(-2.0))
    rs, rp = cf.fresnel_reflectances(1.5, 56.309932474020215)
    assert math.isclose(rs, (1.25 / 3.25) ** 2) and rp < 1e-25
    assert cf.fresnel_reflectances(1 / 1.5, 50.0) == (1.0, 1.0)


@pytest.mark.parametrize(
    "call, error",
    [
        (lambda: cf.furnace([[0.0, 1.0]], 1.0, 0.5, 1.0), ShapeError),
        (lambda: cf.furnace([0.0, 2.0, 1.0], 1.0, 0.5, 1.0), UnitError),
        (lambda: cf.furnace([0.0, 1.0], 1.0, 1.5, 1.0), UnitError),
        (lambda: cf.etalon_orders(0.5, 1.5, "sideways"), ArgumentError),
        (lambda: cf.confocal_plane([1.0], 1.0, 0.5, 0.5), ShapeError),
        (lambda: cf.hidden_patch([0, 0, 0], [0, 0, 0], [0, 0, 1], (0, 0, 0), 1.0, 0.5, 0.5), UnitError),
    ],
)
def test_errors(call, error):
    with pytest.raises(error):
        call()


# ------------------------------------------------------------------------------------------------------ around a corner


DOWN = (0.0, 0.0, -1.0)


def test_a_plane_is_the_sum_of_its_patches():
    """Rings around the foot of the scan point, each of one distance: the integral by the midpoint rule."""
    depth, edges = 0.8, np.linspace(1.5, 2.4, 10)
    rho = np.linspace(0, 1.2, 6001)
    middles, areas = (rho[1:] + rho[:-1]) / 2, math.pi * np.diff(rho**2)
    lengths, values = np.array([
        hidden_patch([0, 0, 0], [0, 0, 0], [x, 0, depth], DOWN, area, 0.6, 0.9, energy=2.0)
        for x, area in zip(middles, areas, strict=True)
    ]).T  # fmt: skip
    found, _ = np.histogram(lengths, edges, weights=values)
    expected = confocal_plane(edges, depth, 0.6, 0.9, energy=2.0)
    # A bin of 0.1 m holds 250 rings of 2e-4 m at least, of which one at each end may fall into the neighbour.
    np.testing.assert_allclose(found, expected, rtol=2 / 250)
    assert found.sum() == pytest.approx(expected.sum(), rel=1e-3)


def test_all_the_light_of_a_plane_and_of_a_disk():
    everything = confocal_plane([0.0, 1e9], 0.8, 0.6, 0.9)
    strength = 0.9**2 * 0.6 / math.pi**3
    assert everything[0] == pytest.approx(math.pi * strength / (3 * 0.8**2), rel=1e-12)
    disk = confocal_plane([0.0, 1.7, 1e9], 0.8, 0.6, 0.9, radius=0.3)
    reach = math.hypot(0.8, 0.3)
    assert disk.sum() == pytest.approx(everything[0] * (1 - (0.8 / reach) ** 6), rel=1e-12)
    assert confocal_plane([2 * reach, 9.0], 0.8, 0.6, 0.9, radius=0.3)[0] == 0


def test_how_a_patch_falls_off():
    def value(x, z, **changes):
        return hidden_patch([x, 0, 0], [x, 0, 0], [0, 0, z], DOWN, 1e-4, 0.5, 0.8, **changes)

    length, near = value(0.0, 1.0)
    assert length == 2.0 and near == pytest.approx((0.8 / math.pi) ** 2 * 0.5 / math.pi * 1e-4)
    assert value(0.0, 2.0)[1] == pytest.approx(near / 2**4)
    # at one depth z the light goes by z^4 / r^8
    assert value(1.0, 1.0)[1] == pytest.approx(near / math.sqrt(2) ** 8)
    assert hidden_patch([0, 0, 0], [0, 0, 0], [0, 0, 1], (0, 0, 1), 1e-4, 0.5, 0.8)[1] == 0
    assert value(0.0, 1.0, wall_normal=DOWN)[1] == 0
    there = hidden_patch([0.3, 0, 0], [-0.2, 0.1, 0], [0, 0, 1], (0.2, 0, -1), 1e-4, 0.5, 0.8)
    back = hidden_patch([-0.2, 0.1, 0], [0.3, 0, 0], [0, 0, 1], (0.2, 0, -1), 1e-4, 0.5, 0.8)
    assert there == pytest.approx(back)
