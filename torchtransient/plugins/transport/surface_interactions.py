"""Surface interactions with derivatives in scenes that have instances of shape groups.

Mitsuba's instance detaches its normal, its frame and the ray, and refuses derivatives of its own parameters beside
those of the shapes in its group. Here the interaction is the one of the shape in its group, with the ray in the group's
space, brought back by the matrix of the instance: all three are attached, each by itself.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.plugins.kernel_arrays import PointerTable, registry_number
from torchtransient.plugins.mitsuba_shapes import attached_distance, is_instance, leaves_hits_detached, misplaces_hits
from torchtransient.plugins.node_walk import shapes_of_scene, shown_by

# Entries of a matrix; the table holds it and its inverse, so that no lane inverts matrices.
_ENTRIES = 16


class Instances:
    """The instances of a scene. Does not change once built."""

    def __init__(self, instances: Sequence[Any]) -> None:
        self._shown = [
            (node, next(value for value in shown_by(node)[0] if value.key == "to_world")) for node in instances
        ]
        self._numbers = [registry_number(node) for node in instances]
        # What is no instance stays where it is.
        self._identities = mi.Float(np.tile(np.eye(4, dtype=np.float32).reshape(-1), 2 * (1 + max(self._numbers))))

    @staticmethod
    def from_scene(scene: Any) -> Instances | None:
        """Return the instances of ``scene``, None without."""
        found = [shape for shape in scene.shapes() if is_instance(shape)]
        return Instances(found) if found else None

    def read(self) -> InstanceTable:
        """Return the table of the current matrices, attached where they are. Call outside of loops, once a job."""
        with dr.resume_grad():
            table = mi.Float(self._identities)
            for number, (node, shown) in zip(self._numbers, self._shown, strict=True):
                matrix = mi.Matrix4f(shown.read(node).matrix)
                first = dr.arange(mi.UInt32, _ENTRIES) + 2 * number * _ENTRIES
                dr.scatter(table, dr.ravel(matrix, order="C"), first)
                dr.scatter(table, dr.ravel(dr.rcp(matrix), order="C"), first + _ENTRIES)
            return InstanceTable(table)

    @contextmanager
    def detached(self) -> Iterator[None]:
        """Hide from Mitsuba, for as long as derivatives are taken, that the matrices are attached. It would refuse to
        trace anything where parameters of the shapes in their groups are attached beside them.
        """
        with dr.resume_grad():
            attached = [(shown, mi.AffineTransform4f(shown.read(node))) for node, shown in self._shown]
            attached = [(shown, matrix) for shown, matrix in attached if dr.grad_enabled(matrix)]
        try:
            for shown, matrix in attached:
                mi.set_property(shown.handle, shown.cpptype, dr.detach(matrix))
            yield
        finally:
            with dr.resume_grad():
                for shown, matrix in attached:
                    mi.set_property(shown.handle, shown.cpptype, matrix)


class InstanceTable:
    """The matrices of the instances by their number in Dr.Jit's registry; for every other shape the identity.

    Not a dataclass on purpose: Dr.Jit loops would take it apart as loop state.
    """

    def __init__(self, table: Any) -> None:
        self.table = table

    def _matrices(self, instance: Any) -> tuple[Any, Any]:
        """(matrix, its inverse) by instance pointer, the identity for null."""
        row = 2 * dr.reinterpret_array(mi.UInt32, instance)
        return dr.gather(mi.Matrix4f, self.table, row), dr.gather(mi.Matrix4f, self.table, row + 1)

    def to_world(self, instance: Any, v: Any) -> Any:
        """Return a vector of the space of an ``instance`` (pointer) in the world, attached to both."""
        return _vector(self._matrices(instance)[0], v)

    def interaction(self, pi: Any, ray: Any, flags: int, active: Any, hits: HitTable | None) -> Any:
        """Return the attached interaction, see :func:`surface_interaction`."""
        with dr.suspend_grad():
            si = pi.compute_surface_interaction(ray, flags, active)
            valid = si.is_valid()
        M, inverse = self._matrices(si.instance)
        local_ray = mi.Ray3f(ray)
        # Selected before the products: what an idle lane holds must not reach the matrices, which all lanes share.
        local_ray.o = _point(inverse, dr.select(valid, ray.o, 0))
        local_ray.d = _vector(inverse, dr.select(valid, ray.d, mi.Vector3f(0, 0, 1)))
        if hits is not None:
            pi = hits.attach(pi, si.shape, local_ray, valid)
        local = si.shape.compute_surface_interaction(local_ray, pi, flags, valid)
        if hits is not None and not mi.has_flag(flags, mi.RayFlags.FollowShape):
            hits.put_right(local, pi, valid)

        # What Mitsuba found keeps its value to the bit.
        si.p = dr.replace_grad(si.p, _point(M, local.p))
        t = local.t
        if mi.has_flag(flags, mi.RayFlags.FollowShape):
            t = dr.norm(dr.select(valid, si.p - ray.o, mi.Vector3f(1))) * dr.rsqrt(dr.squared_norm(ray.d))
        si.t = dr.replace_grad(si.t, dr.select(valid, t, 0))
        si.n = dr.replace_grad(si.n, _normal(inverse, local.n, valid))
        if mi.has_flag(flags, mi.RayFlags.ShadingFrame):
            # Zero where nothing was hit, as all that a masked call answers.
            si.uv = dr.replace_grad(si.uv, local.uv)
            si.dp_du = dr.replace_grad(si.dp_du, _vector(M, local.dp_du))
            si.dp_dv = dr.replace_grad(si.dp_dv, _vector(M, local.dp_dv))
            n = _normal(inverse, local.sh_frame.n, valid)
            si.sh_frame = dr.replace_grad(si.sh_frame, _frame(n, si.dp_du))
        si.wi = dr.replace_grad(si.wi, dr.select(valid, si.to_local(-ray.d), -ray.d))
        return si


class AttachedSurfaces:
    """Attached surface interactions beside Mitsuba's. A plain object, which Dr.Jit loops leave alone."""

    def __init__(self, instances: InstanceTable | None, hits: HitTable | None) -> None:
        self._instances, self._hits = instances, hits

    @staticmethod
    def from_contents(contents: Any) -> AttachedSurfaces | None:
        """Return the surfaces of one job, None where Mitsuba's own interactions are right."""
        if contents.instances is None and contents.detached_hits is None:
            return None
        return AttachedSurfaces(*(part and part.read() for part in (contents.instances, contents.detached_hits)))

    def to_world(self, instance: Any, v: Any) -> Any:
        """Return a vector of the space of an ``instance`` in the world, attached to both."""
        return v if self._instances is None else self._instances.to_world(instance, v)

    def tables(self) -> list[Any]:
        """Return the arrays computed from parameters, attached where these are."""
        tables = [] if self._instances is None else [self._instances.table]
        return tables if self._hits is None else tables + self._hits.tables()

    def interaction(self, pi: Any, ray: Any, flags: int, active: Any) -> Any:
        """Return the attached interaction, see :func:`surface_interaction`."""
        if self._instances is not None:
            return self._instances.interaction(pi, ray, flags, active, self._hits)
        pi = self._hits.attach(pi, pi.shape, ray, active & pi.is_valid())
        si = pi.compute_surface_interaction(ray, flags, active)
        if not mi.has_flag(flags, mi.RayFlags.FollowShape):
            self._hits.put_right(si, pi, si.is_valid())
        return si


def surface_interaction(surfaces: AttachedSurfaces | None, pi: Any, ray: Any, flags: int, active: Any) -> Any:
    """Return a surface interaction that is attached to the ray, the shape, and what moves the shape.

    Its values are those of ``pi.compute_surface_interaction(ray, flags, active)``.

    Args:
        surfaces: attached surfaces of the job's context, None where Mitsuba's own derivatives are right.
        pi: PreliminaryIntersection3f.
        ray: Ray3f.
        flags: ``mi.RayFlags``.
        active: mask of lanes.
    """
    if surfaces is None:
        return pi.compute_surface_interaction(ray, flags, active)
    return surfaces.interaction(pi, ray, flags, active)


def distance_to(surfaces: AttachedSurfaces | None, pi: Any, ray: Any, active: Any) -> Any:
    """Return the distance of a surface along an attached ray, metres.

    Args:
        surfaces: attached surfaces of the job's context, None where Mitsuba's own derivatives are right.
        pi: PreliminaryIntersection3f of the surface.
        ray: Ray3f.
        active: mask of lanes.
    """
    si = surface_interaction(surfaces, pi, ray, mi.RayFlags.Minimal | mi.RayFlags.FollowShape, active)
    return attached_distance(pi, si, ray, active)


def _point(M: Any, p: Any) -> Any:
    return mi.Point3f(*[M[i, 0] * p.x + M[i, 1] * p.y + M[i, 2] * p.z + M[i, 3] for i in range(3)])


def _vector(M: Any, v: Any) -> Any:
    return mi.Vector3f(*[M[i, 0] * v.x + M[i, 1] * v.y + M[i, 2] * v.z for i in range(3)])


def _normal(inverse: Any, n: Any, valid: Any) -> Any:
    """Return a unit normal in the other space, by the transpose of the inverse; an arbitrary one where not ``valid``.
    """
    n = dr.select(valid, n, mi.Normal3f(0, 0, 1))
    across = [inverse[0, i] * n.x + inverse[1, i] * n.y + inverse[2, i] * n.z for i in range(3)]
    return dr.normalize(mi.Normal3f(*across))


def _frame(n: Any, dp_du: Any) -> Any:
    """Return the shading frame that Mitsuba makes of a normal and a tangent, which may be zero."""
    across = dp_du - n * dr.dot(n, dp_du)
    across = dr.select(dr.any(dp_du != 0), across, mi.coordinate_system(n)[0])
    s = dr.normalize(across)
    return mi.Frame3f(s, dr.cross(n, s), n)


# --------------------------------------------------------------------------------------------------------------------
# Interactions with derivatives, for the shapes whose hit points Mitsuba leaves detached or misplaces.
#
# The interactions of its ellipsoids and linear curves lie at the ray's point of the *detached* distance: they follow
# neither the shape nor a ray that moves. The rest of the interaction is computed from distance and place on the
# shape, so it is enough to attach these two. Its B-spline curves follow, but the place along the curve does so
# wrongly, and the normal with it: these are put right afterwards.

# Numbers per ellipsoid: centre, semi-axes, quaternion. Per control point of a curve: place, radius.
_ELLIPSOID, _POINT = 10, 4


class DetachedHits:
    """The shapes of a scene that leave their hit points detached; how many ellipsoids each has may change."""

    def __init__(self, shapes: Sequence[Any]) -> None:
        shown = [(shape, {value.key: value for value in shown_by(shape)[0]}) for shape in shapes]
        self._ellipsoids = [(shape, values) for shape, values in shown if "data" in values]
        curves = [(shape, values) for shape, values in shown if "control_points" in values]
        self._curves = [entry for entry in curves if not misplaces_hits(entry[0])]
        self._splines = [entry for entry in curves if misplaces_hits(entry[0])]
        self._starts: list[list[int]] = []
        self._find_starts()

    def _find_starts(self) -> None:
        """Return the place where each shape's ellipsoids or segments begin, counted from one: a shape that is not
        listed has none.
        """
        ellipsoids = _starts([_floats(values["data"].read(shape)) for shape, values in self._ellipsoids], _ELLIPSOID)
        segments, pieces = (
            _starts([values["segment_indices"].read(shape) for shape, values in curves], 1)
            for curves in (self._curves, self._splines)
        )
        if [ellipsoids, segments, pieces] != self._starts:
            self._first_ellipsoid = PointerTable([shape for shape, _ in self._ellipsoids], [1 + n for n in ellipsoids])
            self._first_segment = PointerTable([shape for shape, _ in self._curves], [1 + n for n in segments])
            self._first_piece = PointerTable([shape for shape, _ in self._splines], [1 + n for n in pieces])
            self._starts = [ellipsoids, segments, pieces]

    @staticmethod
    def from_scene(scene: Any) -> DetachedHits | None:
        """Return the shapes of ``scene``, shape groups included; None when it has none."""
        found = [s for s in shapes_of_scene(scene) if leaves_hits_detached(s) or misplaces_hits(s)]
        return DetachedHits(found) if found else None

    def read(self) -> HitTable:
        """Return the table of the current parameters, attached where they are. Call outside of loops, once a job."""
        with dr.resume_grad():
            self._find_starts()
            kinds: list[Any] = []
            if self._ellipsoids:
                kinds.append(EllipsoidTable(self._ellipsoids, self._first_ellipsoid))
            if self._curves:
                kinds.append(CurveTable(self._curves, self._first_segment))
            if self._splines:
                kinds.append(SplineTable(self._splines, self._first_piece))
            return HitTable(kinds)


class HitTable:
    """Tables that attach hit points, by kind of shape. A plain object, which Dr.Jit loops leave alone."""

    def __init__(self, kinds: Sequence[Any]) -> None:
        self._kinds = kinds

    def tables(self) -> list[Any]:
        """Return the arrays that are attached where parameters are."""
        return [table for kind in self._kinds for table in kind.tables()]

    def attach(self, pi: Any, shape: Any, ray: Any, active: Any) -> Any:
        """Return the intersection ``pi`` of ``ray`` with ``shape``, attached to both."""
        pi = mi.PreliminaryIntersection3f(pi)
        for kind in self._kinds:
            kind.attach(pi, shape, ray, active)
        return pi

    def put_right(self, si: Any, pi: Any, active: Any) -> None:
        """Attach what Mitsuba has computed of the hit at ``pi`` with a wrong derivative; ``si`` stays on its ray."""
        for kind in self._kinds:
            kind.put_right(si, pi, active)


class _Kind:
    """Class of shapes with detached hits."""

    def attach(self, pi: Any, shape: Any, ray: Any, active: Any) -> None:
        """Attach the intersections with such shapes, before Mitsuba computes the interaction."""

    def put_right(self, si: Any, pi: Any, active: Any) -> None:
        """Attach interactions with such shapes, after it."""


class EllipsoidTable(_Kind):
    """The ellipsoids of all shapes, one after the other."""

    def __init__(self, shapes: Sequence[tuple[Any, dict[str, Any]]], first: PointerTable) -> None:
        self._first = first
        self._data = dr.concat([_floats(values["data"].read(shape)) for shape, values in shapes])
        self._extents = dr.concat([_extents(shape, values) for shape, values in shapes])

    def tables(self) -> list[Any]:
        return [self._data, self._extents]

    def attach(self, pi: Any, shape: Any, ray: Any, active: Any) -> None:
        first = self._first.look_up(shape, active)
        here = active & (first > 0)
        number = first - 1 + pi.prim_index
        n = [dr.gather(mi.Float, self._data, number * _ELLIPSOID + k, here) for k in range(_ELLIPSOID)]
        size = dr.gather(mi.Float, self._extents, number, here)
        axes = mi.Vector3f(n[3], n[4], n[5]) * size
        turn = dr.quat_to_matrix(mi.Matrix3f, mi.Quaternion4f(*n[6:])).T
        p = dr.select(here, ray.o + ray.d * pi.t, 0)
        local = mi.Vector3f(turn @ (p - mi.Point3f(*n[:3]))) / axes
        towards = mi.Vector3f(turn @ ray.d) / axes
        # Along the ray, |local|^2 = 1.
        rate = 2 * dr.detach(dr.dot(local, towards))
        meets = here & (rate != 0)
        t = pi.t - (dr.squared_norm(local) - 1) / dr.select(meets, rate, 1)
        pi.t = dr.replace_grad(pi.t, dr.select(meets, t, 0))


class CurveTable(_Kind):
    """The segments of all linear curves, one after the other.

    A segment is what spheres around the points of a line cover, whose radius changes along the line. At a hit ``p`` the
    place ``v`` is where ``|p - c(v)|^2 - r(v)^2`` is zero and least.
    """

    def __init__(self, shapes: Sequence[tuple[Any, dict[str, Any]]], first: PointerTable) -> None:
        points = [_floats(values["control_points"].read(shape)) for shape, values in shapes]
        segments = [mi.UInt32(values["segment_indices"].read(shape)) for shape, values in shapes]
        self._first = first
        self._points = dr.concat(points)
        self._segments = dr.concat([s + n for s, n in zip(segments, _starts(points, _POINT), strict=True)])

    def tables(self) -> list[Any]:
        return [self._points]

    def attach(self, pi: Any, shape: Any, ray: Any, active: Any) -> None:
        first = self._first.look_up(shape, active)
        here = active & (first > 0)
        segment = dr.gather(mi.UInt32, self._segments, first - 1 + pi.prim_index, here)
        a, b = (
            [dr.gather(mi.Float, self._points, (segment + end) * _POINT + k, here) for k in range(_POINT)]
            for end in (0, 1)
        )
        v = pi.prim_uv.x
        along, r_slope = mi.Vector3f(*b[:3]) - mi.Vector3f(*a[:3]), b[3] - a[3]
        c, r = mi.Vector3f(*a[:3]) + along * v, a[3] + r_slope * v
        o, d = dr.select(here, mi.Vector3f(ray.o), 0), dr.select(here, ray.d, 0)
        off = o + d * pi.t - c
        rate = 2 * dr.detach(dr.dot(off, d))
        meets = here & (rate != 0)
        step = -(dr.squared_norm(off) - dr.square(r)) / dr.select(meets, rate, 1)
        pi.t = dr.replace_grad(pi.t, dr.select(meets, pi.t + step, 0))
        # Half of the slope by v, at the point that has moved; at the round ends v stays.
        half = dr.dot(off + d * dr.replace_grad(mi.Float(0), step), along) + r * r_slope
        bend = dr.detach(dr.squared_norm(along) - dr.square(r_slope))
        inside = meets & (v > 0) & (v < 1) & (bend > 0)
        pi.prim_uv.x = dr.replace_grad(v, dr.select(inside, v + half / dr.select(inside, bend, 1), 0))


class SplineTable(_Kind):
    """The pieces of all B-spline curves, one after the other.

    The surface is what circles around the curve ``c(v)`` cover: at a hit ``p``, ``(p - c) . c'`` is zero.
    """

    def __init__(self, shapes: Sequence[tuple[Any, dict[str, Any]]], first: PointerTable) -> None:
        points = [_floats(values["control_points"].read(shape)) for shape, values in shapes]
        pieces = [mi.UInt32(values["segment_indices"].read(shape)) for shape, values in shapes]
        self._first = first
        self._points = dr.concat(points)
        self._pieces = dr.concat([s + n for s, n in zip(pieces, _starts(points, _POINT), strict=True)])
        self._counts = dr.concat([dr.full(mi.Float, dr.width(s), dr.width(s)) for s in pieces])

    def tables(self) -> list[Any]:
        return [self._points]

    def put_right(self, si: Any, pi: Any, active: Any) -> None:
        first = self._first.look_up(si.shape, active)
        here = active & (first > 0)
        number = first - 1 + pi.prim_index
        piece = dr.gather(mi.UInt32, self._pieces, number, here)
        points = [
            [dr.gather(mi.Float, self._points, (piece + i) * _POINT + k, here) for k in range(_POINT)] for i in range(4)
        ]
        v = pi.prim_uv.x
        (c, _), (slope, _), (bend, _) = _spline(points, v)
        away = dr.select(here, mi.Vector3f(si.p) - c, 0)
        rate = dr.detach(dr.squared_norm(slope) - dr.dot(away, bend))
        meets = here & (rate != 0)
        step = dr.dot(away, slope) / dr.select(meets, rate, 1)
        v = dr.replace_grad(v, dr.select(meets, v + step, 0))
        (c, r), (slope, r_slope), (bend, _) = _spline(points, v)
        away = mi.Vector3f(si.p) - c
        n = (dr.squared_norm(slope) - dr.dot(away, bend)) * away - (r_slope * r) * slope
        n = mi.Normal3f(dr.normalize(dr.select(meets, n, mi.Vector3f(0, 0, 1))))
        si.n = dr.select(meets, dr.replace_grad(si.n, n), si.n)
        along = v / dr.gather(mi.Float, self._counts, number, meets)
        si.uv.y = dr.select(meets, dr.replace_grad(si.uv.y, along), si.uv.y)
        # The circle runs across both, and is as long as its radius says.
        across = dr.select(meets, dr.cross(slope, away), mi.Vector3f(0, 0, 1))
        s = dr.normalize(dr.mulsign(across, dr.dot(across, si.dp_du)))
        around = s * dr.norm(dr.detach(si.dp_du)) * dr.relative_grad(dr.select(meets, r, 1))
        si.dp_du = dr.select(meets, dr.replace_grad(si.dp_du, around), si.dp_du)
        frame = mi.Frame3f(s, dr.cross(n, s), n)
        si.sh_frame = dr.select(meets, dr.replace_grad(si.sh_frame, frame), si.sh_frame)


def _spline(points: Sequence[Sequence[Any]], v: Any) -> list[tuple[Any, Any]]:
    """(place, radius) at ``v`` of a piece of a uniform cubic B-spline, and their first two derivatives by ``v``."""
    w, v2 = 1 - v, dr.square(v)
    weights = [
        [w * w * w / 6, (3 * v2 * v - 6 * v2 + 4) / 6, (-3 * v2 * v + 3 * v2 + 3 * v + 1) / 6, v2 * v / 6],
        [-w * w / 2, (3 * v2 - 4 * v) / 2, (-3 * v2 + 2 * v + 1) / 2, v2 / 2],
        [w, 3 * v - 2, 1 - 3 * v, v],
    ]
    sums = [[sum(w * p[k] for w, p in zip(row, points, strict=True)) for k in range(_POINT)] for row in weights]
    return [(mi.Vector3f(x, y, z), r) for x, y, z, r in sums]


def _floats(value: Any) -> Any:
    """Return a parameter as a flat array; tensors hand theirs out."""
    return mi.Float(value.array if dr.is_tensor_v(value) else value)


def _starts(arrays: Sequence[Any], size: int) -> list[int]:
    """Return the first entry of each array, when they follow each other; ``size``: numbers per entry."""
    starts = [0]
    for array in arrays:
        starts.append(starts[-1] + dr.width(array) // size)
    return starts[:-1]


def _extents(shape: Any, values: dict[str, Any]) -> Any:
    """By how much the axes of each ellipsoid are stretched: Mitsuba clamps where an opacity has faded to 1 %. Up to a
    factor, which slopes of distances do not depend on.
    """
    if values["extent_adaptive_clamping"].read(shape):
        return dr.sqrt(dr.log(_floats(values["opacities"].read(shape)) / 0.01))
    return dr.full(mi.Float, 1, dr.width(_floats(values["data"].read(shape))) // _ELLIPSOID)
