"""Normals of a surface by the distances of its pixels. Derivatives by kornia."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchtransient.errors import ShapeError
from torchtransient.geometry.distances import image_of, points_from_distance
from torchtransient.geometry.pinhole import camera_to_world


def normals_from_distance(distance: Tensor, camera_matrix: Any, to_world: Any = None) -> Tensor:
    """Unit normals (..., 3, H, W), turned to the camera, of distances along the rays (..., H, W), the label `depth`: in
    kornia's camera, or in the world of a sensor's `to_world`.

    The cross product of Sobel's derivatives of the points, as `kornia.geometry.depth_to_normals`, whose normals point
    away from the camera. A pixel takes part in those of its eight neighbours: at edges they lie between those of both
    sides, on the rim of the image they are one-sided, and where one of the nine is NaN so are they. The label `normals`
    is that of the shading, on the side of the surface's front: it has the other sign where a surface is seen from
    behind. For depth along the axis: `normals_from_distance(distance_from_z_depth(z, K), K)`. Raises ShapeError.
    """
    from kornia.filters import spatial_gradient

    if min(image_of(distance, "normals_from_distance")) < 2:
        raise ShapeError(f"normals_from_distance: expected two rows and columns at least, got {tuple(distance.shape)}.")
    points = points_from_distance(distance, camera_matrix)
    size = points.shape[-2:]
    along = spatial_gradient(points.reshape(-1, 3, *size))
    normals = -torch.nn.functional.normalize(torch.linalg.cross(along[:, :, 0], along[:, :, 1], dim=1), dim=1)
    normals = normals.reshape(points.shape)
    if to_world is None:
        return normals
    turn = camera_to_world(to_world).to(normals.device, normals.dtype)[..., :3, :3]
    return (turn @ normals.flatten(-2)).reshape(normals.shape)
