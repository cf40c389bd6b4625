"""The linear part of a sensor's mean: its transpose, and how far a sensor is from being linear."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchtransient.checks import shown
from torchtransient.errors import ArgumentError, GradientError, ShapeError
from torchtransient.floating import in_single
from torchtransient.sensing.base.layout import check_tensors
from torchtransient.sensing.base.sensor import Sensor


@in_single
def adjoint(sensor: Sensor, y: Tensor, input_shape: Sequence[int]) -> Tensor:
    """``A^T y``: the transpose of a sensor's mean, exactly, for inputs of ``input_shape``; dtype and device of ``y``.

    ``A`` is the linear part of `expected`, ``x -> expected(x) - expected(0)``; a sensor that is not linear gives the
    transpose of its derivative at zero: see `linearity_error`. Differentiable in ``y`` and in the sensor's parameters,
    so that an unrolled reconstruction can be trained through it. Raises ShapeError when ``y`` is no output for that
    shape.
    """
    _check("adjoint", sensor, y=y)
    learnt = any(p.requires_grad for p in sensor.parameters())
    onwards = torch.is_grad_enabled() and (y.requires_grad or learnt)
    with torch.inference_mode(False), torch.enable_grad():
        y = y.clone() if y.is_inference() else y
        x = torch.zeros(tuple(input_shape), dtype=y.dtype, device=y.device, requires_grad=True)
        out = sensor.expected(x)
        if out.shape != y.shape:
            raise ShapeError(
                f"adjoint: expected y {tuple(out.shape)} for inputs {tuple(input_shape)}, got {tuple(y.shape)}."
            )
        if not out.requires_grad:
            raise GradientError(f"adjoint: expected a sensor with gradients, but {type(sensor).__name__} has none.")
        (gradient,) = torch.autograd.grad(out, x, y, create_graph=onwards)
    return gradient


def linearity_error(sensor: Sensor, x: Tensor) -> float:
    """``|A(2 x) - 2 A(x)| / |A(2 x)|`` of the mean without its offset: rounding for a linear sensor."""
    _check("linearity_error", sensor, x=x)
    with torch.no_grad():
        offset = sensor.expected(torch.zeros_like(x))
        once, twice = sensor.expected(x) - offset, sensor.expected(2 * x) - offset
        return float((twice - 2 * once).abs().max() / twice.abs().max().clamp_min(torch.finfo(x.dtype).tiny))


def _check(where: str, sensor: object, **given: object) -> None:
    if not isinstance(sensor, Sensor):
        raise ArgumentError(f"{where}: expected a sensor of tt.sensing, got {shown(sensor)}.")
    check_tensors(where, **given)
