"""Exact transients, integrated over the bins of a time axis: what a renderer must return on the scenes of `tt.scenes`.

Every function takes `edges_opl` (T + 1,), the bin edges in metres of optical path length (`TimeAxis.edges_opl`), and
returns float64 energies (T,): the integral of the arriving radiance (or irradiance) over each half-open bin, for
emitters that fire one delta pulse at t = 0. Summed over an axis that covers everything, a row is the steady value.

Numpy only. Wrong axes raise ShapeError or UnitError, quantities outside their range UnitError. Not covered: motion,
wavelength dependence, coherence, participating media.

Cavities are sums of independent flight lengths (`FlightLaw`): in a closed Lambertian cavity whose form factors do not
depend on the point (a sphere, a pair of infinite plates) the lengths of successive flights share one density p, and the
optical path of n flights has the density p^{*n}. It is held on pieces of width `unit`, each by its values at
Gauss-Legendre nodes. Both densities here break only at multiples of that width, so every piece of every convolution is
smooth and the quadrature converges geometrically: 24 nodes reach 1e-13, checked against exact polynomials and moments.

Around a corner (`confocal_plane`, `hidden_patch`): three bounces between diffuse surfaces. A laser of `energy` joules
lights a spot of the relay wall; results are the radiance that leaves the scan point, lengths count from spot to point.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import ArrayLike, NDArray

from torchtransient.checks import positive, share
from torchtransient.errors import ArgumentError, ShapeError, UnitError

Array = NDArray[np.float64]
NODES = 24


@dataclass(frozen=True)
class FlightLaw:
    """The density of one flight, in units of `unit` metres.

    `density(x)` is a probability per unit for `first_piece <= x < last_piece` (None: no upper end), smooth inside every
    [k, k + 1]; it is never evaluated elsewhere.
    """

    unit: float
    density: Callable[[Array], Array]
    first_piece: int
    last_piece: int | None

    def supports(self, piece: int) -> bool:
        """Return True where the density is non-zero on [piece, piece + 1].

        Args:
            piece: whole number of units of length.
        """
        return piece >= self.first_piece and (self.last_piece is None or piece < self.last_piece)


def sphere_chord(radius: float) -> FlightLaw:
    """Return the law of flights between Lambertian points of a sphere: p(l) = l / (2 R^2) on [0, 2R].

    Mean 4R/3, variance 2R^2/9. Source: Fry et al., Applied Optics 45 (2006), integrating-cavity theory.

    Args:
        radius: radius R, metres.
    """
    return FlightLaw(2.0 * _length("radius", radius), lambda x: 2.0 * x, 0, 1)


def plate_gap(separation: float) -> FlightLaw:
    """Return the law of flights between infinite parallel Lambertian plates: p(r) = 2 h^2 / r^3 for r >= h.

    Mean 2h, infinite variance.

    Args:
        separation: distance h between the plates, metres.
    """
    return FlightLaw(_length("separation", separation), lambda x: 2.0 / x**3, 1, None)


def checked_edges(edges_opl: ArrayLike) -> Array:
    """Return bin edges as a float64 array.

    Args:
        edges_opl: bin edges, (T + 1,), metres, increasing.

    Raises:
        ShapeError, UnitError: for other edges.
    """
    edges = np.asarray(edges_opl, dtype=np.float64)
    if edges.ndim != 1 or edges.size < 2:
        raise ShapeError(f"edges_opl: expected one row of at least two edges, got shape {edges.shape}")
    if not np.all(np.isfinite(edges)) or np.any(np.diff(edges) <= 0):
        raise UnitError("edges_opl: expected finite, strictly increasing lengths in metres")
    return edges


def delta_mass(edges_opl: ArrayLike, opl: float) -> Array:
    """Return the bins of one unit of energy that arrives at one time; bins are half-open [start, end).

    Args:
        edges_opl: bin edges, (T + 1,), metres.
        opl: optical path length of the arrival, metres.

    Returns:
        (T,).
    """
    edges = checked_edges(edges_opl)
    mass = np.zeros(edges.size - 1)
    index = int(np.searchsorted(edges, opl, side="right")) - 1
    if 0 <= index < mass.size:
        mass[index] = 1.0
    return mass


def flight_masses(law: FlightLaw, edges_opl: ArrayLike, start_opl: float = 0.0) -> Iterator[Array]:
    """Yield for n = 0, 1, 2, ... the probability that a start plus n flights end in each bin.

    Row 0 is a delta at the start. Rows are integrals over the bins, not densities times widths; mass beyond the last
    edge is not in any bin. Endless: the caller stops.

    Args:
        law: law of one flight.
        edges_opl: bin edges, (T + 1,), metres.
        start_opl: optical path length of the start, metres.

    Yields:
        (T,).
    """
    edges = checked_edges(edges_opl)
    yield delta_mass(edges, start_opl)
    x = np.maximum((edges - start_opl) / law.unit, 0.0)
    pieces = max(1, math.ceil(x[-1]))
    grid = _Grid(law, pieces)
    values = grid.one_flight()
    while True:
        yield np.diff(grid.cumulative(values, x))
        values = grid.add_flight(values)


class _Grid:
    """Piecewise densities on [0, pieces], as values (pieces, NODES) at Gauss-Legendre nodes."""

    def __init__(self, law: FlightLaw, pieces: int) -> None:
        self.law = law
        self.pieces = pieces
        points, weights = legendre.leggauss(NODES)
        self.nodes, self.weights = (points + 1.0) / 2.0, weights / 2.0
        self.to_coefficients = np.asarray(np.linalg.inv(legendre.legvander(points, NODES - 1)), dtype=np.float64)
        self.operators = {d: op for d in range(pieces) if (op := self._operator(d)) is not None}

    def one_flight(self) -> Array:
        """Values of the density of a single flight."""
        values = np.zeros((self.pieces, NODES))
        for piece in range(self.pieces):
            if self.law.supports(piece):
                values[piece] = self.law.density(piece + self.nodes)
        return values

    def add_flight(self, values: Array) -> Array:
        """Convolve the density `values` with the one of a flight."""
        result = np.zeros_like(values)
        for shift, operator in self.operators.items():
            result[shift:] += values[: self.pieces - shift] @ operator.T
        return result

    def cumulative(self, values: Array, x: Array) -> Array:
        """Integral of the density from 0 to every x (in units of the law)."""
        coefficients = values @ self.to_coefficients.T
        before = np.concatenate([[0.0], np.cumsum(values @ self.weights)])
        piece = np.minimum(x.astype(np.int64), self.pieces - 1)
        antiderivative = legendre.legint(coefficients, lbnd=-1, axis=1) / 2.0
        basis = legendre.legvander(2.0 * (x - piece) - 1.0, NODES)
        return np.asarray(before[piece] + (basis * antiderivative[piece]).sum(axis=1), dtype=np.float64)

    def _basis(self, v: Array) -> Array:
        """The Lagrange polynomials of the nodes at positions v (...), shape (..., NODES)."""
        return np.asarray(legendre.legvander(2.0 * v - 1.0, NODES - 1) @ self.to_coefficients, dtype=np.float64)

    def _operator(self, shift: int) -> Array | None:
        """Matrix from the density on piece i, (NODES,), to its share at the nodes of piece i + shift; None if nothing.

        q(t) = int_0^t p(v) k(shift + t - v) dv + int_t^1 p(v) k(shift + t - v) dv: the first integral sees the flight's
        piece `shift`, the second the piece before it, so each integrand is smooth.
        """
        operator = np.zeros((NODES, NODES))
        t = self.nodes[:, None]
        for piece, low, width in ((shift, np.zeros_like(t), t), (shift - 1, t, 1.0 - t)):
            if self.law.supports(piece):
                v = low + width * self.nodes
                density = self.law.density(shift + t - v)
                operator += np.einsum("tq,tqk->tk", width * self.weights * density, self._basis(v))
        supported = self.law.supports(shift) or self.law.supports(shift - 1)
        return operator if supported else None


def _length(name: str, value: float) -> float:
    number = float(value)
    if not math.isfinite(number) or number <= 0:
        raise UnitError(f"{name}: expected a finite length in metres greater than zero, got {value!r}")
    return number


MAX_TERMS = 100_000


def light_over_plane(edges_opl: ArrayLike, height: float, reflectance: float, intensity: float) -> Array:
    """Compute the irradiance per bin at a meter beside a point light above an infinite Lambertian plane.

    E(tau) dtau = intensity * reflectance * h^3 / r^6 dtau with r = tau / 2 >= h (direct light, one bounce); a bin holds
    (2 I rho h^3 / 5) (r_a^-5 - r_b^-5), the total is 2 I rho / (5 h^2). Derivation: radiance rho I cos / (pi d^2) of
    the plane, integrated against the meter's cosine.

    Args:
        edges_opl: bin edges, (T + 1,), metres.
        height: height h above the plane, metres.
        reflectance: reflectance rho, 0 to 1.
        intensity: intensity I of the light, W/sr.

    Returns:
        (T,), W/m^2.
    """
    edges = checked_edges(edges_opl)
    h = positive("height", height)
    r = np.maximum(edges / 2.0, h)
    factor = 2.0 * intensity * share("reflectance", reflectance) * h**3 / 5.0
    return factor * -np.diff(r**-5)


def integrating_sphere_irradiance(
    edges_opl: ArrayLike, radius: float, reflectance: float, energy: float = 1.0, max_flights: int | None = None
) -> Array:
    """Compute the irradiance per bin on the wall of a Lambertian sphere after energy reached the wall at t = 0.

    E_n(tau) = energy rho^(n-1) / (4 pi R^2) p^{*n}(tau), n >= 1 flights with p(l) = l / (2 R^2) on [0, 2R]; the steady
    sum is energy / (4 pi R^2 (1 - rho)). Source: Fry et al. 2006; Labsphere integrating sphere guide.

    Args:
        edges_opl: bin edges, (T + 1,), metres.
        radius: radius R, metres.
        reflectance: reflectance rho, 0 to 1.
        energy: energy that leaves the wall for its first flight, J.
        max_flights: number of flights after which the series is cut, None for no limit.

    Returns:
        (T,), J/m^2.
    """
    area = 4.0 * math.pi * positive("radius", radius) ** 2
    series = _bounce_series(sphere_chord(radius), edges_opl, 0.0, reflectance, first=1, last=max_flights)
    return energy / area * series


def integrating_sphere_radiance(
    edges_opl: ArrayLike, radius: float, reflectance: float, intensity: float, max_bounces: int | None = None
) -> Array:
    """Compute the radiance per bin at the centre of a Lambertian sphere with a point light there.

    L(tau) = (rho / pi) (I / R^2) [ delta(tau - 2R) + sum_{n>=1} rho^n p^{*n}(tau - 2R) ], steady rho I / (pi R^2 (1 -
    rho)). The scene is `tt.scenes.integrating_sphere`.

    Args:
        edges_opl: bin edges, (T + 1,), metres.
        radius: radius R, metres.
        reflectance: reflectance rho, 0 to 1.
        intensity: intensity I of the light, W/sr.
        max_bounces: reflections at the wall (one for the delta), as a renderer with `max_depth = max_bounces + 1`
            counts.

    Returns:
        (T,), W/(m^2 sr).
    """
    r = positive("radius", radius)
    last = None if max_bounces is None else max_bounces - 1
    series = _bounce_series(sphere_chord(r), edges_opl, 2.0 * r, reflectance, first=0, last=last)
    return share("reflectance", reflectance) / math.pi * intensity / r**2 * series


def integrating_sphere_decay(radius: float, reflectance: float) -> float:
    """Compute the optical path length over which the late signal of a Lambertian sphere falls by 1/e.

    1/s with reflectance [e^{2Rs} (2Rs - 1) + 1] / (2 R^2 s^2) = 1, the pole of the renewal equation of p(l) = l / (2
    R^2). At reflectance 0.5 it is 2R exactly.

    Args:
        radius: radius R, metres.
        reflectance: reflectance rho, between 0 and 1, both excluded.

    Returns:
        Metres.

    Raises:
        UnitError: for other reflectances.
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
    """Compute the radiance per bin at the centre of a Lambertian sphere whose wall emits at t = 0.

    L(tau) = Le [ delta(tau - R) + sum_{n>=1} rho^n p^{*n}(tau - R) ], steady Le / (1 - rho). The scene is
    `tt.scenes.furnace`; the late decay is `integrating_sphere_decay`.

    Args:
        edges_opl: bin edges, (T + 1,), metres.
        radius: radius R, metres.
        reflectance: reflectance rho, 0 to 1.
        radiance: radiance Le of the wall.
        max_bounces: reflections (zero for the delta), as a renderer with `max_depth = max_bounces + 1` counts.

    Returns:
        (T,), in the unit of `radiance`.
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
    """Compute the radiance per bin at normal incidence between infinite Lambertian plates that emit at t = 0.

    L(tau) = Le [ delta(tau - z) + sum_{n>=1} rho^n p^{*n}(tau - z) ], p(r) = 2 h^2 / r^3 for r >= h, steady Le / (1 -
    rho). Source: the view factor of parallel planes. The scene is `tt.scenes.parallel_plates`.

    Args:
        edges_opl: bin edges, (T + 1,), metres.
        separation: distance h between the plates, metres.
        reflectance: reflectance rho, 0 to 1.
        radiance: radiance Le of the plates.
        first_leg: distance z from the camera to the plate, metres, h / 2 unless given.
        max_bounces: reflections (zero for the delta).

    Returns:
        (T,), in the unit of `radiance`.
    """
    h = positive("separation", separation)
    z = h / 2.0 if first_leg is None else positive("first_leg", first_leg)
    return radiance * _bounce_series(plate_gap(h), edges_opl, z, reflectance, first=0, last=max_bounces)


def fresnel_reflectances(index: float, incidence_deg: float = 0.0) -> tuple[float, float]:
    """Compute power reflectances (Rs, Rp) of a smooth interface met from the side of index 1.

    Rs = ((cos_i - n cos_t) / (cos_i + n cos_t))^2, Rp = ((n cos_i - cos_t) / (n cos_i + cos_t))^2 (Fresnel). Total
    reflection (index < 1 beyond the critical angle) gives (1, 1).

    Args:
        index: relative index of refraction n, real.
        incidence_deg: angle from the normal, degrees.
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
    """List reflected or transmitted orders of a plane-parallel slab in air, incoherent, down to 1e-18 of the light.

    With R, T = 1 - R at one interface and the travelled path q = index * thickness / cos_t: reflected m = 0: R at 0; m
    >= 1: T^2 R^(2m-1) at 2 m q; transmitted m >= 0: T^2 R^(2m) at (2m + 1) q; absorption multiplies by exp(-alpha *
    length). Totals without absorption 2R / (1 + R) and (1 - R) / (1 + R). The path is the one light travels, not the
    delay of a wavefront, 2 n d cos_t; dispersion (group index) is not covered.

    Args:
        thickness: thickness of the slab, metres.
        index: index of refraction of the slab.
        side: "reflected" or "transmitted".
        incidence_deg: angle from the normal, degrees.
        polarization: "s", "p" or None for the mean of both.
        absorption_per_m: absorption coefficient alpha, per metre of length in the glass.

    Raises:
        ArgumentError: for other sides and polarizations.
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
    """Compute the radiance per bin of a uniform light seen through, or in, a slab at normal incidence.

    The orders of `etalon_orders` shifted by the path in air.

    Args:
        edges_opl: bin edges, (T + 1,), metres.
        thickness: thickness of the slab, metres.
        index: index of refraction of the slab.
        radiance: radiance of the light.
        air_opl: path in air, metres: 2 for `tt.scenes.etalon_slab(light="behind")` with side="transmitted", 3 for
            light="front" with side="reflected".
        side: "transmitted" or "reflected".

    Returns:
        (T,), in the unit of `radiance`.
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


def confocal_plane(
    edges_opl: ArrayLike,
    depth: float,
    albedo: float,
    wall_albedo: float,
    *,
    energy: float = 1.0,
    radius: float = math.inf,
) -> Array:
    """Compute the radiance per bin of a confocal scan point before a plane that is parallel to the wall.

    With K = energy wall_albedo^2 albedo / pi^3 the light at tau = 2 r is K pi depth^4 / r^7 dtau, r >= depth; a bin
    holds (K pi depth^4 / 3) (r_a^-6 - r_b^-6), and the sum of all bins is pi K / (3 depth^2).
    Derivation: the patch of `hidden_patch` integrated over the plane.

    Args:
        edges_opl: bin edges, (T + 1,), metres.
        depth: distance of the plane from the scan point, metres.
        albedo, wall_albedo: albedo of the hidden surface and of the wall, 0 to 1.
        energy: energy of the laser, J.
        radius: radius in metres of a disk in place of the plane, centred before the scan point, whose rim is at r =
            hypot(depth, radius); infinite for the plane.

    Returns:
        (T,).

    Raises:
        UnitError, ShapeError: for other numbers.
    """
    z = positive("depth", depth)
    reach = math.hypot(z, positive("radius", radius)) if radius != math.inf else math.inf
    r = np.clip(checked_edges(edges_opl) / 2.0, z, reach)
    strength = energy * share("wall_albedo", wall_albedo) ** 2 * share("albedo", albedo) / math.pi**3
    return strength * math.pi * z**4 / 3.0 * -np.diff(r**-6.0)


def hidden_patch(
    spot: ArrayLike,
    scan_point: ArrayLike,
    patch: ArrayLike,
    normal: ArrayLike,
    area: float,
    albedo: float,
    wall_albedo: float,
    *,
    wall_normal: ArrayLike = (0.0, 0.0, 1.0),
    energy: float = 1.0,
) -> tuple[float, float]:
    """Compute the optical path length and radiance of the light over a small diffuse patch.

    energy (wall_albedo / pi)^2 (albedo / pi) times the four cosines times area / (r1^2 r2^2), where r1 and r2 are the
    distances of the patch from the spot and the scan point, whose wall has one normal. Zero where a side faces away.

    Args:
        spot, scan_point, patch: points on the wall and the middle of the patch, (3,), metres.
        normal: normal of the patch, (3,).
        area: area of the patch, m^2.
        albedo, wall_albedo: albedo of the hidden surface and of the wall, 0 to 1.
        wall_normal: normal of the wall, (3,).
        energy: energy of the laser, J.

    Returns:
        (metres, radiance).

    Raises:
        ShapeError, UnitError: for other numbers.
    """
    points = [_triple(name, value) for name, value in (("spot", spot), ("scan_point", scan_point), ("patch", patch))]
    wall, hidden = (_unit(name, value) for name, value in (("wall_normal", wall_normal), ("normal", normal)))
    length, factor = 0.0, positive("area", area) * energy
    for point in points[:2]:
        way = points[2] - point
        distance = float(np.linalg.norm(way))
        cosines = max(0.0, float(way @ wall)) * max(0.0, float(-way @ hidden)) / distance**2
        factor *= cosines / distance**2
        length += distance
    return length, factor * (share("wall_albedo", wall_albedo) / math.pi) ** 2 * share("albedo", albedo) / math.pi


def _triple(name: str, value: ArrayLike) -> Array:
    point = np.asarray(value, dtype=np.float64)
    if point.shape != (3,):
        raise ShapeError(f"{name}: expected three numbers, got shape {point.shape}")
    if not np.isfinite(point).all():
        raise UnitError(f"{name}: expected finite numbers, got {point.tolist()}")
    return point


def _unit(name: str, value: ArrayLike) -> Array:
    vector = _triple(name, value)
    length = float(np.linalg.norm(vector))
    if not length > 0:
        raise UnitError(f"{name}: expected a vector with a direction, got {vector.tolist()}")
    return vector / length
