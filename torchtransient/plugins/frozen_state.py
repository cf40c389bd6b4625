"""The arrays that kernels read and that are neither arguments nor parameters: tables of contents and films.

``dr.freeze`` finds what it is handed and what plugins show to it; tables sit in plain objects, so that loops leave them
alone, and have to be named: ``dr.freeze(f, state_fn=lambda *args: integrator.frozen_state(scene))``.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

# Objects of these look after themselves, or hold no arrays.
_OTHERS = ("builtins", "drjit", "mitsuba", "numpy", "torch")


def arrays_below(value: Any) -> list[Any]:
    """The Dr.Jit arrays in plain objects and in the containers they hold, each once and in order."""
    found: list[Any] = []
    seen: set[int] = set()
    waiting = [value]
    while waiting:
        current = waiting.pop(0)
        if id(current) in seen:
            continue
        seen.add(id(current))
        if dr.is_array_v(current):
            if dr.is_jit_v(current):
                found.append(current)
        elif isinstance(current, dict):
            waiting += current.values()
        elif isinstance(current, (list, tuple)):
            waiting += current
        elif type(current).__module__.split(".")[0] not in _OTHERS and not isinstance(current, mi.Object):
            waiting += getattr(current, "__dict__", {}).values()
    return found
