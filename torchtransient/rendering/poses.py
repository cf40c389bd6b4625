"""Values of one pose of a renderer, and the sizes of its film and scene, for functions beside it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from torch import Tensor

from torchtransient.errors import ShapeError
from torchtransient.rendering.renderer import TransientRenderer
from torchtransient.scene.physics import PhysicsWatch
from torchtransient.scene.variant import active_variant


def pose_of(renderer: TransientRenderer, values: Mapping[str, Any] | None, name: str) -> dict[str, Tensor]:
    """Return the values of a call by key, those of the renderer where it has none.

    Args:
        renderer: the renderer.
        values: values by key, see the call of the renderer.
        name: name of the function, for messages.

    Raises:
        ShapeError: for values with a batch.
        ArgumentError, SceneError, DeviceError, UnitError: as the renderer raises them.
    """
    tensors, _, batch = renderer._collect(values)
    if batch is not None:
        raise ShapeError(f"{name}: expected values without a batch, got one of {batch}. Poses are the batch here.")
    return dict(zip(renderer._keys, tensors, strict=True))


def film_rows(renderer: TransientRenderer) -> int:
    """Return the height of the film, or of its crop window, in pixels.

    Args:
        renderer: the renderer.
    """
    return int(renderer._cube_shape[0])


def watch_of(renderer: TransientRenderer) -> PhysicsWatch:
    """Return the renderer's checks for unphysical values, which warn or raise as its ``physics`` says.

    Args:
        renderer: the renderer.
    """
    return renderer._watch


def scene_size(renderer: TransientRenderer) -> float:
    """Return the diagonal of the box around shapes and sensors, metres; infinite without shapes.

    Args:
        renderer: the renderer.
    """
    with active_variant(renderer.scene.variant):
        scene = renderer.scene.built(renderer._options).scene
        box = scene.bbox()
        if not box.valid():
            return math.inf
        places = [np.array(sensor.world_transform().matrix).reshape(4, 4)[:3, 3] for sensor in scene.sensors()]
        return float(np.linalg.norm(np.ptp([np.array(box.min), np.array(box.max), *places], axis=0)))
