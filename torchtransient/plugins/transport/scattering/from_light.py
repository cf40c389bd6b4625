"""Scattering on the way from lights, where shading normals are not those of the surface (Veach 1997, 5.3)."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.mitsuba_compat import has_surface, has_vertices, normal_texture
from torchtransient.plugins.node_walk import objects_below, shapes_of_scene


class FromLight:
    """The ``scattering`` of paths that run against those of the sensor.

    A value holds the cosine of the side that it is asked for. Paths of the sensor hold that of the light's side,
    against the normal that the BSDF shades by, and the area of a surface changes from one side's to the other's by the
    true normal: the values of both ways differ by ``|n . wo| f(wo, wi) / (|n . wi| f(wi, wo))``, cosines included in f.
    """

    def __init__(self, scattering: Any) -> None:
        self._scattering = scattering

    def __getattr__(self, name: str) -> Any:
        return getattr(self._scattering, name)

    def scatter(self, world: Any, path: Any, vertex: Any, proposals: Any, sampler: Any) -> Any:
        """As :meth:`~..strategy.Scattering.scatter`."""
        answers, step = self._scattering.scatter(world, path, vertex, proposals, sampler)
        for proposal, answer in zip(proposals, answers, strict=True):
            if answer is not None:
                factor = self._factor(vertex, proposal.d, proposal.active)
                answer.value, answer.matrix = answer.value * factor, answer.matrix * factor
        step.weight = step.weight * self._factor(vertex, step.out, vertex.goes_on & ~step.delta)
        return answers, step

    @staticmethod
    def _factor(vertex: Any, out: Any, active: Any) -> Any:
        si, active = vertex.scattered_si, active & vertex.surface
        wo, back = si.to_local(out), dr.copy(si)
        back.wi = wo
        there, other = (
            dr.mean(mi.unpolarized_spectrum(vertex.bsdf.eval(mi.BSDFContext(), one, towards, active)))
            for one, towards in ((si, wo), (back, si.wi))
        )
        ratio = other * dr.abs_dot(si.n, out) / (there * dr.abs_dot(si.n, si.to_world(si.wi)))
        return dr.select(active & dr.isfinite(ratio), ratio, 1)


def shades_by_other_normals(scene: Any) -> bool:
    """Return whether some surface has normals at its vertices or in a texture."""
    shapes = [shape for shape in shapes_of_scene(scene) if has_surface(shape) and shape.bsdf() is not None]
    if any(has_vertices(shape) and shape.has_vertex_normals() for shape in shapes):
        return True
    bsdfs = {bsdf.ptr: bsdf for bsdf in (shape.bsdf() for shape in shapes)}
    nested = [one for bsdf in bsdfs.values() for one in (bsdf, *objects_below(bsdf, mi.BSDF))]
    return any(normal_texture(bsdf) is not None for bsdf in nested)
