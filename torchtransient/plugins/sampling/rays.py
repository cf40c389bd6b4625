"""Rays to lights: how far they start from a surface, and what they meet."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

# -------------------------------------------------------- distances along rays that single precision can tell from none

# Of the largest coordinate: a few ulp.
SHORTEST = 1e-6


def past(p: Any) -> Any:
    """Return the offset behind a hit at which a ray goes on without meeting the same surface again, metres.

    Mitsuba's own rays start as far off a surface.

    Args:
        p: place of the hit, Point3f, metres in the world.
    """
    return (1 + dr.max(dr.abs(p))) * mi.math.RayEpsilon


def shortest(o: Any) -> Any:
    """Return the shortest distance to a point that has a direction seen from there, metres.

    Args:
        o: place that it is seen from, Point3f, metres in the world.
    """
    return (1 + dr.max(dr.abs(o))) * SHORTEST


# ------------------------------------------------------- light sources that the sensor must not see (``hide_emitters``)


@dr.syntax
def behind_area_lights(scene, ray, pi):
    """Find the first hit along a ray that is not an area light.

    Each search starts on the ray itself and distances stay those from ``ray.o``: an origin lifted off the light along
    its normal would land the hit beside the ray, at a wrong distance.

    Args:
        scene: Mitsuba scene.
        ray: Ray3f.
        pi: its first hit, PreliminaryIntersection3f, which is the result if it is no light.
    """
    pi = mi.PreliminaryIntersection3f(pi)
    lit = pi.is_valid() & (pi.shape.emitter() != None)  # noqa: E711 (a Dr.Jit comparison)
    while dr.hint(lit, label="hide_emitters"):
        p = ray(pi.t)
        t = pi.t + past(p)
        onward = mi.Ray3f(ray)
        onward.o = ray(t)
        onward.maxt = ray.maxt - t
        pi = scene.ray_intersect_preliminary(onward, coherent=True)
        pi.t += t
        lit = pi.is_valid() & (pi.shape.emitter() != None)  # noqa: E711
    return pi
