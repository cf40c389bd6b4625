"""Parameters of sensors: numbers or maps of pixels, and results cached by them."""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable
from typing import Any, TypeVar
from weakref import WeakKeyDictionary

import torch
from torch import Tensor, nn

from torchtransient.checks import unit_of
from torchtransient.errors import ShapeError, UnitError
from torchtransient.floating import holds
from torchtransient.sensing.checks import check_number, is_dual, no_arrays


def check_map(value: object, name: str, where: str, *, low: float = 0.0, high: float = math.inf) -> float | Tensor:
    """Return a number in a range as a float, or a map of them as a floating tensor with its gradient.

    Args:
        value: number, or tensor or array (), (H, W) or (..., C, H, W).
        name: name of the argument, which ends in its unit.
        where: name of the caller, for errors.
        low: least value.
        high: largest value.

    Raises:
        UnitError: outside of the range, and for NaN.
        ShapeError: for one dimension, which could be rows as well as channels.
    """
    value = no_arrays(value)
    if not isinstance(value, Tensor):
        return check_number(value, name, where, low=low, high=high)  # type: ignore[arg-type]
    if value.is_complex() or value.dtype == torch.bool:
        raise UnitError(f"{where}: expected {name} as real numbers, got {value.dtype}.")
    if value.ndim == 1:
        raise ShapeError(
            f"{where}: expected {name} to be a number, (H, W) or (..., C, H, W), got {tuple(value.shape)}. Channels "
            "are (C, 1, 1), rows (H, 1)."
        )
    numbers = value if value.is_floating_point() else value.double()
    plain = numbers.detach()
    inside = (plain >= low) & (plain <= high) & torch.isfinite(plain)
    if not holds(inside):
        raise UnitError(
            f"{where}: expected every {name} in [{low:g}, {high:g}]{unit_of(name)}, got {plain.min():g} to "
            f"{plain.max():g}."
        )
    return numbers


def keep_map(module: nn.Module, name: str, value: float | Tensor) -> None:
    """Keep a number as an attribute, an `nn.Parameter` as a parameter (learnt), another tensor as a buffer in float64.

    Args:
        module: module that keeps it.
        name: name of the attribute.
        value: result of `check_map`.
    """
    if isinstance(value, nn.Parameter):
        module.register_parameter(name, value)
    elif isinstance(value, Tensor):
        module.register_buffer(name, value.double())
    else:
        setattr(module, name, value)


def keep_number(module: nn.Module, name: str, value: Tensor, learnable: bool) -> None:
    """Keep a tensor as a parameter, or as a buffer where it is not learnt.

    Args:
        module: module that keeps it.
        name: name of the attribute.
        value: the tensor.
        learnable: make it a parameter.
    """
    if learnable:
        module.register_parameter(name, nn.Parameter(value))
    else:
        module.register_buffer(name, value)


def kept_map(module: nn.Module, name: str, *, high: float = math.inf) -> float | Tensor:
    """Return a number or map that a sensor keeps, in float64, for a measurement.

    Args:
        module: the sensor.
        name: name of the attribute.
        high: largest value.

    Raises:
        UnitError: where a step of an optimizer, or a map of `torch.func.functional_call`, has left [0, high].
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
    """Return a number as it is, and a tensor in float64.

    Args:
        value: number or tensor.
    """
    return value.double() if isinstance(value, Tensor) else value


def pixels_of(value: float | Tensor, x: Tensor, name: str, where: str) -> float | Tensor:
    """Check that a map broadcasts to the pixels of a transient.

    Args:
        value: number or map.
        x: transient (..., C, T, H, W).
        name: name of the map.
        where: name of the caller, for errors.

    Returns:
        The value as it is.

    Raises:
        ShapeError: for maps of other images.
    """
    if not isinstance(value, Tensor):
        return value
    pixels = (*x.shape[:-3], *x.shape[-2:])
    trailing = zip(reversed(value.shape), reversed(pixels), strict=False)
    if value.ndim > len(pixels) or any(have not in (1, wanted) for have, wanted in trailing):
        raise ShapeError(f"{where}: expected pixels {tuple(value.shape)} as in {name}, got {pixels}.")
    return value


def over_time(value: float | Tensor, x: Tensor, name: str, where: str) -> float | Tensor:
    """Return a map with a time dimension of one, to be multiplied with a transient.

    Args:
        value: number or map.
        x: transient (..., C, T, H, W).
        name: name of the map.
        where: name of the caller, for errors.

    Raises:
        ShapeError: for maps of other images.
    """
    pixels = pixels_of(value, x, name, where)
    return pixels.unsqueeze(-3) if isinstance(pixels, Tensor) and pixels.ndim >= 2 else pixels


# ---------------------------------------------------------------------------------------------------------------- cache


Result = TypeVar("Result")

_INTERNALS = frozenset(nn.Module().__dict__)  # of torch: hooks, containers, which are looked at one by one
_PLAIN = (bool, int, float, str, type(None))
_TENSORS = (Tensor, nn.Parameter)  # those of others may compare and copy in ways of their own
_LARGEST = 1 << 16  # numbers of a stage, above which comparing them takes as long
_MOST = 4  # results of a stage, of different arguments


_RESULTS: WeakKeyDictionary[nn.Module, dict[Hashable, tuple[list[Any], Any]]] = WeakKeyDictionary()


def remembered(module: nn.Module, arguments: Hashable, compute: Callable[[], Result]) -> Result:
    """Return ``compute()``, or its last result for equal arguments and equal parameters, buffers and attributes.

    Kernels of responses and of afterpulses take a third of the time of a small image, and stay the same while nothing
    is learnt. Values are compared, so that a number that was changed in place is another number. Computed anew wherever
    a derivative may be asked for, off the CPU, while torch traces or transforms (a result made inside of `torch.func`
    belongs to the transform, and a trace would keep a number for ever), and for modules of others or with attributes
    beside plain numbers and words.

    Args:
        module: the module whose numbers are compared.
        arguments: further arguments of the computation.
        compute: the computation.

    Returns:
        The result, which is shared: do not change it in place.
    """
    state = None if _transformed() else _state(module)
    if state is None:
        return compute()
    kept = _RESULTS.setdefault(module, {})
    before, result = kept.get(arguments, (None, None))
    if before == state:
        return result  # type: ignore[return-value]
    # a tensor made in inference mode could not be used in training afterwards
    with torch.inference_mode(False), torch.no_grad():
        result = compute()
    if before is None and len(kept) >= _MOST:
        kept.clear()
    kept[arguments] = state, result
    return result


def _transformed() -> bool:
    """Return True while operations are traced, differentiated, mapped, or sent elsewhere by a mode."""
    return (
        torch.compiler.is_compiling()
        or torch._C._get_tracing_state() is not None
        or torch._C._functorch.peek_interpreter_stack() is not None
        or torch._C._len_torch_dispatch_stack() > 0
        or torch._C._len_torch_function_stack() > 0
    )


def _state(module: nn.Module) -> list[Any] | None:
    """Return attributes and numbers of a module and all parts of it; None where they do not determine its results."""
    found: list[Any] = []
    watched = torch.is_grad_enabled()
    for part in module.modules():
        if not type(part).__module__.startswith("torchtransient."):
            return None
        attributes = [(name, value) for name, value in part.__dict__.items() if name not in _INTERNALS]
        if not all(isinstance(value, _PLAIN) for _, value in attributes):
            return None
        found += [type(part), *attributes]
        for name, number in (*part._parameters.items(), *part._buffers.items()):
            if number is None:
                continue
            if type(number) not in _TENSORS or number.device.type != "cpu" or number.numel() > _LARGEST:
                return None
            if is_dual(number) or (watched and number.requires_grad):
                return None
            # their bytes, so that a number that was changed in place is another one
            raw = number.detach().flatten().view(torch.uint8).numpy().tobytes()
            found.append((name, number.dtype, number.shape, raw))
    return found
