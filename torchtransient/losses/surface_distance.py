"""How far two triangle meshes are apart, whatever their vertices are: a loss of shapes and a measure of fits."""

from __future__ import annotations

import torch
from torch import Tensor

from torchtransient.errors import ShapeError
from torchtransient.floating import is_true
from torchtransient.losses.comparison import check_dense, check_device, check_whole, working_dtype
from torchtransient.losses.triangles import check_faces, unit_normals

# Numbers held at a time of one of the tensors (points, triangles, 3, 3).
_MOST = 1 << 24


def surface_distance(vertices: Tensor, faces: Tensor, others: Tensor, other_faces: Tensor, *, cells: int = 4) -> Tensor:
    """Mean distance of two surfaces, in the unit of the vertices, whatever that is: scalar, differentiable in both.

    From points of each to the nearest point of the other, over the area, and the mean of both ways. `vertices` and
    `others`: (V, 3), (W, 3); `faces`, `other_faces`: whole numbers (F, 3), (G, 3), of any order and sense. Points are
    the middles of `cells`^2 equal parts of each triangle; to the other surface distances are exact (of triangles that
    are flatter than 1e-6, those to their edges). Triangles without area weigh nothing. Time and memory grow with F
    times G. Half precision is computed in float32. Raises ShapeError, also for a mesh without area; UnitError for other
    numbers, DeviceError.
    """
    where = "surface_distance"
    check_dense((vertices, faces, others, other_faces), where)
    for name, mesh, index in (("vertices", vertices, faces), ("others", others, other_faces)):
        if mesh.ndim != 2 or mesh.shape[1] != 3 or index.ndim != 2 or index.shape[1] != 3 or not len(index):
            raise ShapeError(
                f"{where}: expected {name} (V, 3) with one or more faces (F, 3), got {tuple(mesh.shape)} and "
                f"{tuple(index.shape)}."
            )
        check_faces(index, mesh, f"{where}: {name}")
    check_device(vertices, others, where, "both meshes")
    cells = check_whole("cells", cells, where)
    dtype = working_dtype((vertices, others), where)
    first, second = vertices.to(dtype)[faces.long()], others.to(dtype)[other_faces.long()]
    return 0.5 * (_one_way(first, second, cells) + _one_way(second, first, cells))


def point_triangle_distance(points: Tensor, triangles: Tensor) -> Tensor:
    """(N,): distance of points (N, 3) to the nearest of triangles (F, 3, 3), exact and differentiable."""
    # In units of what there is: squares of metres that are small vanish in single precision.
    middle = triangles.detach().mean((0, 1))
    points, triangles = points - middle, triangles - middle
    unit = torch.maximum(points.detach().abs().amax(), triangles.detach().abs().amax())
    unit = torch.where(unit > 0, unit, torch.ones_like(unit))
    size = max(1, _MOST // (9 * len(triangles)))
    return unit * torch.cat([_distance(part, triangles / unit) for part in torch.split(points / unit, size)])


def _one_way(triangles: Tensor, others: Tensor, cells: int) -> Tensor:
    """Mean distance of points of some triangles (F, 3, 3) to others, over the area."""
    weights = _middles(cells).to(triangles)
    # no matrix product, whose derivative autocast would narrow wherever the backward pass runs
    points = (weights[:, :, None] * triangles[:, None]).sum(2)
    distance = point_triangle_distance(points.reshape(-1, 3), others).reshape(points.shape[:2])
    edges = triangles[:, 1:] - triangles[:, :1]
    longest = edges.detach().abs().amax()
    edges = edges / torch.where(longest > 0, longest, torch.ones_like(longest))
    area = _length(torch.linalg.cross(edges[:, 0], edges[:, 1]))
    if not is_true((area.sum() > 0) | area.isnan().any()):
        raise ShapeError("surface_distance: expected meshes with an area, got one of whose triangles none has any.")
    mean: Tensor = (distance.mean(1) * area).sum() / area.sum()
    return mean


def _length(x: Tensor) -> Tensor:
    """Of vectors (..., 3)."""
    return _root(x.square().sum(-1))


def _root(square: Tensor) -> Tensor:
    """The root has no slope at zero: there it is taken as zero."""
    apart = square != 0  # NaN is no zero
    return torch.where(apart, torch.where(apart, square, torch.ones_like(square)).sqrt(), 0.0)


def _middles(cells: int) -> Tensor:
    """Barycentric coordinates (cells^2, 3) of the middles of equal parts of a triangle, upright ones and others."""
    upright = [(i + 1 / 3, j + 1 / 3) for i in range(cells) for j in range(cells - i)]
    turned = [(i + 2 / 3, j + 2 / 3) for i in range(cells - 1) for j in range(cells - 1 - i)]
    u, v = torch.tensor(upright + turned, dtype=torch.float64).T / cells
    return torch.stack([1 - u - v, u, v], 1)


def _distance(points: Tensor, triangles: Tensor) -> Tensor:
    edges = triangles.roll(-1, 1) - triangles
    normal = unit_normals(edges[:, 0], edges[:, 1])
    from_corner = points[:, None, None] - triangles
    squared = edges.square().sum(-1).clamp_min(torch.finfo(edges.dtype).tiny)
    along = ((from_corner * edges).sum(-1) / squared).clamp(0, 1)
    to_edges = (from_corner - along[..., None] * edges).square().sum(-1).amin(-1)
    height = (from_corner[:, :, 0] * normal).sum(-1)
    inwards = torch.linalg.cross(normal[:, None].expand_as(edges), edges)
    # A triangle without area has no normal, and its edges are all of it.
    inside = ((from_corner * inwards).sum(-1) >= 0).all(-1) & (normal.square().sum(-1) > 0)
    nearest = torch.where(inside, height.square(), to_edges).amin(1)
    return _root(nearest)
