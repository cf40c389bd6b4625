"""Contracts of the walk: strategies, and the values that they exchange in one iteration of :func:`.walk.bounce`.

1. :class:`Segment` finds the :class:`Vertex` at the end of a straight line (``arrive``).
2. :class:`Scattering` looks up its BSDF or phase function (``arrive``).
3. Every :class:`Connection` may propose a direction towards light (``propose``).
4. :class:`Scattering` evaluates these directions and samples the next one (``scatter``).
5. Every :class:`Connection` returns an :class:`Event`, weighted and tested for visibility (``connect``); the sink
   receives it.
6. :class:`Segment` follows the next ray (``depart``); with a :class:`Guide` the density of a guided direction is
   computed behind it (``weigh``).

Every strategy has three forms:

- the primal one, as above;
- its record: ``fields`` (types) and ``record`` (values) of what derivatives cannot recompute, random numbers above all;
- the attached one (``attached``): the recorded vertex evaluated again with derivatives, from a
  :class:`.carry.Carry` to the next one and to :class:`EventTerm`. Forward and reverse mode follow from it.

Strategies return values. Only the loop changes a path, and only a sink changes its own state (:mod:`.sinks`). Films
receive events through a block (:class:`~torchtransient.plugins.films.block.FilmBlock`) and are read by derivatives
through an adjoint block.

Arguments that all methods share: ``context`` is the :class:`.context.RenderContext` of the job, ``path`` the
:class:`.walk.Path` before the vertex, ``vertex`` the :class:`Vertex` or :class:`AttachedVertex`, ``v`` a
:class:`.record.RecordedVertex`, ``sampler`` Mitsuba's sampler of the lanes, ``active`` a mask of lanes, ``wanted`` the
:class:`.context.Wanted` derivatives of the job. Every Float is one number per lane. ``value`` is a spectrum
(``mi.UnpolarizedSpectrum``), in polarized variants a Stokes vector. Lengths are metres, densities per solid angle
unless stated otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi


class Local:
    """Named values that live within one iteration of a loop.

    Not a dataclass: Dr.Jit would take it apart as loop state.
    """

    def __init__(self, **values: Any) -> None:
        vars(self).update(values)


class Vertex(Local):
    """End of a segment in the primal walk; ``path`` belongs to the segment before.

    Attributes:
        si: SurfaceInteraction3f, valid at surfaces (segment).
        at: Interaction3f that rays and emitter samples start from (segment; wavelengths by the scattering).
        valid: mask, the segment hit something (segment).
        surface: mask, the vertex is no point in a medium (segment).
        opl: optical length of the segment, Float64 (segment).
        β: throughput at the end of the segment (segment).
        ray, leg: ray and leg that found the vertex (segment).
        scatter, mei, medium: real collision, MediumInteraction3f and medium (segment through media).
        τ: optical path length up to the vertex, minus the film's start, Float64 (loop).
        η: index of refraction along the segment (loop).
        goes_on: mask, the path may have a further vertex (loop).
        bsdf: BSDF at the vertex (scattering).
        delay: delay of the scattering, DelaySample (scattering).
        scattered_si: ``si`` with the wavelengths behind the surface (scattering).
        connectable: mask, a connection can find light from here (scattering).
        scattered_τ: ``τ`` and the delay, where connections start to count (loop).
        velocity, rate: velocity, and rate of the path up to the vertex, of films that measure rates (loop).
    """


class Proposal(Local):
    """Direction that a connection asks the scattering for.

    Attributes:
        d: unit Vector3f in world space.
        active: mask, a subset of ``vertex.goes_on``, which keeps to ``max_depth``.
        ds: point of the light: ``p, n, d, dist, delta`` of a DirectionSample3f and ``emitter``, None for a light
            outside of the scene.

    Further attributes are the connection's own.
    """


class Answer(Local):
    """Scattering towards a proposal; undefined where the proposal is not active.

    Attributes:
        value: scattered part of unpolarized light, in the frame of the segment towards the sensor.
        pdf: density of the direction in the walk.
        eta: relative index of refraction on that side.
        matrix: ``value`` for polarized light, between the frames of the segment and of the connection.
    """


class Step(Local):
    """Sampled direction of the next segment.

    Attributes:
        out, wo: direction in world space and in the local frame.
        weight: value over density.
        pdf: density of the direction.
        eta: relative index of refraction.
        delta: mask, sampled by a delta lobe.
        unconnected: mask, no connection can find what lies ahead.
        u_lobe, u_dir, u_delay: random numbers of the sample.
    """


class GuidedPoint(Local):
    """Point on a surface, sampled by a :class:`Guide`.

    Attributes:
        p: Point3f.
        shape: ShapePtr.
        primitive: number of the triangle, None if irrelevant.
        n, uv: normal and texture coordinates of intersections there; both None if unknown, then a ray finds the point.
    """

    def __init__(self, p, shape, primitive=None, n=None, uv=None):
        super().__init__(p=p, shape=shape, primitive=primitive, n=n, uv=uv)


class Event(Local):
    """Light that arrives at the sensor.

    Attributes:
        value: contribution, throughput included; the loop zeroes it where inactive.
        opl: optical path length, minus the film's start, Float64.
        active: mask of lanes that have the event.
        depth: smallest ``max_depth`` of a render that contains it, UInt32.
        crowded: static; most lanes have the event at once, so that sums search no lanes with equal addresses.
        rate: derivative of ``opl`` by time, m/s (loop); None where the film does not measure it.

    Further attributes are the connection's own record.
    """

    crowded = False
    rate = None


class EventTerm(Local):
    """Event of a recorded vertex with derivatives.

    Attributes:
        value: attached contribution, times the attached throughput. Zero where inactive, by a selection before the
            product with the throughput: values of idle lanes must not reach the adjoint.
        slope: Float, zero with the derivative of the arrival.
        opl: detached optical path length, Float64.
        active: mask of lanes that have the event.
        arrival: ``v.arrival(name)`` of the recorded event of a connection, active wherever the term is; None for other
            terms, for which the film is read at ``opl``.
        rate: detached rate, m/s; None where the film does not measure it.
        rate_slope: Float, zero with the derivative of the rate, where ``wanted.rate``.
    """

    arrival = rate = rate_slope = None


def rate_of(event: Any) -> dict[str, Any]:
    """Return the rate of an event or a term as the keyword of film blocks, nothing where the film measures none.

    Args:
        event: :class:`Event` or :class:`EventTerm`.
    """
    return {} if event.rate is None else {"rate": event.rate}


@dataclass
class VertexEnd:
    """Place of a vertex without derivatives, as seen from the vertex before. Loop state of the reverse mode."""

    t: Any      # Float      distance along the ray that found it, which starts a little off the vertex before
    n: Any      # Normal3f   zero for points in a volume
    d: Any      # Vector3f   direction of that ray
    valid: Any  # Bool       something was hit

    @staticmethod
    def nowhere() -> VertexEnd:
        """Return the end that follows the last vertex of a path."""
        return VertexEnd(mi.Float(0), mi.Normal3f(0, 0, 1), mi.Vector3f(0, 0, 1), mi.Bool(False))


class AttachedVertex(Local):
    """Recorded vertex with derivatives.

    Attributes:
        v: :class:`.record.RecordedVertex`.
        si, sid: SurfaceInteraction3f, attached and detached (segment).
        end: :class:`VertexEnd` (segment).
        carry: :class:`.carry.Carry` with the throughput at the vertex (segment).
        slope: Float, zero with the derivative of the optical path length up to the vertex (segment).
        velocity: attached velocity, of films that measure rates (segment).
        rate_slope: Float, zero with the derivative of the rate up to the vertex, where ``wanted.rate`` (segment).
        damping_radius: distance below which points are dragged along, with moving geometry (segment).
        bsdf, delay: BSDF and delay of the scattering, see :class:`Vertex` (scattering).
        scattered_si: ``si`` with the wavelengths behind the surface (scattering).
        scattered_slope, scattered_opl: slope and optical path length behind the delay (scattering).
        rotation: rotation of Stokes vectors to the frame of the segment (scattering).
    """

    rate_slope = None


class Strategy:
    """Base of the parts of a walk.

    ``name`` is unique within a context and names a part of the record. Integrators create new strategies for every
    job: ``prepare`` may keep state.
    """

    name = ""

    def prepare(self, context: Any) -> None:
        """Compute the values that all lanes share: once a job, outside of traced code, with gradients enabled.

        Arrays that are kept must be evaluated (``dr.eval``): launches of a job differ in width, and Dr.Jit widens
        unevaluated ones to the width of the first launch that reads them.
        """

    def start(self, context: Any, rays: Any) -> None:
        """Compute values per lane of the primary ``rays``: before every launch, outside of traced code."""

    def tables(self) -> list[Any]:
        """Return the arrays that ``prepare`` computed from parameters, attached where these are."""
        return []

    def fields(self, context: Any) -> dict[str, Any]:
        """Return the types of the numbers that ``attached`` cannot recompute, by name."""
        return {}

    def record(self, sample: Any) -> dict[str, Any]:
        """Return these numbers for the sample of a vertex.

        Args:
            sample: :class:`Vertex` of a segment, :class:`Step` of a scattering, ``proposal`` and ``event`` of a
                connection.
        """
        return {}


class Segment(Strategy):
    """Straight line from vertex to vertex.

    A ``leg`` is the end of the current segment: loop state of the strategy's own form.
    """

    name = "segment"
    # Points near a vertex move along with it (``damped_motion``).
    drags = True
    # Further fields of the Carry that derivatives pass through.
    carried: tuple[str, ...] = ()

    def first(self, context: Any, ray: Any, sampler: Any) -> Any:
        """Return the leg of a primary ray (Ray3f)."""
        raise NotImplementedError

    def depart(
        self, context: Any, ray: Any, vertex: Vertex, β: Any, sampler: Any, active: Any, seen: bool = False
    ) -> Any:
        """Return the leg of a ray that leaves a vertex.

        Args:
            ray: Ray3f, which starts beside ``vertex``.
            β: throughput behind ``vertex``, which chooses among the colours of a medium.
            seen: the ray is part of a primary ray, which passes lights where ``context.hide_emitters``.
        """
        raise NotImplementedError

    def depart_guided(self, context: Any, ray: Any, vertex: Vertex, step: Step, sampler: Any, active: Any) -> Any:
        """Return the leg of a ray that a guide may have sent to a point.

        Args:
            ray: Ray3f, towards ``step.point`` where ``step.guided``.
            step: sampled direction; ``step.target`` is a :class:`GuidedPoint` with ``n`` and ``uv``, or None.
        """
        return self.depart(context, ray, vertex, vertex.β, sampler, active)

    def arrive(self, context: Any, path: Any) -> Vertex:
        """Return the vertex at the end of the current leg of ``path``."""
        raise NotImplementedError

    def surface_of(self, leg: Any) -> tuple[Any, Any]:
        """Return the surface at or behind the end of a leg.

        Returns:
            (PreliminaryIntersection3f of the next surface, mask of legs that end there).
        """
        raise NotImplementedError

    def interaction_of(self, leg: Any, ray: Any, flags: Any, active: Any = True) -> Any:
        """Return the SurfaceInteraction3f of the surface of a leg (:meth:`surface_of`).

        Args:
            ray: Ray3f of the leg.
            flags: RayFlags, fields that the result has at least.
        """
        raise NotImplementedError

    def leg_to(self, pi: Any, ray: Any) -> Any:
        """Return the leg of a primary ray whose first hit ``pi`` (PreliminaryIntersection3f) is known."""
        return pi

    def length_of(self, leg: Any) -> tuple[Any, Any]:
        """Return the length of a leg.

        Returns:
            (metres from the origin of its ray, Float; mask of legs that end at something).
        """
        raise NotImplementedError

    def material_displacement(self, context: Any, pi: Any, ray: Any, active: Any) -> Any:
        """Return the displacement of a hit as a material point of its shape: zero, with the derivative of the point.

        Args:
            pi: PreliminaryIntersection3f of the hit.
            ray: Ray3f that found it.

        Returns:
            Vector3f, attached to the parameters that move the shape.
        """
        raise NotImplementedError

    def ends_at(self, pi: Any, medium: Any) -> Any:
        """Return the leg that ends at a given surface.

        Args:
            pi: PreliminaryIntersection3f of the surface.
            medium: MediumPtr in front of it, see :meth:`medium_towards`; None in vacuum.
        """
        raise NotImplementedError

    def medium_towards(self, d: Any, vertex: Any = None) -> Any:
        """Return the medium of a ray that leaves a vertex, None in vacuum.

        Args:
            d: direction of the ray, Vector3f.
            vertex: vertex that it leaves, None for the sensor.
        """
        raise NotImplementedError

    def medium_at(self, context: Any, p: Any, start: Any, medium: Any, active: Any) -> Any:
        """Return the medium at the end of a straight line, None in vacuum.

        Args:
            p: end, Point3f.
            start: start of the line, Point3f.
            medium: medium at ``start``, on the side of ``p``.
        """
        raise NotImplementedError

    def share_of_surface(self, leg: Any) -> Any:
        """Return the share of a surface's motion along the ray that the end of a leg follows.

        One for legs that end at the surface. A collision in a medium divides the way to the surface behind it in a
        fixed ratio ``t / t_surface``, which is its share.
        """
        raise NotImplementedError

    def transmittance(
        self, context: Any, vertex: Vertex, ds: Any, u: Any, sampler: Any, active: Any, seen: bool = False
    ) -> tuple[Any, Any]:
        """Trace a shadow ray from a vertex.

        Args:
            ds: point of the light, with ``p``, ``d`` and ``dist`` of a DirectionSample3f.
            u: two uniform numbers, drawn for this vertex, which seed a generator.
            seen: the ray is part of a primary ray, which passes lights where ``context.hide_emitters``.

        Returns:
            (mask of points that are visible, transmittance per colour).
        """
        raise NotImplementedError

    def restore(self, v: Any, ray: Any) -> tuple[Any, Any]:
        """Return the ray and the hit of a recorded vertex.

        Args:
            ray: primary ray of its path, with time and wavelengths.

        Returns:
            (Ray3f, PreliminaryIntersection3f).
        """
        raise NotImplementedError

    def next_surface(self, context: Any, ray: Any, active: Any) -> Any:
        """Return the first hit (PreliminaryIntersection3f) along ``ray`` that ends a connection."""
        raise NotImplementedError

    def end(self, context: Any, v: Any) -> Any:
        """Return the :class:`VertexEnd` of a recorded vertex."""
        raise NotImplementedError

    def has_no_normal(self, end: Any) -> Any:
        """Return a mask of ends (:class:`VertexEnd`) in a volume, None without media."""
        return None

    def weight(self, v: Any) -> Any:
        """Return the recorded transmittance over density of the leg that led to vertex ``v``."""
        return 1

    def attached(self, context: Any, v: Any, carry: Any, wanted: Any) -> Any:
        """Return the recorded vertex with derivatives.

        Args:
            carry: attached :class:`.carry.Carry` of the path before the segment.

        Returns:
            :class:`AttachedVertex`, whose slope and throughput include the segment. Its ``end`` is that of :meth:`end`.
        """
        raise NotImplementedError

    def motion(self, context: Any, vertex: Any, following: Any, ahead: Any) -> Any:
        """Return the motion of the segment from an attached vertex to the next one.

        Args:
            vertex: :class:`AttachedVertex` at the start.
            following: :class:`VertexEnd` of the next vertex.
            ahead: mask of paths that a smooth lobe led there.

        Returns:
            Attached ``d`` (direction), ``J`` (one, with the relative derivative of the solid angle), ``drag`` (zero,
            with the sideways shift of the ray) and ``longer()`` (zero, with how much the start lengthens the segment),
            as of :class:`.geometry_terms.DampedMotion`.
        """
        raise NotImplementedError

    def attached_transmittance(self, context: Any, vertex: Any, connected: Any, active: Any) -> Any:
        """Return one, with the derivative of the logarithm of the transmittance towards a point.

        Args:
            connected: attached ``p``, detached ``d``, ``far`` (mask of points at infinity), ``ahead`` (static: the
                segment is the one to the next vertex).
        """
        return 1


class Connection(Strategy):
    """Strategy that finds light at a vertex: emission that was hit, or a point that is sampled on a light.

    A connection respects ``vertex.goes_on``, ``vertex.connectable`` and ``context.deep_enough``, masks with
    ``context.counted`` before it traces a shadow ray, weights its samples by :meth:`weight`, and adds lengths to
    ``vertex.scattered_τ`` with the index ``vertex.η * answer.eta``.
    """

    # All light comes from emitters of the scene, whose bounding box limits the remaining path length.
    light_of_scene_alone = False
    # The last vertex of a path can have an event: emission that was run into. False of connections that sample lights,
    # which the vertex before has used up.
    finds_light = True
    # The first vertex has no event, on any path of the job.
    dark_at_first = False
    # The segment of a proposal does not count in time.
    unwarp = False

    def events(self, wanted: Any) -> int:
        """Return the largest number of events at a vertex; of terms in a derivative (``wanted`` is not None)."""
        return 1

    def propose(self, context: Any, path: Any, vertex: Vertex, sampler: Any) -> Proposal | None:
        """Return a direction for the scattering to evaluate, None for a connection that needs none."""
        return None

    def connect(self, context: Any, path: Any, vertex: Vertex, proposal: Any, answer: Any, zeros: bool) -> Event:
        """Return the event of the vertex.

        Args:
            proposal, answer: result of :meth:`propose` and the scattering towards it, both None for none.
            zeros: static; visible events of value zero are active, since their derivatives can differ from zero,
                unless no attached parameter changes them.
        """
        raise NotImplementedError

    def end_velocity(self, context: Any, vertex: Any, proposal: Any) -> Any:
        """Return the velocity of the point that a proposal leads to (Vector3f, m/s)."""
        return context.velocities.of_sampled_light(context, vertex.at, proposal.ds, proposal.active)

    def rate_beyond(self, proposal: Any) -> Any:
        """Return the rate of the way beyond that point, m/s: of a connection that goes on from there."""
        return 0

    def density(self, context: Any, ref: Any, ds: Any, active: Any) -> Any:
        """Return the density with which the strategy samples a point of a light, None if it samples no points.

        Args:
            ref: Interaction3f that the light is seen from.
            ds: DirectionSample3f of the point.

        Returns:
            Density per solid angle (Float); for a light without extent the probability of its choice.
        """
        return None

    def weight(self, context: Any, ref: Any, ds: Any, density: Any, pdf: Any, active: Any) -> Any:
        """Return the multiple importance weight of a sample of this strategy.

        Args:
            ref: interaction that the light is seen from.
            ds: sampled point of the light.
            density: density of ``ds`` in this strategy.
            pdf: density of ``ds`` in the scattering, 0 where that cannot find it.
            active: mask of lanes.

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
        """Return a mask of lights whose derivatives this connection computes alone, None for none.

        Args:
            emitter: EmitterPtr.
            d: direction of the light from the vertex, Vector3f.
        """
        return None

    def numbers(self, recorded: dict[str, Any]) -> list[Any] | None:
        """Return two uniform numbers that were drawn at a vertex, None for none.

        Args:
            recorded: record of this strategy at the vertex, by name.
        """
        return None

    def attached(self, context: Any, vertex: Any, step: Any, wanted: Any) -> list[EventTerm]:
        """Return the events of a recorded vertex with derivatives.

        Args:
            vertex: :class:`AttachedVertex`.
            step: result of :meth:`Scattering.attached` there.
        """
        raise NotImplementedError


class Guide(Strategy):
    """Sampling of next vertices as points on surfaces, for a share of the samples of the scattering.

    A point counts only if its ray arrives there. The scattering weights samples by the densities of guides and its own
    together. A guide has no attached form: its vertices are differentiated as all others.
    """

    share = 0.5

    def share_at(self, depth: Any) -> Any:
        """Return the share of samples at vertices number ``depth`` (UInt32) of their paths.

        The shares of all guides sum to one only where they reach every direction of a scattering without delta lobes.
        """
        return self.share

    def draw(self, context: Any, vertex: Vertex, x: Any, y: Any) -> GuidedPoint:
        """Draw a point on a surface.

        Args:
            vertex: vertex that the next segment leaves.
            x, y: uniform numbers in [0, 1), Float64 and Float.
        """
        raise NotImplementedError

    def density(self, context: Any, p: Any, q: Any, n: Any, shape: Any, active: Any, primitive: Any = None) -> Any:
        """Return the density of a point on a surface, per solid angle (Float).

        Args:
            p: vertex that it is drawn from, Point3f.
            q, n: point, Point3f, and its normal.
            shape: ShapePtr of the point.
            primitive: number of its triangle, UInt32; None if unknown, for the density of any.
        """
        raise NotImplementedError


class Scattering(Strategy):
    """Scattering at surfaces or in media: evaluation towards proposals, sampling of the next direction."""

    name = "scattering"
    guides: Any = ()
    # Static: the value is zero wherever the density is, for all values of the parameters.
    samples_all = False

    def arrive(self, context: Any, path: Any, vertex: Vertex, sampler: Any) -> None:
        """Look up the scattering of a vertex, before connections propose directions."""
        raise NotImplementedError

    def scatter(self, context: Any, path: Any, vertex: Vertex, proposals: list, sampler: Any) -> tuple[list, Step]:
        """Evaluate the scattering towards the proposals and sample the next direction.

        All proposals come together: one virtual call serves the first of them and the next direction.

        Args:
            proposals: a :class:`Proposal` or None for each connection.

        Returns:
            (an :class:`Answer` for each proposal, None for None; the :class:`Step`).
        """
        raise NotImplementedError

    def weigh(self, context: Any, path: Any, vertex: Vertex, step: Step, ray: Any, leg: Any) -> None:
        """Set weight and density of a step by the end of its segment; called with guides alone.

        Args:
            step: :class:`Step` whose ``guided`` lanes a guide has drawn.
            ray: Ray3f of the segment.
            leg: leg of the ray.
        """

    def look_up_attached(self, context: Any, vertex: Any, wanted: Any) -> None:
        """Look up the scattering of an attached vertex, before :meth:`attached` and those of connections."""
        raise NotImplementedError

    def evaluate(self, context: Any, vertex: Any, out: Any, active: Any, sampled: bool = False, ds: Any = None) -> Any:
        """Evaluate an attached vertex towards a direction.

        Args:
            vertex: :class:`AttachedVertex`.
            out: attached direction in world space.
            sampled: the scattering sampled the direction itself.
            ds: point of a light in that direction, None otherwise.

        Returns:
            Attached ``value`` and ``pdf``, ``wo`` (local direction) and ``eta`` (relative index of refraction).
        """
        raise NotImplementedError

    def attached(self, context: Any, vertex: Any, wanted: Any) -> Any:
        """Return the next step of an attached vertex with derivatives.

        The record of a scattering has the mask ``delta``.

        Returns:
            ``carry`` behind the vertex, ``inv_pdf`` (one over the density of the recorded direction) and ``ahead``
            (mask of paths that a smooth lobe led to the next vertex).
        """
        raise NotImplementedError


def mis_weight(pdf_a: Any, pdf_b: Any) -> Any:
    """Return the weight of the power heuristic, zero where both densities are zero.

    Args:
        pdf_a: density of the strategy that drew the sample, Float.
        pdf_b: density, in the same measure, of the other one.
    """
    a2 = dr.square(pdf_a)
    w = a2 / dr.fma(pdf_b, pdf_b, a2)
    return dr.select(dr.isfinite(w), w, 0)
