"""Points on hidden geometry, drawn by what single-corner light makes of it: the density and the shared samples."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.errors import SceneError, ShapeError, UnitError
from torchtransient.plugins.cache import Cache, digest
from torchtransient.plugins.kernel_arrays import PointerTable, registry_number
from torchtransient.plugins.sampling.area_elements import (
    CYLINDER,
    TRIANGLE,
    AreaElements,
    facing_weight,
    has_shading_normals,
    local_point,
    morton_order,
)

# --------------------------------------------------------------- tables that kernels load four or two numbers at a time


def packed(values: np.ndarray) -> Any:
    """Copy numbers to a flat ``Float`` in Dr.Jit's own memory.

    Dr.Jit lays its array over numpy's memory otherwise. Where that does not begin at a multiple of 16 bytes, which is
    chance, packets are loaded number by number, by a kernel of its own.

    Args:
        values: numbers of any shape.
    """
    source = mi.Float(np.ravel(values).astype(np.float32))
    target = dr.empty(mi.Float, dr.width(source))
    dr.scatter(target, source, dr.arange(mi.UInt32, dr.width(source)))
    dr.eval(target)
    return target


def packed_columns(rows: list[list[Any]], count: int) -> Any:
    """Pack rows of four numbers for each lane into a flat ``Float``, one lane after the other.

    Args:
        rows: four ``Float`` arrays for each row.
        count: number of lanes, up to which zeros fill the array.
    """
    width = max(dr.width(column) for row in rows for column in row)
    target = dr.zeros(mi.Float, 4 * len(rows) * count)
    lane = dr.arange(mi.UInt32, width)
    for i, row in enumerate(rows):
        dr.scatter(target, mi.Vector4f(*row), lane * len(rows) + i)
    dr.eval(target)
    return target


# ----------------------------------------------------------------------------------------------------------------------
# Triangles that are large beside their distance from the wall, cut into equal ones with a density each.
# Light that falls by the fourth power of the distance is drawn badly by a density that is constant over the wall of a
# room: of a plane twice as wide as it is far away, 5 times the variance.

# Longest edge of an element over its distance from the nearest wall point.
_RATIO = 0.5
_MOST_CUTS = 32
# Elements that cutting adds at most.
_BUDGET = 2**17


def cuts_of(elements: AreaElements, points: np.ndarray) -> np.ndarray:
    """Return the number of parts of each triangle's edges, a power of two, (E,): 1 for others and for small ones.

    Args:
        elements: elements of hidden shapes.
        points: wall points, (P, 3).
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
    """Cut triangles into equal ones.

    Cells of a triangle are numbered along its two edges, two for each square of a grid: ``2 (j n + i)``, and one more
    for the upper triangle.

    Args:
        elements: elements of hidden shapes.
        cuts: parts of each triangle's edges, (E,).

    Returns:
        (parts; number of the element that each is a part of, (M,); its cell there, (M,)).
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
    """Density per area of a point, by the shape and primitive that it lies on. A plain class.

    Args:
        shapes: shapes of the elements.
        uncut: elements before they are cut.
        cuts: number of parts that each triangle's edges are cut into.
        place, cell: number of the element that each part belongs to, and of its cell there, (M,).
        density: density of each part per square metre, (tiles, M).
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
        """Return the density (Float, per square metre), 0 for points that are not in the table.

        Args:
            shape, prim_index: ShapePtr and primitive, UInt32.
            p: point on it, Point3f.
            tile: tile of the scan, UInt32; None for the first.
        """
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
        """Return the number of the cell that a point lies in; 0 where inactive."""
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


# ----------------------------------------------------------------------------------------------------------------------

# Share of the draws that goes by plain area: what the weight gives too little (light that arrives after further
# bounces, a wall point near an element) is found all the same.
DEFENSIVE = 0.1


class HiddenElements:
    """Density over the area of shapes: uniform within an element, see :mod:`.area_elements`.

    Triangles that are large beside their distance from the wall are several elements (:func:`cut`). The probability of
    an element is its area times the root mean square over wall points of ``cos^2 cos^2 / r^4`` (both cosines, to the
    wall point and there), mixed with a share of plain area. The albedo does not enter. Elements without area are
    dropped.

    A plain class: its arrays are constants of kernels, which do not depend on their values and sizes. It describes the
    shapes as they are when it is built.

    Args:
        shapes: hidden shapes.
        points, normals: wall points (P, 3), some 5 x 5 over the scan, as arrays or ``mi.Point3f`` and ``mi.Normal3f``;
            (tiles, P, 3) gives each tile of a scan a density of its own, which pays where geometry is nearer than half
            the scan's width.
        defensive: share of plain area.
        every: elements of the shapes, None to build them.

    Attributes:
        left_out: names of the shapes that are not in the table (copies of shape groups, curves, signed distances,
            ellipsoids). Nothing is ever drawn on them: estimators by this density alone refuse them.
        smooth: some shape has normals that are interpolated.

    Raises:
        SceneError: if nothing has an area.
        ShapeError: if points and normals do not match.
        UnitError: if ``defensive`` is no share.
    """

    def __init__(
        self,
        shapes: list[Any],
        points: Any,
        normals: Any,
        defensive: float = DEFENSIVE,
        *,
        every: AreaElements | None = None,
    ) -> None:
        if not 0 < defensive <= 1:
            raise UnitError(f"HiddenElements: defensive is a share in (0, 1], got {defensive!r}.")
        points, normals = _tiles_of(points, "points"), _tiles_of(normals, "normals")
        if points.shape != normals.shape:
            raise ShapeError(
                f"HiddenElements: points and normals of the wall have to match, got {points.shape} and {normals.shape}."
            )
        every = AreaElements.from_shapes(shapes) if every is None else every
        self.left_out, self.key = every.left_out, b""
        if not np.any(every.area > 0):
            raise SceneError(
                f"hidden shapes: expected a surface to draw points on, got none on {_named(shapes)}: triangles without "
                "area, shapes without a surface, copies of groups, curves, sheared disks and cylinders. Give them an "
                "area, or turn nlos_hidden_geometry_sampling off."
            )
        cuts = cuts_of(every, points.reshape(-1, 3))
        parts, uncut, cell = cut(every, cuts)
        order = np.flatnonzero(parts.area > 0)
        order = order[morton_order(parts.centers()[order])]
        self.shapes, self.elements = list(shapes), parts.take(order)
        self.tile_count, self.region = len(points), None
        self.smooth = _is_smooth(shapes, every)
        self._cutting, self._defensive = (every, cuts, uncut[order], cell[order]), defensive
        self._lay_out_densities(self._probabilities(points, normals))

    @staticmethod
    def cached(
        memory: Cache, shapes: list[Any], points: Any, normals: Any, beside: Sequence[Any] = ()
    ) -> HiddenElements:
        """Return the elements of shapes, the same object while they stay in place: not to be changed.

        ``key`` of the result is that of the places of all shapes, and empty where some do not show them.

        Args:
            memory: cache of the scene.
            shapes: hidden shapes.
            points, normals: wall points and their normals, see the class.
            beside: other shapes of the scene.
        """
        every, others = AreaElements.from_shapes(shapes), AreaElements.from_shapes(list(beside))
        parts = [array for each in (every, others) for array in each.columns()]
        numbers = np.array([registry_number(shape) for shape in (*shapes, *beside)])
        seen_from = (np.asarray(points, dtype=np.float64), np.asarray(normals, dtype=np.float64))
        key = digest(*parts, numbers, *seen_from, np.array(_is_smooth(shapes, every)))

        def made() -> HiddenElements:
            elements = HiddenElements(shapes, *seen_from, every=every)
            elements.key = b"" if every.left_out or others.left_out else key
            return elements

        return memory.get("hidden elements", key, made)

    def reweighted(self, weights: np.ndarray) -> HiddenElements:
        """Return the same elements with other probabilities; the share of plain area stays.

        To be called before :meth:`put_first`.

        Args:
            weights: weights of the elements, (tiles, E), finite and not negative, in the order of ``elements``.
        """
        other = copy(self)
        other.tile_count = len(weights)
        other._lay_out_densities(np.array([self._mixed(w) for w in np.asarray(weights, dtype=np.float64)]))
        return other

    # ----------------------------------------------------------------------------------------- tables

    def _probabilities(self, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Return the probabilities of elements for wall points, (tiles, E)."""
        pairs = zip(points, normals, strict=True)
        return np.array([self._mixed(facing_weight(self.elements, q, n)) for q, n in pairs])

    def _mixed(self, w: np.ndarray) -> np.ndarray:
        """Return probabilities of weights, mixed with plain area, which is all where no element has a weight."""
        area, total = self.elements.area / self.elements.area.sum(), w.sum()
        return (1 - self._defensive) * w / total + self._defensive * area if total > 0 else area

    def _lay_out_densities(self, p: np.ndarray) -> None:
        self.probabilities = p
        self._lay_out(p, 0)
        self._by_primitive = PrimitiveDensity(self.shapes, *self._cutting, p / self.elements.area)

    def put_first(self, clear: np.ndarray, region: Any) -> None:
        """Put the elements first whose samples need no visibility rays. The density stays what it is.

        Args:
            clear: mask of these elements, (E,).
            region: region of the points that see them, with ``holds``.
        """
        self.region = region
        order = np.argsort(~clear, kind="stable")
        self.elements, self.probabilities = self.elements.take(order), self.probabilities[:, order]
        self._lay_out(self.probabilities, int(clear.sum()))

    def _lay_out(self, p: np.ndarray, clear: int) -> None:
        e = self.elements
        self.has_clear, self.clear_count = clear > 0, dr.opaque(mi.UInt32, clear)
        self.kinds = tuple(int(k) for k in np.unique(e.kind))
        cdf = np.concatenate([np.zeros((len(p), 1)), np.cumsum(p, axis=1)], axis=1)
        cdf /= cdf[:, -1:]
        self._cdf = mi.Float64(cdf.ravel())
        self._cuts = mi.UInt32(np.concatenate([_cut_points(row) for row in cdf]))
        # [origin, n.x][axis, n.y][axis, n.z][axis, kind]: loaded four numbers at a time.
        rows = np.concatenate([e.axes, np.concatenate([e.normal, e.kind[:, None]], 1)[:, :, None]], axis=2)
        self._rows = packed(rows)
        self._area = mi.Float(e.area.astype(np.float32))
        numbers = np.array([registry_number(shape) for shape in self.shapes], dtype=np.uint32)
        self._shape, self._primitive = mi.UInt32(numbers[e.shape.astype(int)]), mi.UInt32(e.primitive.astype(np.uint32))
        self._count = mi.UInt32(len(e))
        dr.make_opaque(self._cuts, self._cdf, self._rows, self._area, self._shape, self._primitive, self._count)

    # ---------------------------------------------------------------------------------------- in kernels

    def draw(self, u: Any, active: Any = True, tile: Any = None) -> tuple[Any, Any]:
        """Draw points on the hidden geometry.

        Args:
            u: two uniform numbers, Point2f.
            tile: tile whose density is drawn from, UInt32; None for the first.

        Returns:
            (Point3f, geometric Normal3f).
        """
        element, a = self.select_element(mi.Float64(u.x), active, tile)
        return self.point(element, a, u.y, active)

    def draw_with_surface(self, x: Any, y: Any, active: Any = True) -> tuple[Any, Any, Any, Any, Any]:
        """Draw points on the hidden geometry, with the places on their surfaces.

        Args:
            x, y: uniform numbers in [0, 1), Float64 and Float.

        Returns:
            (Point3f, geometric Normal3f, place on the primitive, see :meth:`coordinates`, ShapePtr, primitive).
        """
        element, a = self.select_element(x, active)
        point, n = self.point(element, a, y, active)
        return point, n, self.coordinates(element, a, y, active), *self.surface(element, active)

    def select_element(self, x: Any, active: Any = True, tile: Any = None) -> tuple[Any, Any]:
        """Draw an element.

        Args:
            x: uniform number in [0, 1), Float64.
            tile: tile whose density is drawn from, UInt32; None for the first.

        Returns:
            (number of the element in the table, UInt32; rest of ``x``, uniform in [0, 1) again, Float).
        """
        row = mi.UInt32(0) if tile is None else tile * (self._count + 1)
        element = _search((self._cuts, self._cdf), row, self._count, x, active)
        low = dr.gather(mi.Float64, self._cdf, row + element, active)
        high = dr.gather(mi.Float64, self._cdf, row + element + 1, active)
        rest = mi.Float((x - low) / (high - low))
        return element, dr.clip(rest, 0, 1 - dr.epsilon(mi.Float))

    def point(self, element: Any, a: Any, y: Any, active: Any = True) -> tuple[Any, Any]:
        """Return the point of an element.

        Args:
            element: number in the table, UInt32.
            a, y: numbers in [0, 1).

        Returns:
            (Point3f, geometric Normal3f).
        """
        first, axes = self._row(element, 0, active), [self._row(element, i, active) for i in (1, 2)]
        n = mi.Vector3f(first.w, axes[0].w, axes[1].w)
        p = mi.Vector3f(first.x, first.y, first.z)
        curved = self.kinds != (TRIANGLE,)
        kind = None
        if curved:
            axes.append(self._row(element, 3, active))
            kind = mi.UInt32(axes[2].w)
        x = local_point(kind, a, y, dr, self.kinds)
        offset = mi.Vector3f(0)
        for weight, axis in zip(x, axes, strict=False):
            offset = dr.fma(mi.Vector3f(axis.x, axis.y, axis.z), weight, offset)
        if curved:
            along = dr.select(kind == CYLINDER, x[2], 0) * mi.Vector3f(axes[2].x, axes[2].y, axes[2].z)
            n = dr.select(kind < 2, n, (offset - along) * n.x)
        return mi.Point3f(p + offset), mi.Normal3f(n)

    def per_area(self, shape: Any, prim_index: Any, p: Any, active: Any = True, tile: Any = None) -> Any:
        """Return the density of a point per square metre (Float), 0 for points that are not in the table.

        Args:
            shape, prim_index: ShapePtr and primitive, UInt32.
            p: point on it, Point3f.
            tile: tile of the scan, UInt32; None for the first.
        """
        return self._by_primitive.look_up(shape, prim_index, p, active, tile)

    def coordinates(self, element: Any, a: Any, y: Any, active: Any = True) -> Any:
        """Return Mitsuba's surface coordinates (Point2f) of the point of an element.

        Barycentrics of triangles, the point of the unit disk; meaningless for spheres and cylinders.

        Args:
            element: number in the table, UInt32.
            a, y: numbers in [0, 1), see :meth:`point`.
        """
        row, kind = self._row(element, 3, active), self.kind(element, active)
        x = mi.Point2f(*local_point(kind, a, y, dr, self.kinds)[:2])
        # Of a part of a triangle, those of the uncut one.
        return dr.select(kind == TRIANGLE, mi.Point2f(row.x, row.y) + row.z * x, x)

    def density_of(self, element: Any, active: Any = True, tile: Any = None) -> Any:
        """Return the density of an element of the table per square metre, ``Float``."""
        row = mi.UInt32(0) if tile is None else tile * (self._count + 1)
        low = dr.gather(mi.Float64, self._cdf, row + element, active)
        high = dr.gather(mi.Float64, self._cdf, row + element + 1, active)
        return mi.Float(high - low) / dr.gather(mi.Float, self._area, element, active)

    def kind(self, element: Any, active: Any = True) -> Any:
        """Return the row of an element in the table of :mod:`.area_elements`, ``UInt32``."""
        return mi.UInt32(self._row(element, 3, active).w)

    def surface(self, element: Any, active: Any = True) -> tuple[Any, Any]:
        """Return shape (``ShapePtr``) and primitive (``UInt32``) of an element of the table."""
        number = dr.gather(mi.UInt32, self._shape, element, active)
        return dr.reinterpret_array(mi.ShapePtr, number), dr.gather(mi.UInt32, self._primitive, element, active)

    def _row(self, element: Any, number: int, active: Any) -> Any:
        return dr.gather(mi.Vector4f, self._rows, element * 4 + number, active)


def _cut_points(cdf: np.ndarray) -> np.ndarray:
    """Return the guide table of a cumulative distribution of N intervals, (N + 1,).

    For each of N equal parts of [0, 1] the interval that it begins in, so that a search has few to choose from (Chen
    and Asau 1974).
    """
    count = len(cdf) - 1
    begins = np.searchsorted(cdf, np.arange(count + 1) / count, side="right") - 1
    return np.clip(begins, 0, count - 1).astype(np.uint32)


@dr.syntax
def _search(tables, row, count, x, active):
    """Return the interval of a cumulative distribution that ``x`` falls into; ``tables``: (guide table, distribution).
    """
    cuts, cdf = tables
    part = dr.minimum(mi.UInt32(x * mi.Float64(count)), count - 1)
    # One part to either side, for what rounding moves across an edge.
    low = dr.gather(mi.UInt32, cuts, row + dr.maximum(part, 1) - 1, active)
    high = dr.gather(mi.UInt32, cuts, row + dr.minimum(part + 2, count), active)
    while dr.hint(mi.Mask(active) & (low < high), label="element search"):
        middle = (low + high) >> 1
        above = dr.gather(mi.Float64, cdf, row + middle + 1) <= x
        low = dr.select(above, middle + 1, low)
        high = dr.select(above, high, middle)
    return low


def _tiles_of(values: Any, name: str) -> np.ndarray:
    """Return points or normals as an array (tiles, P, 3), float64."""
    array = np.array(values, dtype=np.float64)
    if dr.is_array_v(values) and not dr.is_tensor_v(values):
        array = array.T
    if array.ndim == 2:
        array = array[None]
    if array.ndim != 3 or array.shape[2] != 3 or 0 in array.shape or not np.isfinite(array).all():
        raise ShapeError(
            f"HiddenElements: expected finite {name} of the wall, (P, 3) or (tiles, P, 3), got {array.shape}."
        )
    return array


def _is_smooth(shapes: list[Any], every: AreaElements) -> bool:
    return any(has_shading_normals(shapes[s]) for s in np.unique(every.shape).astype(int))


def _named(shapes: list[Any]) -> str:
    """Return the names of up to three shapes."""
    names = [repr(shape.id() or shape.class_name()) for shape in shapes]
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "") or "no shape"
