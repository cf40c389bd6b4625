"""One recorded vertex as a function ``Carry -> (EventTerms, Carry)``, put together from what the strategies say.

The sampled path is held fixed in this sense: vertices are points of their shapes, dragged along with the vertex before
where they are near; the first vertex of a camera's path slides along its ray. Where a delta lobe determines the next
ray, that ray itself is attached.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.transport.carry import Carry, attach
from torchtransient.plugins.transport.strategy import Local


@dataclass
class VertexEnd:
    """Where a vertex lies, without derivatives: what the one before sees of it. Loop state of the reverse mode."""

    t: Any      # Float      distance along the ray that found it, which starts a little off the vertex before
    n: Any      # Normal3f   zero for points in a volume
    d: Any      # Vector3f   direction of that ray
    valid: Any  # Bool       something was hit

    @staticmethod
    def nowhere() -> VertexEnd:
        """Behind the last vertex of a path."""
        return VertexEnd(mi.Float(0), mi.Normal3f(0, 0, 1), mi.Vector3f(0, 0, 1), mi.Bool(False))


class AttachedVertex(Local):
    """A recorded vertex with derivatives.

    ``v`` (RecordedVertex), ``si`` (attached), ``sid`` (detached), ``end`` (VertexEnd), ``carry`` (with the throughput
    at the vertex), ``slope`` (zero with the derivative of the optical length up to it), ``damping_radius`` (with
    geometry: points nearer than that slide along). The scattering adds ``bsdf``, ``delay``, ``scattered_si`` (``si``
    with the wavelengths beyond the surface), ``scattered_slope`` and ``scattered_opl`` (behind its delay) and
    ``rotation``.
    """


def attached_carry(v, names, tangents=None):
    """The recorded Carry that arrives at a vertex, with leaves for the fields ``names``."""
    # A leaf has the width of the lanes, or its gradient would be summed up over them.
    zero = dr.zeros(mi.Float, dr.width(v.ray.d))
    o, d = mi.Point3f(v.ray.o), mi.Vector3f(v.ray.d)
    # Of its ends, the derivatives alone are asked for.
    carry = Carry(
        β=mi.Spectrum(v.β), slope=zero, η=mi.Float(v.η), o=o, d=d, x=mi.Point3f(o), w=mi.Vector3f(d), p=mi.Point3f(o),
        n=mi.Normal3f(d),
    )  # fmt: skip
    return attach(carry, names, tangents)


def vertex_terms(world, v, carry, wanted):
    """(events with derivatives, the Carry to the next vertex, the attached vertex)."""
    vertex = world.segment.attached(world, v, carry, wanted)
    world.scattering.look_up_attached(world, vertex, wanted)
    step = world.scattering.attached(world, vertex, wanted)
    terms = [term for c in world.connections for term in c.attached(world, vertex, step, wanted)]
    return terms, step.carry, vertex
