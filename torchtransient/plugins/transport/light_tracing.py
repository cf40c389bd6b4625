"""The sensor as what a path is connected to: light tracing with the strategies of the walk.

A path that starts at a light and scatters as paths of sensors do (values of BSDFs are symmetric; squares of indices
cancel over a path that begins and ends in one medium) finds the pixel that sees its vertex.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.mitsuba_compat import has_normals, normal_texture
from torchtransient.plugins.mitsuba_shapes import has_surface, has_vertices
from torchtransient.plugins.node_walk import objects_below, shapes_of_scene
from torchtransient.plugins.polarized import (
    intensity,
    product,
    rotate_stokes,
    rotation_between,
    stokes_frame_of,
)
from torchtransient.plugins.transport.strategy import Connection, Event, Proposal


class SensorSampled(Connection):
    """Connection of a path that starts at a light to the sensor.

    Events carry ``uv``, in pixels, ``d`` towards the sensor, ``first`` (the path's first vertex is connected), and
    ``speed``, the number of their speed in a pass of the boundary term.

    Args:
        places: :class:`~..sensors.seen_from.SensorPlaces`.
        unwarp: the segment to the sensor does not count in time.

    Attributes:
        numbers: numbers that choose the sensor's point, set before a launch.
        in_line: None, or Local with masks ``near`` of paths of which it is known whether the first vertex is ``shown``,
            and a ``step`` from it to where nothing is in the way then.
    """

    name = "sensor_sampled"
    finds_light = False

    def __init__(self, places, unwarp):
        self.places, self.unwarp, self.numbers, self.in_line = places, unwarp, None, None

    def propose(self, context, path, vertex, sampler):
        active = context.deep_enough(vertex.goes_on & vertex.connectable, path.depth + 2)
        ds, importance = self.places.seen_from(vertex.at, self.numbers, active)
        return Proposal(d=ds.d, active=active & (ds.pdf > 0), ds=ds, importance=importance, u=sampler.next_2d(),
                        sampler=sampler)  # fmt: skip

    def end_velocity(self, context, vertex, proposal):
        return context.velocities.of_sensor(proposal.ds.p)

    def connect(self, context, path, vertex, proposal, answer, zeros):
        ds = proposal.ds
        value = in_sensor_frame(first_row(product(vertex.β, answer.matrix)), mi.Vector3f(ds.d)) * proposal.importance
        active = proposal.active & (dr.max(dr.abs(intensity(value))) > 0)
        if context.hide_emitters:  # primary rays pass lights
            active &= ~(vertex.surface & vertex.si.shape.is_emitter())
        length = mi.Float(0) if self.unwarp else ds.dist * vertex.η * answer.eta
        opl = vertex.scattered_τ + mi.Float64(length)
        active = context.counted(active, opl)
        depth = path.depth + 2
        first, at, known = depth == 2, vertex, self.in_line
        if known is not None:
            at = dr.copy(vertex)
            at.at = dr.copy(vertex.at)
            at.at.p += dr.select(first & known.near, known.step, 0)
        seen, T = context.segment.transmittance(context, at, ds, proposal.u, proposal.sampler, active, seen=True)
        active = seen if known is None else dr.select(first & known.near, active & known.shown, seen)
        return Event(value=value * T, opl=opl, active=active, depth=depth, uv=ds.uv, d=ds.d, first=first, speed=0)


def first_row(matrix):
    """Return unpolarized light of unit power after it has run through matrices the other way round: U changes its sign.

    Args:
        matrix: throughput from the sensor on, in polarized variants a Mueller matrix.
    """
    if not mi.is_polarized:
        return matrix
    return mi.SpectrumEntry(*[matrix[0, i] * (-1 if i == 2 else 1) for i in range(4)])


def in_sensor_frame(light, d):
    """Return light of a path from a light in the frame of the sensor's own ray, which runs against it.

    Args:
        light: Stokes vector, a spectrum in unpolarized variants.
        d: direction in which the light leaves, unit Vector3f.
    """
    if not mi.is_polarized:
        return light
    return rotate_stokes(light, rotation_between(d, stokes_frame_of(d), stokes_frame_of(-d)))


# --------------------------------------------------------------------------------------------------------------------
# Scattering on the way from lights, where shading normals are not those of the surface (Veach 1997, 5.3).

class FromLight:
    """Scattering of paths that run from lights towards the sensor."""

    def __init__(self, scattering: Any) -> None:
        self._scattering = scattering

    def __getattr__(self, name: str) -> Any:
        return getattr(self._scattering, name)

    def scatter(self, context: Any, path: Any, vertex: Any, proposals: Any, sampler: Any) -> Any:
        """Sample the next direction, see :meth:`~.strategy.Scattering.scatter`."""
        answers, step = self._scattering.scatter(context, path, vertex, proposals, sampler)
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
    """Return True if some surface has normals at its vertices or in a texture.

    Args:
        scene: Mitsuba scene.
    """
    shapes = [shape for shape in shapes_of_scene(scene) if has_surface(shape) and shape.bsdf() is not None]
    if any(has_vertices(shape) and has_normals(shape) for shape in shapes):
        return True
    bsdfs = {bsdf.ptr: bsdf for bsdf in (shape.bsdf() for shape in shapes)}
    nested = [one for bsdf in bsdfs.values() for one in (bsdf, *objects_below(bsdf, mi.BSDF))]
    return any(normal_texture(bsdf) is not None for bsdf in nested)
