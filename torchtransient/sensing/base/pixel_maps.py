"""Numbers of pixels: one for all, or a map that broadcasts to (..., C, H, W); and chains whose pixels differ."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from torchtransient.checks import unit_of
from torchtransient.errors import ShapeError, UnitError
from torchtransient.floating import holds
from torchtransient.sensing.base.given import check_dense, no_arrays
from torchtransient.sensing.base.layout import check_number


def check_map(
    value: object, name: str, where: str, *, low: float = 0.0, high: float = math.inf, open_low: bool = False
) -> float | Tensor:
    """A number in [low, high] as a float, or a tensor of them as it is, with its gradient; floating, else float64.
    An array is a tensor.

    A map is (), (H, W) or (..., C, H, W). UnitError outside the range and for NaN, ShapeError for one dimension, which
    could be rows as well as channels.
    """
    value = no_arrays(value, where)
    if not isinstance(value, Tensor):
        return check_number(value, name, where, low=low, high=high, open_low=open_low)  # type: ignore[arg-type]
    check_dense(value, where, name)
    if value.is_complex() or value.dtype == torch.bool:
        raise UnitError(f"{where}: expected {name} as real numbers, got {value.dtype}.")
    if value.ndim == 1:
        raise ShapeError(
            f"{where}: expected {name} to be a number, (H, W) or (..., C, H, W), got {tuple(value.shape)}. Channels "
            "are (C, 1, 1), rows (H, 1)."
        )
    numbers = value if value.is_floating_point() else value.double()
    plain = numbers.detach()
    inside = (plain > low if open_low else plain >= low) & (plain <= high) & torch.isfinite(plain)
    if not holds(inside):
        left = "(" if open_low else "["
        unit = unit_of(name)
        raise UnitError(f"{where}: expected every {name} in {left}{low:g}, {high:g}]{unit}, got {_span(plain)}.")
    return numbers


def _span(values: Tensor) -> str:
    least, most = float(values.min()), float(values.max())
    return f"{least:g}" if least == most else f"{least:g} to {most:g}"


def keep_map(module: nn.Module, name: str, value: float | Tensor) -> None:
    """A number as an attribute, an `nn.Parameter` as a parameter (learnt), another tensor as a buffer in float64."""
    if isinstance(value, nn.Parameter):
        module.register_parameter(name, value)
    elif isinstance(value, Tensor):
        module.register_buffer(name, value.double())
    else:
        setattr(module, name, value)


def kept_map(module: nn.Module, name: str, *, high: float = math.inf) -> float | Tensor:
    """A number or map that a sensor keeps, in float64, for a measurement.

    UnitError where what was in [0, high] when the sensor was made is not any more: a parameter that a step of an
    optimizer took out of it, or a map that `torch.func.functional_call` put in its place.
    """
    value: float | Tensor = getattr(module, name)
    if isinstance(value, Tensor):
        plain = value.detach()
        inside = (plain >= 0) & (plain <= high)
        if not holds(inside):
            where, wrong = type(module).__name__, float(plain[~inside].flatten()[0])
            way = "Bounded()" if high < math.inf else "Positive(function='exp')"
            raise UnitError(
                f"{where}: expected every {name} in [0, {high:g}], got {wrong:g}. What keeps a learnt one inside: "
                f"torch.nn.utils.parametrize.register_parametrization(sensor, {name!r}, tt.parametrize.{way})."
            )
    return wide(value)


def wide(value: float | Tensor) -> float | Tensor:
    """In float64."""
    return value.double() if isinstance(value, Tensor) else value


def pixels_of(value: float | Tensor, x: Tensor, name: str, where: str) -> float | Tensor:
    """A map broadcast to the pixels (..., C, H, W) of a transient `x`: checked, and as it is. Raises ShapeError."""
    if not isinstance(value, Tensor):
        return value
    pixels = (*x.shape[:-3], *x.shape[-2:])
    trailing = zip(reversed(value.shape), reversed(pixels), strict=False)
    if value.ndim > len(pixels) or any(have not in (1, wanted) for have, wanted in trailing):
        image = "an image" if value.ndim <= 2 else "pixels (..., C, H, W)"
        got = pixels[-2:] if value.ndim <= 2 else pixels
        raise ShapeError(
            f"{where}: expected {image} {tuple(value.shape)} as in {name}, got {tuple(got)}. Make the map for this "
            "sensor."
        )
    return value


def over_time(value: float | Tensor, x: Tensor, name: str, where: str) -> float | Tensor:
    """A map with a time dimension of one, to be multiplied with `x` (..., C, T, H, W). Raises ShapeError."""
    pixels = pixels_of(value, x, name, where)
    return pixels.unsqueeze(-3) if isinstance(pixels, Tensor) and pixels.ndim >= 2 else pixels
