"""Exact transients, integrated over the bins of a time axis: what a renderer must return on the scenes of `tt.scenes`.

Every function takes `edges_opl` (T + 1,), the bin edges in metres of optical path length (`TimeAxis.edges_opl`), and
returns float64 energies (T,): the integral of the arriving radiance (or irradiance) over each half-open bin, for
emitters that fire one delta pulse at t = 0. Summed over an axis that covers everything, a row is the steady value.

Numpy only. Wrong axes raise ShapeError or UnitError, quantities outside their range UnitError. Not covered: motion,
wavelength dependence, coherence, participating media.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from torchtransient.checks import positive, share
from torchtransient.errors import ArgumentError, UnitError
from torchtransient.testing.flight_lengths import (
    Array,
    FlightLaw,
    checked_edges,
    delta_mass,
    flight_masses,
    plate_gap,
    sphere_chord,
)

MAX_TERMS = 100_000


def light_over_plane(edges_opl: ArrayLike, height: float, reflectance: float, intensity: float) -> Array:
    """Irradiance per bin (T,) at a meter beside a point light, `height` metres above an infinite Lambertian plane.

    E(tau) dtau = intensity * reflectance * h^3 / r^6 dtau with r = tau / 2 >= h (direct light, one bounce); a bin holds
    (2 I rho h^3 / 5) (r_a^-5 - r_b^-5), the total is 2 I rho / (5 h^2). `intensity` in W/sr, result in W/m^2.
    Derivation: radiance rho I cos / (pi d^2) of the plane, integrated against the meter's cosine.
    """
    edges = checked_edges(edges_opl)
    h = positive("height", height)
    r = np.maximum(edges / 2.0, h)
    factor = 2.0 * intensity * share("reflectance", reflectance) * h**3 / 5.0
    return factor * -np.diff(r**-5)


def integrating_sphere_irradiance(
    edges_opl: ArrayLike, radius: float, reflectance: float, energy: float = 1.0, max_flights: int | None = None
) -> Array:
    """Irradiance per bin (T,) on the wall of a Lambertian sphere after `energy` reached the wall at t = 0.

    E_n(tau) = energy rho^(n-1) / (4 pi R^2) p^{*n}(tau), n >= 1 flights with p(l) = l / (2 R^2) on [0, 2R]; the steady
    sum is energy / (4 pi R^2 (1 - rho)). `energy` is what leaves the wall for its first flight, in J; `radius` in
    metres; result in J/m^2. `max_flights` cuts the series after that many flights. Source: Fry et al. 2006; Labsphere
    integrating sphere guide.
    """
    area = 4.0 * math.pi * positive("radius", radius) ** 2
    series = _bounce_series(sphere_chord(radius), edges_opl, 0.0, reflectance, first=1, last=max_flights)
    return energy / area * series


def integrating_sphere_radiance(
    edges_opl: ArrayLike, radius: float, reflectance: float, intensity: float, max_bounces: int | None = None
) -> Array:
    """Radiance per bin (T,) seen from the centre of a Lambertian sphere with a point light of `intensity` at the
    centre.

    L(tau) = (rho / pi) (I / R^2) [ delta(tau - 2R) + sum_{n>=1} rho^n p^{*n}(tau - 2R) ], steady rho I / (pi R^2 (1 -
    rho)). `radius` in metres, `intensity` in W/sr, result in W/(m^2 sr). `max_bounces` counts reflections at the wall
    (one for the delta), as a renderer with `max_depth = max_bounces + 1` does. The scene is
    `tt.scenes.integrating_sphere`.
    """
    r = positive("radius", radius)
    last = None if max_bounces is None else max_bounces - 1
    series = _bounce_series(sphere_chord(r), edges_opl, 2.0 * r, reflectance, first=0, last=last)
    return share("reflectance", reflectance) / math.pi * intensity / r**2 * series


def integrating_sphere_decay(radius: float, reflectance: float) -> float:
    """Optical path length, metres, over which the late signal of a Lambertian sphere falls by 1/e.

    1/s with reflectance [e^{2Rs} (2Rs - 1) + 1] / (2 R^2 s^2) = 1, the pole of the renewal equation of p(l) = l / (2
    R^2). At reflectance 0.5 it is 2R exactly. Raises UnitError unless 0 < reflectance < 1.
    """
    if not 0.0 < reflectance < 1.0:
        raise UnitError(f"reflectance: expected a number between 0 and 1, both excluded, got {reflectance!r}")

    def excess(x: float) -> float:
        # 2 (e^x (x - 1) + 1) / x^2 as its series, free of cancellation at small x: sum 2 x^k / (k! (k + 2))
        term, total = 1.0, 1.0
        for k in range(1, 400):
            term *= x / k
            total += 2.0 * term / (k + 2)
            if term < 1e-18 * total:
                break
        return reflectance * total - 1.0

    low, high = 0.0, 1.0
    while excess(high) < 0.0:
        low, high = high, 2.0 * high
    for _ in range(200):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if excess(middle) < 0.0 else (low, middle)
    return 2.0 * positive("radius", radius) / (0.5 * (low + high))


def furnace(
    edges_opl: ArrayLike, radius: float, reflectance: float, radiance: float, max_bounces: int | None = None
) -> Array:
    """Radiance per bin (T,) seen from the centre of a Lambertian sphere whose wall emits `radiance` at t = 0.

    L(tau) = Le [ delta(tau - R) + sum_{n>=1} rho^n p^{*n}(tau - R) ], steady Le / (1 - rho). `radius` in metres.
    `max_bounces` counts reflections (zero for the delta), as a renderer with `max_depth = max_bounces + 1` does. The
    scene is `tt.scenes.furnace`; the late decay is `integrating_sphere_decay`.
    """
    r = positive("radius", radius)
    return radiance * _bounce_series(sphere_chord(r), edges_opl, r, reflectance, first=0, last=max_bounces)


def parallel_plates(
    edges_opl: ArrayLike,
    separation: float,
    reflectance: float,
    radiance: float,
    first_leg: float | None = None,
    max_bounces: int | None = None,
) -> Array:
    """Radiance per bin (T,) seen at normal incidence between infinite Lambertian plates that emit `radiance` at t = 0.

    L(tau) = Le [ delta(tau - z) + sum_{n>=1} rho^n p^{*n}(tau - z) ], p(r) = 2 h^2 / r^3 for r >= h, steady Le / (1 -
    rho). `separation` h and `first_leg` z (camera to plate, h / 2 unless given) in metres. Source: the view factor of
    parallel planes. The scene is `tt.scenes.parallel_plates`.
    """
    h = positive("separation", separation)
    z = h / 2.0 if first_leg is None else positive("first_leg", first_leg)
    return radiance * _bounce_series(plate_gap(h), edges_opl, z, reflectance, first=0, last=max_bounces)


def fresnel_reflectances(index: float, incidence_deg: float = 0.0) -> tuple[float, float]:
    """Power reflectances (Rs, Rp) of a smooth interface met from the side of index 1, for a real relative `index`.

    Rs = ((cos_i - n cos_t) / (cos_i + n cos_t))^2, Rp = ((n cos_i - cos_t) / (n cos_i + cos_t))^2 (Fresnel). Total
    reflection (index < 1 beyond the critical angle) gives (1, 1).
    """
    n = positive("index", index)
    cos_i = math.cos(math.radians(incidence_deg))
    sin2_t = (1.0 - cos_i**2) / n**2
    if sin2_t >= 1.0:
        return 1.0, 1.0
    cos_t = math.sqrt(1.0 - sin2_t)
    return ((cos_i - n * cos_t) / (cos_i + n * cos_t)) ** 2, ((n * cos_i - cos_t) / (n * cos_i + cos_t)) ** 2


@dataclass(frozen=True)
class EtalonOrder:
    """One order of a slab: optical path inside the slab (metres) and the fraction of the incident radiance."""

    opl: float
    fraction: float


def etalon_orders(
    thickness: float,
    index: float,
    side: str,
    *,
    incidence_deg: float = 0.0,
    polarization: str | None = None,
    absorption_per_m: float = 0.0,
) -> list[EtalonOrder]:
    """Reflected or transmitted orders of a plane-parallel slab in air, incoherent, down to 1e-18 of the light.

    With R, T = 1 - R at one interface and the travelled path q = index * thickness / cos_t: reflected m = 0: R at 0; m
    >= 1: T^2 R^(2m-1) at 2 m q; transmitted m >= 0: T^2 R^(2m) at (2m + 1) q; absorption multiplies by exp(-alpha *
    length). Totals without absorption 2R / (1 + R) and (1 - R) / (1 + R). `side` is "reflected" or "transmitted";
    `polarization` "s", "p" or None for the mean of both. Lengths in metres, `absorption_per_m` per metre of length in
    the glass. The path is the one light travels, not the delay of a wavefront, 2 n d cos_t; dispersion (group index) is
    not covered.
    """
    if side not in ("reflected", "transmitted"):
        raise ArgumentError(f"side: expected 'reflected' or 'transmitted', got {side!r}")
    if polarization not in ("s", "p", None):
        raise ArgumentError(f"polarization: expected 's', 'p' or None, got {polarization!r}")
    rs, rp = fresnel_reflectances(index, incidence_deg)
    reflectances = {"s": [rs], "p": [rp], None: [rs, rp]}[polarization]
    cos_t = math.sqrt(max(0.0, 1.0 - (math.sin(math.radians(incidence_deg)) / index) ** 2))
    if max(reflectances) >= 1.0:
        return [EtalonOrder(0.0, 1.0)] if side == "reflected" else []
    length = positive("thickness", thickness) / cos_t
    orders: list[EtalonOrder] = []
    if side == "reflected":
        orders.append(EtalonOrder(0.0, float(np.mean(reflectances))))
    for m in range(MAX_TERMS):
        crossings = 2 * m + 1 if side == "transmitted" else 2 * (m + 1)
        fractions = [(1.0 - r) ** 2 * r ** (crossings - 1) for r in reflectances]
        fraction = float(np.mean(fractions)) * math.exp(-absorption_per_m * crossings * length)
        if fraction < 1e-18:
            break
        orders.append(EtalonOrder(crossings * index * length, fraction))
    return orders


def etalon_slab(
    edges_opl: ArrayLike, thickness: float, index: float, radiance: float, air_opl: float, side: str = "transmitted"
) -> Array:
    """Radiance per bin (T,) of a uniform light of `radiance` seen through, or in, a slab at normal incidence.

    The orders of `etalon_orders` shifted by `air_opl`, the path in air in metres: 2 for
    `tt.scenes.etalon_slab(light="behind")` with side="transmitted", 3 for light="front" with side="reflected".
    """
    edges = checked_edges(edges_opl)
    total = np.zeros(edges.size - 1)
    for order in etalon_orders(thickness, index, side):
        total += radiance * order.fraction * delta_mass(edges, air_opl + order.opl)
    return total


def _bounce_series(
    law: FlightLaw, edges_opl: ArrayLike, start_opl: float, reflectance: float, first: int, last: int | None
) -> Array:
    """sum over n = first .. last of rho^(n - first) p^{*n}(tau - start_opl), per bin; None: until nothing is added.

    The mass of n flights within the axis falls faster than geometrically once n exceeds the longest possible number of
    typical flights, so that the series ends by itself, at reflectance 1 too.
    """
    rho = share("reflectance", reflectance)
    edges = checked_edges(edges_opl)
    total = np.zeros(edges.size - 1)
    if last is not None and last < first:
        return total
    typical = (edges[-1] - start_opl) / law.unit
    for n, mass in enumerate(flight_masses(law, edges, start_opl)):
        if n < first:
            continue
        term = rho ** (n - first) * mass
        total += term
        if n == last or (n > typical and float(term.sum()) <= 1e-17 * float(total.sum())):
            return total
        if n > MAX_TERMS:
            raise UnitError(f"the axis reaches {edges[-1]} m, more than {MAX_TERMS} flights; use a shorter axis")
    return total
