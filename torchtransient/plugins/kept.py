"""What follows from the numbers of some plugins, kept for as long as none of them is replaced.

Renders of one scene differ by seed and by the values that were installed since. What depends on none of these need not
be computed, nor be a kernel of its own, in every render.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np

from torchtransient.plugins.node_walk import ShownValue, shown_by
from torchtransient.plugins.parameters import is_attribute


class Kept:
    """A value computed from the numbers of ``plugins``, detached.

    The arrays it was computed from are held with it: so none is written in place meanwhile, and no later one can be
    taken for it because it got the same number from Dr.Jit. While a call is recorded (``dr.freeze``) nothing is kept,
    since the recording has to compute it for other numbers: this is no part of what :mod:`.frozen_state` compares.
    """

    only_remembers = True

    __slots__ = ("_anew", "_arrays", "_fixed", "_seen", "_value")

    def __init__(self, plugins: list[Any]) -> None:
        # As in a ParameterTracker: some values may be replaced by their owners, and are shown anew each time.
        shown = [(node, shown_by(node)[0]) for node in plugins]
        self._anew = [node for node, values in shown if any(_may_move(node, value) for value in values)]
        self._fixed = [(node, value) for node, values in shown if node not in self._anew for value in values]
        self._seen: Any = None
        self._arrays: list[Any] = []
        self._value: Any = None

    def get(self, compute: Callable[[], Any], also: Any = None) -> Any:
        """The value, by ``compute`` where there is none or a number has been replaced, or something else that it
        depends on (``also``, plain numbers) is not what it was.
        """
        if dr.flag(dr.JitFlag.FreezingScope):
            return compute()
        values = [shown.read(node) for node, shown in self._fixed]
        values += [shown.read(node) for node in self._anew for shown in shown_by(node)[0]]
        seen = [also, *map(_variables, values)]
        if seen != self._seen:
            self._seen = None
            self._arrays = [_held(value) for value in values]
            self._value = compute()
            self._seen = seen
        return self._value


def _may_move(node: Any, value: ShownValue) -> bool:
    return value.cpptype is None or is_attribute(node, value.key)


def _variables(value: Any) -> Any:
    """What tells a parameter from others: the numbers that Dr.Jit has given to its variables, or itself."""
    if "Transform" in type(value).__name__:  # by name: Dr.Jit arrays answer to any attribute made of component letters
        value = value.matrix
    if not dr.is_jit_v(value):
        return np.array(value).tolist() if dr.is_array_v(value) else value
    if dr.is_tensor_v(value):
        value = value.array
    return value.index if dr.depth_v(value) == 1 else [_variables(entry) for entry in value]


def _held(value: Any) -> Any:
    """A copy of an array that does not change with it."""
    if "Transform" in type(value).__name__:
        value = value.matrix
    return dr.detach(type(value)(value)) if dr.is_jit_v(value) else None
