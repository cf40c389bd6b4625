"""What follows from the numbers of some plugins, kept for as long as none of them is replaced.

Renders of one scene differ by seed and by the values that were installed since. What depends on none of these need not
be computed, nor be a kernel of its own, in every render.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np

from torchtransient.plugins.node_walk import shown_by


class Kept:
    """A value computed from the numbers of ``plugins``, detached.

    The arrays it was computed from are held with it: so none is written in place meanwhile, and no later one can be
    taken for it because it got the same number from Dr.Jit. While a call is recorded (``dr.freeze``) nothing is kept,
    since the recording has to compute it for other numbers: without a ``__dict__`` this stays out of
    :mod:`.frozen_state`.
    """

    __slots__ = ("_plugins", "_seen", "_value")

    def __init__(self, plugins: list[Any]) -> None:
        self._plugins = plugins
        self._seen: list[tuple[Any, Any]] | None = None
        self._value: Any = None

    def get(self, compute: Callable[[], Any]) -> Any:
        """The value, by ``compute`` where there is none or a number has been replaced."""
        if dr.flag(dr.JitFlag.FreezingScope):
            return compute()
        now = [_told_apart(shown.read(node)) for node in self._plugins for shown in shown_by(node)[0]]
        if self._seen is None or [mark for _, mark in now] != [mark for _, mark in self._seen]:
            self._seen = None
            self._value = compute()
            self._seen = now
        return self._value


def _told_apart(value: Any) -> tuple[Any, Any]:
    """(copy of a parameter, what tells it apart from other ones for as long as the copy is held)."""
    if "Transform" in type(value).__name__:  # by name: Dr.Jit arrays answer to any attribute made of component letters
        value = value.matrix
    if not dr.is_jit_v(value):
        return None, np.array(value).tolist() if dr.is_array_v(value) else value
    copy = dr.detach(type(value)(value))
    return copy, _variables(copy.array if dr.is_tensor_v(copy) else copy)


def _variables(value: Any) -> Any:
    """The numbers that Dr.Jit has given to the variables of an array."""
    return value.index if dr.depth_v(value) == 1 else [_variables(entry) for entry in value]
