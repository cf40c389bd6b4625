"""Between torch tensors and Dr.Jit's tensors of any type, for both kinds of devices."""

from __future__ import annotations

import importlib
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from torchtransient.errors import DeviceError, ShapeError
from torchtransient.rendering.surroundings import is_array_or_structure
from torchtransient.scene.values import FEW, wait_for_torch

_NAMES = {
    torch.float16: "TensorXf16",
    torch.float32: "TensorXf",
    torch.float64: "TensorXf64",
    torch.int32: "TensorXi",
    torch.int64: "TensorXi64",
    torch.uint32: "TensorXu",
    torch.uint64: "TensorXu64",
    torch.bool: "TensorXb",
}
# What a function computes with where Dr.Jit has no such numbers, or too few digits of them to compute with.
_WIDER = {
    torch.float16: torch.float32,
    torch.bfloat16: torch.float32,
    torch.uint8: torch.int32,
    torch.int8: torch.int32,
    torch.int16: torch.int32,
    torch.uint16: torch.int32,
}
_MODULES = {"cpu": "drjit.llvm.ad", "cuda": "drjit.cuda.ad"}


def computable(tensor: torch.Tensor, name: str) -> torch.Tensor:
    """The tensor in a dtype that Dr.Jit computes with, by an operation that gradients pass. ``name``: of the argument,
    for messages. Raises ``ShapeError`` for what is not dense and real, ``DeviceError`` for another device.
    """
    if tensor.is_complex():
        raise ShapeError(
            f"{name}: expected real numbers, got dtype {tensor.dtype}. Pass torch.view_as_real(x): Dr.Jit has no "
            "complex tensors."
        )
    if tensor.layout != torch.strided:
        raise ShapeError(f"{name}: expected a dense tensor, got layout {tensor.layout}.")
    if tensor.device.type not in _MODULES:
        raise DeviceError(f"{name}: expected a tensor on 'cpu' or 'cuda', got {str(tensor.device)!r}.")
    wider = _WIDER.get(tensor.dtype, tensor.dtype)
    if wider not in _NAMES:
        raise ShapeError(f"{name}: expected real numbers, whole numbers or truth values, got dtype {tensor.dtype}.")
    return tensor if wider == tensor.dtype else tensor.to(wider)


def own(tensor: torch.Tensor) -> Any:
    """A Dr.Jit tensor in Dr.Jit's own memory: what a function puts into a scene must not alias the caller's."""
    import drjit as dr

    kind = _type_of(tensor)
    shape = tuple(int(n) for n in tensor.shape)
    if tensor.numel() <= FEW:
        few = dr.array_t(kind)(tensor.reshape(-1).tolist())
        # A single number would be a literal of the kernels, which every other number would have compiled anew.
        dr.make_opaque(few)
        return kind(few, shape)
    copied = fresh(kind(_dense(tensor)))
    dr.eval(copied)
    dr.sync_thread()
    return copied


def _dense(tensor: torch.Tensor) -> torch.Tensor:
    dense = tensor.detach().resolve_neg().contiguous()
    wait_for_torch(dense)
    return dense


def _type_of(tensor: torch.Tensor) -> Any:
    return getattr(importlib.import_module(_MODULES[tensor.device.type]), _NAMES[tensor.dtype])


def as_tensor(array: Any) -> Any:
    """Any Dr.Jit array as a tensor. Attached where the array is. Raises ``ShapeError`` for pointers."""
    import drjit as dr

    if hasattr(type(array), "Domain"):  # a pointer to some class
        raise ShapeError(
            f"expected arrays of numbers, got a {type(array).__name__}: pointers are no tensor. Return what they stand "
            "for, or their numbers: drjit.reinterpret_array(mi.UInt32, pointer)."
        )
    return array if dr.is_tensor_v(array) else dr.tensor_t(type(array))(array)


def fresh(array: Any) -> Any:
    """Any Dr.Jit array as a tensor that nobody else holds: a product that costs nothing where the array has not been
    computed yet, and a copy where it has. Whatever Dr.Jit has still to scatter is carried out.
    """
    import drjit as dr

    tensor = as_tensor(array)
    kind, shape, flat = type(tensor), tuple(int(n) for n in tensor.shape), tensor.array
    if math.prod(shape) and dr.is_jit_v(flat):
        one = type(flat)
        flat = flat & dr.opaque(one, True) if dr.is_mask_v(flat) else flat * dr.opaque(one, 1)
    return kind(flat, shape)


def handle(value: Any) -> Any:
    """An array or structure of Mitsuba as an object of its own: what a function adds to it in place, nobody else sees.
    Other values as they are. Attached where the array is.
    """
    if isinstance(value, np.ndarray):
        return value.copy()
    return type(value)(value) if is_array_or_structure(value) else value


def as_torch(tensors: Sequence[Any]) -> tuple[torch.Tensor, ...]:
    """Fresh Dr.Jit tensors as torch tensors of the same memory, computed in as few kernels as there can be."""
    import drjit as dr

    plain = [dr.detach(tensor) for tensor in tensors]
    dr.eval(plain)
    dr.sync_thread()
    return tuple(tensor.torch() for tensor in plain)
