"""Points of meshes whose vertices are attached, from one table: three vertices are gathered, and nothing else.

What Mitsuba says of a point is a virtual call for each thing asked, and each back-propagates to the vertices on its
own: many times the sums of one gather.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.plugins.kernel_arrays import PointerTable, whole_numbers
from torchtransient.plugins.mitsuba_compat import has_vertices, mesh_faces, mesh_positions
from torchtransient.plugins.sampling.area_elements import has_shading_normals
from torchtransient.plugins.transport.strategy import Local


class AttachedTriangles:
    """The triangles of the ``shapes`` whose vertices are attached and whose normals are those of their planes.

    ``lists(shape)``: which shapes those are; ``holds_all``: no other of the shapes with the pointers ``moving`` moves.
    A plain object, which Dr.Jit loops leave alone.
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
        """What is attached."""
        return [] if self.vertices is None else [self.vertices]

    def lists(self, shape: Any) -> Any:
        """Which of an array of pointers to shapes are in the table."""
        return mi.Mask(False) if self.starts is None else self.starts.look_up(shape) > 0

    def point(self, pi: Any, active: Any) -> Local:
        """Where the hit points ``pi`` on listed shapes are, as their shapes move: ``p``, ``across`` (twice the area
        along the normal of either side).
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
    """One buffer, attached to all; None for none."""
    if len(buffers) < 2:
        return buffers[0] if buffers else None
    joined, first = dr.zeros(mi.Float, sum(map(dr.width, buffers))), 0
    for buffer in buffers:
        dr.scatter(joined, buffer, first + dr.arange(mi.UInt32, dr.width(buffer)))
        first += dr.width(buffer)
    return joined
