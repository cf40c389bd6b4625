"""Sensors as DeepInverse physics, so that its reconstruction algorithms run on ours. Needs the package ``deepinv``.

Import this module, or call `torchtransient.sensing.deepinv_physics`, only where it is used: the import of ``deepinv``
takes seconds. Source: Tachella et al., "DeepInverse: a Python package for solving imaging inverse problems" (2025).
"""

from __future__ import annotations

import itertools
from typing import Any

import torch
from deepinv.physics import LinearPhysics, Physics
from torch import Tensor

from torchtransient.errors import ShapeError
from torchtransient.sensing.sensor import Sensor, adjoint


class SensorPhysics(Physics):  # type: ignore[misc]
    """Sensor as a `Physics`: ``y = sensor(x)`` with ``A`` its mean and the sensor's own noise.

    ``forward`` draws from the sensor under its own gradient policy (and with ``generator``); ``A`` is `Sensor.expected`
    and ``A_vjp`` the transpose of its derivative.

    Args:
        sensor: sensor or chain, of light (B, C, T, H, W).
        keywords: arguments of `Physics`.
    """

    def __init__(self, sensor: Sensor, **keywords: Any) -> None:
        super().__init__(**keywords)
        self.sensor_module = sensor

    def A(self, x: Tensor, **kwargs: Any) -> Tensor:
        """Mean of the measurement."""
        return self.sensor_module.expected(x)

    def forward(self, x: Tensor, generator: torch.Generator | None = None, **kwargs: Any) -> Tensor:
        """Measure light, with the noise of the sensor."""
        y: Tensor = self.sensor_module(x, generator=generator)
        return y

    def A_vjp(self, x: Tensor, v: Tensor, **kwargs: Any) -> Tensor:
        """Apply the transpose of the derivative of ``A`` at ``x`` to ``v``."""
        onwards = torch.is_grad_enabled() and (v.requires_grad or x.requires_grad)
        with torch.enable_grad():
            at = x if x.requires_grad else x.detach().requires_grad_()
            (gradient,) = torch.autograd.grad(self.sensor_module.expected(at), at, v, create_graph=onwards)
        return gradient


class LinearSensorPhysics(LinearPhysics):  # type: ignore[misc]
    """Linear sensor without its offset: ``A x = expected(x) - expected(0)``, with its exact transpose.

    DeepInverse asks for ``A(0) = 0`` of every `LinearPhysics`. Ambient light and dark counts are `offset`, and
    ``forward`` is a measurement less the offset: ``A x`` plus noise of zero mean, hence below zero at times.
    Measurements from elsewhere are handed to DeepInverse as ``y - physics.offset()``; its Poisson likelihood takes them
    as they are, with ``bkg=physics.offset()``.

    Args:
        sensor: sensor or chain.
        img_size: (C, T, H, W) of the light.
        keywords: arguments of `LinearPhysics`.

    Raises:
        ShapeError: for fewer dimensions.
    """

    def __init__(self, sensor: Sensor, img_size: tuple[int, ...], **keywords: Any) -> None:
        super().__init__(img_size=img_size, **keywords)
        if len(img_size) < 4:
            raise ShapeError(f"LinearSensorPhysics: expected img_size (C, T, H, W), got {img_size}.")
        self.sensor_module = sensor

    def offset(self, x: Tensor | None = None) -> Tensor:
        """Mean of the measurement in the dark, differentiable in the sensor's parameters.

        Args:
            x: light of the wanted shape and dtype; None for ``img_size`` in float32.
        """
        if x is None:
            numbers = itertools.chain(self.sensor_module.parameters(), self.sensor_module.buffers())
            x = torch.zeros(1, *self.img_size, device=next(numbers, torch.empty(0)).device)
        return self.sensor_module.expected(torch.zeros_like(x))

    def A(self, x: Tensor, **kwargs: Any) -> Tensor:
        """Linear part of the mean."""
        return self.sensor_module.expected(x) - self.offset(x)

    def A_adjoint(self, y: Tensor, **kwargs: Any) -> Tensor:
        """Apply the exact transpose, by one backward pass."""
        return adjoint(self.sensor_module, y, (y.shape[0], *self.img_size))

    def forward(self, x: Tensor, generator: torch.Generator | None = None, **kwargs: Any) -> Tensor:
        """Measure light without the offset, with the noise of the sensor."""
        y: Tensor = self.sensor_module(x, generator=generator)
        return y - self.offset(x)
