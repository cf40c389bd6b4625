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

from dataclasses import dataclass
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
    """The end of a segment in the primal walk. Connections read it; ``path`` still belongs to the segment before.

    From the segment: ``si`` (SurfaceInteraction3f, valid at surfaces), ``at`` (Interaction3f that rays and emitter
    samples start from), ``valid`` (something was hit), ``surface`` (it is not a point in a medium), ``opl`` (Float64,
    optical length of the segment), ``β`` (throughput at its end), ``ray`` and ``leg`` (how it was reached); in media
    also ``scatter, mei, medium``. From the loop: ``τ`` (Float64, optical path length up to it), ``η`` (index along the
    segment), ``goes_on`` (the path may have a further vertex). From the scattering: ``bsdf``, ``delay``
    (DelaySample), ``scattered_si`` and ``at`` with the wavelengths beyond the surface, ``connectable`` (light can be
    found by connecting to it), ``scattered_τ`` (``τ`` and the delay: where connections start to count).
    """


class Proposal(Local):
    """Where a connection wants to connect to: ``d`` (unit Vector3f in the world), ``active`` (a subset of
    ``vertex.goes_on``, which keeps to ``max_depth``), ``ds`` (what lies there: ``p, n, d, dist, delta`` of a
    DirectionSample3f and its ``emitter``, None for a light that is no part of the scene), and what is the connection's
    own.
    """


class Answer(Local):
    """Scattering towards a proposal: ``value`` (what it makes of unpolarized light, in the frame of the segment towards
    the sensor), ``pdf`` (per solid angle, with which the walk would have gone there), ``eta`` (relative index on that
    side). ``matrix``: that value between the frames of the segment and of the connection, for light that may be
    polarized. Not defined where the proposal is not active.
    """


class Step(Local):
    """The next direction ``out`` (``wo`` in the local frame): ``weight`` (value over pdf), ``pdf``, ``eta`` (relative
    index), ``delta`` (Bool), ``unconnected`` (no connection could have found what lies there), the random numbers
    ``u_lobe, u_dir, u_delay``.
    """


class GuidedPoint(Local):
    """A point on a surface that a :class:`Guide` has drawn: ``p``, ``shape`` (ShapePtr), ``primitive`` (the number of
    its triangle, None where that does not matter), and ``n`` and ``uv`` as intersections have them, both None where
    they are not known: then a ray has to find the point.
    """

    def __init__(self, p, shape, primitive=None, n=None, uv=None):
        super().__init__(p=p, shape=shape, primitive=primitive, n=n, uv=uv)


class Event(Local):
    """Light that arrives: ``value`` (throughput included), ``opl`` (Float64, minus the film's start), ``active``,
    ``depth`` (UInt32, the smallest ``max_depth`` of a render that contains it), and what the strategy records of it.
    The loop makes ``value`` zero where it is not active. ``crowded`` (static): most paths have it at once, so that sums
    are added up without a search for lanes that share an address.
    """

    crowded = False


class EventTerm(Local):
    """An event with derivatives: ``value`` (attached, times the attached throughput), ``slope`` (Float: zero with the
    derivative of the arrival), ``opl`` (Float64, detached), ``active``; ``arrival``, as ``v.arrival(name)`` says,
    where it is the recorded event of a connection, which then was active wherever the term is.

    ``value`` has to be zero where it is not active, selected before it is multiplied with the throughput: what an idle
    lane holds must not reach the adjoint.
    """

    # Otherwise the film is asked for the adjoint at ``opl``.
    arrival = None


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


class Strategy:
    """A part of the walk. ``name`` is unique within a world and names its part of the record. Integrators make new
    strategies for every job, so that ``prepare`` may keep what it likes.
    """

    name = ""

    def prepare(self, context: Any) -> None:
        """Once a job, outside of traced code, with gradients enabled: what all lanes share. Arrays that are kept are
        evaluated (``dr.eval``): launches of a job differ in width, and the first one that reads others may widen
        them to its own.
        """

    def start(self, context: Any, rays: Any) -> None:
        """Before every launch, outside of traced code: what is told by the lane (``rays``: its primary rays)."""

    def tables(self) -> list[Any]:
        """What ``prepare`` has computed of parameters: attached where they are."""
        return []

    def fields(self, context: Any) -> dict[str, Any]:
        """Types of the numbers that ``attached`` cannot recompute, by name."""
        return {}

    def record(self, sample: Any) -> dict[str, Any]:
        """Those numbers for one sample: what ``arrive``, ``scatter``, or proposal and event were."""
        return {}


class Segment(Strategy):
    """From vertex to vertex along a straight line.

    ``leg`` is loop state of the strategy's own form: how the segment that is being followed ends.
    """

    name = "segment"
    # Whether near points are dragged along with the vertex that sees them (``damped_motion``).
    drags = True
    # Fields of the Carry that derivatives go through for its sake.
    carried: tuple[str, ...] = ()

    def first(self, context: Any, ray: Any, sampler: Any) -> Any:
        """The leg of a primary ray."""
        raise NotImplementedError

    def depart(
        self, context: Any, ray: Any, vertex: Vertex, β: Any, sampler: Any, active: Any, seen: bool = False
    ) -> Any:
        """The leg of ``ray``, which leaves ``vertex`` with throughput ``β``. ``seen``: it is part of a primary ray,
        which lights are hidden from where ``context.hide_emitters``.
        """
        raise NotImplementedError

    def depart_guided(self, context: Any, ray: Any, vertex: Vertex, step: Step, sampler: Any, active: Any) -> Any:
        """The same where some rays were sent to a point by a guide: ``step.guided``, ``step.point``, and in
        ``step.target`` what is known of it (Local with ``n`` and ``uv``, or None).
        """
        return self.depart(context, ray, vertex, vertex.β, sampler, active)

    def arrive(self, context: Any, path: Any) -> Vertex:
        """The vertex at the end of the current leg. Sensors do not see lights where ``context.hide_emitters``."""
        raise NotImplementedError

    def surface_of(self, leg: Any) -> tuple[Any, Any]:
        """(PreliminaryIntersection3f of the next surface, whether the leg ends there)."""
        raise NotImplementedError

    def found(self, leg: Any, ray: Any, flags: Any, active: Any = True) -> Any:
        """SurfaceInteraction3f of the next surface along ``ray``, with what the ``flags`` ask for at least."""
        raise NotImplementedError

    def known(self, pi: Any, ray: Any) -> Any:
        """The leg of a primary ray whose PreliminaryIntersection3f is known."""
        return pi

    def length_of(self, leg: Any) -> tuple[Any, Any]:
        """(length of ``leg`` from the origin of its ray, whether something is there)."""
        raise NotImplementedError

    def held(self, context: Any, pi: Any, ray: Any, active: Any) -> Any:
        """Zero with how far derivatives move the surface point ``pi``, found by ``ray``, as a point of its shape."""
        raise NotImplementedError

    def ends_at(self, pi: Any, medium: Any) -> Any:
        """The leg that ends at the surface ``pi``, in the ``medium`` that :meth:`medium_towards` says."""
        raise NotImplementedError

    def medium_towards(self, d: Any, vertex: Any = None) -> Any:
        """The medium of a ray that leaves ``vertex`` (None: the sensor) in direction ``d``, None in vacuum."""
        raise NotImplementedError

    def medium_at(self, context: Any, p: Any, start: Any, medium: Any, active: Any) -> Any:
        """The medium at ``p``, where that at the point ``start`` is ``medium`` on the side of ``p``; None in vacuum."""
        raise NotImplementedError

    def share_of_surface(self, leg: Any) -> Any:
        """How much of the motion of the surface behind it the end of ``leg`` follows."""
        raise NotImplementedError

    def transmittance(
        self, context: Any, vertex: Vertex, ds: Any, u: Any, sampler: Any, active: Any, seen: bool = False
    ) -> tuple[Any, Any]:
        """(whether the point ``ds`` (``p, d, dist``) can be seen, factor per colour). ``u``: two uniform
        numbers that were drawn for this vertex and serve as the start of a generator. ``seen``: as of :meth:`depart`.
        """
        raise NotImplementedError

    def restore(self, v: Any, ray: Any) -> tuple[Any, Any]:
        """(Ray3f, PreliminaryIntersection3f) of a recorded vertex; ``ray`` is the primary one."""
        raise NotImplementedError

    def next_surface(self, context: Any, ray: Any, active: Any) -> Any:
        """The first surface along ``ray`` that a connection ends at."""
        raise NotImplementedError

    def end(self, context: Any, v: Any) -> Any:
        """Where a recorded vertex lies, without derivatives: a :class:`.vertex.VertexEnd`."""
        raise NotImplementedError

    def has_no_normal(self, end: Any) -> Any:
        """Mask of the :class:`.vertex.VertexEnd` that lie in a volume, None where none can."""
        return None

    def weight(self, v: Any) -> Any:
        """Recorded weight of the leg that led to vertex ``v``."""
        return 1

    def attached(self, context: Any, v: Any, carry: Any, wanted: Any) -> Any:
        """The :class:`.vertex.AttachedVertex` of a recorded one: slope and throughput of ``carry`` move to it, and its
        ``end`` is what :meth:`end` says.
        """
        raise NotImplementedError

    def motion(self, context: Any, vertex: Any, following: Any, ahead: Any) -> Any:
        """How the segment from an attached ``vertex`` to the one that is ``following`` it moves where that one lies
        ``ahead`` (mask): attached ``d``, ``J``, ``drag`` and ``longer()`` as a
        :class:`.scattering.geometry_terms.DampedMotion` has them.
        """
        raise NotImplementedError

    def attached_transmittance(self, context: Any, vertex: Any, connected: Any, active: Any) -> Any:
        """One with the derivative of the logarithm of the transmittance towards ``connected``: Local with attached
        ``p``, detached ``d``, ``far``, and ``ahead`` (whether the segment is the one to the next vertex).
        """
        return 1


class Connection(Strategy):
    """Light that is found at a vertex, or that a vertex is connected to.

    What a connection owes: it keeps to ``vertex.goes_on``, ``vertex.connectable`` and ``context.deep_enough``, asks
    ``context.counted`` before it traces a shadow ray, weighs its samples by :meth:`weight`, and counts time from
    ``vertex.scattered_τ`` along ``vertex.η * answer.eta``.
    """

    # Whether all of its light is that of the scene's emitters, so that their box bounds where it can come from.
    light_of_scene_alone = False
    # Whether it may have an event at the last vertex of a path, from where nothing is connected any more.
    finds_light = True
    # Whether it has no event at the first vertex, of any path of the job.
    dark_at_first = False

    def events(self, wanted: Any) -> int:
        """Events that it has at a vertex at most; in a derivative (``wanted`` is not None) the number of terms."""
        return 1

    def propose(self, context: Any, path: Any, vertex: Vertex, sampler: Any) -> Proposal | None:
        """A direction in which scattering is asked for, None where none is."""
        return None

    def connect(self, context: Any, path: Any, vertex: Vertex, proposal: Any, answer: Any, zeros: bool) -> Event:
        """The event. ``zeros`` (static): events of value zero matter for a derivative, so that the visible ones of
        them are active, too, unless no attached parameter can change them.
        """
        raise NotImplementedError

    def density(self, context: Any, ref: Any, ds: Any, active: Any) -> Any:
        """Density with which this strategy samples the light's point ``ds`` from ``ref``: per solid angle, and for a
        light without extent the probability of choosing it. None where it samples none.
        """
        return None

    def weight(self, context: Any, ref: Any, ds: Any, density: Any, pdf: Any, active: Any) -> Any:
        """Weight of a sample ``ds`` of this strategy, which has the density ``density`` for it; ``pdf``: that with
        which scattering finds it, 0 where it cannot.

        All connections count as one technique of density ``B = sum b_i`` beside scattering with density ``A`` (power
        heuristic), and share its weight by their densities: ``b_i / B * B^2 / (A^2 + B^2)``. A strategy of another file
        that samples lights changes the weights of all by its ``density`` alone.
        """
        others = [c.density(context, ref, ds, active) for c in context.connections if c is not self]
        others = [other for other in others if other is not None]
        if not others:
            return mis_weight(density, pdf)
        total = density + sum(others)
        return dr.select(total > 0, density / total, 0) * mis_weight(total, pdf)

    def claims(self, context: Any, emitter: Any, d: Any, wanted: Any) -> Any:
        """Mask of the emitters, in the direction ``d``, that derivatives reach by connections alone; None for none."""
        return None

    def numbers(self, recorded: dict[str, Any]) -> list[Any] | None:
        """Two uniform numbers out of the record that were drawn at the vertex, None where there are none."""
        return None

    def attached(self, context: Any, vertex: Any, step: Any, wanted: Any) -> list[EventTerm]:
        """The events of a recorded vertex with derivatives."""
        raise NotImplementedError


class Guide(Strategy):
    """Draws some of the next vertices in place of the scattering: a point, which counts only if the ray arrives there.

    ``share`` of all samples are its own; the scattering weighs them by the densities of guides and scattering together.
    It needs no attached form: the vertex is differentiated as every other one.
    """

    share = 0.5

    def share_at(self, depth: Any) -> Any:
        """Its share of the samples at the vertices number ``depth`` of their paths (UInt32). All shares of a vertex may
        sum to one only where the guides reach all that the scattering does, and it has no delta lobe.
        """
        return self.share

    def draw(self, context: Any, vertex: Vertex, x: Any, y: Any) -> GuidedPoint:
        """A point on a surface for two uniform numbers (Float64, Float)."""
        raise NotImplementedError

    def density(self, context: Any, p: Any, q: Any, n: Any, shape: Any, active: Any, primitive: Any = None) -> Any:
        """Density per solid angle at ``p`` with which it draws the point ``q`` (normal ``n``) of ``shape``.
        ``primitive``: the number of the shape's triangle, None where it is not known: then it is that of any.
        """
        raise NotImplementedError


class Scattering(Strategy):
    """What happens to light at a vertex. Which indices of refraction and delta lobes there are follows from the scene's
    contents.
    """

    name = "scattering"
    guides: Any = ()
    # Static: whether its value is zero wherever its density is, for all values of its parameters.
    samples_all = False

    def arrive(self, context: Any, path: Any, vertex: Vertex, sampler: Any) -> None:
        """Look up how the vertex scatters, before any connection is proposed."""
        raise NotImplementedError

    def scatter(self, context: Any, path: Any, vertex: Vertex, proposals: list, sampler: Any) -> tuple[list, Step]:
        """(an answer for each proposal, None for None; the next direction). All proposals come together, so that one
        virtual call can serve the first of them and the next direction.
        """
        raise NotImplementedError

    def weigh(self, context: Any, path: Any, vertex: Vertex, step: Step, ray: Any, leg: Any) -> None:
        """With guides: weight and density of ``step``, once it is known how its segment ends."""

    def look_up_attached(self, context: Any, vertex: Any, wanted: Any) -> None:
        """Look up how an attached vertex scatters, before :meth:`attached` and the connections'."""
        raise NotImplementedError

    def evaluate(self, context: Any, vertex: Any, out: Any, active: Any, sampled: bool = False, ds: Any = None) -> Any:
        """A :class:`Local` with attached ``value``, ``pdf``, ``wo`` (local direction) and ``eta`` towards the attached
        world direction ``out``. ``sampled``: the direction was drawn by the scattering itself. ``ds``: what lies there,
        if it is a light's point.
        """
        raise NotImplementedError

    def attached(self, context: Any, vertex: Any, wanted: Any) -> Any:
        """The next step with derivatives: Local with ``carry`` behind the vertex, ``inv_pdf`` of the recorded
        direction, ``ahead`` (the next vertex was found by a smooth lobe). Its record has the mask ``delta``.
        """
        raise NotImplementedError


def mis_weight(pdf_a: Any, pdf_b: Any) -> Any:
    """Power heuristic, zero where both densities are."""
    a2 = dr.square(pdf_a)
    w = a2 / dr.fma(pdf_b, pdf_b, a2)
    return dr.select(dr.isfinite(w), w, 0)
