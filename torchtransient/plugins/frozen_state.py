"""State of a recorded call beside its arguments: arrays to be handed in, and a key of everything else.

``dr.freeze`` finds what it is handed and what plugins show to it; tables sit in plain objects, so that loops leave them
alone, and have to be named: ``dr.freeze(f, state_fn=lambda *args: integrator.frozen_state(scene))``. Numbers that are
no arrays become part of the kernels: a recording is good for one structure alone, see
:func:`state_below`.
"""

from __future__ import annotations

import enum
import functools
import sys
from array import array
from collections import deque
from collections.abc import Mapping
from decimal import Decimal
from fractions import Fraction
from functools import partial
from types import FunctionType, MethodType
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.plugins.cache import digest

# Their objects are known one by one below, or not comparable.
_OTHERS = ("builtins", "drjit", "mitsuba", "numpy", "torch")
_PLAIN = (type(None), bool, int, str, bytes)
# By class: how a walk deals with its objects.
_TREATED: dict[type, str] = {**dict.fromkeys(_PLAIN, "plain"), float: "float", list: "list", tuple: "list"}
# Messages of Dr.Jit about functions that it cannot record.
_NOT_RECORDABLE = (
    "recording a frozen function",
    "record(): ",
    "collect(): ",
    "replay(): ",
    "validate(): ",
    "within frozen functions",
    "cannot be recorded",
    "FlatVariables",
)


# Why a call cannot be recorded now, and can be another time.
WAITS = "an array of a plugin waits for what another call writes to it"
# Without numbers and addresses, which differ from run to run.
_REASONS = {
    "was created before recording": "a plugin of the scene does not show Dr.Jit all of its arrays",
    "validate(): ": "a plugin of the scene does not show Dr.Jit all of its arrays",
    "not supplied as an input": "a plugin of the scene does not show Dr.Jit all of its arrays",
    "in unsupported state": WAITS,
    "reading from evaluated variables": "numbers of arrays are read while it is traced",
    "FlatVariables": "an attribute of a plugin changes its type while it is recorded",
}


class NotComparableError(Exception):
    """Error of a job that cannot be compared with another one: it holds an object of an unknown type."""


def arrays_below(value: Any) -> list[Any]:
    """Return the Dr.Jit arrays of plain objects and of the containers that they hold, each once and in order.

    Args:
        value: object, list, tuple or dictionary. Mitsuba's structures of arrays count as arrays.

    Raises:
        NotComparableError: for objects of an unknown type.
    """
    return state_below(value)[1]


def state_below(value: Any) -> tuple[tuple[Any, ...], list[Any]]:
    """Return structure and arrays of plain objects and of the containers that they hold.

    Two jobs of the same structure are traced to the same kernels.

    Args:
        value: object, list, tuple or dictionary.

    Returns:
        (structure: all that is no array, with the places and types of arrays, hashable; Mitsuba's objects count by
        their address. Arrays: see :func:`arrays_below`).

    Raises:
        NotComparableError: for objects of an unknown type.
    """
    walk = _Walk(value)
    return tuple(walk.structure), walk.arrays


class _Walk:
    """Walk over plain objects that collects ``arrays`` and ``structure``.

    Not recursive: a function that calls itself would leave circles of references, and so objects that live on.
    """

    def __init__(self, value: Any) -> None:
        self.arrays: list[Any] = []
        self.structure: list[Any] = []
        # Objects are identified by their numbers in order, so temporary ones have to live as long as the walk.
        self._seen: dict[int, tuple[int, Any]] = {}
        self._waiting = [value]
        # A walk is part of every call: most of what it meets is plain, or an array, and is dealt with here.
        note, seen, waiting, pop = self.structure.append, self._seen, self._waiting, self._waiting.pop
        while waiting:
            current = pop()
            kind = type(current)
            treated = _TREATED.get(kind)
            if treated == "plain":
                note((kind, current))
                continue
            if treated == "float":
                note(current.hex())  # tells zeros apart, and a NaN is like another
                continue
            met = seen.get(id(current))
            if met is not None:
                note(met[0])
                continue
            seen[id(current)] = len(seen), current
            if treated == "array":
                self.arrays.append(current)
                note(kind)
            elif treated == "list":
                note((kind, len(current)))
                waiting += current
            elif treated == "plugin":
                note((kind, current.ptr))
            elif treated == "remembers":
                note(kind)  # what follows from the rest
            elif treated == "object":
                self._attributes(current, kind)
            else:
                self._add_other(current, kind)

    def _add_other(self, current: Any, kind: type) -> None:
        if kind not in _TREATED:
            _TREATED[kind] = _treatment(current, kind)
            # Again, as that.
            del self._seen[id(current)]
            self._waiting.append(current)
        elif dr.is_array_v(current):
            self.structure.append((kind, digest(np.array(current))))
        elif not (self._container(current, kind) or self._library(current, kind) or self._callable(current, kind)):
            self._object(current, kind)

    def _container(self, current: Any, kind: type) -> bool:
        if isinstance(current, Mapping):
            self.structure.append((kind, len(current)))
            for item in current.items():
                self._waiting += item
        elif isinstance(current, (list, tuple, deque)):
            self.structure.append((kind, len(current)))
            self._waiting += current
        elif isinstance(current, (set, frozenset)):
            self.structure.append((kind, frozenset(current)))
            if not all(isinstance(entry, (*_PLAIN, enum.Enum)) for entry in current):
                raise NotComparableError(f"a {kind.__name__} of objects")
        else:
            return False
        if kind.__module__.split(".")[0] not in (*_OTHERS, "collections", "types"):
            self._attributes(current, kind)  # of a class made out of a container
        return True

    def _library(self, current: Any, kind: type) -> bool:
        """Add values of Python, NumPy, torch, Dr.Jit and Mitsuba; return False for others."""
        note = self.structure.append
        if isinstance(current, (np.ndarray, np.generic)):
            if np.asarray(current).dtype.hasobject:
                raise NotComparableError("a NumPy array of objects")
            note((kind, digest(np.asarray(current))))
        elif isinstance(current, _torch_tensor()):
            note((kind, current.requires_grad, digest(current.detach().cpu().numpy())))
        elif isinstance(current, (enum.Enum, range, type, complex, array, bytearray, Fraction, Decimal)):
            note((kind, str(current)) if isinstance(current, (array, bytearray)) else current)
        elif hasattr(kind, "_traverse_1_cb_ro"):
            # Mitsuba's distributions: Dr.Jit finds their arrays.
            self.arrays.append(current)
            note(kind)
        elif isinstance(fields := getattr(kind, "DRJIT_STRUCT", None), dict) and kind.__module__ in _OTHERS:
            note(kind)
            values = [getattr(current, name) for name in fields]
            if any(dr.is_jit_v(value) for value in values):
                self.arrays.append(current)
            else:
                self._waiting += values
        elif "Transform" in kind.__name__ and kind.__module__ == "mitsuba":
            note((kind, digest(np.array(current.matrix))))
        elif kind.__module__ == "mitsuba" and "Bounding" in kind.__name__:
            note((kind, str(current)))
        else:
            return False
        return True

    def _callable(self, current: Any, kind: type) -> bool:
        if isinstance(current, MethodType):
            self.structure.append(kind)
            self._waiting += [current.__func__, current.__self__]
        elif isinstance(current, FunctionType):
            # Its code, not itself: a structure holds nothing that a closure may hold.
            self.structure.append(current.__code__)
            self._waiting += [current.__defaults__, current.__kwdefaults__]
            for cell in current.__closure__ or ():
                try:
                    self._waiting.append(cell.cell_contents)
                except ValueError:  # not filled yet
                    self.structure.append("empty")
        elif isinstance(current, partial):
            self.structure.append(kind)
            self._waiting += [current.func, current.args, current.keywords]
        else:
            return False
        return True

    def _object(self, current: Any, kind: type) -> None:
        if kind.__module__.split(".")[0] in _OTHERS or not (hasattr(current, "__dict__") or _slots_of(kind)):
            raise NotComparableError(f"a {kind.__module__}.{kind.__qualname__}")
        self._attributes(current, kind)

    def _attributes(self, current: Any, kind: type) -> None:
        slots = [name for name in _slots_of(kind) if hasattr(current, name)]
        held = getattr(current, "__dict__", {})
        self.structure.append((kind, *held, *slots))
        self._waiting += held.values()
        self._waiting += [getattr(current, name) for name in slots]


def _treatment(current: Any, kind: type) -> str:
    """Return the treatment of objects of a class in a walk."""
    if getattr(kind, "only_remembers", False):
        return "remembers"
    if dr.is_array_v(current):
        return "array" if dr.is_jit_v(current) else "other"
    if isinstance(current, mi.Object):
        return "plugin"
    ours = kind.__module__.split(".")[0] == "torchtransient"
    containers = (Mapping, list, tuple, deque, set, frozenset, enum.Enum)
    return "object" if ours and hasattr(current, "__dict__") and not isinstance(current, containers) else "other"


@functools.cache
def _slots_of(kind: type) -> list[str]:
    names: list[str] = []
    for base in kind.__mro__:
        slots = vars(base).get("__slots__", ())
        names += [slots] if isinstance(slots, str) else slots
    return [name for name in names if name not in ("__dict__", "__weakref__")]


def _torch_tensor() -> tuple[type, ...]:
    """Return the class of torch's tensors if torch is imported; plugins do not import it."""
    torch = sys.modules.get("torch")
    return () if torch is None else (torch.Tensor,)


def says_it_can_be_recorded(plugin: Any) -> bool:
    """Return True if a plugin's own class declares that it can be recorded.

    Subclasses do not inherit the declaration, since they may behave otherwise; classes of this library can all be
    recorded.

    Args:
        plugin: plugin written in Python.
    """
    kind = type(plugin)
    known = kind.__module__.startswith("torchtransient.plugins.")
    return bool(vars(kind).get("can_be_recorded", known))


def not_recordable(error: BaseException, before: BaseException | None = None) -> str | BaseException:
    """Return the reason why Dr.Jit could not record a call, or the error itself if it is of another kind.

    Args:
        error: exception that the call raised.
        before: exception that was being handled when the call was made, None without.
    """
    seen: BaseException | None = error
    found = error
    while seen is not None and seen is not before:
        found, seen = seen, seen.__cause__ or seen.__context__
    text = str(found)
    if not isinstance(found, RuntimeError) or not any(words in text for words in _NOT_RECORDABLE):
        return found
    for words, reason in _REASONS.items():
        if words in text:
            return reason
    return text[:120]
