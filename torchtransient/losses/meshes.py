"""Losses of triangle meshes: smoothness penalties of one mesh, and the distance of two surfaces.

Smoothness is added to a loss of the measurement, and holds a fitted shape together where the measurement is silent:
alone it is least for a shape without features. Neighbors share an edge by the numbers of its vertices; vertices in one
place under two numbers (seams of textures, facets) have to be merged first.
"""

from __future__ import annotations

from typing import Literal, get_args

import torch
from torch import Tensor

from torchtransient.checks import shown
from torchtransient.errors import ArgumentError, ShapeError, UnitError
from torchtransient.floating import is_true
from torchtransient.losses.checks import Reduction, check_dense, check_mask, counted, reduce, working_dtype
from torchtransient.losses.loss_module import LossModule

Weights = Literal["uniform", "cotangent"]
# The sine, or cotangent, of the sharpest corner that is told from none: ten times the rounding of single precision.
_SHARPEST = 1e-6
# Parts of a side of a triangle between the points whose distances are taken.
_CELLS = 4
# Numbers held at a time of one of the tensors (points, triangles, 3, 3).
_MOST = 1 << 24


# ---------------------------------------------------------------------------------------------------------- smoothness


def mesh_laplacian_smoothing(
    vertices: Tensor,
    faces: Tensor,
    *,
    weights: Weights = "uniform",
    mask: Tensor | None = None,
    reduction: Reduction = "mean",
) -> Tensor:
    """Compute the squared distance of each vertex from the mean of its neighbors, `|mean - vertex|^2`.

    Args:
        vertices: (..., V, 3).
        faces: vertex numbers (F, 3). Faces with a vertex twice are skipped.
        weights: "uniform", which also pulls the vertices of a flat mesh to even distances, or "cotangent" of the angles
            across each edge, which keeps the tessellation and moves vertices along the normal by the mean curvature.
            Cotangents are detached; edges whose cotangents sum up to less than zero have no weight.
        mask: vertices that count, (V,) or (..., V); False for a border, which would be pulled inwards. Neighbors that
            do not count are taken as they are, and have gradients.
        reduction: "mean" over vertices that count, "sum", or "none".

    Returns:
        Unit of the vertices, squared; scalar, or (..., V) for "none"; 0 for vertices of no face.

    Raises:
        ShapeError: for other shapes, and vertex numbers out of range.
        ArgumentError: for other `weights`.
        UnitError: for faces of a floating dtype.

    Source: Taubin 1995; Desbrun et al. 1999 for cotangents.
    """
    where = "mesh_laplacian_smoothing"
    if weights not in get_args(Weights):
        raise ArgumentError(f"{where}: expected weights 'uniform' or 'cotangent', got {shown(weights)}.")
    vertices, index = _with_area(*_checked(vertices, faces, where))
    keep = check_mask(mask, vertices[..., 0], where)
    seen = vertices if keep is None else counted(vertices, _reached(keep, index)[..., None])
    first, second, weight = _edges(seen.detach(), index, weights)
    total = torch.zeros_like(seen)
    # towards each end from the other one
    step = weight[..., None] * (seen[..., second, :] - seen[..., first, :])
    total = total.index_add(-2, first, step).index_add(-2, second, -step)
    sums = torch.zeros_like(seen[..., 0]).index_add(-1, first, weight).index_add(-1, second, weight)
    lonely = sums == 0
    offset = total / torch.where(lonely, torch.ones_like(sums), sums)[..., None]
    return reduce(offset.square().sum(-1), reduction, where, keep)


class MeshLaplacianSmoothing(LossModule, function=mesh_laplacian_smoothing, by_place=("weights", "reduction")):
    """`mesh_laplacian_smoothing` with its options held."""

    def forward(self, vertices: Tensor, faces: Tensor, mask: Tensor | None = None) -> Tensor:
        return self.loss(vertices, faces, mask=mask)


def mesh_normal_consistency(
    vertices: Tensor, faces: Tensor, *, mask: Tensor | None = None, reduction: Reduction = "mean"
) -> Tensor:
    """Compute the bend of each inner edge, `1 - cos` of the angle between the normals on both sides.

    0 where the mesh is flat, 1 at a right angle, 2 where it folds back; independent of the order and sense of faces.

    Args:
        vertices: (..., V, 3).
        faces: vertex numbers (F, 3). Faces with a vertex twice are skipped.
        mask: vertices that count, (V,) or (..., V); edges count whose faces have only such.
        reduction: "mean" over edges that count, "sum", or "none".

    Returns:
        Scalar, or (..., E) in the order of the edges' vertex numbers for "none". Edges of more than two faces have an
        entry for each pair; edges of triangles without area are 0, without gradient.

    Raises:
        ShapeError: for other shapes, and vertex numbers out of range.
        UnitError: for faces of a floating dtype.
    """
    where = "mesh_normal_consistency"
    vertices, index = _with_area(*_checked(vertices, faces, where))
    keep = check_mask(mask, vertices[..., 0], where)
    corners = _hinges(index)
    kept = None if keep is None else keep[..., corners].all(-1)
    a, b, c, d = (counted(vertices[..., corner, :], None if kept is None else kept[..., None]) for corner in corners.T)
    ours, theirs = _unit_normals(b - a, c - a), _unit_normals(a - b, d - b)
    bent = 1 - (ours * theirs).sum(-1)
    flat = (ours.square().sum(-1) == 0) | (theirs.square().sum(-1) == 0)
    return reduce(torch.where(flat, torch.zeros_like(bent), bent), reduction, where, kept)


class MeshNormalConsistency(LossModule, function=mesh_normal_consistency, by_place=("reduction",)):
    """`mesh_normal_consistency` with its reduction held."""

    def forward(self, vertices: Tensor, faces: Tensor, mask: Tensor | None = None) -> Tensor:
        return self.loss(vertices, faces, mask=mask)


def _checked(vertices: Tensor, faces: Tensor, where: str) -> tuple[Tensor, Tensor]:
    """Return vertices in the working dtype, and the faces.

    Raises ShapeError for other shapes and numbers that are none of vertices, UnitError for faces that are no integers.
    """
    check_dense((vertices, faces), where)
    if vertices.ndim < 2 or vertices.shape[-1] != 3 or faces.ndim != 2 or faces.shape[1] != 3 or not len(faces):
        raise ShapeError(
            f"{where}: expected vertices (..., V, 3) with one or more faces (F, 3), got {tuple(vertices.shape)} and "
            f"{tuple(faces.shape)}."
        )
    if faces.is_floating_point() or faces.is_complex() or faces.dtype == torch.bool:
        raise UnitError(f"{where}: expected faces of whole numbers, got {faces.dtype}. Use faces.long().")
    index, number = faces.long(), vertices.shape[-2]
    if not is_true((index >= 0) & (index < number)):
        raise ShapeError(f"{where}: expected faces of numbers from 0 to {number - 1}, got others.")
    return vertices.to(working_dtype((vertices,), where)), index


def _with_area(vertices: Tensor, index: Tensor) -> tuple[Tensor, Tensor]:
    """Return the faces with three different vertices."""
    a, b, c = index.unbind(1)
    return vertices, index[(a != b) & (b != c) & (c != a)]


def _reached(mask: Tensor, index: Tensor) -> Tensor:
    """Mask of the vertices that count and of their neighbors."""
    near = mask[..., index].any(-1, keepdim=True).expand(*mask.shape[:-1], *index.shape).flatten(-2)
    found = torch.zeros(mask.shape, device=mask.device).index_add(-1, index.flatten(), near.float())
    return mask | (found > 0)


def _sides(index: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the sides (3 F, 2) of faces, the vertices across them, the edges (E, 2), and the edge of each side."""
    sides = torch.cat([index[:, [0, 1]], index[:, [1, 2]], index[:, [2, 0]]])
    across = torch.cat([index[:, 2], index[:, 0], index[:, 1]])
    return sides, across, *torch.unique(sides.sort(1).values, dim=0, return_inverse=True)


def _edges(vertices: Tensor, index: Tensor, weights: Weights) -> tuple[Tensor, Tensor, Tensor]:
    """Both ends of each edge (E,) and its weight (..., E)."""
    sides, across, edges, place = _sides(index)
    first, second = edges.unbind(1)
    if weights == "uniform":
        return first, second, vertices.new_ones((*vertices.shape[:-2], len(edges)))
    a, b = (vertices[..., sides[:, k], :] - vertices[..., across, :] for k in range(2))
    longest = torch.maximum(a.abs().amax(-1), b.abs().amax(-1))[..., None]
    a, b = (x / torch.where(longest > 0, longest, torch.ones_like(longest)) for x in (a, b))
    area = torch.linalg.cross(a, b).norm(dim=-1)
    cotangent = (a * b).sum(-1) / area.clamp_min(_SHARPEST)
    weight = cotangent.new_zeros((*cotangent.shape[:-1], len(edges))).index_add(-1, place, cotangent)
    return first, second, weight.clamp_min(0)


def _hinges(index: Tensor) -> Tensor:
    """(E, 4), for each pair of faces at an edge: the vertices of the edge, and the third one of either face."""
    _, across, edges, place = _sides(index)
    order = place.argsort(stable=True)
    number, most = place[order], int(torch.bincount(place, minlength=1).max())
    pairs = []
    for apart in range(1, most):
        same = number[apart:] == number[:-apart]
        one, other = order[:-apart][same], order[apart:][same]
        pairs.append(torch.cat([edges[place[one]], across[one, None], across[other, None]], 1))
    found = torch.cat(pairs) if pairs else index.new_zeros((0, 4))
    return found[found[:, 2] != found[:, 3]]


# ------------------------------------------------------------------------------------------------- distance of surfaces


def surface_distance(vertices: Tensor, faces: Tensor, others: Tensor, other_faces: Tensor) -> Tensor:
    """Compute the mean distance of two surfaces both ways, from points of each to the nearest point of the other.

    A mean over the area of each surface, then of the two, by the centers of 16 equal parts of each triangle, whose
    distances are exact (of triangles flatter than 1e-6, those to their edges). Independent of how the surfaces are
    meshed. Time and memory grow with F times G.

    Args:
        vertices: (V, 3).
        faces: vertex numbers (F, 3), in any order and sense. Triangles without area weigh nothing.
        others: vertices of the other mesh, (W, 3).
        other_faces: (G, 3).

    Returns:
        Scalar in the unit of the vertices, differentiable in both meshes; float32 for half precision.

    Raises:
        ShapeError: for other shapes, vertex numbers out of range, and a mesh without area.
        UnitError: for faces of a floating dtype.
    """
    where = "surface_distance"
    vertices, faces = _checked(vertices, faces, where)
    others, other_faces = _checked(others, other_faces, where)
    if vertices.ndim != 2 or others.ndim != 2:
        raise ShapeError(f"{where}: expected vertices (V, 3), got {tuple(vertices.shape)} and {tuple(others.shape)}.")
    dtype = torch.promote_types(vertices.dtype, others.dtype)
    first, second = vertices.to(dtype)[faces], others.to(dtype)[other_faces]
    return 0.5 * (_one_way(first, second) + _one_way(second, first))


def point_triangle_distance(points: Tensor, triangles: Tensor) -> Tensor:
    """Return the distance of points to the nearest of triangles, exact and differentiable.

    Args:
        points: (N, 3), metres.
        triangles: (F, 3, 3), metres.

    Returns:
        (N,), metres.
    """
    # relative to the extent: squares of small lengths vanish in single precision
    middle = triangles.detach().mean((0, 1))
    points, triangles = points - middle, triangles - middle
    unit = torch.maximum(points.detach().abs().amax(), triangles.detach().abs().amax())
    unit = torch.where(unit > 0, unit, torch.ones_like(unit))
    size = max(1, _MOST // (9 * len(triangles)))
    return unit * torch.cat([_distance(part, triangles / unit) for part in torch.split(points / unit, size)])


def _one_way(triangles: Tensor, others: Tensor) -> Tensor:
    """Mean distance of points on triangles (F, 3, 3) to others, over the area."""
    weights = _middles(_CELLS).to(triangles)
    # no matrix product, whose derivative autocast would narrow wherever the backward pass runs
    points = (weights[:, :, None] * triangles[:, None]).sum(2)
    distance = point_triangle_distance(points.reshape(-1, 3), others).reshape(points.shape[:2])
    edges = triangles[:, 1:] - triangles[:, :1]
    longest = edges.detach().abs().amax()
    edges = edges / torch.where(longest > 0, longest, torch.ones_like(longest))
    area = _root(torch.linalg.cross(edges[:, 0], edges[:, 1]).square().sum(-1))
    if not is_true((area.sum() > 0) | area.isnan().any()):
        raise ShapeError("surface_distance: expected meshes with an area, got one of whose triangles none has any.")
    mean: Tensor = (distance.mean(1) * area).sum() / area.sum()
    return mean


def _root(square: Tensor) -> Tensor:
    """Root with slope zero at zero."""
    apart = square != 0  # NaN is no zero
    return torch.where(apart, torch.where(apart, square, torch.ones_like(square)).sqrt(), 0.0)


def _middles(cells: int) -> Tensor:
    """Barycentric coordinates (cells^2, 3) of the centers of equal parts of a triangle, upright and turned."""
    upright = [(i + 1 / 3, j + 1 / 3) for i in range(cells) for j in range(cells - i)]
    turned = [(i + 2 / 3, j + 2 / 3) for i in range(cells - 1) for j in range(cells - 1 - i)]
    u, v = torch.tensor(upright + turned, dtype=torch.float64).T / cells
    return torch.stack([1 - u - v, u, v], 1)


def _distance(points: Tensor, triangles: Tensor) -> Tensor:
    edges = triangles.roll(-1, 1) - triangles
    normal = _unit_normals(edges[:, 0], edges[:, 1])
    from_corner = points[:, None, None] - triangles
    squared = edges.square().sum(-1).clamp_min(torch.finfo(edges.dtype).tiny)
    along = ((from_corner * edges).sum(-1) / squared).clamp(0, 1)
    to_edges = (from_corner - along[..., None] * edges).square().sum(-1).amin(-1)
    height = (from_corner[:, :, 0] * normal).sum(-1)
    inwards = torch.linalg.cross(normal[:, None].expand_as(edges), edges)
    # a triangle without area has no normal, and is its edges
    inside = ((from_corner * inwards).sum(-1) >= 0).all(-1) & (normal.square().sum(-1) > 0)
    nearest = torch.where(inside, height.square(), to_edges).amin(1)
    return _root(nearest)


# ----------------------------------------------------------------------------------------------------------- triangles


def _unit_normals(first: Tensor, second: Tensor) -> Tensor:
    """Unit normals (..., 3) of triangles by two edges (..., 3); zero, with gradient zero, for parallel edges.

    Edges are parallel where twice the area is at most 1e-6 of the square of the longer one.
    """
    # of edges near one: squares of small ones vanish
    longest = torch.maximum(first.detach().abs().amax(-1, keepdim=True), second.detach().abs().amax(-1, keepdim=True))
    unit = torch.where(longest > 0, longest, torch.ones_like(longest))
    normal = torch.linalg.cross(first / unit, second / unit)
    square = normal.square().sum(-1, keepdim=True)
    upright = square > _SHARPEST**2
    return torch.where(upright, normal / torch.where(upright, square, torch.ones_like(square)).sqrt(), 0.0)
