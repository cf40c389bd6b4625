"""Linear maps between hidden volumes and captures, with exact adjoints and derivatives that save nothing.

A map is two plain functions that run without autograd, a piece at a time. Torch differentiates one node: its backward
pass is the adjoint, the backward pass of the adjoint is the map again, and forward mode is the map of the tangent. No
tensor is kept for it, so that memory does not grow with the steps inside. States of operators are their settings, which
are compared when they are loaded.
"""

from __future__ import annotations

import json
import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from typing import Any, Self

import torch
from torch import Tensor, nn

from torchtransient.errors import GradientError, ShapeError, StorageError, UnitError


def checked_precision(dtype: torch.dtype, who: str) -> torch.dtype:
    """Return a precision of tables.

    Args:
        dtype: float32 or float64.
        who: begins the message.

    Raises:
        UnitError: for other types.
    """
    if dtype not in (torch.float32, torch.float64):
        raise UnitError(f"{who}: expected dtype torch.float32 or torch.float64, got {dtype}.")
    return dtype


class _Apply(torch.autograd.Function):
    """``map_`` or ``adjoint_`` of an operator."""

    @staticmethod
    def forward(x: Tensor, operator: LinearOperator, adjoint: bool) -> Tensor:
        # Without autocast: what measurements and phases lose by half precision is more than a network does.
        with torch.no_grad(), torch.autocast("cuda" if x.is_cuda else "cpu", enabled=False):
            return (operator.adjoint_ if adjoint else operator.map_)(x)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        x, ctx.operator, ctx.adjoint = inputs
        ctx.real = not x.is_complex()

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None]:
        found = _apply(grad, ctx.operator, not ctx.adjoint)
        return (found.real if ctx.real and found.is_complex() else found), None, None

    @staticmethod
    def jvp(ctx: Any, tangent: Tensor, *_: None) -> Tensor:
        return _apply(tangent, ctx.operator, ctx.adjoint)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], x: Tensor, operator: LinearOperator, adjoint: bool) -> Any:
        # Leading dimensions are a batch anyway.
        dim = in_dims[0]
        return _apply(x if dim is None else x.movedim(dim, 0), operator, adjoint), None if dim is None else 0


def _apply(x: Tensor, operator: LinearOperator, adjoint: bool) -> Tensor:
    result: Tensor = _Apply.apply(x, operator, adjoint)  # type: ignore[no-untyped-call]
    return result


class LinearOperator(nn.Module, ABC):
    """A linear map ``A`` from a volume to the measurement that a scan makes of it.

    ``forward(volume)`` is ``A volume``, ``adjoint(y)`` is ``A^H y``, both differentiable in both modes, any number of
    times, for any leading dimensions (batch, channels), under ``torch.vmap``, and on the device of their tables
    (``operator.to(device)``). ``volume_shape``, ``data_shape``: the trailing dimensions of the two;
    ``volume_name``, ``data_name``: their names in messages.

    Classes define ``map_(x)`` and ``adjoint_(y)``, which run without autograd, take any leading dimensions, may be
    called from several threads at once, and are each other's adjoints to rounding: ``<A x, y> = <x, A^H y>``, the real
    part of it where one of the two is real by nature (:attr:`real_volume`, :attr:`real_data`). They take tensors of the
    operator's own precision (:attr:`dtype`, real; complex ones have the matching complex type); others are converted,
    half precision to float32 tables as well. ``torch.autocast`` does not reach into them.

    Tables are buffers. Operators are differentiable by their operands alone: GradientError for tables and parameters of
    a class that require a gradient, which would get none. Not supported: ``torch.compile(fullgraph=True)``; without
    it the graph breaks at an operator, whose results are the same.
    """

    volume_shape: tuple[int, ...]
    data_shape: tuple[int, ...]
    dtype: torch.dtype
    real_volume = True
    real_data = True
    volume_name = "volume"
    data_name = "data"

    @abstractmethod
    def map_(self, x: Tensor) -> Tensor:
        """Return ``A x``.

        Args:
            x: (..., *volume_shape).

        Returns:
            (..., *data_shape).
        """

    @abstractmethod
    def adjoint_(self, y: Tensor) -> Tensor:
        """Return ``A^H y``.

        Args:
            y: (..., *data_shape).

        Returns:
            (..., *volume_shape).
        """

    def forward(self, volume: Tensor) -> Tensor:
        """Apply the map, ``A volume``.

        Args:
            volume: (..., *volume_shape), on the device of the operator.

        Returns:
            (..., *data_shape).

        Raises:
            ShapeError: for another shape.
        """
        volume = self._taken(self.volume_name, volume, self.volume_shape, real=self.real_volume)
        return _apply(volume, self, False)

    def adjoint(self, data: Tensor) -> Tensor:
        """Apply the adjoint map, ``A^H data``.

        Args:
            data: (..., *data_shape), on the device of the operator.

        Returns:
            (..., *volume_shape).

        Raises:
            ShapeError: for another shape.
        """
        data = self._taken(self.data_name, data, self.data_shape, real=self.real_data)
        return _apply(data, self, True)

    def _taken(self, name: str, x: Tensor, shape: tuple[int, ...], *, real: bool) -> Tensor:
        who = type(self).__name__
        if tuple(x.shape[x.ndim - len(shape) :]) != shape:
            sizes = ", ".join(map(str, shape))
            raise ShapeError(f"{who}: expected {name} (..., {sizes}), got {tuple(x.shape)}.")
        if not x.numel():
            raise ShapeError(f"{who}: expected one {name} at least, got an empty batch {tuple(x.shape)}.")
        if real and x.is_complex():
            raise ShapeError(f"{who}: expected {name} of real numbers, got {x.dtype}. Give its real part or modulus.")
        asking = [key for key, t in (*self.named_parameters(), *self.named_buffers()) if t.requires_grad]
        if asking:
            raise GradientError(
                f"{who}: expected tables without gradients, which they would not get, got {', '.join(asking)}."
            )
        return x.to(self.dtype.to_complex() if x.is_complex() or not real else self.dtype)

    def _apply(self, fn: Callable[..., Any], recurse: bool = True) -> Self:
        """Moves and conversions of a module, which :attr:`dtype` follows, whatever tables there are."""
        dtype = checked_precision(fn(torch.empty((), dtype=self.dtype, device="cpu")).dtype, type(self).__name__)
        super()._apply(fn, recurse)  # type: ignore[no-untyped-call]
        if dtype != self.dtype:
            self.dtype = dtype
            self._converted()
        return self

    def _converted(self) -> None:
        """Make tables anew in another precision."""

    @property
    def device(self) -> torch.device | None:
        """Device of the tables, None for an operator without any."""
        table = next((tensor for tensor in (*self.buffers(), *self.parameters())), None)
        return None if table is None else table.device


def each(function: Callable[[Tensor], Tensor], x: Tensor, dims: int) -> Tensor:
    """Apply a function to every item of the leading dimensions of a tensor, one at a time.

    Args:
        function: function of one item.
        x: (..., *item).
        dims: number of dimensions of an item.

    Returns:
        (..., *result).
    """
    lead = x.shape[: x.ndim - dims]
    if not lead:
        return function(x)
    items = x.reshape(-1, *x.shape[x.ndim - dims :])
    first = function(items[0])
    out = first.new_empty(len(items), *first.shape)
    out[0], shape = first, first.shape
    del first  # not held beside the next one
    for i in range(1, len(items)):
        out[i] = function(items[i])
    return out.reshape(*lead, *shape)


# Shares by which numbers may differ: those of another machine, or that a file rounds to single precision.
SLACK = 1e-6
# Sums of a tensor that tell it from others.
SUMS = 4


def packed(described: dict[str, Any]) -> Tensor:
    """Return plain data as JSON in bytes, which files that hold tensors alone take too.

    Args:
        described: plain data.

    Returns:
        (N,) uint8 on the CPU.
    """
    return torch.tensor(list(json.dumps(described).encode()), dtype=torch.uint8, device="cpu")


def unpacked(state: Any, who: str) -> Any:
    """Return the plain data of :func:`packed`.

    Args:
        state: (N,) uint8.
        who: begins the message.

    Raises:
        StorageError: for other objects.
    """
    try:
        return json.loads(bytes(state.tolist()))
    except (AttributeError, TypeError, ValueError) as error:
        raise StorageError(f"{who}: expected the state of an operator, as state_dict() gives it: {error}.") from None


def plain(value: Any) -> Any:
    """Return a setting as plain data: records by their fields, tensors by their shape, size and some sums.

    Args:
        value: number, text, tensor, record, or a list of such.
    """
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, Tensor):
        flat = value.detach().to("cpu", torch.float64).reshape(-1)
        k = torch.arange(1, SUMS + 1, dtype=torch.float64, device="cpu")[:, None]
        places = torch.arange(1, len(flat) + 1, dtype=torch.float64, device="cpu")
        size = float(flat.abs().max()) if len(flat) else 0.0
        return {"shape": list(value.shape), "size": size, "sums": (torch.cos(k * places) @ flat).tolist()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    record = {"type": type(value).__name__}
    if is_dataclass(value):
        record |= {field.name: plain(getattr(value, field.name)) for field in fields(value)}
    return record


def check_same(mine: Any, theirs: Any, who: str, what: str = "settings") -> None:
    """Check that a state that is loaded is that of an equal operator.

    Args:
        mine, theirs: settings as :func:`plain` returns them.
        who: begins the message.
        what: name of the setting.

    Raises:
        ShapeError: where they differ by more than rounding.
    """
    if isinstance(mine, dict) and isinstance(theirs, dict) and mine.keys() == theirs.keys():
        if "sums" not in mine:
            for key in mine:
                check_same(mine[key], theirs[key], who, key if what == "settings" else f"{what}.{key}")
            return
        slack = SLACK * max(mine["size"], theirs["size"]) * math.sqrt(max(1, math.prod(mine["shape"])))
        near = (abs(a - b) <= slack for a, b in zip(mine["sums"], theirs["sums"], strict=True))
        equal = mine["shape"] == theirs["shape"] and all(near)
    elif isinstance(mine, list) and isinstance(theirs, list) and len(mine) == len(theirs):
        for a, b in zip(mine, theirs, strict=True):
            check_same(a, b, who, what)
        return
    elif isinstance(mine, float) or isinstance(theirs, float):
        both = isinstance(mine, float | int) and isinstance(theirs, float | int)
        equal = both and math.isclose(mine, theirs, rel_tol=SLACK, abs_tol=1e-3 * SLACK)
    else:
        equal = mine == theirs
    if not equal:
        raise ShapeError(
            f"{who}: expected the state of an operator like this one, with {what} {mine!r}, got one with {theirs!r}. "
            "Make the operator as the one that was saved."
        )
