"""What the loop, its strategies and its sinks say to each other. Nothing here knows an effect by name.

One turn of the loop (:func:`.walk.bounce`) asks a *segment* for the vertex at the end of a straight line, every
*connection* for a direction it wants to connect along, the *scattering* for the values in these directions and for the
next one, and the connections for events; a *sink* decides what becomes of events and vertices.

Every strategy has three forms side by side: the primal one; ``fields`` and ``record``, what of it cannot be recomputed
and is kept for derivatives; and the ``attached`` one, which re-evaluates a recorded vertex with derivatives. Forward
and reverse mode follow from the last one.

Shapes: every Float is one number per lane; ``value`` is per colour (``mi.UnpolarizedSpectrum``), a Stokes vector in
polarized variants.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi


class Local:
    """Named values that live within one iteration of a loop.

    Not a dataclass on purpose: Dr.Jit would take it apart as loop state.
    """

    def __init__(self, **values: Any) -> None:
        vars(self).update(values)


class Vertex(Local):
    """The end of a segment in the primal walk.

    ``si`` (SurfaceInteraction3f, valid at surfaces), ``at`` (Interaction3f that rays and emitter samples start from),
    ``valid`` (something was hit), ``surface`` (it is not a point in a medium), ``opl`` (Float64, optical length of the
    segment), ``β`` (throughput at its end), ``ray`` and ``leg`` (how it was reached). The scattering adds ``bsdf``,
    ``delay`` (DelaySample), ``connectable``; the loop adds ``goes_on``.
    """


class Proposal(Local):
    """Where a connection wants to connect to: ``d`` (unit Vector3f in the world), ``active``, and what is its own."""


class Answer(Local):
    """Scattering towards a proposal: ``value`` (what it makes of unpolarized light, in the frame of the segment towards
    the sensor), ``pdf`` (per solid angle, of the scattering's own sampling), ``eta`` (relative index on that side).
    """


class Step(Local):
    """The next direction ``out``: ``weight`` (value over pdf), ``pdf``, ``eta`` (relative index), ``delta`` (Bool),
    ``unconnected`` (no connection could have found what lies there), ``u_lobe`` and ``u_dir`` (its random numbers).
    """


class Event(Local):
    """Light that arrives: ``value`` (throughput included), ``opl`` (Float64, minus the film's start), ``active``,
    ``depth`` (UInt32, the smallest ``max_depth`` of a render that contains it).
    """


class EventTerm(Local):
    """An event with derivatives: ``value`` (attached, times the attached throughput), ``slope`` (Float: zero with the
    derivative of the arrival), ``opl`` (Float64, detached), ``active``.
    """


class Strategy:
    """A part of the walk. ``name`` is unique within a world and names its part of the record."""

    name = ""

    def prepare(self, world: Any) -> None:
        """Once a job, outside of traced code: what all lanes share."""

    def tables(self) -> list[Any]:
        """What ``prepare`` has computed of parameters: attached where they are."""
        return []

    def fields(self, world: Any) -> dict[str, Any]:
        """Types of the numbers that ``attached`` cannot recompute, by name. Random numbers of its own are called
        ``u`` (Point2f).
        """
        return {}

    def record(self, sample: Any) -> dict[str, Any]:
        """Those numbers for one sample: what ``arrive``, ``scatter``, or proposal and event were."""
        return {}


class Segment(Strategy):
    """From vertex to vertex along a straight line.

    ``leg`` is loop state of the strategy's own form: how the segment that is being followed ends.
    """

    name = "segment"

    def first(self, world: Any, ray: Any, sampler: Any) -> Any:
        """The leg of a primary ray."""
        raise NotImplementedError

    def depart(self, world: Any, ray: Any, vertex: Vertex, β: Any, sampler: Any, active: Any) -> Any:
        """The leg of ``ray``, which leaves ``vertex`` with throughput ``β``."""
        raise NotImplementedError

    def arrive(self, world: Any, path: Any) -> Vertex:
        """The vertex at the end of the current leg."""
        raise NotImplementedError

    def transmittance(self, world: Any, vertex: Vertex, ds: Any, u: Any, sampler: Any, active: Any) -> tuple[Any, Any]:
        """(whether the point ``ds`` (``p, d, dist``) can be seen, factor per colour). ``u``: numbers to draw with."""
        raise NotImplementedError

    def restore(self, v: Any, ray: Any) -> tuple[Any, Any]:
        """(Ray3f, PreliminaryIntersection3f) of a recorded vertex; ``ray`` is the primary one."""
        raise NotImplementedError

    def next_surface(self, world: Any, ray: Any, active: Any) -> Any:
        """The first surface along ``ray`` that a connection ends at."""
        raise NotImplementedError

    def end(self, world: Any, v: Any) -> Any:
        """Where a recorded vertex lies, without derivatives: a :class:`.vertex.VertexEnd`."""
        raise NotImplementedError

    def has_no_normal(self, end: Any) -> Any:
        """Mask of the :class:`.vertex.VertexEnd` that lie in a volume, None where none can."""
        return None

    def weight(self, v: Any) -> Any:
        """Recorded weight of the leg that led to vertex ``v``."""
        return 1

    def attached(self, world: Any, v: Any, carry: Any, wanted: Any) -> Any:
        """The :class:`.vertex.AttachedVertex` of a recorded one: slope and throughput of ``carry`` move to it."""
        raise NotImplementedError

    def attached_transmittance(self, world: Any, vertex: Any, connected: Any, active: Any) -> Any:
        """One with the derivative of the logarithm of the transmittance towards ``connected``: Local with attached
        ``p``, detached ``d``, ``far``, and ``ahead`` (whether the segment is the one to the next vertex).
        """
        return 1


class Connection(Strategy):
    """Light that is found at a vertex, or that a vertex is connected to."""

    def propose(self, world: Any, path: Any, vertex: Vertex, sampler: Any) -> Proposal | None:
        """A direction in which scattering is asked for, None where none is."""
        return None

    def connect(self, world: Any, path: Any, vertex: Vertex, proposal: Any, answer: Any, zeros: bool) -> Event:
        """The event. ``zeros`` (static): events of value zero matter, too."""
        raise NotImplementedError

    def density(self, world: Any, ref: Any, ds: Any, active: Any) -> Any:
        """Density per solid angle at ``ref`` with which this strategy finds the light's point ``ds``; the others ask
        for it to weigh their own samples. Zero where it never does.
        """
        return mi.Float(0)

    def claims(self, world: Any, emitter: Any, wanted: Any) -> Any:
        """Mask of the emitters that derivatives reach by this strategy alone; None for none."""
        return None

    def attached(self, world: Any, vertex: Any, step: Any, wanted: Any) -> list[EventTerm]:
        """The events of a recorded vertex with derivatives."""
        raise NotImplementedError


class Scattering(Strategy):
    """What happens to light at a vertex."""

    name = "scattering"

    def arrive(self, world: Any, path: Any, vertex: Vertex, sampler: Any) -> None:
        """Look up how the vertex scatters, before any connection is proposed."""
        raise NotImplementedError

    def scatter(self, world: Any, path: Any, vertex: Vertex, proposals: list, sampler: Any) -> tuple[list, Step]:
        """(an answer for each proposal, None for None; the next direction). All proposals come together, so that one
        virtual call can serve the first of them and the next direction.
        """
        raise NotImplementedError

    def evaluate(self, world: Any, vertex: Any, out: Any, active: Any, sampled: bool = False) -> Any:
        """A :class:`Local` with attached ``value``, ``pdf``, ``wo`` (local direction) and ``eta`` towards the attached
        world direction ``out``. ``sampled``: the direction was drawn by the scattering itself.
        """
        raise NotImplementedError

    def attached(self, world: Any, vertex: Any, wanted: Any) -> Any:
        """The next step with derivatives: Local with ``carry`` behind the vertex, ``inv_pdf`` of the recorded
        direction, ``ahead`` (the next vertex was found by a smooth lobe).
        """
        raise NotImplementedError


def mis_weight(pdf_a: Any, pdf_b: Any) -> Any:
    """Power heuristic, zero where both densities are."""
    a2 = dr.square(pdf_a)
    w = a2 / dr.fma(pdf_b, pdf_b, a2)
    return dr.select(dr.isfinite(w), w, 0)
