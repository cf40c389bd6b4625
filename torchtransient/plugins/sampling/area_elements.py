"""Area elements of shapes as rows of one table: every triangle of a mesh, every analytic shape as one.

A point of an element is drawn uniformly over its area from two numbers; ``torchtransient`` does so itself, since
Mitsuba 3.9 has densities that are wrong for rectangles under non-uniform scales, and since a virtual call would compile
the sampling of every shape there is. Laid out with numpy, outside of kernels.

======== ==================================== ==================================================
kind     origin, axes                         point from ``(a, y)``, ``phi = 2 pi a``
======== ==================================== ==================================================
triangle corner, two edges, see below         ``o + e1 s (1 - a) + e2 s a``, ``s = sqrt(y)``
disk     centre, two radii, unused            ``o + a1 s cos phi + a2 s sin phi``, ``s = sqrt(y)``
sphere   centre, three axes of its radius     ``o + R (s cos phi, s sin phi, z)``, ``z = 1 - 2 y``
cylinder centre of the foot, two radii, axis  ``o + a1 cos phi + a2 sin phi + a3 y``
======== ==================================== ==================================================

The last axis of a triangle that is part of a larger one says which part: ``(b1, b2, scale)``, the barycentrics of its
corner in the whole one, and what its edges are of that one's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.plugins.kernel_arrays import host_numbers
from torchtransient.plugins.mitsuba_compat import has_normals, mesh_faces, mesh_normals, mesh_positions
from torchtransient.plugins.mitsuba_shapes import has_surface
from torchtransient.plugins.node_walk import shown_by
from torchtransient.plugins.parameter_effect import class_of

TRIANGLE, DISK, SPHERE, CYLINDER = range(4)
_KINDS = {"Disk": DISK, "Sphere": SPHERE, "Cylinder": CYLINDER}
# Points that stand for an element that is not flat or not small.
_ACROSS = 4
# By how much angles and lengths of axes may differ in single precision.
_SHEAR = 1e-4


@dataclass
class AreaElements:
    """Elements of shapes in the order of shapes and primitives, float64; ``E`` of them.

    Attributes:
        axes: origin and three axes, (E, 4, 3).
        kind, shape, primitive, area: row of the table above, numbers of shape and primitive, square metres, (E,).
        normal: normals of flat elements, (E, 3), on the side that shading normals take for the front; else
            ``(sign / radius, 0, 0)``.
        two_sided: light scatters on the back as well, (E,).
        left_out: names of the shapes without rows: copies of groups, curves, signed distances, ellipsoids.
    """

    axes: np.ndarray
    kind: np.ndarray
    shape: np.ndarray
    primitive: np.ndarray
    area: np.ndarray
    normal: np.ndarray
    two_sided: np.ndarray
    left_out: list[str]

    @staticmethod
    def from_shapes(shapes: list[Any]) -> AreaElements:
        """Build the elements of Mitsuba shapes, those without area included."""
        parts, left_out = [], []
        for number, shape in enumerate(shapes):
            rows = _rows_of(shape)
            if rows is None:
                left_out.append(shape.id() or class_of(shape))
                continue
            axes, kind, area, normal = rows
            count = len(area)
            two_sided = bool(mi.has_flag(shape.bsdf().flags(), mi.BSDFFlags.BackSide))
            parts.append(
                (
                    axes,
                    np.full(count, kind),
                    np.full(count, number),
                    np.arange(count),
                    area,
                    normal,
                    np.full(count, two_sided),
                )
            )
        if not parts:
            empty = np.zeros(0)
            parts = [(np.zeros((0, 4, 3)), empty, empty, empty, empty, np.zeros((0, 3)), empty.astype(bool))]
        return AreaElements(*(np.concatenate(column) for column in zip(*parts, strict=True)), left_out)

    def __len__(self) -> int:
        return len(self.area)

    def take(self, order: np.ndarray) -> AreaElements:
        """Return the elements of the given numbers, in order."""
        return AreaElements(*(column[order] for column in self.columns()), self.left_out)

    def columns(self) -> tuple[np.ndarray, ...]:
        """Return the arrays, without the names of the shapes left out."""
        return self.axes, self.kind, self.shape, self.primitive, self.area, self.normal, self.two_sided

    def centers(self) -> np.ndarray:
        """Return a point of (or in) each element, (E, 3)."""
        o, a, b, c = (self.axes[:, i] for i in range(4))
        return o + np.select(
            [self.kind[:, None] == TRIANGLE, self.kind[:, None] == CYLINDER], [(a + b) / 3, c / 2], np.zeros(3)
        )

    def points(self, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return points spread over some elements, and normals there: two arrays (M, P, 3).

        One point, its centre, for triangles, and 16 for all others, of which there are few.

        Args:
            numbers: numbers of the elements, (M,).
        """
        part = self.take(numbers)
        if np.all(part.kind == TRIANGLE):
            return part.centers()[:, None], part.normal[:, None]
        a, y = (g.ravel() for g in np.meshgrid(*[(np.arange(_ACROSS) + 0.5) / _ACROSS] * 2))
        x = local_point(part.kind[:, None], a[None], y[None], np)
        p = part.axes[:, None, 0] + sum(x[i][..., None] * part.axes[:, None, i + 1] for i in range(3))
        radial = (
            p
            - part.axes[:, None, 0]
            - np.where(part.kind == CYLINDER, 1, 0)[:, None, None] * (x[2][..., None] * part.axes[:, None, 3])
        )
        flat = (part.kind == TRIANGLE) | (part.kind == DISK)
        return p, np.where(flat[:, None, None], part.normal[:, None], radial * part.normal[:, None, :1])


def local_point(kind: Any, a: Any, y: Any, math_of: Any, kinds: tuple[int, ...] = (0, 1, 2, 3)) -> list[Any]:
    """Return the weights of the three axes of elements for a point, see the table above.

    Args:
        kind: kinds of the elements.
        a, y: two numbers in [0, 1).
        math_of: module with ``sqrt``, ``cos``, ``sin`` and ``where`` (numpy) or ``select`` (Dr.Jit).
        kinds: kinds that there are.
    """
    select = getattr(math_of, "select", None) if math_of is dr else math_of.where
    s = math_of.sqrt(y)
    x = [s * (1 - a), s * a, 0.0]
    if any(k != TRIANGLE for k in kinds):
        cos, sin = math_of.cos(2 * math.pi * a), math_of.sin(2 * math.pi * a)
        z = 1 - 2 * y
        # 1 - z^2 without a difference of nearly equal numbers.
        q = math_of.sqrt(4 * y * (1 - y))
        others = {DISK: (s * cos, s * sin, 0.0), SPHERE: (q * cos, q * sin, z), CYLINDER: (cos, sin, y)}
        for k in kinds:
            if k in others:
                x = [select(kind == k, new, old) for new, old in zip(others[k], x, strict=True)]
    return x


def can_be_listed(shape: Any) -> bool:
    """Return True if points can be drawn on a shape.

    Not on copies of groups, curves, signed distances and ellipsoids, nor on sheared disks, spheres and cylinders, where
    Mitsuba's rays disagree with the matrix.

    Args:
        shape: one ``mi.Shape``.
    """
    if not has_surface(shape) or shape.is_ellipsoids():
        return False
    return bool(shape.is_mesh() or (shape.class_name() in _KINDS and not _is_sheared(shape)))


def _is_sheared(shape: Any) -> bool:
    """Return True if the axes of an analytic shape are not orthogonal, or those of a round one differ in length."""
    axes = _matrix(shape)[:3].T
    length = np.linalg.norm(axes, axis=1)
    same = {"Disk": [], "Sphere": [0, 1, 2], "Cylinder": [0, 1]}[shape.class_name()]
    # A disk has no thickness to be sheared.
    pairs = [(0, 1)] if shape.class_name() == "Disk" else [(0, 1), (0, 2), (1, 2)]
    oblique = any(abs(axes[i] @ axes[k]) > _SHEAR * length[i] * length[k] for i, k in pairs)
    return oblique or (bool(same) and float(np.ptp(length[same])) > _SHEAR * float(length[same].max()))


def _rows_of(shape: Any) -> tuple[np.ndarray, int, np.ndarray, np.ndarray] | None:
    """Return (axes, kind, area, normal) of one shape, None for a shape that cannot be listed."""
    if not can_be_listed(shape):
        return None
    return _triangles(shape) if shape.is_mesh() else _analytic(shape, _KINDS[shape.class_name()])


def _triangles(mesh: Any) -> tuple[np.ndarray, int, np.ndarray, np.ndarray]:
    v = host_numbers(mesh_positions(mesh)).reshape(-1, 3)
    f = np.array(mesh_faces(mesh), dtype=np.int64).reshape(-1, 3)
    o, e1, e2 = v[f[:, 0]], v[f[:, 1]] - v[f[:, 0]], v[f[:, 2]] - v[f[:, 0]]
    n = np.cross(e1, e2)
    twice = np.linalg.norm(n, axis=1)
    n /= np.where(twice > 0, twice, 1)[:, None]
    at_corners = _corner_normals(mesh, f)
    if at_corners is not None:
        # A mirrored transform turns the order of the corners around, and not what is the front.
        n *= np.where((at_corners.sum(1) * n).sum(1) < 0, -1, 1)[:, None]
    if mesh.has_flipped_normals():
        n = -n
    uncut = np.broadcast_to([0.0, 0.0, 1.0], o.shape)
    return np.stack([o, e1, e2, uncut], 1), TRIANGLE, twice / 2, n


def _corner_normals(mesh: Any, faces: np.ndarray) -> np.ndarray | None:
    """Return the normals at the corners of the triangles (F, 3, 3), None if there are only those of their planes."""
    if mesh.has_face_normals() or not has_normals(mesh):
        return None
    return host_numbers(mesh_normals(mesh)).reshape(-1, 3)[faces]


def has_shading_normals(shape: Any) -> bool:
    """Return True if the normals at the corners of some triangle are not those of one side of its plane.

    Args:
        shape: one ``mi.Shape``.
    """
    if not shape.is_mesh():
        return False
    at_corners = _corner_normals(shape, np.array(mesh_faces(shape), dtype=np.int64).reshape(-1, 3))
    if at_corners is None:
        return False
    _, _, area, n = _triangles(shape)
    cos = (at_corners * n[:, None]).sum(-1) * (-1 if shape.has_flipped_normals() else 1)
    return bool(np.any(cos[area > 0] < 1 - 1e-6))


def _matrix(shape: Any) -> np.ndarray:
    shown = next(v for v in shown_by(shape)[0] if v.key == "to_world")
    return host_numbers(shown.read(shape).matrix).reshape(4, 4)


def _analytic(shape: Any, kind: int) -> tuple[np.ndarray, int, np.ndarray, np.ndarray]:
    m = _matrix(shape)
    o, a, b, c = m[:3, 3], m[:3, 0], m[:3, 1], m[:3, 2]
    inside_out = -1.0 if shape.has_flipped_normals() else 1.0
    if kind == DISK:
        # Mitsuba's normal follows the inverse transpose, so a mirrored disk faces as its image does.
        n = np.linalg.inv(m[:3, :3])[2]
        axes, area, normal = [o, a, b, 0 * c], math.pi * np.linalg.norm(np.cross(a, b)), n / np.linalg.norm(n)
    elif kind == SPHERE:
        r = np.linalg.norm(a)
        axes, area = [o, *(r * np.eye(3))], 4 * math.pi * r * r
        normal = np.array([inside_out / r, 0, 0])
    else:
        r = np.linalg.norm(a)
        mirrored = math.copysign(1.0, np.linalg.det(m[:3, :3]))
        axes, area = [o, a, b, c], 2 * math.pi * r * np.linalg.norm(c)
        normal = np.array([mirrored * inside_out / r, 0, 0])
    return np.array(axes)[None], kind, np.array([area]), normal[None]


def morton_order(points: np.ndarray, bits: int = 10) -> np.ndarray:
    """Return the order of points along a Morton curve, which keeps neighbours together, (N,).

    Args:
        points: points, (N, 3).
        bits: bits of a coordinate.
    """
    if not len(points):
        return np.zeros(0, dtype=np.int64)
    extent = max(float(np.ptp(points, axis=0).max()), 1e-30)
    cell = np.clip((points - points.min(0)) / extent * (2**bits - 1), 0, 2**bits - 1).astype(np.int64)
    code = np.zeros(len(points), dtype=np.int64)
    for bit in range(bits):
        for axis in range(3):
            code |= ((cell[:, axis] >> bit) & 1) << (3 * bit + axis)
    return np.argsort(code, kind="stable")


def facing_weight(elements: AreaElements, points: np.ndarray, normals: np.ndarray, chunk: int = 1 << 16) -> np.ndarray:
    """Return the weight of elements in single-corner light that is sent and received at wall points, (E,).

    Area times the root mean square over wall points of ``cos^2 cos^2 / r^4``, with the cosines at both ends, without
    visibility and albedo.

    Args:
        elements: elements of hidden shapes.
        points, normals: points (metres) and normals of the wall, (P, 3).
        chunk: number of elements that are computed at once.
    """
    weight = np.zeros(len(elements))
    flat = elements.kind == TRIANGLE
    groups = [np.flatnonzero(flat)[i : i + chunk] for i in range(0, int(flat.sum()), chunk)]
    groups += [np.flatnonzero(~flat)] if not flat.all() else []
    for numbers in groups:
        x, n = elements.points(numbers)
        square = np.zeros(x.shape[:2])
        for p, wall_normal in zip(points, normals, strict=True):
            d = p - x
            r2 = np.maximum((d * d).sum(-1), 1e-30)
            there = (n * d).sum(-1)
            there = np.where(elements.two_sided[numbers, None], np.abs(there), np.maximum(there, 0))
            here = np.maximum(-(d * wall_normal).sum(-1), 0)
            square += (there * here) ** 4 / r2**8
        weight[numbers] = np.sqrt(square.mean(1) / len(points))
    return weight * elements.area
