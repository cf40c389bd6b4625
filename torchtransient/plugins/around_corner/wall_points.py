"""Points of a relay wall: scan points that are looked at, and laser spots."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.errors import ShapeError
from torchtransient.plugins.around_corner.geometry import front_normal
from torchtransient.plugins.bsdfs.lambertian import scatters_behind


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
        """(``p``, ``n``, ``value``, ``leg``) of these points."""
        return (
            dr.gather(mi.Point3f, self.p, index, active),
            _one_or_each(self.n, index, active),
            _one_or_each(self.value, index, active),
            _one_or_each(self.leg, index, active),
        )


def points_of(si: Any, factor: Any, length: Any) -> WallPoints:
    """What interactions with a diffuse wall make of light that comes along ``si.wi``, or goes that way: their albedo
    times ``factor``, and the legs ``length``.
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
