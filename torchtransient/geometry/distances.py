"""Depth along the axis, distance along the ray, points, normals, and the optical path of light that has met one
surface.

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
    """Return unit vectors from the pinhole through the centres of pixels.

    Args:
        camera_matrix: camera matrix (..., 3, 3).
        size: (H, W) of the image.
        to_world: pose (..., 4, 4) of the sensor, for vectors of the world; None for those of kornia's camera.

    Returns:
        (..., 3, H, W).

    Raises:
        ShapeError: for other shapes.
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
    """Return the distance along each pixel's ray (the label `depth`).

    Args:
        z_depth: depth along the axis (the label `z_depth`), (..., H, W), metres.
        camera_matrix: camera matrix (..., 3, 3).
    """
    cosines = _cosines(z_depth, camera_matrix, "distance_from_z_depth")
    known, depth = without_nan(z_depth)
    return torch.where(known, depth / cosines, torch.nan).to(z_depth.dtype)


@without_autocast
def z_depth_from_distance(distance: Tensor, camera_matrix: Any) -> Tensor:
    """Return the depth along the axis (the label `z_depth`).

    Args:
        distance: distance along each pixel's ray (the label `depth`), (..., H, W), metres.
        camera_matrix: camera matrix (..., 3, 3).
    """
    cosines = _cosines(distance, camera_matrix, "z_depth_from_distance")
    known, along = without_nan(distance)
    return torch.where(known, along * cosines, torch.nan).to(distance.dtype)


@without_autocast
def points_from_distance(distance: Tensor, camera_matrix: Any, to_world: Any = None) -> Tensor:
    """Return the points at a distance along each pixel's ray.

    Args:
        distance: distance along the rays, (..., H, W), metres.
        camera_matrix: camera matrix (..., 3, 3).
        to_world: pose (..., 4, 4) of the sensor, for points of the world (the label `position`); None for those of
            kornia's camera.

    Returns:
        (..., 3, H, W), metres.
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
    """Return the optical path of light from an emitter to the surface at a distance along each pixel's ray and on to
    the camera. There and back, `2 index distance`, of a light at the pinhole.

    Args:
        distance: distance along the rays, (..., H, W), metres.
        camera_matrix: camera matrix (..., 3, 3); needed for a light that is not at the pinhole.
        to_world: pose (..., 4, 4) of the sensor; needed for a light that is not at the pinhole.
        light: place of the light in the world, (3,) or (..., 3), metres; None for the pinhole.
        index: index of refraction between light, surface and camera: a number, or a tensor that broadcasts to the image
            and keeps its gradient.

    Returns:
        (..., H, W), metres.

    Raises:
        ShapeError, UnitError: for other arguments.
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
    """Return the distance along each pixel's ray of light that has met one surface, the inverse of `opl_from_distance`,
    on the ellipse with the light and the pinhole as foci.

    Args:
        opl: optical path, (..., H, W), metres.
        camera_matrix: camera matrix (..., 3, 3); needed for a light that is not at the pinhole.
        to_world: pose (..., 4, 4) of the sensor; needed for a light that is not at the pinhole.
        light: place of the light in the world, (3,) or (..., 3), metres; None for the pinhole.
        index: index of refraction between light, surface and camera: a number, or a tensor that broadcasts to the image
            and keeps its gradient.

    Returns:
        (..., H, W), metres. NaN, of which nothing flows back, if the path is too short for any surface: negative, or
        not longer than the way from the light to the pinhole. Light that comes straight from the emitter is not
        handled.
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
    """Return height and width of a floating image.

    Args:
        image: image (..., H, W).
        where: subject of messages.

    Raises:
        ShapeError: for anything else.
    """
    if not isinstance(image, Tensor) or image.ndim < 2 or not image.is_floating_point():
        got = f"{tuple(image.shape)} of {image.dtype}" if isinstance(image, Tensor) else type(image).__name__
        raise ShapeError(f"{where}: expected a floating image (..., H, W), got {got}.")
    return int(image.shape[-2]), int(image.shape[-1])


def without_nan(image: Tensor) -> tuple[Tensor, Tensor]:
    """Return the mask of numbers, and the image in single precision at least, with 1 for NaN.

    A slope of zero times NaN would be NaN, and reach cameras and lights.

    Args:
        image: image (..., H, W).
    """
    known = ~torch.isnan(image)
    return known, torch.where(known, single(image), 1.0)


def _like(camera_matrix: Any, image: Tensor, where: str) -> Tensor:
    """Return camera matrices on the image's device in its precision, single at least."""
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
    """Return the cosines between rays and axis."""
    size = image_of(image, where)
    return _rays(_like(camera_matrix, image, where), size)[..., 2, :, :]


def _triangle(image: Tensor, camera_matrix: Any, to_world: Any, light: Any, where: str) -> tuple[Tensor, Tensor]:
    """Return rays (..., 3, H, W) in the world, and the vector (..., 3, 1, 1) from the pinhole to the light."""
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
    """Return unit normals, turned to the camera, of distances along the rays.

    The cross product of Sobel's derivatives of the points, as `kornia.geometry.depth_to_normals`, whose normals point
    away from the camera. Each normal depends on its eight neighbours: at edges it lies between those of both sides, on
    the rim of the image it is one-sided, and if one of the nine distances is NaN so is the normal. The label `normals`
    is that of the shading, on the side of the surface's front: it has the other sign for a surface that is seen from
    behind. For depth along the axis: `normals_from_distance(distance_from_z_depth(z, K), K)`.

    Args:
        distance: the label `depth`, (..., H, W), metres.
        camera_matrix: camera matrix (..., 3, 3).
        to_world: pose (..., 4, 4) of the sensor, for normals of the world; None for those of kornia's camera.

    Returns:
        (..., 3, H, W).

    Raises:
        ShapeError: for images of one row or column.
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
