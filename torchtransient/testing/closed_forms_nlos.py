"""Exact captures around a corner, as `closed_forms` has exact renders: three bounces between diffuse surfaces.

A laser of `energy` joules lights a spot of the relay wall; the results are the radiance that leaves the scan point. All
lengths count from the spot to the scan point.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from torchtransient.checks import positive, share
from torchtransient.errors import ShapeError, UnitError
from torchtransient.testing.flight_lengths import Array, checked_edges


def confocal_plane(
    edges_opl: ArrayLike,
    depth: float,
    albedo: float,
    wall_albedo: float,
    *,
    energy: float = 1.0,
    radius: float = math.inf,
) -> Array:
    """Radiance per bin (T,) of a confocal scan point `depth` metres before a plane that is parallel to the wall.

    With K = energy wall_albedo^2 albedo / pi^3 the light at tau = 2 r is K pi depth^4 / r^7 dtau, r >= depth; a bin
    holds (K pi depth^4 / 3) (r_a^-6 - r_b^-6), all of it pi K / (3 depth^2). `radius`: of a disk around the point
    before which the scan point stands, which ends at r = hypot(depth, radius); infinite for the plane. Derivation: the
    patch of `hidden_patch` integrated over the plane. Raises UnitError and ShapeError.
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
    """(optical path length in metres, radiance) of the light over a small diffuse patch.

    energy (wall_albedo / pi)^2 (albedo / pi) times the four cosines times area / (r1^2 r2^2), where r1 and r2 are the
    distances of the patch from the spot and the scan point, whose wall has one normal. Zero where a side faces away.
    Points (3,) in metres, `area` in square metres. Raises ShapeError and UnitError.
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
