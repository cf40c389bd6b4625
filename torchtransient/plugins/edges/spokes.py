"""Edges at the corners of a face: candidates for a viewer on a mesh, next to which a draw by length hardly finds edges.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.plugins.kernel_arrays import PointerTable, whole_numbers
from torchtransient.plugins.transport.strategy import Local


class Spokes:
    """Edges by the corners of faces.

    Args:
        shapes: meshes.
        faces: joined places of the corners of all faces of each shape, (F, 3).
        ends: joined places of the ends of all edges of each shape, (E, 2), in the order of the table's rows.
        listed: points of a shape are asked for, by shape: members of instances are not.
    """

    def __init__(self, shapes: list[Any], faces: list[np.ndarray], ends: list[np.ndarray], listed: list[bool]) -> None:
        places = np.cumsum([0, *(int(each.max(initial=-1)) + 1 for each in faces)])
        first = np.cumsum([0, *(len(each) for each in faces)])[:-1]
        corner = np.concatenate([each + start for each, start in zip(faces, places, strict=False)])
        end = np.concatenate([each + start for each, start in zip(ends, places, strict=False)])
        kept = [(shape, 1 + start) for shape, start, some in zip(shapes, first, listed, strict=True) if some]
        self._faces = PointerTable([shape for shape, _ in kept], [int(start) for _, start in kept])
        self._corners, self._ends = whole_numbers(corner.ravel()), whole_numbers(end.ravel())
        self._rows = whole_numbers(np.argsort(end.ravel(), kind="stable") // 2)
        self._starts = whole_numbers(np.cumsum([0, *np.bincount(end.ravel(), minlength=places[-1])]))
        dr.make_opaque(self._corners, self._ends, self._rows, self._starts)

    def around(self, pi: Any, V: Any, active: Any) -> Local:
        """Return the corners of the faces that viewers lie on: ``active``, ``places``, and ``V``.

        Args:
            pi: PreliminaryIntersection3f of the viewers.
            V: viewers, Point3f.
        """
        face = self._faces.look_up(pi.shape, active & pi.is_valid())
        active = active & (face > 0) & (dr.reinterpret_array(mi.UInt32, pi.instance) == 0)
        first = (face - 1 + pi.prim_index) * 3
        places = [dr.gather(mi.UInt32, self._corners, first + i, active) for i in range(3)]
        return Local(active=active, places=places, V=mi.Point3f(V))

    def draw(self, around: Local, x: Any) -> tuple[Any, Any]:
        """Return (row of an edge, mask of edges that run from their corner on) for a uniform number ``x``."""
        x = x * 3
        corner = dr.minimum(mi.UInt32(x), 2)
        place = dr.select(corner == 0, around.places[0], dr.select(corner == 1, around.places[1], around.places[2]))
        start, degree = self._span(place, around.active)
        row = start + dr.minimum(mi.UInt32((x - mi.Float(corner)) * degree), mi.UInt32(degree) - 1)
        row = dr.gather(mi.UInt32, self._rows, row, around.active)
        return row, dr.gather(mi.UInt32, self._ends, 2 * row, around.active) == place

    def place(self, around: Local, k: Local, forward: Any, u: Any) -> Any:
        """Return the place in [0, 1] along edges ``k``, with a density near ``1 / squared distance from V``.

        Args:
            around: corners by :meth:`around`.
            k: rows of the table.
            forward: mask of edges that run from their corner on.
            u: uniform number.
        """
        L, corner = dr.norm(k.b - k.a), dr.select(forward, k.a, k.b)
        ρ = dr.norm(corner - around.V)
        along = ρ * u / dr.maximum(ρ + L * (1 - u), 1e-20)
        return dr.select(forward, along, 1 - along)

    def density(self, around: Local, k: Local) -> Any:
        """Return the density by length of the points of edges ``k`` that :meth:`draw` and :meth:`place` have."""
        L, total = dr.norm(k.b - k.a), mi.Float(0)
        for i, (corner, along) in enumerate(((k.a, k.u), (k.b, 1 - k.u))):
            place = dr.gather(mi.UInt32, self._ends, 2 * k.e + i, around.active & (2 * k.e + i < dr.width(self._ends)))
            _, degree = self._span(place, around.active)
            ρ = dr.norm(corner - around.V)
            by_length = ρ * (ρ + L) / (L * dr.square(ρ + along * L))
            share = sum(dr.select(place == other, 1.0, 0.0) for other in around.places) / (3 * degree)
            total += dr.select(dr.isfinite(by_length), by_length * share, 0)
        return dr.select(around.active & (2 * k.e < dr.width(self._ends)), total, 0)

    def _span(self, place: Any, active: Any) -> tuple[Any, Any]:
        start, stop = (dr.gather(mi.UInt32, self._starts, place + i, active) for i in (0, 1))
        return start, mi.Float(dr.maximum(stop - start, 1))
