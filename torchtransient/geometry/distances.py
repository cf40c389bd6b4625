"""Depth along the axis, distance along the ray, points, and the optical path of light that has met one surface.

Images are (..., H, W). `camera_matrix` (3, 3) or (..., 3, 3) is that of `intrinsics`, of the same image. Lengths in
metres. NaN, of pixels that meet nothing, stays NaN, and nothing flows back from there. Results have the dtype of the
image; half precision is computed in float32.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchtransient.checks import positive, shown
from torchtransient.errors import ShapeError, UnitError
from torchtransient.floating import holds, number_tensor, single, without_autocast
from torchtransient.geometry.pinhole import camera_matrices, camera_to_world, image_size


@without_autocast
def ray_directions(camera_matrix: Any, size: tuple[int, int], to_world: Any = None) -> Tensor:
    """Unit vectors (..., 3, H, W) from the pinhole through the centres of the pixels of an image of `size` (H, W): in
    kornia's camera, or in the world of a sensor's `to_world`. Raises ShapeError.
    """
    matrix = camera_matrices(camera_matrix, "ray_directions")
    return _rays(single(matrix), image_size(size, "ray_directions"), to_world).to(matrix.dtype)


def _rays(matrix: Tensor, size: tuple[int, int], to_world: Any = None) -> Tensor:
    v, u = torch.meshgrid(
        *(torch.arange(number, dtype=matrix.dtype, device=matrix.device) for number in size), indexing="ij"
    )
    pixels = torch.stack([u, v, torch.ones_like(u)]).reshape(3, -1)
    rays: Tensor = torch.linalg.solve(matrix, pixels.expand(*matrix.shape[:-2], 3, -1))
    rays = rays / rays.norm(dim=-2, keepdim=True)
    if to_world is not None:
        rays = torch.matmul(camera_to_world(to_world).to(rays)[..., :3, :3], rays)
    return rays.reshape((*rays.shape[:-1], *size))


@without_autocast
def distance_from_z_depth(z_depth: Tensor, camera_matrix: Any) -> Tensor:
    """Distance from the pinhole along each pixel's ray (the label `depth`) of depth along the axis (`z_depth`)."""
    cosines = _cosines(z_depth, camera_matrix, "distance_from_z_depth")
    known, depth = without_nan(z_depth)
    return torch.where(known, depth / cosines, torch.nan).to(z_depth.dtype)


@without_autocast
def z_depth_from_distance(distance: Tensor, camera_matrix: Any) -> Tensor:
    """Depth along the axis (the label `z_depth`) of distance along each pixel's ray (`depth`)."""
    cosines = _cosines(distance, camera_matrix, "z_depth_from_distance")
    known, along = without_nan(distance)
    return torch.where(known, along * cosines, torch.nan).to(distance.dtype)


@without_autocast
def points_from_distance(distance: Tensor, camera_matrix: Any, to_world: Any = None) -> Tensor:
    """Points (..., 3, H, W) at a distance along each pixel's ray: in kornia's camera, or in the world of a sensor's
    `to_world` (the label `position`).
    """
    size = image_of(distance, "points_from_distance")
    points = _rays(_like(camera_matrix, distance, "points_from_distance"), size, to_world)
    known, along = without_nan(distance)
    points = points * along[..., None, :, :]
    if to_world is not None:
        points = points + camera_to_world(to_world).to(points)[..., :3, 3, None, None]
    return torch.where(known[..., None, :, :], points, torch.nan).to(distance.dtype)


@without_autocast
def opl_from_distance(
    distance: Tensor, camera_matrix: Any = None, to_world: Any = None, *, light: Any = None, index: float | Tensor = 1.0
) -> Tensor:
    """Optical path of light that has met one surface, at a distance along each pixel's ray: from the emitter there and
    on to the camera. There and back, `2 index distance`, of a light at the pinhole.

    `light`: its place in the world, (3,) or (..., 3), which wants `camera_matrix` and the sensor's `to_world`. `index`:
    of refraction of what is between, a number, or a tensor that broadcasts to the image and keeps its gradient. Raises
    ShapeError, UnitError.
    """
    image_of(distance, "opl_from_distance")
    given = _index(index, distance, "opl_from_distance")
    known, length = without_nan(distance)
    if light is None:
        return torch.where(known, 2 * given * length, torch.nan).to(distance.dtype)
    rays, baseline = _triangle(distance, camera_matrix, to_world, light, "opl_from_distance")
    onward: Tensor = torch.linalg.vector_norm(rays * length[..., None, :, :] - baseline, dim=-3)
    return torch.where(known, given * (length + onward), torch.nan).to(distance.dtype)


@without_autocast
def distance_from_opl(
    opl: Tensor, camera_matrix: Any = None, to_world: Any = None, *, light: Any = None, index: float | Tensor = 1.0
) -> Tensor:
    """Distance along each pixel's ray of light that has met one surface, by its optical path: the inverse of
    `opl_from_distance`, on the ellipse with the light and the pinhole as foci.

    NaN, of which nothing flows back, where the path is too short for any surface: negative, or not longer than the way
    from the light to the pinhole. Light that comes straight from the emitter is none of these. Raises as
    `opl_from_distance`.
    """
    image_of(opl, "distance_from_opl")
    path, given = single(opl), _index(index, opl, "distance_from_opl")
    if light is None:
        return torch.where(path >= 0, torch.where(path >= 0, path, 0.0) / (2 * given), torch.nan).to(opl.dtype)
    rays, baseline = _triangle(opl, camera_matrix, to_world, light, "distance_from_opl")
    across = (rays * baseline).sum(-3)
    square = (baseline * baseline).sum(-3)
    length = path / given
    long = (length > 0) & (length * length > square)
    # Elsewhere some path that has a distance: the slope of what is not taken has to be finite, too.
    length = torch.where(long, path, given * (1 + square.sqrt()).detach()) / given
    # |d ray - baseline| = length - d, squared.
    distance = (length * length - square) / (2 * (length - across))
    return torch.where(long, distance, torch.nan).to(opl.dtype)


# ------------------------------------------------------------------------------------------------------------- checks


def image_of(image: Any, where: str) -> tuple[int, int]:
    """Height and width. Raises ShapeError for what is no floating image."""
    if not isinstance(image, Tensor) or image.ndim < 2 or not image.is_floating_point():
        got = f"{tuple(image.shape)} of {image.dtype}" if isinstance(image, Tensor) else type(image).__name__
        raise ShapeError(f"{where}: expected a floating image (..., H, W), got {got}.")
    return int(image.shape[-2]), int(image.shape[-1])


def without_nan(image: Tensor) -> tuple[Tensor, Tensor]:
    """Where an image is no NaN; and the image, in single precision at least, with 1 elsewhere: a slope of zero times
    NaN would be NaN, and reach cameras and lights.
    """
    known = ~torch.isnan(image)
    return known, torch.where(known, single(image), 1.0)


def _like(camera_matrix: Any, image: Tensor, where: str) -> Tensor:
    """In the image's place and precision, single at least."""
    return camera_matrices(camera_matrix, where).to(image.device, torch.promote_types(image.dtype, torch.float32))


def _index(index: Any, image: Tensor, where: str) -> float | Tensor:
    if not isinstance(index, Tensor):
        return positive(f"{where}: index", index)
    given = single(number_tensor(index, f"{where}: expected index as a number greater than zero", UnitError))
    try:
        torch.broadcast_to(given, image.shape)
    except RuntimeError:
        raise ShapeError(
            f"{where}: expected index as a number, or one that broadcasts to {tuple(image.shape)}, got "
            f"{tuple(given.shape)}."
        ) from None
    if not holds((given > 0) & torch.isfinite(given)):
        raise UnitError(f"{where}: index: expected finite numbers greater than zero, got {shown(index)}.")
    return given.to(image.device, torch.promote_types(image.dtype, torch.float32))


def _cosines(image: Tensor, camera_matrix: Any, where: str) -> Tensor:
    """Of the angles between rays and axis."""
    size = image_of(image, where)
    return _rays(_like(camera_matrix, image, where), size)[..., 2, :, :]


def _triangle(image: Tensor, camera_matrix: Any, to_world: Any, light: Any, where: str) -> tuple[Tensor, Tensor]:
    """Rays (..., 3, H, W) in the world, and from the pinhole to the light (..., 3, 1, 1)."""
    size = image_of(image, where)
    if camera_matrix is None or to_world is None:
        raise UnitError(f"{where}: a light that is not at the pinhole wants camera_matrix= and to_world=.")
    matrix = _like(camera_matrix, image, where)
    place = number_tensor(light, f"{where}: expected light as a point (3,) of the world").to(matrix)
    if place.shape[-1:] != (3,):
        raise ShapeError(f"{where}: expected light as points (..., 3) of the world, got {tuple(place.shape)}.")
    origin = camera_to_world(to_world).to(matrix)[..., :3, 3]
    return _rays(matrix, size, to_world), (place - origin)[..., None, None]


@without_autocast
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
    known, filled = without_nan(distance)
    points = points_from_distance(filled, camera_matrix)
    size = points.shape[-2:]
    along = spatial_gradient(points.reshape(-1, 3, *size))
    normals = -torch.nn.functional.normalize(torch.linalg.cross(along[:, :, 0], along[:, :, 1], dim=1), dim=1)
    normals = normals.reshape(points.shape)
    if to_world is not None:
        turn = camera_to_world(to_world).to(normals)[..., :3, :3]
        normals = (turn @ normals.flatten(-2)).reshape(normals.shape)
    unknown = (~known).to(normals).reshape(-1, 1, *size)
    near = torch.nn.functional.max_pool2d(unknown, 3, stride=1, padding=1).reshape(*known.shape[:-2], 1, *size) > 0
    return torch.where(near, torch.nan, normals).to(distance.dtype)
