"""What losses of triangle meshes share: faces that are numbers of vertices, and normals where there are any."""

from __future__ import annotations

import torch
from torch import Tensor

from torchtransient.errors import ShapeError, UnitError
from torchtransient.floating import is_true
from torchtransient.losses.comparison import check_device

# The sine, or cotangent, of the sharpest corner that is told from none: ten times the rounding of single precision.
SHARPEST = 1e-6


def check_faces(faces: Tensor, vertices: Tensor, where: str) -> None:
    """Raises UnitError unless they are whole numbers, ShapeError unless they are those of vertices (..., V, 3)."""
    if faces.is_floating_point() or faces.is_complex() or faces.dtype == torch.bool:
        raise UnitError(f"{where}: expected faces of whole numbers, got {faces.dtype}. Use faces.long().")
    check_device(faces, vertices, where, "vertices and faces")
    wide, number = faces.long(), vertices.shape[-2]
    if not is_true((wide >= 0) & (wide < number)):
        raise ShapeError(f"{where}: expected faces of numbers from 0 to {number - 1}, got others.")


def unit_normals(first: Tensor, second: Tensor) -> Tensor:
    """Unit normals (..., 3) of triangles by two of their edges (..., 3); zero, with gradient zero, where there is none.

    There is none where both edges are parallel: twice the area is at most 1e-6 of the square of the longer one.
    """
    # of edges near one: squares of small ones vanish
    longest = torch.maximum(first.detach().abs().amax(-1, keepdim=True), second.detach().abs().amax(-1, keepdim=True))
    unit = torch.where(longest > 0, longest, torch.ones_like(longest))
    normal = torch.linalg.cross(first / unit, second / unit)
    square = normal.square().sum(-1, keepdim=True)
    upright = square > SHARPEST**2
    return torch.where(upright, normal / torch.where(upright, square, torch.ones_like(square)).sqrt(), 0.0)
