"""Cache of what is computed of a scene, keyed by its inputs.

Renders of one scene differ by seed and by the values that were installed since. Results that depend on none of these
need not be computed, nor be a kernel of their own, in every render.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Hashable, Sequence
from typing import Any, TypeVar

import drjit as dr
import numpy as np

from torchtransient.plugins.node_walk import ShownValue, shown_by
from torchtransient.plugins.parameters import is_attribute

Result = TypeVar("Result")
# A scene that moves asks for nothing twice; several scans of a still one ask for a few things.
_MOST = 4


class Cache:
    """Cache of the last few results of each kind, keyed by all that they depend on.

    Results are detached. While a call is recorded (``dr.freeze``) a cache with ``plugins`` is not read, since the
    recording has to compute for other numbers.

    Args:
        plugins: plugins whose numbers are inputs of every result, beside its key. Results are dropped as soon as one
            number is replaced. The arrays that they were computed from are held with them, so that none is written in
            place, and no later one can be taken for it because it got the same number from Dr.Jit.
    """

    # Results follow from their keys: recorded calls do not depend on them beside these.
    only_remembers = True

    def __init__(self, plugins: Sequence[Any] | None = None) -> None:
        self._results: dict[str, dict[Hashable, Any]] = {}
        self._has_plugins = plugins is not None
        # As in a ParameterTracker: some values may be replaced by their owners, and are shown anew each time.
        shown = [(node, shown_by(node)[0]) for node in plugins or ()]
        self._shown_anew = [node for node, values in shown if any(_may_move(node, value) for value in values)]
        self._fixed = [(node, value) for node, values in shown if node not in self._shown_anew for value in values]
        self._numbers: Any = None
        self._arrays: list[Any] = []

    def get(self, kind: str, key: Hashable, compute: Callable[[], Result]) -> Result:
        """Return a result, computed unless it is in the cache. It is shared: not to be changed.

        Args:
            kind: name of the computation.
            key: data that the result depends on, beside the numbers of plugins.
            compute: function that computes it.
        """
        if self._has_plugins:
            if dr.flag(dr.JitFlag.FreezingScope):
                return compute()
            self._drop_outdated()
        results = self._results.setdefault(kind, {})
        if key not in results:
            result = compute()
            while len(results) >= _MOST:
                del results[next(iter(results))]
            results[key] = result
        return results[key]  # type: ignore[no-any-return]

    def _drop_outdated(self) -> None:
        values = [shown.read(node) for node, shown in self._fixed]
        values += [shown.read(node) for node in self._shown_anew for shown in shown_by(node)[0]]
        variables = [_variables(value) for value in values]
        if variables != self._numbers:
            self._results.clear()
            self._arrays = [_held(value) for value in values]
            self._numbers = variables


def digest(*arrays: np.ndarray) -> bytes:
    """Return a hash of arrays, of their values, shapes and types.

    Args:
        arrays: numpy arrays of any shapes.
    """
    found = hashlib.blake2b(digest_size=16)
    for array in arrays:
        found.update(f"{array.dtype.str}{array.shape}".encode())
        found.update(np.ascontiguousarray(array).data)
    return found.digest()


def _may_move(node: Any, value: ShownValue) -> bool:
    return value.cpptype is None or is_attribute(node, value.key)


def _variables(value: Any) -> Any:
    """Numbers that Dr.Jit has given to the variables of a parameter, or the parameter itself."""
    if "Transform" in type(value).__name__:  # by name: Dr.Jit arrays answer to any attribute made of component letters
        value = value.matrix
    if not dr.is_jit_v(value):
        return np.array(value).tolist() if dr.is_array_v(value) else value
    if dr.is_tensor_v(value):
        value = value.array
    return value.index if dr.depth_v(value) == 1 else [_variables(entry) for entry in value]


def _held(value: Any) -> Any:
    """Return a copy of an array that does not change with it."""
    if "Transform" in type(value).__name__:
        value = value.matrix
    return dr.detach(type(value)(value)) if dr.is_jit_v(value) else None
