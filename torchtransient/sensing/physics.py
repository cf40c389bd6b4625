"""Sensors as physics of DeepInverse, which is imported when it is asked for."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch

from torchtransient.errors import MissingPackageError, UnitError
from torchtransient.sensing.sensor import Sensor, linearity_error

if TYPE_CHECKING:
    from deepinv.physics import Physics


def deepinv_physics(sensor: Sensor, img_size: Sequence[int] | None = None) -> Physics:
    """Make a physics of DeepInverse of a sensor, ``y = physics(x)`` with x (B, C, T, H, W).

    With ``img_size``: a `LinearPhysics` with ``A``, ``A_adjoint``, and all that DeepInverse derives from them. ``A`` is
    the linear part of the mean alone, with ``A(0) = 0``: ambient light and dark counts are ``physics.offset()``, (1,
    ...) in the shape of a measurement, and ``physics(x)`` is a measurement less the offset. Take it off measured data
    as well. Without it: a `Physics` of any sensor, with ``A``, the whole mean, and ``A_vjp``.

    Args:
        sensor: sensor or chain.
        img_size: (C, T, H, W) of the light of a linear sensor, or None.

    Raises:
        UnitError: for a sensor that fails by more than 1e-4.
        MissingPackageError: when ``deepinv`` is not installed (``pip install 'torchtransient[deepinv]'``).
    """
    try:
        from torchtransient.sensing import deepinverse
    except ImportError as error:
        raise MissingPackageError(
            f"deepinv_physics: expected the package deepinv to be installed ({error}); pip install "
            "'torchtransient[deepinv]'."
        ) from error
    if img_size is None:
        return deepinverse.SensorPhysics(sensor)
    size = tuple(int(n) for n in img_size)
    light = torch.rand((1, *size), generator=torch.Generator().manual_seed(0))
    deviation = linearity_error(sensor, light)
    if deviation > 1e-4:
        raise UnitError(
            f"deepinv_physics: expected a linear sensor for img_size={size}, got a deviation of {deviation:.1e} at "
            "double the light. Leave img_size out for a physics that is not linear."
        )
    return deepinverse.LinearSensorPhysics(sensor, size)
