"""Stokes components in the frames of a camera that has been turned or mirrored."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from torchtransient import geometry
from torchtransient.data.augmentation.pixel_map import PixelMap
from torchtransient.errors import SceneError
from torchtransient.stokes import rotate_frame

# The sensor's horizontal axis is cross(ray, up), and up in kornia's camera is -y (docs/polarization.md).
_UP = (0.0, -1.0, 0.0)


def turned_stokes(light: Tensor, dim: int, drawn: PixelMap, camera_matrix: Tensor | None) -> Tensor:
    """Light that has been moved already, (..., 4, ..., H, W) with its components along `dim`, in the new frames.

    A mirror turns the handedness over: S2 and S3 change their signs. A turn of the camera turns the frame of each
    pixel, by an angle that depends on its ray; half a turn leaves it. `camera_matrix`: the one before. Raises
    SceneError where it is needed and None.
    """
    if light.is_complex():
        parts = [turned_stokes(part, dim, drawn, camera_matrix) for part in (light.real, light.imag)]
        return torch.complex(parts[0], parts[1])
    if drawn.mirror is not None:
        signs = torch.tensor([1.0, 1.0, -1.0, -1.0], dtype=light.dtype, device=light.device)
        light = light * signs.reshape(4, *[1] * (-dim - 1))
    turn = drawn.rotation
    if np.array_equal(np.abs(turn), np.eye(3)):
        return light
    if camera_matrix is None:
        raise SceneError(
            "Augment: turning Stokes components wants intrinsics= of the camera, since the frame of each pixel depends "
            "on its ray. Flips and half turns do without."
        )
    rays = geometry.ray_directions(drawn.intrinsics(camera_matrix.double()), drawn.new_size)
    rotation = torch.tensor(turn, device=rays.device)
    up = rays.new_tensor(_UP)[:, None, None].expand_as(rays)
    before = _across(rays, torch.einsum("ij,...jhw->...ihw", rotation, up))
    after = _across(rays, up)
    upwards = torch.linalg.cross(before, rays, dim=-3)
    angle = torch.atan2((after * upwards).sum(-3), (after * before).sum(-3)).to(light.dtype)
    # Between the leading dimensions of the camera's matrix and the image: what is behind the components.
    angle = angle.reshape(*angle.shape[:-2], *[1] * (-dim - 3), *angle.shape[-2:])
    return rotate_frame(light, angle, dim)


def _across(rays: Tensor, up: Tensor) -> Tensor:
    """The horizontal axes of frames (..., 3, H, W)."""
    return torch.nn.functional.normalize(torch.linalg.cross(rays, up, dim=-3), dim=-3)
