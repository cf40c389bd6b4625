"""Lines from hidden points to points of the wall: cosines, distances, occlusion."""

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
    """Return the straight lines from samples to wall points.

    Args:
        sample: samples with ``p``, ``n`` and ``geometric_n``.
        p, n: wall points and their normals.

    Returns:
        ``d`` (not normalized), ``r`` (metres), ``inverse_square`` (1 / r^2), ``cos`` and ``geometric_cos`` (signed, of
        the sample's shading and geometric normal), ``wall_cos`` (0 behind the wall).
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
    """Return the geometric normal (Normal3f) on the side of the shading normal, where a one-sided surface scatters.

    Mitsuba's own points to the other side with mirrored transforms, and with normals against the order of the corners.

    Args:
        si: interactions (SurfaceInteraction3f).
    """
    return dr.mulsign(mi.Normal3f(si.n), dr.dot(si.sh_frame.n, si.n))


def sees(scene: Any, start: Any, end: Any, n: Any, active: Any) -> Any:
    """Return a mask of pairs of points that see each other; points of one plane do not.

    Args:
        scene: built scene.
        start: points with ``p`` and ``geometric_n``.
        end, n: points, and normals of the sides that have to face ``start``.
        active: mask of pairs.
    """
    to = mi.Vector3f(end - start.p)
    line = Local(geometric_cos=dr.dot(start.geometric_n, to), r=dr.norm(to))
    least = OFFSET * (dr.max(dr.abs(end)) + line.r)
    seen = active & (dr.abs(line.geometric_cos) > least) & (-dr.dot(n, to) > least)
    return seen & ~occluded(scene, start, line, end, n, seen)


def occluded(scene: Any, sample: Any, line: Any, p: Any, n: Any, active: Any) -> Any:
    """Return a mask of samples and wall points with something in between.

    Both ends are moved off their surfaces along the geometric normals, by the rounding error of single precision at
    the largest coordinate on the way: on curved meshes neighbouring triangles are not met, whatever the scale of the
    scene. Surfaces that lie nearer to another one than that do not hide it.

    Args:
        scene: built scene.
        sample: samples with ``p`` and ``geometric_n``.
        line: their lines to the wall points (:func:`span`), of which ``r`` and ``geometric_cos`` count.
        p, n: wall points and their normals.
        active: mask of pairs to be tested.
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
    """Points of a diffuse wall, plane or curved: scan points or laser spots. A plain class, no state of Dr.Jit's loops.

    Args:
        p: points (``Point3f``, metres), ``width`` of them.
        n: unit normals of the side that is lit (``Normal3f``), one for all or one each, as ``value`` and ``leg``.
        value: albedo over pi (``UnpolarizedSpectrum``).
        leg: optical path from laser to spot, or from scan point to sensor (``Float64``, metres), 0 to leave it out.

    Raises:
        ShapeError: for another number of normals, values or legs.
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
        """Gather (``p``, ``n``, ``value``, ``leg``) of the points with the numbers ``index`` (UInt32)."""
        return (
            dr.gather(mi.Point3f, self.p, index, active),
            gather_one_or_each(self.n, index, active),
            gather_one_or_each(self.value, index, active),
            gather_one_or_each(self.leg, index, active),
        )


def points_of(si: Any, factor: Any, length: Any) -> WallPoints:
    """Build wall points from interactions with a diffuse wall.

    Args:
        si: interactions (SurfaceInteraction3f); ``wi`` is where the light comes from or goes to.
        factor: factor of the albedo, such as 1 / pi.
        length: legs (Float, metres).
    """
    bsdf, valid = si.bsdf(), si.is_valid()
    side = dr.select(si.wi.z > 0, 1, dr.select(scatters_behind(bsdf) & (si.wi.z < 0), -1, 0))
    albedo = mi.unpolarized_spectrum(bsdf.eval_diffuse_reflectance(si, valid))
    value = dr.select(valid & (side != 0), albedo * factor, 0)
    front = front_normal(si)
    n = dr.select(valid, dr.select(side < 0, -front, front), mi.Normal3f(0, 0, 1))
    return WallPoints(dr.select(valid, si.p, 0), n, value, dr.select(valid, length, 0))


def gather_one_or_each(array: Any, index: Any, active: Any = True) -> Any:
    """Gather entries of an array that has one entry for all, or one each.

    Args:
        array: array of any type, of width one or of one entry each.
        index: numbers of the entries (UInt32).
        active: mask.
    """
    return dr.gather(type(array), array, index if dr.width(array) > 1 else mi.UInt32(0), active)
