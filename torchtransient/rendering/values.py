"""Values of torch, Dr.Jit and ``mitsuba.SceneParameters``: PyTrees, conversions, and the values that a scene holds."""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, fields, is_dataclass
from typing import Any

import numpy as np
import torch

from torchtransient.checks import one_line
from torchtransient.errors import DeviceError, SceneError, ShapeError, TorchTransientError, UnknownKeyError
from torchtransient.plugins.mitsuba_compat import check_pose, is_turned_by_reflections
from torchtransient.plugins.node_walk import ShownValue
from torchtransient.scene.parameters import classify, is_transform, read_value, unknown_key
from torchtransient.scene.values import FEW, add_normals, as_mitsuba_value, dependent_keys, wait_for_torch
from torchtransient.scene.variant import quiet

# --------------------------------------------------------------------------------------------------------- PyTrees


@dataclass(frozen=True)
class Slot:
    """Place of a value in a list: of a leaf in a tree, or of a tensor among the leaves."""

    number: int


def flatten(tree: Any) -> tuple[Any, list[Any]]:
    """Return the structure of a PyTree, the tree with a :class:`Slot` for each leaf, and its leaves.

    Lists, tuples (named ones too), dictionaries, dataclasses, and classes with ``DRJIT_STRUCT`` are branches. The
    structures of Mitsuba and Dr.Jit are leaves: their fields have types of their own.

    Args:
        tree: any nesting of these.
    """
    leaves: list[Any] = []

    def slot(leaf: Any) -> Slot:
        leaves.append(leaf)
        return Slot(len(leaves) - 1)

    return _map_leaves(slot, tree), leaves


def unflatten(structure: Any, leaves: Sequence[Any]) -> Any:
    """Return the PyTree of a structure of :func:`flatten`, with ``leaves`` in the order of its slots.

    Args:
        structure: structure of a tree.
        leaves: its leaves.
    """
    return _map_leaves(lambda slot: leaves[slot.number], structure)


def same_structure(a: Any, b: Any) -> bool:
    """Return True if two structures have the same classes and names, in the same order.

    Args:
        a, b: structures of :func:`flatten`.
    """
    names, parts = _branches(a)
    others, other_parts = _branches(b)
    return type(a) is type(b) and names == others and all(map(same_structure, parts, other_parts))


def _map_leaves(function: Callable[[Any], Any], tree: Any) -> Any:
    names, parts = _branches(tree)
    if names is None:
        return function(tree)
    parts = [_map_leaves(function, part) for part in parts]
    kind = type(tree)
    if isinstance(tree, tuple):
        try:
            return tuple.__new__(kind, parts)  # named tuples, whatever arguments their class has
        except TypeError:  # structures of C, as torch's
            return kind(parts)
    made = [] if kind is list else copy(tree)
    if isinstance(made, list):
        made[:] = parts
    elif isinstance(made, dict):
        made.update(zip(names, parts, strict=True))
    else:
        for name, part in zip(names, parts, strict=True):
            object.__setattr__(made, name, part)  # of frozen dataclasses too
    return made


def _branches(tree: Any) -> tuple[list[Any] | None, list[Any]]:
    """Return names and parts of a tree; None and nothing for a leaf."""
    if isinstance(tree, (list, tuple)) and not isinstance(tree, torch.Size):
        return list(range(len(tree))), list(tree)
    if isinstance(tree, dict):
        return list(tree), list(tree.values())
    names: list[Any] = []
    if isinstance(getattr(type(tree), "DRJIT_STRUCT", None), dict) and not is_typed_structure(tree):
        names = list(type(tree).DRJIT_STRUCT)
    elif is_dataclass(tree) and not isinstance(tree, (type, Slot)):
        names = [one.name for one in fields(tree)]
    return names or None, [getattr(tree, name) for name in names]


def is_typed_structure(value: Any) -> bool:
    """Return True if a value is a structure of Mitsuba or Dr.Jit, whose fields cannot be tensors.

    Args:
        value: any value.
    """
    kind = type(value)
    described = isinstance(getattr(kind, "DRJIT_STRUCT", None), dict)
    return described and kind.__module__.partition(".")[0] in ("drjit", "mitsuba") and not hasattr(value, "__dict__")


# ------------------------------------------------------------------------------------------------ torch and Dr.Jit

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
# The dtype of the computation, where Dr.Jit lacks that of the tensor or has too few digits in it.
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
    """Return a tensor in a dtype that Dr.Jit computes with, by an operation that gradients pass.

    Args:
        tensor: dense and real, on the CPU or a GPU.
        name: name of the argument, for messages.

    Raises:
        ShapeError: if the tensor is complex, sparse or of another kind of numbers.
        DeviceError: if it is on another device.
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


def drjit_copy(tensor: torch.Tensor) -> Any:
    """Return a copy of a torch tensor as a Dr.Jit tensor: a scene never aliases memory of the caller.

    Args:
        tensor: tensor of any shape, on the CPU or a GPU.
    """
    import drjit as dr

    kind = getattr(importlib.import_module(_MODULES[tensor.device.type]), _NAMES[tensor.dtype])
    shape = tuple(int(n) for n in tensor.shape)
    if tensor.numel() <= FEW:
        few = dr.array_t(kind)(tensor.reshape(-1).tolist())
        # A single number would be a literal of the kernels, compiled again for every other number.
        dr.make_opaque(few)
        return kind(few, shape)
    dense = tensor.detach().resolve_neg().contiguous()
    wait_for_torch(dense)
    copied = fresh(kind(dense))
    dr.eval(copied)
    dr.sync_thread()
    return copied


def as_tensor(array: Any) -> Any:
    """Return any Dr.Jit array of numbers as a Dr.Jit tensor, attached where the array is.

    Args:
        array: array, tensor, matrix or structure of arrays.

    Raises:
        ShapeError: if the array holds pointers.
    """
    import drjit as dr

    if hasattr(type(array), "Domain"):  # a pointer to some class
        raise ShapeError(
            f"expected arrays of numbers, got a {type(array).__name__}: pointers are no tensor. Return the fields that "
            "are numbers, or the numbers of the pointers: drjit.reinterpret_array(mi.UInt32, pointer)."
        )
    return array if dr.is_tensor_v(array) else dr.tensor_t(type(array))(array)


def fresh(array: Any) -> Any:
    """Return any Dr.Jit array as a tensor of its own memory, attached where the array is.

    A product by one costs nothing where the array is not computed yet, and is a copy where it is. Scatters that wait
    in the array are carried out.

    Args:
        array: array, tensor, matrix or structure of arrays.
    """
    import drjit as dr

    tensor = as_tensor(array)
    kind, shape, flat = type(tensor), tuple(int(n) for n in tensor.shape), tensor.array
    if math.prod(shape) and dr.is_jit_v(flat):
        one = type(flat)
        flat = flat & dr.opaque(one, True) if dr.is_mask_v(flat) else flat * dr.opaque(one, 1)
    return kind(flat, shape)


def as_torch(tensors: Sequence[Any]) -> tuple[torch.Tensor, ...]:
    """Return fresh Dr.Jit tensors as torch tensors of the same memory, computed in as few kernels as possible.

    Args:
        tensors: tensors that nothing else holds.
    """
    import drjit as dr

    plain = [dr.detach(tensor) for tensor in tensors]
    dr.eval(plain)
    dr.sync_thread()
    return tuple(tensor.torch() for tensor in plain)


# ---------------------------------------------------------------------------------------------- values of a scene


def variant_of(params: Any) -> str | None:
    """Return the variant of the scene behind ``params``, None if there is no parameter.

    Args:
        params: parameters of a scene (`mi.SceneParameters`).
    """
    for _, _, node, _ in params.properties.values():
        return str(node.variant_name())
    return None


def values_of(params: Any) -> dict[str, Any]:
    """Return every value that can be written, by key: handles, no copies of memory.

    Args:
        params: parameters of a scene (`mi.SceneParameters`).
    """
    import mitsuba as mi

    found = {}
    for key, (handle, cpptype, node, flags) in params.properties.items():
        if flags & mi.ParamFlags.ReadOnly.value:
            continue
        try:
            value = ShownValue(key, handle, 0, cpptype).read(node)  # type: ignore[call-arg]
        except (RuntimeError, TypeError):
            continue
        if value is not None:  # not set, as the absorption of hair
            found[key] = _handle(value)
    return found


def _handle(value: Any) -> Any:
    """Return an object of its own for the same memory: the plugin's own would follow later writes."""
    import drjit as dr

    return type(value)(value) if dr.is_jit_v(value) or is_transform(value) else value


def _same(a: Any, b: Any) -> bool:
    """Return whether two values are the same memory and the same node of the graph, or equal plain values."""
    import drjit as dr

    if type(a) is not type(b):
        return False
    first, second = dr.detail.collect_indices(a), dr.detail.collect_indices(b)
    if first or second:
        return bool(first == second)
    return a is b or bool(np.all(a == b))


def put_back(params: Any, values: Mapping[str, Any], now: Mapping[str, Any] | None = None) -> None:
    """Write those values that differ from the scene's, and update the scene.

    Args:
        params: ``mitsuba.SceneParameters`` of the scene.
        values: values by key, such as :func:`values_of` returned before.
        now: values that the scene holds now, None to read them.
    """
    now = values_of(params) if now is None else now
    keys = [key for key, value in values.items() if key not in now or not _same(value, now[key])]
    if not keys:
        return
    # Mitsuba recomputes normals when positions change: both have to go back.
    keys = add_normals(keys, values)
    for key in keys:
        params[key] = values[key]
    _update(params, keys)


def _update(params: Any, keys: Sequence[str]) -> None:
    for key in (*keys, *dependent_keys(keys, params)):
        params.set_dirty(key)
    with quiet():
        params.update()


def detached(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values without derivatives of Dr.Jit.

    Args:
        values: values by key.
    """
    import drjit as dr

    return {key: dr.detach(value) if dr.grad_enabled(value) else value for key, value in values.items()}


def shapes_of(params: Any, keys: Iterable[str], name: str) -> dict[str, tuple[int, ...]]:
    """Return the shapes of torch values by key.

    Args:
        params: ``mitsuba.SceneParameters`` of the scene.
        keys: keys of parameters.
        name: name of the wrapped function, for messages.

    Raises:
        UnknownKeyError: if the scene has no such parameter.
        SceneError: if a parameter is not an array of real numbers.
    """
    found = {}
    for key in keys:
        if key not in params.properties:
            hint = unknown_key(str(key), list(params.properties), "`parameters`")
            raise UnknownKeyError(f"{name}: {hint.replace('scene.parameters()', 'params')}")
        kind, shape = classify(key, params[key])
        if kind in ("plain", "integer") or shape is None:
            raise SceneError(
                f"{name}: the parameter {key!r} is not an array of real numbers; write it into the scene before the "
                "call, params[key] = value."
            )
        found[key] = shape
    return found


def write(params: Any, leaves: Mapping[str, Any], name: str) -> None:
    """Set parameters from flat Dr.Jit arrays by operations that gradients pass, and update the scene.

    Args:
        params: ``mitsuba.SceneParameters`` of the scene.
        leaves: flat arrays by key, of the shapes of :func:`shapes_of`.
        name: name of the wrapped function, for messages.

    Raises:
        SceneError: if Mitsuba refuses a value, or a pose reflects a shape that it would turn inside out.
    """
    try:
        for key, leaf in leaves.items():
            current = params[key]
            kind, shape = classify(key, current)
            node = params.properties[key][2]
            if kind == "transform" and is_turned_by_reflections(node.class_name(), key.rsplit(".", 1)[-1]):
                check_pose(key, read_value(current, shape), np.array(leaf))
            params[key] = as_mitsuba_value(kind, shape or (), current, leaf)
        _update(params, tuple(leaves))
    except (RuntimeError, ValueError, TypeError) as error:
        if isinstance(error, TorchTransientError):
            raise
        raise SceneError(f"{name}: values of {', '.join(leaves)}: Mitsuba refuses them: {one_line(error)}") from error
