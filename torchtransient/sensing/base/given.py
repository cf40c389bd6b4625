"""What sensors are given: no gradient is cut off in silence, and arrays are taken where tensors are."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.autograd import forward_ad

from torchtransient.checks import shown
from torchtransient.errors import GradientError, ShapeError, UnitError


def tensor_of(array: np.ndarray[Any, Any], where: str) -> Tensor:
    """A tensor of an array of numbers, of any byte order. UnitError for what holds none."""
    native = np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("=")) if array.dtype.kind != "O" else array
    try:
        return torch.from_numpy(native if native.flags.writeable else native.copy())
    except TypeError as error:
        raise UnitError(f"{where}: expected numbers as a tensor or an array, got {shown(array)}.") from error


def check_dense(x: Tensor, where: str, name: str = "") -> Tensor:
    """The tensor. ShapeError for a sparse one."""
    if x.layout != torch.strided:
        said = f"{name} as a dense tensor" if name else "a dense tensor"
        raise ShapeError(f"{where}: expected {said}, got {x.layout}. x.to_dense() makes one.")
    return x


def no_arrays(value: Any, where: str) -> Any:
    """The value, or a tensor of an array with dimensions."""
    return tensor_of(value, where) if isinstance(value, np.ndarray) and value.ndim else value


def numbers_of(value: Any, name: str, where: str) -> Any:
    """A list of the numbers of a tensor of one dimension; anything else as it is. GradientError as `refuse_cut_off`."""
    refuse_cut_off(value, name, where)
    return value.tolist() if isinstance(value, Tensor) and value.ndim == 1 else value


def refuse_cut_off(value: object, name: str, where: str) -> None:
    """GradientError for a number that requires a gradient and is about to be taken without it."""
    if isinstance(value, Tensor) and (is_dual(value) or (value.requires_grad and torch.is_grad_enabled())):
        raise GradientError(_message(name, where))


def is_dual(value: Tensor) -> bool:
    """Whether a tensor carries a tangent of forward-mode differentiation."""
    if torch.compiler.is_compiling():
        return False
    return forward_ad.unpack_dual(value).tangent is not None  # type: ignore[no-untyped-call]


def _message(name: str, where: str) -> str:
    return (
        f"{where}: expected {name} without a gradient, which is not supported here and would be cut off in silence; "
        f"got a tensor that requires one. Give its value, {name}.detach(), and learn it by learnable=True where "
        f"{where} has that, or by an nn.Parameter where it takes one; a buffer of a module is learnt by "
        "torch.func.functional_call(module, {its name: tensor}, (x,))."
    )


# ------------------------------------------------------------------------------------------------- of constructors


def careful_init(init: Callable[..., None]) -> Callable[..., None]:
    """An ``__init__`` that takes arrays, and refuses tensors whose gradient the module has not kept."""

    @functools.wraps(init)
    def run(self: nn.Module, *args: Any, **keywords: Any) -> None:
        where = type(self).__name__
        given = [no_arrays(value, where) for value in args]
        named = {name: no_arrays(value, where) for name, value in keywords.items()}
        for value in (*given, *named.values()):
            if isinstance(value, Tensor):
                check_dense(value, where)
        init(self, *given, **named)
        # once, when the whole object is there; private parts are looked at with what they are part of
        if getattr(type(self).__init__, "__wrapped__", None) is init and not where.startswith("_"):
            names = init.__code__.co_varnames[1:] if hasattr(init, "__code__") else ()
            places = {names[i] if i < len(names) else f"argument {i}": value for i, value in enumerate(given)}
            check_kept(self, {**places, **named}, where)

    return run


def check_kept(module: nn.Module, given: Mapping[str, Any], where: str) -> None:
    """GradientError for a given tensor that requires a gradient, of which the module holds neither it nor a result."""
    wanted = [(name, t) for name, value in given.items() for t in _tensors(value) if t.requires_grad or is_dual(t)]
    if not wanted:
        return
    held = list(_held(module))
    same = {id(t) for t in held}
    lost = [(name, t) for name, t in wanted if id(t) not in same]
    reached = _reached(held) if lost else set()
    for name, tensor in lost:
        if is_dual(tensor) and any(is_dual(t) for t in held):
            continue  # tangents have no graph to follow
        if id(tensor) not in reached and (tensor.grad_fn is None or id(tensor.grad_fn) not in reached):
            raise GradientError(_message(name, where))


def refuse_gradients(record: object) -> None:
    """GradientError for fields of a dataclass that require a gradient; for records whose numbers are taken as such."""
    where = type(record).__name__
    for field in fields(record):  # type: ignore[arg-type]
        for tensor in _tensors(getattr(record, field.name)):
            refuse_cut_off(tensor, field.name, where)


def _tensors(value: Any) -> Iterator[Tensor]:
    """The tensors of an argument and of the containers in it; modules keep their own."""
    if isinstance(value, Tensor):
        yield value
    elif isinstance(value, Mapping):
        for part in value.values():
            yield from _tensors(part)
    elif isinstance(value, (list, tuple)):
        for part in value:
            yield from _tensors(part)
    elif is_dataclass(value) and not isinstance(value, type):
        for field in fields(value):
            yield from _tensors(getattr(value, field.name))


def _held(module: nn.Module) -> Iterator[Tensor]:
    for part in module.modules():
        # no attribute of any other kind: nothing that is merely kept, and not used as a tensor, counts
        yield from part.parameters(recurse=False)
        yield from part.buffers(recurse=False)
        yield from (v for v in part.__dict__.values() if isinstance(v, Tensor))


def _reached(held: Iterable[Tensor]) -> set[int]:
    """Identities of the tensors, and of the steps, that the held tensors were computed from."""
    nodes: list[Any] = [t.grad_fn for t in held if t.grad_fn is not None]
    found: set[int] = set()
    while nodes:
        node = nodes.pop()
        if id(node) in found:
            continue
        found.add(id(node))
        variable = getattr(node, "variable", None)
        if variable is not None:
            found.add(id(variable))
        nodes += [nxt for nxt, _ in node.next_functions if nxt is not None]
    return found
