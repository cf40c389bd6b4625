"""Smoothness of triangle meshes: penalties that hold a fitted shape together where the measurement says nothing.

Added to a loss of what was measured, not alone: both are least for a shape without any feature. Neighbours are what
shares an edge by the numbers of its vertices; vertices that stand in one place under two numbers (seams of textures,
facets) do not know each other, so merge them first.
"""

from __future__ import annotations

from typing import Literal, get_args

import torch
from torch import Tensor, nn

from torchtransient.checks import is_one_of, shown
from torchtransient.errors import ShapeError
from torchtransient.losses.comparison import (
    Reduction,
    check_dense,
    check_mask,
    check_reduction,
    counted,
    reduce,
    working_dtype,
)
from torchtransient.losses.triangles import SHARPEST, check_faces, unit_normals

Weights = Literal["uniform", "cotangent"]


def mesh_laplacian_smoothing(
    vertices: Tensor,
    faces: Tensor,
    *,
    weights: Weights = "uniform",
    mask: Tensor | None = None,
    reduction: Reduction = "mean",
) -> Tensor:
    """`|mean of the neighbours - vertex|^2` of each vertex (..., V, 3) of a mesh with `faces` (F, 3).

    In the unit of the vertices, squared. `weights` of that mean: "uniform", which also pulls the vertices of a flat
    mesh to even distances (Taubin 1995), or "cotangent", of the angles across each edge, which leaves flat and
    evenly curved meshes as they are meshed and moves vertices along the normal, by the mean curvature (Desbrun et al.
    1999).
    Cotangents go in without gradient; an edge whose cotangents sum up to less than zero, of blunt angles, has no
    weight. Faces that have a vertex twice are none; vertices of no face are zero. A border is pulled inwards: leave it
    out by `mask`.

    `mask` (V,) or (..., V): vertices that count. Their neighbours are looked at as they are, and have gradients, also
    those that do not count, such as a border: a mean of some of them would be off to one side. `reduction="none"`:
    (..., V). Raises ShapeError, UnitError for other numbers, DeviceError.
    """
    where = "mesh_laplacian_smoothing"
    check_reduction(reduction, where)
    _check_weights(weights, where)
    vertices, index = _checked(vertices, faces, where)
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


def mesh_normal_consistency(
    vertices: Tensor, faces: Tensor, *, mask: Tensor | None = None, reduction: Reduction = "mean"
) -> Tensor:
    """`1 - cos` of the angle between the normals on both sides of each inner edge of a mesh (..., V, 3).

    `faces`: (F, 3). 0 where the mesh is flat, 1 at a right angle, 2 where it folds back. Of any order and sense of the
    faces: the angle is that at the edge. Edges of more than two faces count each pair; edges of triangles without area
    are 0, without gradient; faces that have a vertex twice are none. `mask` (V,) or (..., V): edges count whose faces
    have no vertex that does not. `reduction="none"`: (..., E), in the order of the edges' vertex numbers. Raises
    ShapeError, UnitError, DeviceError.
    """
    where = "mesh_normal_consistency"
    check_reduction(reduction, where)
    vertices, index = _checked(vertices, faces, where)
    keep = check_mask(mask, vertices[..., 0], where)
    corners = _hinges(index)
    kept = None if keep is None else keep[..., corners].all(-1)
    a, b, c, d = (counted(vertices[..., corner, :], None if kept is None else kept[..., None]) for corner in corners.T)
    ours, theirs = unit_normals(b - a, c - a), unit_normals(a - b, d - b)
    bent = 1 - (ours * theirs).sum(-1)
    flat = (ours.square().sum(-1) == 0) | (theirs.square().sum(-1) == 0)
    return reduce(torch.where(flat, torch.zeros_like(bent), bent), reduction, where, kept)


def _check_weights(weights: Weights, where: str) -> None:
    if not is_one_of(weights, get_args(Weights)):
        raise ShapeError(f"{where}: expected weights 'uniform' or 'cotangent', got {shown(weights)}.")


def _checked(vertices: Tensor, faces: Tensor, where: str) -> tuple[Tensor, Tensor]:
    """Vertices in the dtype of the work, and the faces that are triangles."""
    check_dense((vertices, faces), where)
    if vertices.ndim < 2 or vertices.shape[-1] != 3 or faces.ndim != 2 or faces.shape[1] != 3 or not len(faces):
        raise ShapeError(
            f"{where}: expected vertices (..., V, 3) with one or more faces (F, 3), got {tuple(vertices.shape)} and "
            f"{tuple(faces.shape)}."
        )
    vertices = vertices.to(working_dtype((vertices,), where))
    check_faces(faces, vertices, f"{where}: vertices")
    return vertices, _proper(faces)


def _proper(faces: Tensor) -> Tensor:
    """Faces of three vertices: one that has a vertex twice is no triangle, and would make it its own neighbour."""
    index = faces.long()
    a, b, c = index.unbind(1)
    return index[(a != b) & (b != c) & (c != a)]


def _reached(mask: Tensor, index: Tensor) -> Tensor:
    """Vertices that count, and their neighbours, which are looked at."""
    near = mask[..., index].any(-1, keepdim=True).expand(*mask.shape[:-1], *index.shape).flatten(-2)
    found = torch.zeros(mask.shape, device=mask.device).index_add(-1, index.flatten(), near.float())
    return mask | (found > 0)


def _edges(vertices: Tensor, index: Tensor, weights: Weights) -> tuple[Tensor, Tensor, Tensor]:
    """Both ends of each edge (E,) and its weight (..., E)."""
    sides = torch.cat([index[:, [0, 1]], index[:, [1, 2]], index[:, [2, 0]]])
    edges, place = _distinct(sides.sort(1).values)
    first, second = edges.unbind(1)
    if weights == "uniform":
        return first, second, vertices.new_ones((*vertices.shape[:-2], len(edges)))
    across = torch.cat([index[:, 2], index[:, 0], index[:, 1]])
    a, b = (vertices[..., sides[:, k], :] - vertices[..., across, :] for k in range(2))
    longest = torch.maximum(a.abs().amax(-1), b.abs().amax(-1))[..., None]
    a, b = (x / torch.where(longest > 0, longest, torch.ones_like(longest)) for x in (a, b))
    area = torch.linalg.cross(a, b).norm(dim=-1)
    cotangent = (a * b).sum(-1) / area.clamp_min(SHARPEST)
    weight = cotangent.new_zeros((*cotangent.shape[:-1], len(edges))).index_add(-1, place, cotangent)
    return first, second, weight.clamp_min(0)


def _distinct(sides: Tensor) -> tuple[Tensor, Tensor]:
    """Each edge once, and which of them each side is."""
    edges, place = torch.unique(sides, dim=0, return_inverse=True)
    return edges, place


def _hinges(index: Tensor) -> Tensor:
    """(E, 4) of each pair of faces at one edge: the edge's vertices, and the third one of either face."""
    sides = torch.cat([index[:, [0, 1]], index[:, [1, 2]], index[:, [2, 0]]]).sort(1).values
    across = torch.cat([index[:, 2], index[:, 0], index[:, 1]])
    edges, place = _distinct(sides)
    order = place.argsort(stable=True)
    number, most = place[order], int(torch.bincount(place, minlength=1).max())
    pairs = []
    for apart in range(1, most):
        same = number[apart:] == number[:-apart]
        one, other = order[:-apart][same], order[apart:][same]
        pairs.append(torch.cat([edges[place[one]], across[one, None], across[other, None]], 1))
    found = torch.cat(pairs) if pairs else index.new_zeros((0, 4))
    return found[found[:, 2] != found[:, 3]]


class MeshLaplacianSmoothing(nn.Module):
    """`mesh_laplacian_smoothing(vertices, faces)` with its options held."""

    def __init__(self, weights: Weights = "uniform", reduction: Reduction = "mean") -> None:
        super().__init__()
        check_reduction(reduction, "MeshLaplacianSmoothing")
        _check_weights(weights, "MeshLaplacianSmoothing")
        self.weights, self.reduction = weights, reduction

    def forward(self, vertices: Tensor, faces: Tensor, mask: Tensor | None = None) -> Tensor:
        return mesh_laplacian_smoothing(vertices, faces, weights=self.weights, mask=mask, reduction=self.reduction)


class MeshNormalConsistency(nn.Module):
    """`mesh_normal_consistency(vertices, faces)` with its reduction held."""

    def __init__(self, reduction: Reduction = "mean") -> None:
        super().__init__()
        check_reduction(reduction, "MeshNormalConsistency")
        self.reduction = reduction

    def forward(self, vertices: Tensor, faces: Tensor, mask: Tensor | None = None) -> Tensor:
        return mesh_normal_consistency(vertices, faces, mask=mask, reduction=self.reduction)
