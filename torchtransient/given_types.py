"""Things as people give them, checked where they are given: of a class, rows of things, mappings, functions.

What is none is a typed error that names it, before anything is made of it. :mod:`torchtransient.quantities` reads
numbers.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Collection, Iterator, Mapping
from typing import Any, TypeVar

from torchtransient.errors import ArgumentError, ShapeError, TorchTransientError
from torchtransient.quantities import shown, with_article

Kind = TypeVar("Kind")


def of_class(
    name: str, value: Any, kind: type[Kind], hint: str = "", error: type[TorchTransientError] = ArgumentError
) -> Kind:
    """``value``, which is of a class. Raises ``error``, with a ``hint`` at its end."""
    if not isinstance(value, kind):
        raise error(f"{name}: expected {with_article(kind.__name__)}, got {shown(value)}{hint}.")
    return value


def several(
    name: str, values: Any, what: str, kind: type[Kind] | None = None, error: type[TorchTransientError] = ShapeError
) -> list[Kind]:
    """``values`` one by one, as a list; each of a class, where one is said. Raises ``error`` for texts, mappings, and
    what cannot be gone through. ``what`` they are, for the message: "pixels (row, column)".
    """
    found = list(one_by_one(name, values, what, error))
    for one in found:
        if kind is not None and not isinstance(one, kind):
            raise error(f"{name}: expected several {what}, got {shown(one)} among them.")
    return found


def one_by_one(
    name: str, values: Any, what: str, error: type[TorchTransientError] = ShapeError
) -> Iterator[Any]:
    """As :func:`several`, of which nothing is taken yet."""
    with contextlib.suppress(TypeError):
        if not isinstance(values, (str, bytes, Mapping)):
            return iter(values)
    raise error(f"{name}: expected several {what}, got {shown(values)}.")


def mapping(name: str, value: Any, what: str, error: type[TorchTransientError] = ArgumentError) -> Mapping[Any, Any]:
    """``value``, which is a mapping. Raises ``error``, with ``what`` is written: "{title: image}"."""
    if not isinstance(value, Mapping):
        raise error(f"{name}: expected a dictionary {what}, got {shown(value)}.")
    return value


def function(name: str, value: Any, what: str, error: type[TorchTransientError] = ArgumentError) -> Callable[..., Any]:
    """``value``, which can be called. Raises ``error``, with ``what`` it is of: "images (N, 1, H, W)"."""
    if not callable(value):
        raise error(f"{name}: expected a function of {what}, got {shown(value)}.")
    called: Callable[..., Any] = value
    return called


def with_methods(name: str, value: Any, what: str, *methods: str) -> Any:
    """``value``, which has ``methods``, as a recipe has ``maker()``. Raises ArgumentError that names the first that is
    not there.
    """
    lacking = [method for method in methods if isinstance(value, type) or not callable(getattr(value, method, None))]
    if lacking:
        raise ArgumentError(f"{name}: expected {what}, with {lacking[0]}(), got {shown(value)}.")
    return value


def a_recipe(name: str, value: Any, *methods: str) -> Any:
    """As :func:`with_methods`, for what makes samples. Raises ArgumentError, which says what reads files of recipes."""
    hint = ""
    if isinstance(value, (str, os.PathLike)):
        hint = " tt.data.Recipe.read reads files."
    elif isinstance(value, Mapping):
        hint = " tt.data.Recipe.from_dict reads dictionaries."
    try:
        return with_methods(name, value, "a recipe", *methods)
    except ArgumentError as error:
        raise ArgumentError(f"{error}{hint}") from None


def by_number(name: str, value: Any) -> Any:
    """``value``, a data set of samples by number, or a list of them. Raises ArgumentError."""
    is_none = isinstance(value, (type, str, bytes)) or getattr(value, "ndim", None) == 0
    if is_none or not hasattr(value, "__len__") or not hasattr(value, "__getitem__"):
        raise ArgumentError(f"{name}: expected a data set of samples by number, got {shown(value)}.")
    return value


def text(name: str, value: Any, what: str, error: type[TorchTransientError] = ArgumentError) -> str:
    """``value``, which is a text. Raises ``error``, with ``what`` it is: "the name of a sampler"."""
    if not isinstance(value, str):
        raise error(f"{name}: expected {what}, got {shown(value)}.")
    return value


def is_one_of(value: Any, names: Collection[str]) -> bool:
    """Whether a value is one of these texts; an array is none, whatever is in it."""
    return isinstance(value, str) and value in names
