"""Precision of tensors in functions and modules: half precision is computed in single, and autocast is switched off."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import torch
from torch import Tensor

from torchtransient.checks import real_array, shown
from torchtransient.errors import ShapeError, TorchTransientError

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


def without_autocast(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Run a function or method in the dtype of its tensors, inside `torch.autocast` as well.

    Autocast makes bfloat16 or float16 of the operands of matrix products and convolutions. A network bears that; a
    measurement loses 3e-3 of its value by it, phases their millimetres, and poses their centimetres.

    Args:
        function: function of tensors, positional or by name.
    """

    @functools.wraps(function)
    def run(*args: Arguments.args, **keywords: Arguments.kwargs) -> Result:
        for kind in {"cpu"} | {x.device.type for x in (*args, *keywords.values()) if isinstance(x, Tensor)}:
            if kind != "meta" and torch.is_autocast_enabled(kind):
                with torch.autocast(kind, enabled=False):
                    return run(*args, **keywords)
        return function(*args, **keywords)

    return run


class _Product(torch.autograd.Function):
    """``matrix @ x`` whose derivatives, of any order, are such products again."""

    generate_vmap_rule = True

    @staticmethod
    def forward(matrix: Tensor, x: Tensor) -> Tensor:
        with torch.autocast(x.device.type, enabled=False):
            return matrix @ x

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor], output: Tensor) -> None:
        ctx.save_for_backward(*inputs)
        ctx.save_for_forward(*inputs)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, Tensor | None]:
        matrix, x = ctx.saved_tensors
        of_matrix = of_x = None
        if ctx.needs_input_grad[0]:
            columns = x.movedim(-2, 0).flatten(1)
            of_matrix = product(gradient.movedim(-2, 0).flatten(1), columns.mT)
        if ctx.needs_input_grad[1]:
            of_x = product(matrix.mT, gradient)
        return of_matrix, of_x

    @staticmethod
    def jvp(ctx: Any, of_matrix: Tensor | None, of_x: Tensor | None) -> Tensor:
        matrix, x = ctx.saved_tensors
        parts = [product(of_matrix, x)] if of_matrix is not None else []
        parts += [product(matrix, of_x)] if of_x is not None else []
        total: Tensor = sum(parts[1:], parts[0])
        return total


def product(matrix: Tensor, x: Tensor) -> Tensor:
    """Multiply ``matrix`` and ``x`` in their dtype, in derivatives of any order too.

    `without_autocast` covers the forward pass. The derivative of a product is made of products, and inside
    `torch.autocast` a backward pass would round those to half precision, by up to 1e-2 of a gradient.

    Args:
        matrix: matrix (M, K).
        x: matrices (..., K, P).

    Returns:
        (..., M, P).
    """
    if torch.compiler.is_compiling() or x.device.type == "meta":
        return matrix @ x
    result: Tensor = _Product.apply(matrix, x)  # type: ignore[no-untyped-call]
    return result


def floating(x: Any, where: str) -> Tensor:
    """Return a tensor of floating numbers.

    Args:
        x: tensor of any shape.
        where: subject of messages.

    Raises:
        ShapeError: for anything else.
    """
    if not isinstance(x, Tensor) or not x.is_floating_point():
        got = str(x.dtype) if isinstance(x, Tensor) else type(x).__name__
        raise ShapeError(f"{where}: expected a floating tensor, got {got}. Convert it with .float().")
    return x


def number_tensor(given: Any, expected: str, error: type[TorchTransientError] = ShapeError) -> Tensor:
    """Return a floating tensor with its gradient, or float64 of other numbers.

    Args:
        given: numbers of any library and shape.
        expected: beginning of the message.
        error: type of the error.

    Raises:
        error: for anything but numbers.
    """
    if isinstance(given, Tensor) and given.is_floating_point():
        return given
    array = real_array(given)
    if array is None:
        raise error(f"{expected}, got {shown(given)}.")
    return torch.tensor(array)


def single(x: Tensor) -> Tensor:
    """Return a tensor in float32 or better: half precision has no linear algebra on the CPU, and loses digits.

    Args:
        x: tensor of any shape.
    """
    return x.float() if x.is_floating_point() and x.element_size() < 4 else x


def in_single(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Run a function or method with its half-precision tensors in float32; the result is float32.

    Counts are whole in bfloat16 up to 256 and in float16 up to 2048, which ends at 65504; positions in bins and rates
    per cycle fare no better. Gradients arrive in the precision of the tensors that were given.

    Args:
        function: function of tensors, positional or by name.
    """

    @functools.wraps(function)
    def run(*args: Arguments.args, **keywords: Arguments.kwargs) -> Result:
        given = [single(x) if isinstance(x, Tensor) else x for x in args]
        named = {name: single(x) if isinstance(x, Tensor) else x for name, x in keywords.items()}
        return function(*given, **named)  # type: ignore[arg-type]

    return run


def holds(condition: Tensor) -> bool:
    """Return True if a condition is true everywhere, or its values cannot be read.

    Checks of values are left out inside `torch.func.vmap`, in `torch.compile` (the graph would break), and for
    tensors on "meta".

    Args:
        condition: truth values of any shape.
    """
    return torch.compiler.is_compiling() or is_true(condition)


def is_true(condition: Tensor) -> bool:
    """Return as :func:`holds`, but read the values in `torch.compile` too, which breaks the graph.

    Args:
        condition: truth values of any shape.
    """
    if condition.is_meta:
        return True
    try:
        return bool(condition.all())
    except RuntimeError as error:
        if "vmap" not in str(error):
            raise
        return True
