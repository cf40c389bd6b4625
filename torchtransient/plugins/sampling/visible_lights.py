"""Light sources that the sensor must not see (``hide_emitters``)."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.sampling.ray_offsets import past


@dr.syntax
def behind_area_lights(scene, ray, pi):
    """The first hit along ``ray`` at or behind ``pi`` that is not an area light.

    Each search starts on the ray itself and distances stay those from ``ray.o``: an origin lifted off the light along
    its normal would land the hit beside the ray, at a wrong distance.
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
