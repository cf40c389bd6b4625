"""From a hidden point to a point of the wall: cosines, distance, and whether something is in between."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.errors import ShapeError
from torchtransient.plugins.bsdfs.lambertian import scatters_behind
from torchtransient.plugins.transport.strategy import Local

# By how much ends of lines are moved off their surfaces, and shortened, in parts of the largest coordinate: 8 times the
# rounding of single precision. Convex meshes of any shape and scale lose no light from a quarter of it on.
OFFSET = 2**-20


def span(sample: Any, p: Any, n: Any) -> Local:
    """The straight line from samples to wall points ``p`` with normals ``n``.

    ``r`` (metres), ``cos`` (of the shading normal there, signed), ``geometric_cos`` (signed), ``wall_cos`` (0 behind
    the wall), ``inverse_square`` (1 / r^2), ``d`` (not normalized).
    """
    d = mi.Vector3f(p - sample.p)
    square = dr.squared_norm(d)
    inverse = dr.rsqrt(square)
    cos = dr.dot(sample.n, d) * inverse
    geometric_cos = cos if sample.geometric_n is sample.n else dr.dot(sample.geometric_n, d) * inverse
    wall_cos = dr.maximum(-dr.dot(n, d) * inverse, 0)
    return Local(
        d=d,
        r=square * inverse,
        cos=cos,
        geometric_cos=geometric_cos,
        wall_cos=wall_cos,
        inverse_square=inverse * inverse,
    )


def front_normal(si: Any) -> Any:
    """The geometric normal (Normal3f) on the side that the shading normal points to, where a one-sided surface
    scatters: with mirrored transforms, and normals against the order of the corners, Mitsuba's own points behind.
    """
    return dr.mulsign(mi.Normal3f(si.n), dr.dot(si.sh_frame.n, si.n))


def sees(scene: Any, start: Any, end: Any, n: Any, active: Any) -> Any:
    """Return whether points ``start`` (``p``, ``geometric_n``) see the points ``end``, which face them with the side of
    ``n``: points of one plane do not.
    """
    to = mi.Vector3f(end - start.p)
    line = Local(geometric_cos=dr.dot(start.geometric_n, to), r=dr.norm(to))
    least = OFFSET * (dr.max(dr.abs(end)) + line.r)
    seen = active & (dr.abs(line.geometric_cos) > least) & (-dr.dot(n, to) > least)
    return seen & ~occluded(scene, start, line, end, n, seen)


def occluded(scene: Any, sample: Any, line: Any, p: Any, n: Any, active: Any) -> Any:
    """Return whether something stands between samples and wall points.

    Both ends are moved off their surfaces along the geometric normals, by what single precision leaves of the largest
    coordinate on the way: on curved meshes neighbouring triangles are not met, whatever the scale of the scene. What
    lies nearer to a surface than that does not hide it.
    """
    # No coordinate of the sample exceeds the largest of the wall point by more than the distance.
    reach = dr.max(dr.abs(p)) + line.r
    offset = OFFSET * reach
    start = mi.Point3f(sample.p + sample.geometric_n * dr.mulsign(offset, line.geometric_cos))
    ray = dr.zeros(mi.Ray3f)
    ray.o = start
    ray.d = mi.Vector3f(p + mi.Vector3f(n) * offset - start)
    # The end lies before the wall already: what remains is the rounding of the length itself.
    ray.maxt = mi.Float(1 - OFFSET)
    return scene.ray_test(ray, False, active)


# ---------------------------------------------- points of a relay wall: scan points that are looked at, and laser spots


class WallPoints:
    """``width`` points of a diffuse wall, plane or curved.

    ``p`` (``Point3f``, metres), ``n`` (``Normal3f``, unit, of the side that is lit), ``value``
    (``UnpolarizedSpectrum``: albedo over pi, one or one each), ``leg`` (``Float64``, metres, one or one each: optical
    path from laser to spot, or from scan point to sensor; 0 where the legs are left out). Raises ShapeError.

    A plain class, which Dr.Jit loops leave alone.
    """

    def __init__(self, p: Any, n: Any, value: Any, leg: Any = 0.0) -> None:
        self.p, self.n = mi.Point3f(p), mi.Normal3f(n)
        self.value, self.leg = mi.UnpolarizedSpectrum(value), mi.Float64(leg)
        self.width = dr.width(self.p)
        for name in ("n", "value", "leg"):
            width = dr.width(getattr(self, name))
            if width not in (1, self.width):
                raise ShapeError(f"WallPoints: expected one {name} or {self.width}, as there are points, got {width}.")
        # In memory: scans of other places are the same kernels.
        dr.make_opaque(self.p, self.n, self.value, self.leg)

    def take(self, index: Any, active: Any = True) -> tuple[Any, Any, Any, Any]:
        """Return (``p``, ``n``, ``value``, ``leg``) of these points."""
        return (
            dr.gather(mi.Point3f, self.p, index, active),
            _one_or_each(self.n, index, active),
            _one_or_each(self.value, index, active),
            _one_or_each(self.leg, index, active),
        )


def points_of(si: Any, factor: Any, length: Any) -> WallPoints:
    """Build wall points from interactions with a diffuse wall, for light along ``si.wi``: their albedo times
    ``factor``, and the legs ``length``.
    """
    bsdf, valid = si.bsdf(), si.is_valid()
    side = dr.select(si.wi.z > 0, 1, dr.select(scatters_behind(bsdf) & (si.wi.z < 0), -1, 0))
    albedo = mi.unpolarized_spectrum(bsdf.eval_diffuse_reflectance(si, valid))
    value = dr.select(valid & (side != 0), albedo * factor, 0)
    front = front_normal(si)
    n = dr.select(valid, dr.select(side < 0, -front, front), mi.Normal3f(0, 0, 1))
    return WallPoints(dr.select(valid, si.p, 0), n, value, dr.select(valid, length, 0))


def _one_or_each(array: Any, index: Any, active: Any) -> Any:
    return dr.gather(type(array), array, index if dr.width(array) > 1 else mi.UInt32(0), active)
