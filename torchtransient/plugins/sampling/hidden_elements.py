"""Points on hidden geometry, drawn by what single-corner light makes of it: the density and the shared samples."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.errors import SceneError, ShapeError, UnitError
from torchtransient.plugins.pointer_table import registry_number
from torchtransient.plugins.remembered import Remembered, digest
from torchtransient.plugins.sampling.area_elements import (
    CYLINDER,
    TRIANGLE,
    AreaElements,
    facing_weight,
    has_shading_normals,
    local_point,
    morton_order,
)
from torchtransient.plugins.sampling.packed import packed
from torchtransient.plugins.sampling.split_triangles import PrimitiveDensity, cut, cuts_of

# Share of the draws that goes by plain area: what the weight gives too little (light that arrives after further
# bounces, a wall point near an element) is found all the same.
DEFENSIVE = 0.1


class HiddenElements:
    """A density over the area of ``shapes``: uniform within an element, see :mod:`.area_elements`; triangles that are
    large beside their distance from the wall are several elements (:mod:`.split_triangles`).

    The probability of an element is its area times the root mean square over wall points of ``cos^2 cos^2 / r^4``
    (both cosines, to the wall point and there), mixed with ``defensive`` of plain area. ``points`` and ``normals``
    ``(P, 3)``: wall points, some 5 x 5 over the scan; ``(tiles, P, 3)`` gives each tile of a scan a density of its own,
    which pays where geometry is nearer than half the scan's width. Arrays, or ``mi.Point3f`` and ``mi.Normal3f``.

    The albedo does not enter. ``left_out`` names the shapes that are not in the table (copies of shape groups, curves,
    signed distances, ellipsoids): nothing is ever drawn on them, so that whoever samples this density alone has to
    refuse them. Elements without area are dropped. ``smooth``: whether some shape has normals that are interpolated.

    A plain class: its arrays are constants of kernels, which do not depend on their values and sizes. It describes the
    shapes as they are when it is built. Raises SceneError where nothing has an area, ShapeError, UnitError.
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
        every = AreaElements.of(shapes) if every is None else every
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
    def remembered(
        memory: Remembered, shapes: list[Any], points: Any, normals: Any, beside: Sequence[Any] = ()
    ) -> HiddenElements:
        """Those of shapes that are where they were before are the same: not to be changed. ``beside``: the other shapes
        of the scene. ``key`` holds where all of them are, and is empty where some do not say.
        """
        every, others = AreaElements.of(shapes), AreaElements.of(list(beside))
        parts = [array for each in (every, others) for array in each.columns()]
        numbers = np.array([registry_number(shape) for shape in (*shapes, *beside)])
        seen_from = (np.asarray(points, dtype=np.float64), np.asarray(normals, dtype=np.float64))
        key = digest(*parts, numbers, *seen_from, np.array(_is_smooth(shapes, every)))

        def made() -> HiddenElements:
            elements = HiddenElements(shapes, *seen_from, every=every)
            elements.key = b"" if every.left_out or others.left_out else key
            return elements

        return memory.of("hidden elements", key, made)

    def reweighted(self, weights: np.ndarray) -> HiddenElements:
        """The same elements drawn by other weights ``(tiles, E)``, finite and not negative, in the order of
        ``elements``; the share of plain area stays. Before :meth:`put_first` alone.
        """
        other = copy(self)
        other.tile_count = len(weights)
        other._lay_out_densities(np.array([self._mixed(w) for w in np.asarray(weights, dtype=np.float64)]))
        return other

    # ----------------------------------------------------------------------------------------- tables

    def _probabilities(self, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """(tiles, elements)"""
        pairs = zip(points, normals, strict=True)
        return np.array([self._mixed(facing_weight(self.elements, q, n)) for q, n in pairs])

    def _mixed(self, w: np.ndarray) -> np.ndarray:
        """Probabilities of weights, with the share of plain area: all of it where nothing has a weight."""
        area, total = self.elements.area / self.elements.area.sum(), w.sum()
        return (1 - self._defensive) * w / total + self._defensive * area if total > 0 else area

    def _lay_out_densities(self, p: np.ndarray) -> None:
        self.probabilities = p
        self._lay_out(p, 0)
        self._by_primitive = PrimitiveDensity(self.shapes, *self._cutting, p / self.elements.area)

    def put_first(self, clear: np.ndarray, region: Any) -> None:
        """Put those elements first, ``(E,)`` of booleans, whose samples need no visibility rays to points that
        ``region.holds``. The density stays what it is.
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
        """A point and the geometric normal there (``Point3f``, ``Normal3f``) for two random numbers (``Point2f``) of
        each lane; ``tile`` (``UInt32``): of which tile's density, the first where None.
        """
        element, a = self.select_element(mi.Float64(u.x), active, tile)
        return self.point(element, a, u.y, active)

    def draw_with_surface(self, x: Any, y: Any, active: Any = True) -> tuple[Any, Any, Any, Any, Any]:
        """A point for two numbers in [0, 1) (``Float64``, ``Float``), the geometric normal there, its place on the
        primitive as in :meth:`coordinates`, and the shape and primitive that it lies on.
        """
        element, a = self.select_element(x, active)
        point, n = self.point(element, a, y, active)
        return point, n, self.coordinates(element, a, y, active), *self.surface(element, active)

    def select_element(self, x: Any, active: Any = True, tile: Any = None) -> tuple[Any, Any]:
        """An element (its number in the table) for a ``Float64`` in [0, 1), and what is left of that number: uniform in
        [0, 1) again.
        """
        row = mi.UInt32(0) if tile is None else tile * (self._count + 1)
        element = _search((self._cuts, self._cdf), row, self._count, x, active)
        low = dr.gather(mi.Float64, self._cdf, row + element, active)
        high = dr.gather(mi.Float64, self._cdf, row + element + 1, active)
        rest = mi.Float((x - low) / (high - low))
        return element, dr.clip(rest, 0, 1 - dr.epsilon(mi.Float))

    def point(self, element: Any, a: Any, y: Any, active: Any = True) -> tuple[Any, Any]:
        """The point of an element for two numbers in [0, 1), and the geometric normal there."""
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
        """Density per unit area (``Float``) at a point ``p`` (``Point3f``) of a shape (``ShapePtr``) and primitive
        (``UInt32``); 0 for what is not in the table.
        """
        return self._by_primitive.look_up(shape, prim_index, p, active, tile)

    def coordinates(self, element: Any, a: Any, y: Any, active: Any = True) -> Any:
        """Where Mitsuba's interactions place the point of two numbers on an element: barycentrics of triangles, the
        point of the unit disk (``Point2f``); meaningless for spheres and cylinders.
        """
        row, kind = self._row(element, 3, active), self.kind(element, active)
        x = mi.Point2f(*local_point(kind, a, y, dr, self.kinds)[:2])
        # Of a part of a triangle, those of the uncut one.
        return dr.select(kind == TRIANGLE, mi.Point2f(row.x, row.y) + row.z * x, x)

    def density_of(self, element: Any, active: Any = True, tile: Any = None) -> Any:
        """Density per unit area of an element of the table, ``Float``."""
        row = mi.UInt32(0) if tile is None else tile * (self._count + 1)
        low = dr.gather(mi.Float64, self._cdf, row + element, active)
        high = dr.gather(mi.Float64, self._cdf, row + element + 1, active)
        return mi.Float(high - low) / dr.gather(mi.Float, self._area, element, active)

    def kind(self, element: Any, active: Any = True) -> Any:
        """Which row of the table of :mod:`.area_elements` an element is of, ``UInt32``."""
        return mi.UInt32(self._row(element, 3, active).w)

    def surface(self, element: Any, active: Any = True) -> tuple[Any, Any]:
        """Shape (``ShapePtr``) and primitive (``UInt32``) of an element of the table."""
        number = dr.gather(mi.UInt32, self._shape, element, active)
        return dr.reinterpret_array(mi.ShapePtr, number), dr.gather(mi.UInt32, self._primitive, element, active)

    def _row(self, element: Any, number: int, active: Any) -> Any:
        return dr.gather(mi.Vector4f, self._rows, element * 4 + number, active)


def _cut_points(cdf: np.ndarray) -> np.ndarray:
    """For each of as many equal parts of [0, 1] as there are intervals, and one more, the interval that it begins in: a
    search has but a few to choose from (Chen and Asau 1974).
    """
    count = len(cdf) - 1
    begins = np.searchsorted(cdf, np.arange(count + 1) / count, side="right") - 1
    return np.clip(begins, 0, count - 1).astype(np.uint32)


@dr.syntax
def _search(tables, row, count, x, active):
    """Number of the interval of a cumulative distribution that ``x`` falls into; ``tables``: cut points and
    distribution.
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
    """An array ``(tiles, P, 3)``, float64."""
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
    """Up to three shapes in words."""
    names = [repr(shape.id() or shape.class_name()) for shape in shapes]
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "") or "no shape"
