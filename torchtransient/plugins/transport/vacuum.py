"""Segments through vacuum: straight lines from surface to surface.

Arguments that all methods share are explained in :mod:`.strategy`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.plugins.kernel_arrays import PointerTable, whole_numbers
from torchtransient.plugins.mitsuba_compat import mesh_faces, mesh_positions
from torchtransient.plugins.mitsuba_shapes import has_vertices
from torchtransient.plugins.sampling.area_elements import has_shading_normals
from torchtransient.plugins.sampling.rays import behind_area_lights
from torchtransient.plugins.transport.carry import slope_only
from torchtransient.plugins.transport.geometry_terms import EDGE_ON, damped_motion, displacement, material_point, slide
from torchtransient.plugins.transport.scene_contents import DAMPING
from torchtransient.plugins.transport.strategy import AttachedVertex, Local, Segment, Vertex, VertexEnd
from torchtransient.plugins.transport.surface_interactions import surface_interaction

# How a preliminary intersection is kept: its shape and instance as numbers in Dr.Jit's registry.
NUMBERS = {"t": "Float", "prim_uv": "Point2f", "prim_index": "UInt32", "shape_index": "UInt32"}


def intersection_fields(context, prefix=""):
    """Return the types of the numbers that record a preliminary intersection.

    Args:
        context: :class:`.context.RenderContext` of the job.
        prefix: prefix of their names.
    """
    pointers = ("shape", "instance") if context.contents.instances else ("shape",)
    return {prefix + name: getattr(mi, kind) for name, kind in NUMBERS.items()} | {
        prefix + name: mi.UInt32 for name in pointers
    }


def intersection_numbers(pi, prefix=""):
    """Return the numbers that record an intersection, by name.

    Args:
        pi: PreliminaryIntersection3f.
        prefix: put before each name.
    """
    values = {prefix + name: getattr(pi, name) for name in NUMBERS}
    return values | {prefix + n: dr.reinterpret_array(mi.UInt32, getattr(pi, n)) for n in ("shape", "instance")}


def intersection(numbers, active, prefix=""):
    """Return the recorded PreliminaryIntersection3f.

    Args:
        numbers: record, by name.
        active: mask of lanes that have one.
        prefix: prefix of the names.
    """
    pi = dr.zeros(mi.PreliminaryIntersection3f)
    for name in NUMBERS:
        setattr(pi, name, numbers[prefix + name])
    for name in ("shape", "instance"):
        if prefix + name in numbers:
            setattr(pi, name, dr.reinterpret_array(mi.ShapePtr, numbers[prefix + name]))
    pi.valid = active & (pi.t < dr.inf)
    return pi


def length_to(contents, p, q, valid, d):
    """Return the length of a segment, metres.

    Args:
        contents: :class:`.scene_contents.SceneContents`.
        p, q: ends, Point3f.
        valid: mask of segments that end at ``q``; others lead to distant light, or nowhere (length 0).
        d: direction of the segment.
    """
    length = dr.norm(dr.select(valid, q - p, mi.Vector3f(0, 0, 1)))
    if contents.distant is None:
        return dr.select(valid, length, 0)
    return dr.select(valid, length, contents.distant.length(p, d))


class Vacuum(Segment):
    """Segment through vacuum. A leg is the preliminary intersection at its end.

    In derivatives the first vertex and those behind delta lobes slide along the rays that found them. All others are
    material points: they move with their shapes, so that the integral over a surface that moves has no edges but where
    something hides it. Near points are dragged along with the vertex that sees them
    (:func:`~.geometry_terms.damped_motion`).
    """

    def prepare(self, context):
        self.meter_normal = None
        moving = frozenset() if context.wanted is None or not context.wanted.geometry else context.wanted.shapes
        # Where no shape moves, every vertex stays where it is but for what it is dragged along.
        self.triangles = AttachedTriangles(context.scene.shapes(), moving) if moving else None

    def start(self, context, rays):
        self.meter_normal = rays.meter_normal

    def tables(self):
        tables = [] if self.triangles is None else self.triangles.tables()
        return [table for table in tables if dr.grad_enabled(table)]

    # ------------------------------------------------------------------------------------------------- primal

    def first(self, context, ray, sampler):
        pi = context.scene.ray_intersect_preliminary(ray, coherent=True)
        return behind_area_lights(context.scene, ray, pi) if context.hide_emitters else pi

    def depart(self, context, ray, vertex, β, sampler, active, seen=False):
        pi = context.scene.ray_intersect_preliminary(ray, active=active)
        return behind_area_lights(context.scene, ray, pi) if seen and context.hide_emitters else pi

    def arrive(self, context, path):
        si, (leg, _) = self.interaction_of(path.leg, path.ray, mi.RayFlags.All), self.surface_of(path.leg)
        return Vertex(
            si=si, at=si, valid=si.is_valid(), surface=mi.Bool(True), β=path.β, ray=path.ray, leg=leg,
            opl=self.optical_length(context, path, si.p, si.is_valid()),
        )  # fmt: skip

    def optical_length(self, context, path, p, valid):
        """Return the optical length of the segment that ends at ``p``, measured between hit points.

        Args:
            path: :class:`.walk.Path` before the vertex, with the start ``prev_p`` and the index ``η`` of the segment.
            p: end, Point3f.
            valid: mask of segments that end at a surface; others lead to distant light.

        Returns:
            Metres times index, Float64. Zero for the first segment where ``context.camera_unwarp``.
        """
        length = dr.norm(p - path.prev_p)
        if context.contents.distant is not None:
            length = dr.select(valid, length, context.contents.distant.length(path.prev_p, path.ray.d))
        if context.camera_unwarp:
            length = dr.select(path.depth == 0, 0, length)
        return mi.Float64(length * path.η)

    def surface_of(self, leg):
        return leg, mi.Bool(True)

    def length_of(self, leg):
        return leg.t, leg.is_valid()

    def ends_at(self, pi, medium):
        return pi

    def medium_towards(self, d, vertex=None):
        return None

    def medium_at(self, context, p, start, medium, active):
        return None

    def share_of_surface(self, leg):
        return mi.Float(1)

    def interaction_of(self, leg, ray, flags, active=True):
        return leg.compute_surface_interaction(ray, flags, active)

    def transmittance(self, context, vertex, ds, u, sampler, active, seen=False):
        ray = vertex.at.spawn_ray_to(ds.p)
        if not (seen and context.hide_emitters):
            return active & ~context.scene.ray_test(ray, active), 1
        pi = behind_area_lights(context.scene, ray, context.scene.ray_intersect_preliminary(ray, active=active))
        return active & ~pi.is_valid(), 1

    def next_surface(self, context, ray, active):
        return context.scene.ray_intersect_preliminary(ray, active=active)

    # ------------------------------------------------------------------------------------------------- record

    def fields(self, context):
        shifted = context.contents.delays is not None and context.contents.delays.shifts
        of_ray = {"o": mi.Point3f, "d": mi.Vector3f} | ({"wavelengths": mi.UnpolarizedSpectrum} if shifted else {})
        return of_ray | intersection_fields(context)

    def record(self, vertex):
        ray = vertex.ray
        return {"o": ray.o, "d": ray.d, "wavelengths": ray.wavelengths} | intersection_numbers(vertex.leg)

    def restore(self, v, ray):
        r = v.record_of(self.name)
        wavelengths = r.get("wavelengths", ray.wavelengths)
        return mi.Ray3f(r["o"], r["d"], ray.time, wavelengths), intersection(r, v.active)

    # ----------------------------------------------------------------------------------------------- attached

    def end(self, context, v):
        si = v.pi.compute_surface_interaction(v.ray, mi.RayFlags.Minimal, v.active)
        return VertexEnd(si.t, si.n, v.ray.d, si.is_valid() & v.active)

    def attached(self, context, v, carry, wanted):
        start = carry.o
        if wanted.geometry:
            carry = self.from_meter(context, v, carry)
        ray = mi.Ray3f(v.ray)
        if not wanted.slides_position_only:
            ray.o, ray.d = carry.o, carry.d
        si = self.attached_surface(context, v, carry, ray, wanted, v.active)
        vertex = self.arrived(context, v, carry, ray, si, wanted)
        self.add_rate(context, vertex, start, wanted)
        return vertex

    def attached_surface(self, context, v, carry, ray, wanted, active):
        """Return the SurfaceInteraction3f of a recorded vertex, attached to its ray and to the surface.

        The hit moves along the ray as the surface moves. Where ``wanted.slides_position_only``, a shift ``carry.o`` of
        the ray is added to the position as a vector; else the ray itself is attached. Seen edge-on
        (:data:`.geometry_terms.EDGE_ON`) the hit stays: it would move by one over the cosine, which is rounding there.

        Args:
            carry: attached Carry that arrives there.
            ray: Ray3f of the segment, attached if need be.
        """
        si = surface_interaction(context.surfaces, v.pi, ray, mi.RayFlags.All, active)
        if wanted.slides_position_only:  # an attached ray would have every shape differentiated
            si.p = si.p + slide(displacement(carry.o, active), v.ray.d, dr.detach(si.n), active)
        if wanted.geometry:
            with dr.suspend_grad():
                edge_on = dr.abs_dot(si.n, v.ray.d) < EDGE_ON
            si = dr.select(edge_on, dr.detach(si), si)
        return si

    def arrived(self, context, v, carry, ray, si, wanted):
        """Return the attached vertex (:class:`.strategy.AttachedVertex`) at the end of a segment of known interaction.

        With the Carry's slope before the segment and its index η, the slope at the vertex is ``slope + η d|p - o|``. A
        sideways shift makes a ray no longer, so that the origin ``o`` is attached only where the ray is
        (``wanted.ray``).

        Args:
            carry: attached Carry before the segment.
            ray: Ray3f of the segment, attached if need be.
            si: attached SurfaceInteraction3f at its end.
        """
        vertex = AttachedVertex(v=v, si=si, sid=dr.detach(si), carry=carry, slope=carry.slope)
        valid = vertex.sid.is_valid()
        vertex.end = VertexEnd(vertex.sid.t, vertex.sid.n, v.ray.d, valid)
        if wanted.geometry:
            # Of what the path sees first, too: a floor without end says nothing of the things that stand on it.
            first = v.first(self.name, "t") * DAMPING
            vertex.damping_radius = dr.minimum(context.contents.damping_radius, first)
            si.wi = dr.select(valid, si.to_local(-carry.w), -carry.w)
            # Shifted sideways, a ray gets no longer.
            o = ray.o if wanted.ray else v.ray.o
            length = length_to(context.contents, o, si.p, valid, ray.d)
            if context.camera_unwarp:
                length = dr.select(v.k == 0, 0, length)
            vertex.slope = carry.slope + slope_only(carry.η * length)
        return vertex

    @staticmethod
    def add_rate(context, vertex, start, wanted):
        """Set velocity and slope of the rate of an attached vertex, for films that measure rates.

        The end of the segment counts here, of the first one its start too; of others the vertex that they leave has
        counted it.

        Args:
            start: attached start of the first segment, without a sideways shift of the ray.
        """
        velocities, v, carry = context.velocities, vertex.v, vertex.carry
        if velocities is None:
            return
        vertex.velocity = velocities.of_vertex(vertex, vertex.si, v.active & vertex.sid.is_valid())
        if not wanted.rate:
            return
        first = v.k == 0
        longer = carry.η * dr.dot(vertex.velocity - dr.select(first, velocities.of_sensor(start), 0), carry.w)
        longer = dr.select(first, 0, longer) if context.camera_unwarp else longer
        vertex.rate_slope = carry.rate + slope_only(longer)

    def motion(self, context, vertex, following, ahead):
        δ = displacement(vertex.scattered_si.p, ahead)
        return self.motion_to(context, vertex.v.after(), δ, following, ahead, vertex.damping_radius)

    def motion_to(self, context, after, δ, following, ahead, radius):
        """Return the motion of a segment from a point x, which moves by ``δ``, to a recorded vertex y.

        y is a material point and moves by ``v`` with its shape (:meth:`material_hits`; zero where no shape moves).
        Relative to y, the start moves by ``δ - v``, to which :func:`~.geometry_terms.damped_motion` gives the direction
        ``d - W (δ - v)_perp``, the solid angle ``J`` and a drag of y by the share ``a = 1 - W r``. To these come

            J     *= 1 + (1 - a) (dA / A + dn.d / n.d)    since the element of area and the normal at y move,
            drag  += v_perp                               so that the ray meets y where it went,
            longer = -δ.d                                 by the start alone: :meth:`arrived` counts the end.

        Args:
            after: :class:`.record.RecordedVertex` of y.
            δ: displacement of x, Vector3f: zero, with the derivative.
            following: :class:`.strategy.VertexEnd` of y.
            ahead: mask of paths that a smooth lobe led to y.
            radius: damping radius, metres: nearer points are dragged along.

        Returns:
            Attached ``d``, ``J``, ``drag`` and ``longer()``, see :meth:`~.strategy.Segment.motion`.
        """
        d, volume = mi.Vector3f(following.d), self.has_no_normal(following)
        if self.triangles is None:
            return damped_motion(δ, d, following.t, following.n, ahead, radius, volume=volume)
        surface = ahead if volume is None else ahead & ~volume
        p, n, area = self.material_hits(context, after.pi, after.ray, following.n, surface)
        moved = displacement(p, surface)
        motion = damped_motion(δ - moved, d, following.t, following.n, ahead, radius, volume=volume)
        J = motion.J * dr.select(surface, motion.of_material(n, dr.relative_grad(area)), 1)
        # A ray that is shifted across with a point of a shape meets it where it went.
        drag = motion.drag + (moved - d * dr.dot(d, moved))
        return Local(d=motion.d, J=J, drag=drag, longer=lambda: -dr.dot(δ, d))

    def material_hits(self, context, pi, ray, n, active):
        """Return recorded hits as material points: attached to the parameters that move their shapes.

        A material point keeps its coordinates (u, v) on its triangle with the corners a, b, c:

            p = a + u (b - a) + v (c - a),    n ~ (b - a) x (c - a),    A = |(b - a) x (c - a)|.

        Triangles that move are gathered from :class:`AttachedTriangles`; for other shapes Mitsuba computes the same
        (:func:`~.geometry_terms.material_point`). Shapes without material points (``contents.sliding``) stay where they
        are.

        Args:
            pi: PreliminaryIntersection3f of the hits.
            ray: Ray3f that found them.
            n: their detached normals, whose side the results take.

        Returns:
            (p, Point3f; n, Normal3f; A, Float, of which only the relative derivative counts).
        """
        with dr.suspend_grad():
            if context.contents.sliding is not None:
                active = active & ~context.contents.sliding.lists(pi.shape)
            listed = active & self.triangles.lists(pi.shape)
            at = ray(pi.t)
        point = self.triangles.point(pi, listed)
        twice = dr.norm(point.across)
        across = dr.mulsign(point.across / twice, dr.dot(point.across, n))
        if self.triangles.holds_all:
            return dr.select(listed, point.p, at), dr.select(listed, across, n), dr.select(listed, twice, 1)
        other = active & ~listed
        si, area = material_point(pi, ray, other, context.contents.meshes, context.surfaces)
        p, n = dr.select(other, si.p, at), dr.select(other, si.n, n)
        return dr.select(listed, point.p, p), dr.select(listed, across, n), dr.select(listed, twice, area)

    def material_displacement(self, context, pi, ray, active):
        """Return the displacement of a hit as a material point, see :meth:`~.strategy.Segment.material_displacement`.
        """
        if self.triangles is None:
            return mi.Vector3f(0)
        p, _, _ = self.material_hits(context, pi, ray, mi.Normal3f(0, 0, 1), active & pi.is_valid())
        return displacement(p, active & pi.is_valid())

    def from_meter(self, context, v, carry):
        """Return the Carry of paths from an irradiance meter at rest, whose first vertex is a material point, too.

        No pixel holds the rays of a meter, so that its first vertex may move as all others do. With the motion of the
        segment to it from a start at rest, the throughput is multiplied by ``J`` and by the relative change of the
        cosine at the meter.

        Args:
            v: :class:`.record.RecordedVertex`; other vertices than the first keep their Carry.
            carry: attached Carry that arrives there.
        """
        if self.meter_normal is None:
            return carry
        first = v.active & (v.k == 0)
        with dr.suspend_grad():
            end = self.end(context, v)
        radius = context.contents.damping_radius
        motion = self.motion_to(context, v, mi.Vector3f(0), end, first & end.valid, radius)
        n = dr.select(first, self.meter_normal, mi.Normal3f(v.ray.d))
        cos = dr.abs_dot(n, motion.d)
        # Of rays edge-on to the meter the cosine is rounding, and its relative change is one over it.
        J = motion.J * dr.relative_grad(dr.select(first & (dr.detach(cos) > EDGE_ON), cos, 1))
        return replace(
            carry,
            β=carry.β * dr.select(first, J, 1),
            o=carry.o + dr.select(first, motion.drag, 0),
            w=dr.select(first, dr.replace_grad(mi.Vector3f(carry.w), carry.w + (motion.d - end.d)), carry.w),
        )


# --------------------------------------------------------------------------------------------------------------------
# Points of meshes whose vertices are attached, from one table: three vertices are gathered, and nothing else.
#
# What Mitsuba says of a point is a virtual call for each thing asked, and each back-propagates to the vertices on its
# own: many times the sums of one gather.

class AttachedTriangles:
    """Triangles of meshes whose vertices are attached and whose normals are those of their planes, in one table.

    A plain object, which Dr.Jit loops leave alone.

    Args:
        shapes: shapes of the scene.
        moving: pointers of the shapes that move.

    Attributes:
        holds_all: the table has all shapes that move.
    """

    def __init__(self, shapes: list[Any], moving: frozenset[Any]) -> None:
        meshes = [s for s in shapes if s.ptr in moving and _is_listed(s)]
        self.holds_all = moving <= {mesh.ptr for mesh in meshes}
        corners, starts, vertices, faces = [], [], 0, 1
        for mesh in meshes:
            corners.append(np.array(mesh_faces(mesh), dtype=np.int64) + vertices)
            starts.append(faces)
            vertices, faces = vertices + mesh.vertex_count(), faces + mesh.face_count()
        # Shapes that are not listed begin at 0.
        self.starts = PointerTable(meshes, starts) if meshes else None
        self.corners = whole_numbers(np.concatenate(corners)) if meshes else None
        self.vertices = _joined([mesh_positions(mesh) for mesh in meshes])

    def tables(self) -> list[Any]:
        """Return the attached arrays."""
        return [] if self.vertices is None else [self.vertices]

    def lists(self, shape: Any) -> Any:
        """Return a mask of pointers to shapes in the table."""
        return mi.Mask(False) if self.starts is None else self.starts.look_up(shape) > 0

    def point(self, pi: Any, active: Any) -> Local:
        """Return hits on listed triangles as material points.

        Args:
            pi: PreliminaryIntersection3f of the hits.
            active: mask of hits on listed shapes.

        Returns:
            Attached ``p`` (Point3f) and ``across`` (Vector3f): twice the area, along the normal of either side.
        """
        if self.starts is None:
            return Local(p=mi.Point3f(0), across=mi.Vector3f(0, 0, 1))
        with dr.suspend_grad():
            face = (self.starts.look_up(pi.shape, active) - 1 + pi.prim_index) * 3
            corners = [dr.gather(mi.UInt32, self.corners, face + i, active) for i in range(3)]
        a, b, c = (dr.gather(mi.Point3f, self.vertices, corner, active) for corner in corners)
        along, other = b - a, c - a
        across = dr.select(active, dr.cross(along, other), mi.Vector3f(0, 0, 1))
        return Local(p=a + along * pi.prim_uv.x + other * pi.prim_uv.y, across=across)


def _is_listed(shape: Any) -> bool:
    return has_vertices(shape) and dr.grad_enabled(mesh_positions(shape)) and not has_shading_normals(shape)


def _joined(buffers: list[Any]) -> Any:
    """Return the buffers as one, attached to all; None for none."""
    if len(buffers) < 2:
        return buffers[0] if buffers else None
    joined, first = dr.zeros(mi.Float, sum(map(dr.width, buffers))), 0
    for buffer in buffers:
        dr.scatter(joined, buffer, first + dr.arange(mi.UInt32, dr.width(buffer)))
        first += dr.width(buffer)
    return joined
