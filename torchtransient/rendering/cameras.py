"""Pinhole camera of a renderer's sensor, with the values of a call."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from torchtransient import geometry
from torchtransient.checks import as_whole, shown
from torchtransient.errors import ArgumentError, SceneError
from torchtransient.plugins.parameter_effect import class_of
from torchtransient.rendering.renderer import TransientRenderer
from torchtransient.scene.opaque import opaque
from torchtransient.scene.variant import active_variant


@dataclass(frozen=True)
class Camera:
    """A pinhole camera, for the functions of ``tt.geometry``, with gradients to values of the call.

    Attributes:
        intrinsics: camera matrix (3, 3), in pixels of the image.
        to_world: pose of the sensor, (4, 4).
        size: height and width of the image.
    """

    intrinsics: torch.Tensor
    to_world: torch.Tensor
    size: tuple[int, int]


# Parameters of the optics of Mitsuba's cameras, by class.
_OPTICS = {
    "PerspectiveCamera": ("x_fov", "principal_point_offset_x", "principal_point_offset_y"),
    "ThinLensCamera": ("x_fov",),
}


@opaque
def camera_of(
    renderer: TransientRenderer, values: Mapping[str, Any] | None = None, sensor: int | None = None
) -> Camera:
    """Return the camera of a renderer's sensor (``perspective``, ``thinlens``), that of the crop window of its film.

    Args:
        renderer: the renderer.
        values: values by key as in a call of the renderer, without a batch. Those of the sensor count (``x_fov``,
            ``principal_point_offset_x``, ``_y`` and ``to_world``), with their gradients.
        sensor: index of the sensor in the scene, None for the renderer's first.

    Raises:
        SceneError: for sensors without a pinhole.
        ArgumentError: for batches and unknown sensors.
        ShapeError, UnitError, DeviceError: for values, as the renderer raises them.
    """
    index = renderer._sensors[0] if sensor is None else sensor
    tensors, _, batch = renderer._collect(values)
    if batch is not None:
        raise ArgumentError(f"camera_of: expected values without a batch, got one of {batch}; call it for each entry.")
    given = dict(zip(renderer._keys, tensors, strict=True))
    with active_variant(renderer.scene.variant):
        import mitsuba as mi

        sensors = renderer.scene.built(renderer._options).scene.sensors()
        number = as_whole(index)
        if number is None or not 0 <= number < len(sensors):
            raise ArgumentError(f"camera_of: expected a sensor from 0 to {len(sensors) - 1}, got {shown(index)}.")
        found = sensors[number]
        params = mi.traverse(found)
        if class_of(found) not in _OPTICS:
            raise SceneError(
                f"camera_of: expected a perspective or thinlens sensor, got {found.id()!r} ({class_of(found)}); "
                "others have no pinhole."
            )
        name, film = found.id(), found.film()
        # A thin lens has its axis in the middle of the film.
        built = dict.fromkeys(_OPTICS["PerspectiveCamera"], 0.0)
        built |= {key: float(np.array(params[key]).reshape(-1)[0]) for key in _OPTICS[class_of(found)]}
        matrix = torch.tensor(np.array(found.world_transform().matrix).reshape(4, 4), dtype=torch.float32)
        whole, crop, offset = ([int(n) for n in size] for size in (film.size(), film.crop_size(), film.crop_offset()))
    x_fov, x, y = (given.get(f"{name}.{key}", torch.tensor(value)) for key, value in built.items())
    inside = geometry.intrinsics(
        x_fov, (whole[1], whole[0]), fov_axis="x", principal_point_offset=torch.stack([x, y], -1), crop_offset=offset
    )
    return Camera(inside, given.get(f"{name}.to_world", matrix), (crop[1], crop[0]))
