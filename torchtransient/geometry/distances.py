"""Depth along the axis, distance along the ray, points, and the optical path of light that has met one surface.

Images are (..., H, W). `camera_matrix` (3, 3) or (..., 3, 3) is that of `intrinsics`, of the same image. Lengths in
metres. NaN, of pixels that meet nothing, stays NaN.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchtransient.errors import ShapeError, UnitError
from torchtransient.geometry.pinhole import camera_matrices, camera_to_world, image_size
from torchtransient.quantities import positive, real_array, shown


def ray_directions(camera_matrix: Any, size: tuple[int, int], to_world: Any = None) -> Tensor:
    """Unit vectors (..., 3, H, W) from the pinhole through the centres of the pixels of an image of `size` (H, W): in
    kornia's camera, or in the world of a sensor's `to_world`. Raises ShapeError.
    """
    matrix = camera_matrices(camera_matrix, "ray_directions")
    height, width = image_size(size, "ray_directions")
    v, u = torch.meshgrid(
        torch.arange(height, dtype=matrix.dtype, device=matrix.device),
        torch.arange(width, dtype=matrix.dtype, device=matrix.device),
        indexing="ij",
    )
    pixels = torch.stack([u, v, torch.ones_like(u)]).reshape(3, -1)
    rays: Tensor = torch.linalg.solve(matrix, pixels.expand(*matrix.shape[:-2], 3, -1))
    rays = rays / rays.norm(dim=-2, keepdim=True)
    if to_world is not None:
        rays = torch.matmul(camera_to_world(to_world).to(rays.device, rays.dtype)[..., :3, :3], rays)
    return rays.reshape((*rays.shape[:-1], height, width))


def distance_from_z_depth(z_depth: Tensor, camera_matrix: Any) -> Tensor:
    """Distance from the pinhole along each pixel's ray (the label `depth`) of depth along the axis (`z_depth`)."""
    return z_depth / _cosines(z_depth, camera_matrix, "distance_from_z_depth")


def z_depth_from_distance(distance: Tensor, camera_matrix: Any) -> Tensor:
    """Depth along the axis (the label `z_depth`) of distance along each pixel's ray (`depth`)."""
    return distance * _cosines(distance, camera_matrix, "z_depth_from_distance")


def points_from_distance(distance: Tensor, camera_matrix: Any, to_world: Any = None) -> Tensor:
    """Points (..., 3, H, W) at a distance along each pixel's ray: in kornia's camera, or in the world of a sensor's
    `to_world` (the label `position`).
    """
    size = image_of(distance, "points_from_distance")
    points = ray_directions(_like(camera_matrix, distance, "points_from_distance"), size, to_world)
    points = points * distance[..., None, :, :]
    if to_world is not None:
        points = points + camera_to_world(to_world).to(points.device, points.dtype)[..., :3, 3, None, None]
    return points


def opl_from_distance(
    distance: Tensor, camera_matrix: Any = None, to_world: Any = None, light: Any = None, index: float = 1.0
) -> Tensor:
    """Optical path of light that has met one surface, at a distance along each pixel's ray: from the emitter there and
    on to the camera. There and back, `2 index distance`, of a light at the pinhole.

    `light`: its place in the world, (3,) or (..., 3), which wants `camera_matrix` and the sensor's `to_world`. `index`:
    of refraction of what is between. Raises ShapeError, UnitError.
    """
    index = positive("opl_from_distance: index", index)
    image_of(distance, "opl_from_distance")
    if light is None:
        return 2 * index * distance
    rays, baseline = _triangle(distance, camera_matrix, to_world, light, "opl_from_distance")
    onward: Tensor = torch.linalg.vector_norm(rays * distance[..., None, :, :] - baseline, dim=-3)
    return index * (distance + onward)


def distance_from_opl(
    opl: Tensor, camera_matrix: Any = None, to_world: Any = None, light: Any = None, index: float = 1.0
) -> Tensor:
    """Distance along each pixel's ray of light that has met one surface, by its optical path: the inverse of
    `opl_from_distance`, on the ellipse with the light and the pinhole as foci.

    NaN where the path is too short for any surface. Light that comes straight from the emitter is none of these.
    Raises as `opl_from_distance`.
    """
    index = positive("distance_from_opl: index", index)
    image_of(opl, "distance_from_opl")
    if light is None:
        return opl / (2 * index)
    rays, baseline = _triangle(opl, camera_matrix, to_world, light, "distance_from_opl")
    length = opl / index
    across = (rays * baseline).sum(-3)
    square = (baseline * baseline).sum(-3)
    # |d ray - baseline| = length - d, squared.
    distance = (length * length - square) / (2 * (length - across))
    return torch.where(length * length > square, distance, torch.nan)


# ------------------------------------------------------------------------------------------------------------- checks


def image_of(image: Any, where: str) -> tuple[int, int]:
    """Height and width. Raises ShapeError for what is no floating image."""
    if not isinstance(image, Tensor) or image.ndim < 2 or not image.is_floating_point():
        got = f"{tuple(image.shape)} of {image.dtype}" if isinstance(image, Tensor) else type(image).__name__
        raise ShapeError(f"{where}: expected a floating image (..., H, W), got {got}.")
    return int(image.shape[-2]), int(image.shape[-1])


def _like(camera_matrix: Any, image: Tensor, where: str) -> Tensor:
    return camera_matrices(camera_matrix, where).to(image.device, image.dtype)


def _cosines(image: Tensor, camera_matrix: Any, where: str) -> Tensor:
    """Of the angles between rays and axis."""
    size = image_of(image, where)
    rays = ray_directions(_like(camera_matrix, image, where), size)
    return rays[..., 2, :, :]


def _triangle(image: Tensor, camera_matrix: Any, to_world: Any, light: Any, where: str) -> tuple[Tensor, Tensor]:
    """Rays (..., 3, H, W) in the world, and from the pinhole to the light (..., 3, 1, 1)."""
    size = image_of(image, where)
    if camera_matrix is None or to_world is None:
        raise UnitError(f"{where}: a light that is not at the pinhole wants camera_matrix= and to_world=.")
    if isinstance(light, Tensor) and light.is_floating_point():
        place = light.to(image.device, image.dtype)
    else:
        array = real_array(light)
        if array is None:
            raise ShapeError(f"{where}: expected light as a point (3,) of the world, got {shown(light)}.")
        place = torch.tensor(array, dtype=image.dtype, device=image.device)
    if place.shape[-1:] != (3,):
        raise ShapeError(f"{where}: expected light as points (..., 3) of the world, got {tuple(place.shape)}.")
    rays = ray_directions(_like(camera_matrix, image, where), size, to_world)
    origin = camera_to_world(to_world).to(image.device, image.dtype)[..., :3, 3]
    return rays, (place - origin)[..., None, None]
