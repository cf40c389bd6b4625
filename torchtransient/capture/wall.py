"""Relay walls as surfaces that points are laid out on: a parallelogram or a triangle mesh."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchtransient.checks import Numbers, checked_mesh, count, positive, real_array, shares, shown, transform
from torchtransient.errors import ArgumentError, SceneError, ShapeError, UnitError

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

# A point counts as lying on the wall up to this part of the wall's diagonal: coordinates of files have five digits.
ON_WALL = 1e-4
# From the edges of a wall, in parts of its size and its distance from the origin.
_EDGE = 2.0**-20
# Pairs of a ray and a triangle that are tested in one array.
_PAIRS_AT_ONCE = 2**20
# Rays through a shared edge must not slip between its triangles: the barycentric coordinates of a hit may lack this.
_BARY_SLACK = 1e-9
# Indices of points have 32 bits in kernels.
_MOST_POINTS = 2**32 - 1


@dataclass(frozen=True, eq=False)
class Wall:
    """Relay wall with coordinates (u, v) in [0, 1]^2, of which (0.5, 0.5) is `center`. Lengths in metres.

    Make one with :meth:`plane`, :meth:`mesh` or, of anything that describes a wall, :meth:`of`.

    Attributes:
        center: (3,), middle of the wall.
        half_u, half_v: (3,), from the middle to the edges at u = 1 and v = 1. A flat wall is the parallelogram
            ``center + (2u - 1) half_u + (2v - 1) half_v``.
        normal: (3,), unit vector into the room that the wall sees. On a curved wall a point is found by going from its
            place in the parallelogram along the normal (the mesh's mean normal) to the mesh, from the front.
        shape: Mitsuba dictionary that a renderer builds the wall from.
        vertices, faces: (V, 3) and (F, 3) of a curved wall, None for a flat one.

    Picklable.
    """

    center: Array
    half_u: Array
    half_v: Array
    _: KW_ONLY
    normal: Array
    shape: Mapping[str, Any]
    vertices: Array | None = None
    faces: NDArray[np.int64] | None = None

    @classmethod
    def plane(
        cls,
        width: float = 2.0,
        height: float = 2.0,
        *,
        center: Numbers = (0.0, 0.0, 0.0),
        normal: Numbers = (0.0, 0.0, 1.0),
        up: Numbers = (0.0, 1.0, 0.0),
        albedo: float | Numbers = 0.5,
    ) -> Wall:
        """Return a diffuse rectangle. u runs along `up x normal`, v along `up` as far as it lies in the wall.

        Args:
            width: width of the wall, metres.
            height: height of the wall, metres.
            center: middle of the wall (3,), metres.
            normal: normal of the wall (3,), of any length.
            up: direction that is up along the wall (3,), of any length.
            albedo: albedo of the wall, one number or a linear sRGB triple.

        Raises:
            UnitError: for sizes that are not positive or albedos outside of [0, 1].
            SceneError: for a normal without a direction or along `up`.
        """
        width, height = positive("Wall.plane: width", width), positive("Wall.plane: height", height)
        n, u, v = _frame(triple("Wall.plane normal", normal), triple("Wall.plane up", up), "Wall.plane")
        to_world = np.eye(4)
        to_world[:3, 0], to_world[:3, 1], to_world[:3, 2] = u * width / 2, v * height / 2, n
        to_world[:3, 3] = triple("Wall.plane center", center)
        return cls.of({"type": "rectangle", "to_world": to_world, "bsdf": _diffuse(albedo)})

    @classmethod
    def mesh(
        cls,
        vertices: Any,
        faces: Any,
        *,
        up: Numbers = (0.0, 1.0, 0.0),
        albedo: float | Numbers = 0.5,
    ) -> Wall:
        """Return a diffuse triangle mesh. u and v span the smallest rectangle across the mean normal that holds the
        mesh.

        Args:
            vertices: (V, 3), metres.
            faces: (F, 3) whole numbers, wound against the clock as seen from the room.
            up: direction that is up along the wall (3,), of any length.
            albedo: albedo of the wall, one number or a linear sRGB triple.

        Raises:
            ShapeError: for other shapes or indices.
            UnitError: for numbers that are not finite.
            SceneError: for a mesh without a mean normal.
        """
        points, triangles = checked_mesh("Wall.mesh", vertices, faces)
        corners = points[triangles]
        areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])  # twice
        mean = areas.sum(0)
        if not np.linalg.norm(mean) > 1e-3 * np.linalg.norm(areas, axis=1).sum():
            raise SceneError(
                "Wall.mesh: expected a surface that faces one side, got one whose normals cancel: a closed body, or "
                "triangles wound both ways. Give the visible part alone, its corners against the clock."
            )
        n, u, v = _frame(mean, triple("Wall.mesh up", up), "Wall.mesh")
        along = (points @ np.stack([u, v, n]).T)[triangles.reshape(-1)]
        low, high = along.min(0), along.max(0)
        middle = (low + high) / 2
        return cls(
            center=middle[0] * u + middle[1] * v + middle[2] * n,
            half_u=(high[0] - low[0]) / 2 * u,
            half_v=(high[1] - low[1]) / 2 * v,
            normal=n,
            shape={"type": "mesh_arrays", "vertices": points, "faces": triangles, "bsdf": _diffuse(albedo)},
            vertices=points,
            faces=triangles,
        )

    @classmethod
    def of(cls, description: Any) -> Wall:
        """Return the wall of a description.

        Args:
            description: a wall; a Mitsuba dictionary of a `rectangle` or of `mesh_arrays`; or a pair (vertices, faces).

        Raises:
            SceneError, ArgumentError: for anything else; then errors as :meth:`mesh`.
        """
        if isinstance(description, Wall):
            return description
        if isinstance(description, Mapping):
            kind = str(description.get("type"))
            matrix = transform("Wall: to_world", description.get("to_world", np.eye(4)))
            if kind == "rectangle":
                return cls._rectangle(description, matrix)
            if kind == "mesh_arrays":
                points, triangles = checked_mesh("Wall", description.get("vertices"), description.get("faces"))
                if description.get("flip_normals"):
                    triangles = triangles[:, ::-1]
                placed = cls.mesh(points @ matrix[:3, :3].T + matrix[:3, 3], triangles)
                return cls(**{**placed.__dict__, "shape": description})
            raise SceneError(
                f"Wall: expected a Mitsuba dictionary of type 'rectangle' or 'mesh_arrays', got {kind!r}. Give the "
                "triangles of other shapes: Wall.mesh(vertices, faces)."
            )
        if isinstance(description, Sequence) and len(description) == 2:
            return cls.mesh(*description)
        raise ArgumentError(
            "Wall: expected Wall.plane(...), a Mitsuba dictionary of a rectangle, or a pair (vertices, faces), got "
            f"{type(description).__name__}."
        )

    @classmethod
    def _rectangle(cls, description: Mapping[str, Any], matrix: Array) -> Wall:
        half_u, half_v = matrix[:3, 0], matrix[:3, 1]
        # Normals go by the inverse transpose; Mitsuba's keep their side when the transform mirrors.
        try:
            normal = np.linalg.inv(matrix[:3, :3])[2]
        except np.linalg.LinAlgError:
            raise SceneError(f"Wall: expected a to_world with an inverse, got {matrix.tolist()}.") from None
        if description.get("flip_normals"):
            normal = -normal
        return cls(matrix[:3, 3], half_u, half_v, normal=normal / np.linalg.norm(normal), shape=description)

    @property
    def width(self) -> float:
        """Length along u, metres."""
        return float(2 * np.linalg.norm(self.half_u))

    @property
    def height(self) -> float:
        """Length along v, metres."""
        return float(2 * np.linalg.norm(self.half_v))

    @property
    def diagonal(self) -> float:
        """The longer diagonal of the rectangle that (u, v) spans, metres."""
        a, b = self.half_u + self.half_v, self.half_u - self.half_v
        return float(2 * max(np.linalg.norm(a), np.linalg.norm(b)))

    def at(self, u: Any, v: Any) -> tuple[Array, Array]:
        """Return points and unit normals (..., 3) at coordinates.

        Args:
            u: coordinate along `half_u`, in [0, 1], broadcast with `v`. Points on the edges are placed a millionth of
                the wall's size inside, where rays in single precision hit it.
            v: coordinate along `half_v`, in [0, 1].

        Raises:
            SceneError: for coordinates outside of [0, 1] and for holes of a curved wall.
        """
        u, v = np.broadcast_arrays(np.asarray(u, np.float64), np.asarray(v, np.float64))
        if not (np.all((u >= 0) & (u <= 1)) and np.all((v >= 0) & (v <= 1))):
            raise SceneError("Wall.at: expected coordinates (u, v) between 0 and 1, got some outside of the wall.")
        u, v = (self._inside(x, half)[..., None] for x, half in ((u, self.half_u), (v, self.half_v)))
        flat = self.center + (2 * u - 1) * self.half_u + (2 * v - 1) * self.half_v
        if self.vertices is None:
            return flat, np.broadcast_to(self.normal, flat.shape).copy()
        points, normals, hit = self._from_front(flat.reshape(-1, 3))
        if not hit.all():
            missed = np.flatnonzero(~hit)
            raise SceneError(
                f"Wall: {len(missed)} of {len(hit)} points do not meet the mesh along its mean normal, the first at "
                f"(u, v) = ({u.flat[missed[0]]:.4g}, {v.flat[missed[0]]:.4g}). Scan a part of the wall that has no "
                "holes: extent=(u0, v0, u1, v1)."
            )
        return points.reshape(flat.shape), normals.reshape(flat.shape)

    def _inside(self, share: Array, half: Array) -> Array:
        """Return coordinates as far from the edges as single precision needs."""
        margin = _EDGE * (self.diagonal + np.abs(self.center).max()) / (2 * np.linalg.norm(half))
        return np.clip(share, margin, 1 - margin)

    def grid(
        self, size: int | Sequence[int], extent: Numbers | None = None, *, cell_centers: bool = True
    ) -> tuple[Array, Array]:
        """Return points and normals of a regular grid; rows run along v, columns along u.

        Args:
            size: (nx, ny), or one number for both.
            extent: part of the wall that is scanned, (u0, v0, u1, v1), None for all of it.
            cell_centers: points are the middles of nx x ny cells; else they begin and end on the edges of the extent (a
                single one stands in the middle).

        Returns:
            Points and unit normals, (ny, nx, 3) each, metres.

        Raises:
            ShapeError: for sizes below 1.
            SceneError: for an extent without an area or outside of the wall, and as :meth:`at`.
        """
        nx, ny = grid_size(size, "Wall.grid")
        u0, v0, u1, v1 = _extent(extent)
        u, v = _places(nx, u0, u1, cell_centers), _places(ny, v0, v1, cell_centers)
        return self.at(u[None, :], v[:, None])

    def normals_at(self, points: Array, what: str) -> Array:
        """Return the unit normals at points of the wall.

        Args:
            points: (N, 3), metres, on the wall up to `ON_WALL` of its diagonal.
            what: name of the points, for messages.

        Returns:
            (N, 3).

        Raises:
            SceneError: for points beside it.
        """
        relative = points - self.center
        basis = np.stack([self.half_u, self.half_v, self.normal], axis=1)
        a, b, height = np.linalg.solve(basis, relative.T)
        tolerance = ON_WALL * self.diagonal
        margin_u, margin_v = (1 + tolerance / np.linalg.norm(h) for h in (self.half_u, self.half_v))
        inside = (np.abs(a) <= margin_u) & (np.abs(b) <= margin_v)
        normals = np.broadcast_to(self.normal, points.shape).copy()
        if self.vertices is not None:
            flat = points - height[:, None] * self.normal
            found, normals, hit = self._from_front(flat)
            height = np.where(hit, ((points - found) * self.normal).sum(1), np.inf)
        off = np.flatnonzero(~inside | ~(np.abs(height) <= tolerance))
        if len(off):
            first = points[off[0]]
            where = "beside it" if not inside[off[0]] else f"{abs(height[off[0]]):.4g} m off it"
            raise SceneError(
                f"{what}: expected points on the wall, got {len(off)} of {len(points)} elsewhere, the first at "
                f"{np.array2string(first, precision=4)}, {where}. The wall is {self.width:.4g} x {self.height:.4g} m "
                f"around {np.array2string(self.center, precision=4)}; Wall.at(u, v) gives points on it."
            )
        return normals

    def _from_front(self, places: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
        """First points of the mesh met by rays that come from the room through `places` (N, 3), their normals, and
        whether there is one.
        """
        assert self.vertices is not None and self.faces is not None
        corners = self.vertices[self.faces]
        above = (self.vertices @ self.normal).max() - places @ self.normal + self.diagonal
        distance, triangle = first_hits(places + above[:, None] * self.normal, -self.normal, corners)
        hit = triangle >= 0
        points = places + (above - np.where(hit, distance, 0.0))[:, None] * self.normal
        normals = _triangle_normals(corners)[triangle]
        back = hit & ((normals * self.normal).sum(1) <= 0)
        if back.any():
            raise SceneError(
                f"Wall: {int(back.sum())} points lie on triangles that turn their back to the room. Wind the corners "
                "of all triangles against the clock, as seen from the room."
            )
        return points, normals, hit

    def __repr__(self) -> str:
        kind = "plane" if self.faces is None else f"{len(self.faces)} triangles"
        place = np.array2string(self.center, precision=4, separator=", ")
        return f"Wall({kind}, {self.width:.4g} x {self.height:.4g} m, center={place})"


def triple(what: str, values: Any) -> Array:
    """Return three finite numbers as float64 (3,).

    Args:
        what: subject of messages.
        values: numbers of any library.

    Raises:
        ShapeError, UnitError: for anything else.
    """
    array = real_array(values)
    if array is None or array.shape != (3,):
        raise ShapeError(f"{what}: expected three numbers [x, y, z], got {shown(values)}.")
    if not np.isfinite(array).all():
        raise UnitError(f"{what}: expected finite metres, got {array.tolist()}.")
    return array


def grid_size(size: int | Sequence[int], who: str) -> tuple[int, int]:
    """Return (nx, ny).

    Args:
        size: one whole number or a pair, at least 1.
        who: subject of messages.

    Raises:
        ShapeError: for anything else.
    """
    given: Any = size
    pair = tuple(given) if isinstance(given, Sequence) or getattr(given, "ndim", 0) == 1 else (given, given)
    if len(pair) != 2:
        raise ShapeError(f"{who}: expected (nx, ny) or one whole number, got {shown(size)}.")
    nx, ny = (count(f"{who}: size", n, 1, ShapeError) for n in pair)
    if nx * ny > _MOST_POINTS:
        raise ShapeError(f"{who}: expected at most {_MOST_POINTS} points in all, got {shown(size)}.")
    return nx, ny


def _frame(normal: Array, up: Array, who: str) -> tuple[Array, Array, Array]:
    length = np.linalg.norm(normal)
    if not length > 0:
        raise SceneError(f"{who}: expected a normal with a direction, got {normal.tolist()}.")
    n = normal / length
    u = np.cross(up, n)
    if not np.linalg.norm(u) > 1e-9 * np.linalg.norm(up):
        raise SceneError(f"{who}: up {up.tolist()} is parallel to the wall's normal; choose another up=.")
    u = u / np.linalg.norm(u)
    return n, u, np.cross(n, u)


def _diffuse(albedo: float | Numbers) -> dict[str, Any]:
    values = shares("Wall: albedo", albedo)
    plain: Any = {"type": "rgb", "value": list(values)} if isinstance(values, tuple) else values
    return {"type": "diffuse", "reflectance": plain}


def _extent(extent: Numbers | None) -> tuple[float, float, float, float]:
    if extent is None:
        return 0.0, 0.0, 1.0, 1.0
    given = real_array(extent)
    if given is None or given.shape != (4,):
        raise ShapeError(f"extent: expected four coordinates of the wall (u0, v0, u1, v1), got {shown(extent)}.")
    u0, v0, u1, v1 = given.tolist()
    if not (0 <= u0 < u1 <= 1 and 0 <= v0 < v1 <= 1):
        raise SceneError(f"extent: expected 0 <= u0 < u1 <= 1 and 0 <= v0 < v1 <= 1, got {extent!r}.")
    return u0, v0, u1, v1


def _places(count: int, low: float, high: float, centers: bool) -> Array:
    share = (np.arange(count) + 0.5) / count if centers or count == 1 else np.arange(count) / (count - 1)
    return low + (high - low) * share


# ----------------------------------------------------------------------------------------------- rays against triangles


def first_hits(origins: Array, direction: Array, corners: Array) -> tuple[Array, Indices]:
    """Find the first triangle that each of some parallel rays meets, from either side.

    Args:
        origins: (N, 3).
        direction: unit vector (3,), the same for all rays.
        corners: corners of triangles (F, 3, 3).

    Returns:
        Distance (N,) and index (N,) of the triangle; infinity and -1 for rays that meet none.

    Source: Moeller and Trumbore (1997), for pairs alone whose ray is within the box of the triangle across the rays.
    """
    first = np.cross(direction, np.eye(3)[np.abs(direction).argmin()])
    first /= np.linalg.norm(first)
    frame = np.stack([first, np.cross(direction, first)], axis=1)
    places, flat = origins @ frame, corners @ frame
    slack = 1e-6 * np.ptp(flat.reshape(-1, 2), axis=0)
    low, high = flat.min(1) - slack, flat.max(1) + slack
    order = np.argsort(places[:, 0], kind="stable")
    x, y = places[order].T.copy()
    begin = np.searchsorted(x, low[:, 0])
    counts = np.searchsorted(x, high[:, 0]) - begin
    total = np.cumsum(counts)
    distances, indices = np.full(len(origins), np.inf), np.full(len(origins), -1, dtype=np.int64)
    start = 0
    while start < len(corners):
        # As many triangles as fit, and one at least.
        stop = max(start + 1, int(np.searchsorted(total, total[start] - counts[start] + _PAIRS_AT_ONCE, side="right")))
        here = counts[start:stop]
        place = np.arange(here.sum()) + np.repeat(begin[start:stop] - (np.cumsum(here) - here), here)
        beside = y[place]
        near = np.flatnonzero(
            (beside >= np.repeat(low[start:stop, 1], here)) & (beside <= np.repeat(high[start:stop, 1], here))
        )
        ray, triangle = order[place[near]], np.repeat(np.arange(start, stop), here)[near]
        t = _distances(origins[ray], direction, corners[triangle])
        # Of equally near ones the first in the mesh, as a search over all triangles would have it.
        nearest = np.lexsort((triangle, t, ray))
        nearest = nearest[np.unique(ray[nearest], return_index=True)[1]]
        nearest = nearest[t[nearest] < distances[ray[nearest]]]
        distances[ray[nearest]], indices[ray[nearest]] = t[nearest], triangle[nearest]
        start = stop
    return distances, indices


def _distances(origins: Array, direction: Array, corners: Array) -> Array:
    """Return distances along rays (N, 3) to a triangle (N, 3, 3) of each; infinity for a ray that passes it."""
    a, first, second = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    across = np.cross(direction, second)
    determinant = (first * across).sum(1)
    # What the ray runs along has no point to meet; relative to the edges, since small triangles are triangles too.
    scale = np.linalg.norm(first, axis=1) * np.linalg.norm(second, axis=1)
    open_to_ray = np.abs(determinant) > 1e-12 * scale
    inverse = np.where(open_to_ray, 1 / np.where(open_to_ray, determinant, 1.0), 0.0)
    to_origin = origins - a
    u = (to_origin * across).sum(1) * inverse
    other = np.cross(to_origin, first)
    v = (other @ direction) * inverse
    t = (other * second).sum(1) * inverse
    met = open_to_ray & (u >= -_BARY_SLACK) & (v >= -_BARY_SLACK) & (u + v <= 1 + _BARY_SLACK) & (t > 0)
    return np.where(met, t, np.inf)


def _triangle_normals(corners: Array) -> Array:
    """Return unit normals (F, 3) of triangles (F, 3, 3) by the winding of their corners, zero without an area."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.asarray(normals / np.where(length > 0, length, 1.0))
