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

from torchtransient.plugins.kernel_arrays import registry_number
from torchtransient.plugins.mitsuba_compat import attached_distance, is_instance
from torchtransient.plugins.node_walk import shown_by
from torchtransient.plugins.transport.hits import HitTable

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
    def of(scene: Any) -> Instances | None:
        """Those of ``scene``, None when it has none."""
        found = [shape for shape in scene.shapes() if is_instance(shape)]
        return Instances(found) if found else None

    def read(self) -> InstanceTable:
        """Their matrices as they are now, attached where they are; to be called outside of loops, once a job."""
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
        """A vector of the space of an ``instance`` (pointer) in the world, attached to both."""
        return _vector(self._matrices(instance)[0], v)

    def interaction(self, pi: Any, ray: Any, flags: int, active: Any, hits: HitTable | None) -> Any:
        """As :func:`surface_interaction`."""
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
    """What derivatives of surfaces need beside Mitsuba. A plain object, which Dr.Jit loops leave alone."""

    def __init__(self, instances: InstanceTable | None, hits: HitTable | None) -> None:
        self._instances, self._hits = instances, hits

    @staticmethod
    def of(contents: Any) -> AttachedSurfaces | None:
        """Those of one job, None where Mitsuba's own interactions are right."""
        if contents.instances is None and contents.detached_hits is None:
            return None
        return AttachedSurfaces(*(part and part.read() for part in (contents.instances, contents.detached_hits)))

    def to_world(self, instance: Any, v: Any) -> Any:
        """A vector of the space of an ``instance`` in the world, attached to both."""
        return v if self._instances is None else self._instances.to_world(instance, v)

    def tables(self) -> list[Any]:
        """What has been computed of parameters: attached where they are."""
        tables = [] if self._instances is None else [self._instances.table]
        return tables if self._hits is None else tables + self._hits.tables()

    def interaction(self, pi: Any, ray: Any, flags: int, active: Any) -> Any:
        """As :func:`surface_interaction`."""
        if self._instances is not None:
            return self._instances.interaction(pi, ray, flags, active, self._hits)
        pi = self._hits.attach(pi, pi.shape, ray, active & pi.is_valid())
        si = pi.compute_surface_interaction(ray, flags, active)
        if not mi.has_flag(flags, mi.RayFlags.FollowShape):
            self._hits.put_right(si, pi, si.is_valid())
        return si


def surface_interaction(surfaces: AttachedSurfaces | None, pi: Any, ray: Any, flags: int, active: Any) -> Any:
    """``pi.compute_surface_interaction(ray, flags, active)``, attached to the ray, the shape, and what moves the shape.

    ``surfaces``: those of ``world``, None where Mitsuba's own are right.
    """
    if surfaces is None:
        return pi.compute_surface_interaction(ray, flags, active)
    return surfaces.interaction(pi, ray, flags, active)


def distance_to(surfaces: AttachedSurfaces | None, pi: Any, ray: Any, active: Any) -> Any:
    """Distance along an attached ``ray`` of the surface at ``pi``."""
    si = surface_interaction(surfaces, pi, ray, mi.RayFlags.Minimal | mi.RayFlags.FollowShape, active)
    return attached_distance(pi, si, ray, active)


def _point(M: Any, p: Any) -> Any:
    return mi.Point3f(*[M[i, 0] * p.x + M[i, 1] * p.y + M[i, 2] * p.z + M[i, 3] for i in range(3)])


def _vector(M: Any, v: Any) -> Any:
    return mi.Vector3f(*[M[i, 0] * v.x + M[i, 1] * v.y + M[i, 2] * v.z for i in range(3)])


def _normal(inverse: Any, n: Any, valid: Any) -> Any:
    """A unit normal, brought to the other space by the transpose of the inverse; some normal where not ``valid``."""
    n = dr.select(valid, n, mi.Normal3f(0, 0, 1))
    across = [inverse[0, i] * n.x + inverse[1, i] * n.y + inverse[2, i] * n.z for i in range(3)]
    return dr.normalize(mi.Normal3f(*across))


def _frame(n: Any, dp_du: Any) -> Any:
    """The shading frame that Mitsuba makes of a normal and a tangent, which may be zero."""
    across = dp_du - n * dr.dot(n, dp_du)
    across = dr.select(dr.any(dp_du != 0), across, mi.coordinate_system(n)[0])
    s = dr.normalize(across)
    return mi.Frame3f(s, dr.cross(n, s), n)
