"""Triangles that are large beside their distance from the wall, cut into equal ones with a density each.

Light that falls by the fourth power of the distance is drawn badly by a density that is constant over the wall of a
room: of a plane twice as wide as it is far away, 5 times the variance.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.plugins.pointer_table import PointerTable
from torchtransient.plugins.sampling.area_elements import TRIANGLE, AreaElements
from torchtransient.plugins.sampling.packed import packed

# Longest edge of an element over its distance from the nearest wall point.
_RATIO = 0.5
_MOST_CUTS = 32
# Elements that cutting adds at most.
_BUDGET = 2**17


def cuts_of(elements: AreaElements, points: np.ndarray) -> np.ndarray:
    """Into how many parts each edge of a triangle is cut, a power of two: ``(E,)``, 1 for all that is small or not a
    triangle. ``points``: wall points ``(P, 3)``.
    """
    o, e1, e2 = (elements.axes[:, i] for i in range(3))
    longest = np.sqrt(np.max([(e * e).sum(1) for e in (e1, e2, e1 - e2)], axis=0))
    corners = np.stack([o, o + e1, o + e2, o + (e1 + e2) / 3], 1)
    # No corner is nearer than the first by more than an edge: most are far enough by that.
    least = np.full(len(elements), np.inf)
    for p in points:
        least = np.minimum(least, ((o - p) ** 2).sum(1))
    near = np.flatnonzero(longest > _RATIO * (np.sqrt(least) - longest))
    square = np.full(len(near), np.inf)
    for p in points:
        square = np.minimum(square, ((corners[near] - p) ** 2).sum(2).min(1))
    wanted = np.ones(len(elements))
    wanted[near] = longest[near] / np.maximum(_RATIO * np.sqrt(square), 1e-30)
    levels = np.clip(np.ceil(np.log2(np.maximum(wanted, 1))), 0, np.log2(_MOST_CUTS)).astype(int)
    levels = np.where((elements.kind == TRIANGLE) & (elements.area > 0), levels, 0)
    while (4**levels - 1).sum() > _BUDGET:
        levels = np.maximum(levels - 1, 0)
    return 2**levels


def cut(elements: AreaElements, cuts: np.ndarray) -> tuple[AreaElements, np.ndarray, np.ndarray]:
    """(the parts, ``(M,)``: whose part each is, ``(M,)``: in which cell of it). Cells are numbered along the two edges,
    two for each square of a grid: ``2 (j n + i)``, and one more for the upper triangle.
    """
    numbers, cells = [np.flatnonzero(cuts == 1)], [np.zeros((cuts == 1).sum(), dtype=int)]
    for n in np.unique(cuts[cuts > 1]):
        i, j = (g.ravel() for g in np.meshgrid(np.arange(n), np.arange(n)))
        inside = np.concatenate([2 * (j * n + i)[i + j < n], 2 * (j * n + i)[i + j < n - 1] + 1])
        uncut = np.flatnonzero(cuts == n)
        numbers.append(np.repeat(uncut, len(inside)))
        cells.append(np.tile(inside, len(uncut)))
    number, cell = np.concatenate(numbers), np.concatenate(cells)
    parts, n = elements.take(number), cuts[number]
    upper, i, j = cell % 2, (cell // 2) % n, (cell // 2) // n
    # A part starts at the corner of its right angle; those of the upper ones point back.
    b1, b2, scale = (i + upper) / n, (j + upper) / n, np.where(upper == 1, -1, 1) / n
    triangle = parts.kind == TRIANGLE
    axes = parts.axes.copy()
    axes[:, 0] += b1[:, None] * parts.axes[:, 1] + b2[:, None] * parts.axes[:, 2]
    axes[:, 1:3] *= scale[:, None, None]
    axes[triangle, 3] = np.stack([b1, b2, scale], 1)[triangle]
    parts.axes, parts.area = axes, parts.area / n**2
    return parts, number, cell


class PrimitiveDensity:
    """The density per area of a point, by the shape and primitive that it lies on. A plain class.

    ``uncut``: elements before they are cut, by ``cuts``; ``place`` ``(M,)`` and ``cell``: whose parts, and which, the
    columns of ``density`` ``(tiles, M)`` are.
    """

    def __init__(
        self,
        shapes: list[Any],
        uncut: AreaElements,
        cuts: np.ndarray,
        place: np.ndarray,
        cell: np.ndarray,
        density: Any,
    ) -> None:
        size = np.where(cuts > 1, 2 * cuts**2, 1)
        first = np.cumsum(size) - size
        table = np.zeros((len(density), size.sum()), dtype=np.float32)
        table[:, first[place] + cell] = density
        self._density = mi.Float(table.ravel())
        self._stride = mi.UInt32(table.shape[1])
        dr.make_opaque(self._density, self._stride)
        listed, start = np.unique(uncut.shape.astype(int), return_index=True)
        # One more than the number of the shape's first element: zero is what is not in the table.
        self._start = PointerTable([shapes[s] for s in listed], [1 + int(s) for s in start])
        self._cut = bool(np.any(cuts > 1))
        if self._cut:
            self._first = mi.UInt32(first.astype(np.uint32))
            records = np.flatnonzero(cuts > 1)
            record = np.zeros(len(uncut), dtype=np.uint32)
            record[records] = 1 + np.arange(len(records))
            self._record = mi.UInt32(record)
            dr.make_opaque(self._first, self._record)
            self._frames = packed(_frames(uncut.take(records), cuts[records]))

    def look_up(self, shape: Any, prim_index: Any, p: Any, active: Any, tile: Any) -> Any:
        """``Float``; 0 for what is not in the table."""
        start = self._start.look_up(shape, active)
        listed = mi.Mask(active) & (start > 0)
        index = start - 1 + prim_index
        if self._cut:
            uncut = index
            index = dr.gather(mi.UInt32, self._first, uncut, listed)
            record = dr.gather(mi.UInt32, self._record, uncut, listed)
            index += self._cell(record, p, listed & (record > 0))
        if tile is not None:
            index += tile * self._stride
        return dr.gather(mi.Float, self._density, index, listed)

    def _cell(self, record: Any, p: Any, active: Any) -> Any:
        """Number of the cell that a point lies in; 0 where inactive."""
        o, g1, g2 = (dr.gather(mi.Vector4f, self._frames, (record - 1) * 3 + i, active) for i in range(3))
        d = mi.Vector3f(p.x - o.x, p.y - o.y, p.z - o.z)
        u = dr.maximum(dr.dot(d, mi.Vector3f(g1.x, g1.y, g1.z)), 0)
        v = dr.maximum(dr.dot(d, mi.Vector3f(g2.x, g2.y, g2.z)), 0)
        n = mi.UInt32(o.w)
        # Points on a rim may lie beyond it by a rounding error.
        i = dr.minimum(mi.UInt32(u), n - 1)
        j = dr.minimum(mi.UInt32(v), n - 1 - i)
        upper = (u - mi.Float(i) + v - mi.Float(j) > 1) & (i + j + 1 < n)
        return dr.select(active, 2 * (j * n + i) + dr.select(upper, mi.UInt32(1), 0), 0)


def _frames(elements: AreaElements, cuts: np.ndarray) -> np.ndarray:
    """Rows ``[o, n] [g1, 0] [g2, 0]``: with these, ``g . (p - o)`` counts cells along each edge."""
    o, e1, e2 = (elements.axes[:, i] for i in range(3))
    a, b, c = ((x * y).sum(1) for x, y in ((e1, e1), (e1, e2), (e2, e2)))
    scale = (cuts / (a * c - b * b))[:, None]
    g1, g2 = scale * (c[:, None] * e1 - b[:, None] * e2), scale * (a[:, None] * e2 - b[:, None] * e1)
    zero = np.zeros(len(cuts))
    rows = [np.concatenate([x, w[:, None]], 1) for x, w in ((o, cuts), (g1, zero), (g2, zero))]
    return np.stack(rows, 1)
