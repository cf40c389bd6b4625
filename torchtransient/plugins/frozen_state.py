"""What a recorded call depends on beside its arguments: arrays to be handed in, and all else, that tells it apart.

``dr.freeze`` finds what it is handed and what plugins show to it; tables sit in plain objects, so that loops leave them
alone, and have to be named: ``dr.freeze(f, state_fn=lambda *args: integrator.frozen_state(scene))``. Numbers that are
no arrays become part of the kernels: a recording is good for one structure alone, see
:func:`state_below`.
"""

from __future__ import annotations

import enum
from types import FunctionType, MethodType
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.plugins.remembered import digest

# Objects of these look after themselves, or hold no arrays.
_OTHERS = ("builtins", "drjit", "mitsuba", "numpy", "torch")
_PLAIN = (type(None), bool, int, float, complex, str, bytes)
# What Dr.Jit says of functions that it cannot record.
_NOT_RECORDABLE = (
    "recording a frozen function",
    "record(): ",
    "replay(): ",
    "validate(): ",
    "within frozen functions",
    "cannot be recorded",
)


def arrays_below(value: Any) -> list[Any]:
    """The Dr.Jit arrays in plain objects and in the containers they hold, each once and in order, and Mitsuba's
    structures of arrays.
    """
    return state_below(value)[1]


def state_below(value: Any) -> tuple[tuple[Any, ...], list[Any]]:
    """(structure, arrays). The structure is all that is no array in plain objects and in the containers they hold, with
    the places and types of arrays: of two jobs with the same structure the same kernels are traced. Hashable; Mitsuba's
    objects count by their address. Arrays: as :func:`arrays_below`.
    """
    walk = _Walk(value)
    return tuple(walk.structure), walk.arrays


class _Walk:
    """Once through plain objects. ``arrays``: Dr.Jit's; ``structure``: everything else. Not recursive: a function that
    calls itself would leave circles of references, and so objects that live on, behind.
    """

    def __init__(self, value: Any) -> None:
        self.arrays: list[Any] = []
        self.structure: list[Any] = []
        numbers: dict[int, int] = {}
        waiting = [value]
        note = self.structure.append
        while waiting:
            current = waiting.pop()
            if isinstance(current, _PLAIN):
                note((type(current), current))
                continue
            number = numbers.setdefault(id(current), len(numbers))
            if number != len(numbers) - 1:
                note(number)
                continue
            kind = type(current)
            if dr.is_array_v(current):
                if dr.is_jit_v(current):
                    self.arrays.append(current)
                    note(kind)
                else:
                    note((kind, str(current)))
            elif kind in (list, tuple):
                note((kind, len(current)))
                waiting += current
            elif kind is dict:
                note((kind, *current))
                waiting += current.values()
            elif isinstance(current, mi.Object):
                note((kind, current.ptr))
            else:
                self._object(current, kind, waiting)

    def _object(self, current: Any, kind: type, waiting: list[Any]) -> None:
        note = self.structure.append
        if getattr(kind, "only_remembers", False):
            note(kind)  # what follows from the rest
        elif isinstance(current, np.ndarray):
            note((kind, digest(current)))
        elif isinstance(current, (enum.Enum, range, type, frozenset)):
            note(current)
        elif isinstance(current, MethodType):
            note((kind, current.__func__))
            waiting.append(current.__self__)
        elif isinstance(current, FunctionType):
            note(current)
            waiting += [cell.cell_contents for cell in current.__closure__ or ()]
        elif hasattr(kind, "_traverse_1_cb_ro"):
            # Mitsuba's distributions: Dr.Jit finds their arrays.
            self.arrays.append(current)
            note(kind)
        elif isinstance(fields := getattr(kind, "DRJIT_STRUCT", None), dict) and kind.__module__ in _OTHERS:
            jit = any(dr.is_jit_v(getattr(current, name)) for name in fields)
            if jit:
                self.arrays.append(current)
            note(kind if jit else (kind, str(current)))
        elif kind.__module__.split(".")[0] not in _OTHERS:
            held = getattr(current, "__dict__", {})
            note((kind, *held))
            waiting += held.values()
        elif isinstance(current, (dict, list, tuple)):
            note((kind, *current) if isinstance(current, dict) else (kind, len(current)))
            waiting += current.values() if isinstance(current, dict) else current
        else:
            note((kind, str(current)))


def not_recordable(error: BaseException) -> str | None:
    """What Dr.Jit says of a function that it cannot record; None for other errors."""
    found, seen = None, error
    while seen is not None:
        text = str(seen)
        if isinstance(seen, RuntimeError) and any(words in text for words in _NOT_RECORDABLE):
            # What it came of says more.
            found = text if found is None or "(see above)" in found else found
        seen = seen.__cause__ or seen.__context__  # type: ignore[assignment]
    return found
