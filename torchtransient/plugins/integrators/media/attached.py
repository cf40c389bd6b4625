"""The physics of one vertex in a medium, with derivatives, shared by reverse and forward mode.

A vertex in a medium slides along the ray that found it, as one on a surface does: it divides the stretch between the
surfaces before and behind it in a fixed ratio, so that it never leaves the medium when one of them moves, and the
stretch's length enters as the measure of what was integrated. Against the next vertex it moves as if that one were
nailed down. Where nothing that moves bounds the stretch it is a fixed point.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.integrators.media.free_flight import medium_interaction
from torchtransient.plugins.integrators.media.medium_vertex import unpolarizing


class InMedium:
    """What the vertices of this iteration that lie in a medium (``scatter``) are made of; a plain object.

    ``stretch``: attached length of the stretch that the vertex divides, 1 where it has no end.
    """

    def __init__(self, scatter, mei, σ_s, phase, stretch):
        self.scatter, self.mei, self.σ_s, self.phase, self.stretch = scatter, mei, σ_s, phase, stretch


def attached_distance(v, ray, facts):
    """Distance along ``ray`` of a vertex in a medium, and the length of the stretch that it divides."""
    if not facts.geometry:
        return v.medium.t, mi.Float(1)
    begin = mi.Float(0)
    if facts.media.open_boundaries:
        entered = v.scatter & v.medium.entry.is_valid()
        behind = v.medium.entry.compute_surface_interaction(ray, mi.RayFlags.Minimal, entered)
        begin = dr.select(entered, behind.t, 0)
    exit = v.pi.compute_surface_interaction(ray, mi.RayFlags.Minimal, v.scatter)
    bounded = v.scatter & v.pi.is_valid()
    end = dr.select(bounded, exit.t, begin + 1)
    stretch = end - begin
    ratio = dr.detach((v.medium.t - begin) / stretch)
    return dr.fma(ratio, stretch, begin), dr.select(bounded, stretch, 1)


def surface_or_medium(v, ray, w, facts, live):
    """The interaction of a vertex and what it needs to scatter in a medium (None in scenes without media).

    Vertices in media come as interactions too: at the point itself, with no normal and no shape.
    """
    if facts.media is None:
        return v.pi.compute_surface_interaction(ray, mi.RayFlags.All, live), None
    si = v.pi.compute_surface_interaction(ray, mi.RayFlags.All, live & ~v.scatter)
    t, stretch = attached_distance(v, ray, facts)
    mei = medium_interaction(ray, v.medium.end, t)
    mei.wi = -w
    mei.sh_frame = mi.Frame3f(-w)
    si.t = dr.select(v.scatter, t, si.t)
    si.p = dr.select(v.scatter, mei.p, si.p)
    si.n = dr.select(v.scatter, mi.Normal3f(0), si.n)
    si.sh_frame = dr.select(v.scatter, mi.Frame3f(dr.detach(w)), si.sh_frame)
    active = live & v.scatter
    phase = dr.select(active, mei.medium.phase_function(), dr.zeros(mi.PhaseFunctionPtr))
    σ_s = mei.medium.get_scattering_coefficients(mei, active)[0]
    return si, InMedium(v.scatter, mei, σ_s, phase, stretch)


def evaluate(inside, ctx, bsdf, si, wo, d, active, sampled=False):
    """Scattering and its density towards ``d`` (``wo`` in the frame of ``si``) of a surface or a medium.

    A phase function too narrow for single precision has no light towards a given point, and its own samples
    (``sampled``) have the ratio of value and density that they were drawn with.
    """
    val, pdf = bsdf.eval_pdf(ctx, si, wo, active)
    if inside is None:
        return val, pdf
    value, density = inside.phase.eval_pdf(mi.PhaseFunctionContext(None), inside.mei, d, active & inside.scatter)
    usable = dr.isfinite(dr.detach(density)) & (dr.detach(density) > 0)
    other = 1 if sampled else 0
    value = unpolarizing(dr.select(usable, mi.unpolarized_spectrum(value), other) * inside.σ_s)
    density = dr.select(usable, density, other)
    return dr.select(inside.scatter, value, val), dr.select(inside.scatter, density, pdf)
