"""PyTrees: nested lists, tuples, dictionaries and structures, taken apart into leaves and put together again.

What Dr.Jit takes for one: lists, tuples (also named ones), dictionaries, dataclasses, and classes with a dictionary
``DRJIT_STRUCT`` of their fields. Everything else is a leaf.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from torchtransient.errors import ShapeError


@dataclass(frozen=True)
class Tree:
    """The structure of a PyTree without its leaves. ``kind``: its class; ``names``: its keys or fields, in order;
    ``like``: an instance of a class that is made anew by copying it, as it was when it was taken apart.
    """

    kind: type | None
    names: tuple[Any, ...] = ()
    branches: tuple[Tree, ...] = ()
    like: Any = dataclasses.field(default=None, compare=False)

    def put_together(self, leaves: Iterator[Any]) -> Any:
        """A PyTree of this structure with ``leaves`` in their order."""
        if self.kind is None:
            return next(leaves)
        parts = [branch.put_together(leaves) for branch in self.branches]
        if self.kind in (list, tuple):
            return self.kind(parts)
        if self.kind is dict:
            return dict(zip(self.names, parts, strict=True))
        if issubclass(self.kind, tuple):
            return _tuple_of(self.kind, parts)
        made = _copy(self.like)
        if isinstance(made, list):
            made[:] = parts
            return made
        for name, part in zip(self.names, parts, strict=True):
            if isinstance(made, dict):
                made[name] = part
            else:
                _set(made, name, part)
        return made


LEAF = Tree(None)


def taken_apart(tree: Any, is_leaf: Callable[[Any], bool] = lambda tree: False) -> tuple[Tree, list[Any]]:
    """(structure, leaves) of a PyTree; what ``is_leaf`` says is one although it has a structure."""
    names: tuple[Any, ...]
    like: Any
    if is_leaf(tree):
        return LEAF, [tree]
    if isinstance(tree, (list, tuple)):
        names, parts, like = (), list(tree), None if isinstance(tree, tuple) or type(tree) is list else _copy(tree)
    elif isinstance(tree, dict):
        names, parts, like = tuple(tree), list(tree.values()), None if type(tree) is dict else _copy(tree)
    elif fields := _fields(tree):
        names, parts, like = fields, [getattr(tree, name) for name in fields], _copy(tree)
    else:
        return LEAF, [tree]
    apart = [taken_apart(part, is_leaf) for part in parts]
    branches = tuple(branch for branch, _ in apart)
    return Tree(type(tree), names, branches, like), [leaf for _, leaves in apart for leaf in leaves]


def _fields(value: Any) -> tuple[str, ...]:
    """The fields of a structure in the sense of Dr.Jit; none of what is no structure."""
    if isinstance(value, type):
        return ()
    described = getattr(type(value), "DRJIT_STRUCT", None)
    if isinstance(described, dict):
        return tuple(described)
    return tuple(field.name for field in dataclasses.fields(value)) if dataclasses.is_dataclass(value) else ()


def _tuple_of(kind: type[tuple[Any, ...]], parts: list[Any]) -> tuple[Any, ...]:
    try:
        return tuple.__new__(kind, parts)  # as named tuples make others of their kind, whatever their class takes
    except TypeError:  # structures of C, as torch's
        return kind(parts)


_EXPECTED = "Expected lists, tuples, dictionaries or structures of Python; return the fields in a dictionary"


def _copy(structure: Any) -> Any:
    try:
        return copy.copy(structure)
    except TypeError as error:
        name = type(structure).__name__
        raise ShapeError(f"a {name} cannot be made again with other fields: {error}. {_EXPECTED}.") from error


def _set(structure: Any, name: str, value: Any) -> None:
    try:
        object.__setattr__(structure, name, value)
    except (TypeError, AttributeError) as error:
        raise ShapeError(
            f"a {type(structure).__name__} cannot hold a {type(value).__name__} as its field {name!r}: {error}. "
            f"{_EXPECTED}."
        ) from error
