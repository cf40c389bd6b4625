"""Hidden elements that are visible from every point of a scan: their samples need no visibility rays.

All lines from an element to the scan lie in its *shaft*, the convex hull of both. Where no triangle of the scene meets
the inside of the shaft, nothing on it is ever hidden. The test is conservative: a triangle counts as outside where one
of a few planes tells the two apart, and what is in doubt needs rays.

Coordinates are those of the wall: ``w`` along the mean normal of the scan points, which fill a box. Each side of the
box and the element are touched by a plane, along ``u``, ``v`` and both diagonals; the element's own plane and the one
of the other triangle are tried besides. A lane takes an element through a tree of boxes over all triangles, depth
first, and leaves at the first triangle that may be in the way.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.plugins.kernel_arrays import host_numbers
from torchtransient.plugins.mitsuba_compat import mesh_faces, mesh_positions
from torchtransient.plugins.sampling.area_elements import TRIANGLE, AreaElements, morton_order
from torchtransient.plugins.sampling.hidden_elements import HiddenElements

# What single precision leaves of the largest coordinate: triangles that share an edge do not hide each other. Rays
# start 15 times farther off a surface.
ROUNDING = 6e-6
# Rays that are traced while a triangle is tested, and as many again for those that are not spared.
_RAYS_A_TRIANGLE = 1000
# Directions across the wall that shafts are cut off in.
_ACROSS = [(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0), (1.0, 1.0), (-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0)]


class ScanRegion:
    """Box around all points of a scan, aligned with their mean normal.

    Args:
        points, normals: scan points and laser spots, and their normals, (P, 3).
    """

    def __init__(self, points: np.ndarray, normals: np.ndarray) -> None:
        points, normals = (np.asarray(a, dtype=np.float64).reshape(-1, 3) for a in (points, normals))
        w = normals.mean(0)
        length = np.linalg.norm(w)
        w = w / length if length > 1e-6 else np.array([0.0, 0.0, 1.0])
        u = np.cross(w, np.eye(3)[np.abs(w).argmin()])
        u /= np.linalg.norm(u)
        self.frame = np.stack([u, np.cross(w, u), w])
        local = points @ self.frame.T
        self.low, self.high = local.min(0), local.max(0)
        self.scale = float(np.abs(points).max())

    def holds(self, points: np.ndarray) -> bool:
        """Return whether all points (P, 3) lie in the box, to rounding."""
        local = np.asarray(points, dtype=np.float64).reshape(-1, 3) @ self.frame.T
        slack = ROUNDING * self.scale
        return bool(np.all(local >= self.low - slack) and np.all(local <= self.high + slack))


def saves_time(scene: Any, rays: int) -> bool:
    """Return whether finding shafts takes less time than ``rays`` visibility rays, some of which they spare.

    It costs some 400 rays a triangle.

    Args:
        scene: built scene.
        rays: number of rays.
    """
    triangles = sum(int(shape.face_count()) for shape in scene.shapes() if shape.is_mesh())
    return rays > _RAYS_A_TRIANGLE * triangles


def spare_rays(scene: Any, elements: HiddenElements, points: np.ndarray, normals: np.ndarray) -> float:
    """Put elements that nothing hides from the scan first in a table: their samples need no visibility rays.

    Args:
        scene: built scene, which has to stay as it is; moved shapes need another table.
        elements: table of the hidden elements, which is changed.
        points, normals: all scan points and laser spots, and their normals, (P, 3).

    Returns:
        Share of the samples without visibility rays.
    """
    region = ScanRegion(points, normals)
    clear = clear_elements(scene.shapes(), elements.elements, region, elements.smooth)
    elements.put_first(clear, region)
    return float(elements.probabilities[:, : int(clear.sum())].sum(1).mean())


def clear_elements(shapes: list[Any], elements: AreaElements, region: ScanRegion, smooth: bool = False) -> np.ndarray:
    """Find the elements that nothing hides from any point of a region.

    Args:
        shapes: all shapes of the scene.
        elements: the hidden ones.
        region: box of scan points and laser spots.
        smooth: normals are interpolated, so that points may be seen from behind their planes; then only elements with
            the region on one side of their planes are clear.

    Returns:
        Mask (E,) of clear elements: triangles that lie before the whole region.
    """
    found = np.zeros(len(elements), dtype=bool)
    numbers = np.flatnonzero(elements.kind == TRIANGLE)
    corners = elements.axes[numbers, 0][:, None] + elements.axes[numbers, :3] * [[0], [1], [1]]
    corners = corners @ region.frame.T
    slack = ROUNDING * max(region.scale, float(np.abs(corners).max(initial=0)))
    normal, two_sided = elements.normal[numbers] @ region.frame.T, elements.two_sided[numbers]
    normal, one_side = _turned_to(region, corners[:, 0], normal, two_sided)
    # The planes across need an element that lies ahead of the region, not beside it.
    some = corners[:, :, 2].min(1) > region.high[2] + slack
    if smooth:
        some &= one_side
    if not some.any():
        return found
    planes = _shafts(corners[some], normal[some], (~two_sided | one_side)[some], region)
    tree = ObstacleTree(shapes, region, corners[some], slack)
    found[numbers[some]] = ~_met(tree, planes, corners[some])
    return found


def _turned_to(region: ScanRegion, p: np.ndarray, normal: np.ndarray, two_sided: np.ndarray) -> tuple[Any, Any]:
    """Return normals of the planes through ``p``, and a mask of those with the whole region in front.

    Normals of two-sided elements are turned round where the whole region lies behind.
    """
    height = (normal * p).sum(1)
    least, most = _extent(normal, region.low, region.high)
    flipped = two_sided & (most <= height)
    return np.where(flipped[:, None], -normal, normal), flipped | (least >= height)


def _extent(n: np.ndarray, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the least and largest coordinate of a box along normals (N, 3)."""
    return np.minimum(n * low, n * high).sum(1), np.maximum(n * low, n * high).sum(1)


def _shafts(corners: np.ndarray, normal: np.ndarray, seen_from_front: np.ndarray, region: ScanRegion) -> np.ndarray:
    """Return planes ``[a, b]`` (E, planes, 4): points with ``a . p > b`` are outside of the shaft.

    ``seen_from_front``: no line of an element goes behind its plane.
    """
    low, high = region.low, region.high
    w, zero = corners[:, :, 2], np.zeros(len(corners))
    planes = []
    for a, b in _ACROSS:
        side = a * (high[0] if a > 0 else low[0]) + b * (high[1] if b > 0 else low[1])
        reach = a * corners[:, :, 0] + b * corners[:, :, 1] - side
        # Through the far edge of the box where the shaft widens, through the near one where it narrows.
        wide, narrow = (reach / (w - low[2])).max(1), (reach / (w - high[2])).max(1)
        slope, start = np.where(wide >= 0, wide, narrow), np.where(wide >= 0, low[2], high[2])
        planes.append(np.stack([zero + a, zero + b, -slope, side - slope * start], 1))
    planes.append(np.stack([zero, zero, zero + 1, w.max(1)], 1))
    planes.append(np.stack([zero, zero, zero - 1, zero - low[2]], 1))
    behind = np.concatenate([-normal, -(normal * corners[:, 0]).sum(1, keepdims=True)], 1)
    planes.append(np.where(seen_from_front[:, None], behind, [0, 0, 0, np.inf]))
    return np.stack(planes, 1)


class ObstacleTree:
    """Complete binary tree of boxes over everything that can hide an element, in the region's coordinates.

    A leaf is a triangle, or the box of a shape without triangles. Node 1 is the root; 2 n and 2 n + 1 are below node n.
    A plain class.
    """

    def __init__(self, shapes: list[Any], region: ScanRegion, hidden: np.ndarray, slack: float) -> None:
        triangles, boxes = _obstacles(shapes, region.frame)
        triangles = triangles[~_harmless(triangles, region, hidden, slack)]
        low = np.concatenate([triangles.min(1), boxes[:, 0]])
        high = np.concatenate([triangles.max(1), boxes[:, 1]])
        order = morton_order(low + high)
        depth = max(1, int(len(order) - 1).bit_length()) if len(order) else 1
        leaves = 2**depth
        # Nothing meets an empty box.
        bounds = np.stack([np.full((2 * leaves, 3), np.inf), np.full((2 * leaves, 3), -np.inf)], 1)
        bounds[leaves : leaves + len(order)] = np.stack([low, high], 1)[order]
        for level in range(depth - 1, -1, -1):
            below = bounds[2 ** (level + 1) : 2 ** (level + 2)].reshape(-1, 2, 2, 3)
            bounds[2**level : 2 ** (level + 1)] = np.stack([below[:, :, 0].min(1), below[:, :, 1].max(1)], 1)
        corners = np.full((leaves, 3, 3), np.nan)
        corners[: len(order)] = np.concatenate([triangles, np.full((len(boxes), 3, 3), np.nan)])[order]
        self.leaves, self.slack = dr.opaque(mi.UInt32, leaves), dr.opaque(mi.Float64, slack)
        self.low, self.high = (mi.Point3d(bounds[:, i].T) for i in (0, 1))
        self.corners = [mi.Point3d(corners[:, i].T) for i in range(3)]
        self.region = mi.Vector3d(region.low), mi.Vector3d(region.high)
        dr.make_opaque(self.low, self.high, self.corners, self.region)


def _obstacles(shapes: list[Any], frame: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return triangles (T, 3, 3) of meshes, and boxes (B, 2, 3) around all other shapes, in the frame."""
    triangles, boxes = [np.zeros((0, 3, 3))], [np.zeros((0, 2, 3))]
    for shape in shapes:
        if shape.is_mesh() and not shape.is_ellipsoids():
            v = host_numbers(mesh_positions(shape)).reshape(-1, 3) @ frame.T
            triangles.append(v[np.array(mesh_faces(shape), dtype=np.int64).reshape(-1, 3)])
        elif shape.bbox().valid():
            ends = [np.array(end, dtype=np.float64) for end in (shape.bbox().min, shape.bbox().max)]
            box = np.stack(np.meshgrid(*zip(*ends, strict=True), indexing="ij"), -1).reshape(-1, 3) @ frame.T
            boxes.append(np.stack([box.min(0), box.max(0)])[None])
    return np.concatenate(triangles), np.concatenate(boxes)


def _harmless(triangles: np.ndarray, region: ScanRegion, hidden: np.ndarray, slack: float) -> np.ndarray:
    """Return a mask of triangles with region and hidden geometry on one side, as those of a flat wall."""
    n = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    n /= np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-300)
    height = (n * triangles[:, 0]).sum(1)
    ends = [_extent(n, region.low, region.high), _extent(n, hidden.min((0, 1)), hidden.max((0, 1)))]
    above = [least >= height - slack for least, _ in ends]
    below = [most <= height + slack for _, most in ends]
    return (above[0] & above[1]) | (below[0] & below[1])


def _met(tree: ObstacleTree, planes: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return a mask of the shafts that meet a triangle."""
    shafts = [mi.Vector4d(planes[:, i].T) for i in range(planes.shape[1])]
    own = [mi.Vector3d(corners[:, i].T) for i in range(3)]
    dr.make_opaque(shafts, own)
    return np.array(_traverse(tree, shafts, own), dtype=bool)


@dr.syntax
def _traverse(tree, shafts, own):
    node = mi.UInt32(1)
    met = dr.full(mi.Mask, False, dr.width(own[0]))
    going = ~met
    while dr.hint(going, label="shafts"):
        outside = _box_outside(tree, shafts, node)
        leaf = ~outside & (node >= tree.leaves)
        met |= leaf & ~_triangle_outside(tree, shafts, own, node - tree.leaves, leaf)
        down = ~outside & ~leaf
        # Otherwise to the next node beside this one, or beside one above it.
        up = node >> dr.tzcnt(~node)
        node = dr.select(down, 2 * node, up + 1)
        going = down | ((up != 0) & ~met)
    return met


def _box_outside(tree, shafts, node):
    """Return a mask of boxes beyond one of the planes, by the corner that lies farthest inside."""
    low, high = dr.gather(mi.Point3d, tree.low, node), dr.gather(mi.Point3d, tree.high, node)
    outside = low.x > high.x
    for plane in shafts:
        inmost = sum(dr.minimum(plane[i] * low[i], plane[i] * high[i]) for i in range(3))
        outside |= inmost >= plane.w - tree.slack
    return outside


def _triangle_outside(tree, shafts, own, leaf, active):
    """Return a mask of triangles outside of the shafts, as :func:`_box_outside`; False for boxes.

    Triangles with element and region on one side of their plane count as outside.
    """
    corners = [mi.Vector3d(dr.gather(mi.Point3d, c, leaf, active)) for c in tree.corners]
    outside = mi.Mask(False)
    for plane in shafts:
        a = mi.Vector3d(plane.x, plane.y, plane.z)
        outside |= _least([dr.dot(a, c) for c in corners]) >= plane.w - tree.slack
    n = dr.normalize(dr.cross(corners[1] - corners[0], corners[2] - corners[0]))
    height = dr.dot(n, corners[0])
    low, high = tree.region
    for side in (1, -1):
        region = sum(dr.minimum(side * n[i] * low[i], side * n[i] * high[i]) for i in range(3))
        element = _least([side * dr.dot(n, c) for c in own])
        outside |= dr.minimum(region, element) >= side * height - tree.slack
    return outside


def _least(values):
    return dr.minimum(dr.minimum(values[0], values[1]), values[2])
