"""Losses that are given to losses: what a `compare` has to take, asked of it before it is called."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from typing import Any, Protocol, cast

from torch import Tensor, nn

from torchtransient import checks
from torchtransient.checks import shown
from torchtransient.errors import ArgumentError
from torchtransient.losses.comparison import Reduction
from torchtransient.losses.layouts import time_dim

# First arguments of what is no loss (input, target): a model there would be taken for a measurement, in silence, since
# both are tensors of one shape.
_MEASUREMENT_FIRST = {"counts", "measured", "target"}
# Second ones of such, and of losses that take more than a model before the measurement.
_NO_MEASUREMENT = {"mean", "rate", "second", "faces"}


class PairLoss(Protocol):
    """A loss of this room that compares two tensors; `functools.partial` holds further options of one."""

    def __call__(self, input: Tensor, target: Tensor, *, mask: Tensor | None, reduction: Reduction) -> Tensor: ...


class PairModule(Protocol):
    """A loss of this room as a module, which holds a `reduction` of its own."""

    reduction: Reduction

    def __call__(self, input: Tensor, target: Tensor, mask: Tensor | None) -> Tensor: ...


def check_compare(compare: object, where: str, reduction: Reduction | None) -> dict[str, inspect.Parameter]:
    """Its parameters. Raises ArgumentError unless it is a function or module (model, measurement) with a mask, and of
    nothing else that is not given; `reduction`: a function takes it, too.
    """
    checks.function(f"{where}: compare", compare, "tensors")
    module = isinstance(compare, nn.Module)
    function = cast(Callable[..., Any], compare.forward if isinstance(compare, nn.Module) else compare)
    title = type(compare).__name__ if module else _title(compare)
    names: dict[str, object] = {"mask": None} if module else {"mask": None, "reduction": reduction}
    wanted = ", ".join(f"{name}=" for name in names)
    if isinstance(function, functools.partial) and function.args:
        raise ArgumentError(
            f"{where}: expected compare to take (input, target, {wanted}), got a functools.partial of {title} that "
            "fills in the first of them. Hold options by their names."
        )
    try:
        signature = inspect.signature(function)
        bound = signature.bind(None, None, **names)
    except (TypeError, ValueError) as error:
        raise ArgumentError(
            f"{where}: expected compare to take (input, target, {wanted}) and no more, got "
            f"{title}: {error}. functools.partial holds further arguments of a loss of tt.losses."
        ) from None
    first, second = [*bound.arguments, "", ""][:2]
    if first in _MEASUREMENT_FIRST or second in _NO_MEASUREMENT:
        raise ArgumentError(
            f"{where}: expected compare to take the model first and the measurement second, (input, target), got "
            f"{title}, which takes {first} first and {second} second. Turn it round in a function."
        )
    return dict(signature.parameters)


def shared_dim(
    compare: object, known: dict[str, inspect.Parameter], dim: int | None, like: Tensor, where: str
) -> int | None:
    """Where time is: `dim`, or what `compare` holds, whose parameters are `known`. Raises ArgumentError for two
    places."""
    named = known["dim"].default if "dim" in known else None
    held = getattr(compare, "dim", None) if isinstance(compare, nn.Module) else named
    if held is None or held is inspect.Parameter.empty:
        return dim
    place = time_dim(like, held, where)
    if dim is not None and time_dim(like, dim, where) != place:
        raise ArgumentError(
            f"{where}: expected time in one dimension, got dim={dim}, and dim={held} held by compare. Leave "
            "the latter out."
        )
    return place


def _title(function: object) -> str:
    named = function.func if isinstance(function, functools.partial) else function
    return str(getattr(named, "__name__", shown(function)))
