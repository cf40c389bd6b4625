"""What wants a derivative: tensors and arrays, in containers and in structures of Mitsuba."""

from __future__ import annotations

import types
from collections import UserDict, deque
from typing import Any

import torch
from torch.autograd import forward_ad

_LIBRARIES = ("drjit", "mitsuba")


def entries_of(value: Any) -> tuple[Any, ...]:
    """What a container of Python or a list of parameters of torch holds; nothing of others."""
    if isinstance(value, (list, tuple, set, frozenset, deque, torch.nn.ParameterList)):
        return tuple(value)
    if isinstance(value, (dict, types.MappingProxyType, UserDict, torch.nn.ParameterDict)):
        return tuple(value.values())
    return tuple(vars(value).values()) if isinstance(value, types.SimpleNamespace) else ()


def wants_derivative(value: Any) -> bool:
    """Whether a value is a torch tensor or an array of Dr.Jit that something is to be differentiated by."""
    import drjit as dr

    if isinstance(value, torch.Tensor):
        return (value.requires_grad and torch.is_grad_enabled()) or _is_transformed(value)
    return is_array_or_structure(value) and bool(dr.grad_enabled(value))


def _is_transformed(tensor: torch.Tensor) -> bool:
    """Whether a tensor carries a tangent, or belongs to a ``grad`` or ``vmap`` of torch.func."""
    private: Any = torch._C
    if private._functorch.is_functorch_wrapped_tensor(tensor):
        return True
    return forward_ad.unpack_dual(tensor).tangent is not None  # type: ignore[no-untyped-call]


def is_array_or_structure(value: Any) -> bool:
    """Whether a value is an array of Dr.Jit, or a structure of Mitsuba that holds such (rays, interactions)."""
    import drjit as dr

    return bool(dr.is_array_v(value)) or is_typed_structure(value)


def is_typed_structure(value: Any) -> bool:
    """Whether a value is a structure of Mitsuba or Dr.Jit whose fields have types of their own: arrays, no tensors."""
    kind = type(value)
    described = isinstance(getattr(kind, "DRJIT_STRUCT", None), dict)
    return described and kind.__module__.partition(".")[0] in _LIBRARIES and not hasattr(value, "__dict__")
