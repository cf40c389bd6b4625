"""Arrays for kernels: numbers of numpy in Dr.Jit's memory, and values by plugin."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import DTypeLike

from torchtransient.errors import SceneError

# ------------------------------------------------------------------------------- numbers of Dr.Jit in memory of numpy's

# Bytes: the widest packet of Dr.Jit's LLVM.
_ALIGNMENT = 64


def host_numbers(value: Any, dtype: DTypeLike = np.float64) -> np.ndarray:
    """Return a copy of an array's numbers in the memory of the host.

    They are read through a detached handle: Dr.Jit evaluates an array in place to read it, and a literal that a scene
    shows to recordings would be another array afterwards.

    Args:
        value: Dr.Jit array, attached or not.
        dtype: dtype of the copy, None for that of ``value``.

    Returns:
        Numpy array of the shape of ``value``; of vectors with their components first, (3, N).
    """
    return np.array(dr.detach(value), dtype=dtype)


def whole_numbers(values: np.ndarray) -> Any:
    """Return a copy of whole numbers as a ``mi.UInt32``.

    Args:
        values: whole numbers, (N,), 0 to 2^32 - 1.
    """
    return mi.UInt32(_aligned(values, np.uint32))


def floats(values: np.ndarray) -> Any:
    """Return a copy of numbers as a ``mi.Float``.

    Args:
        values: real numbers, (N,).
    """
    return mi.Float(_aligned(values, np.float32))


def _aligned(values: np.ndarray, dtype: DTypeLike) -> np.ndarray:
    """A copy (N,) where Dr.Jit's own arrays would lie: it shares memory with numpy, and kernels differ by how their
    arrays are aligned, so that others would be compiled in every process.
    """
    values = np.asarray(values, dtype).ravel()
    room = np.empty(values.nbytes + _ALIGNMENT, np.uint8)
    first = -room.ctypes.data % _ALIGNMENT
    copy = room[first : first + values.nbytes].view(dtype)
    copy[:] = values
    return copy


# ----------------------------------------------------------------------------------------------------------------------
# Values by plugin: what a kernel looks up for the BSDF, shape, emitter or medium that a lane points to.
# A pointer of Dr.Jit is the number that its registry gave the plugin, so a table is an array that is gathered from.

# The pointer type of each kind of plugin, as names: types change with the variant.
_POINTERS = {
    "BSDF": "BSDFPtr",
    "Emitter": "EmitterPtr",
    "Medium": "MediumPtr",
    "PhaseFunction": "PhaseFunctionPtr",
    "Sensor": "SensorPtr",
    "Shape": "ShapePtr",
}
# Kinds that kernels look up as well, and that have no table.
_MORE_POINTERS = ("MeshPtr", "TexturePtr")


# Entries of tables come in steps: the length is part of kernels, and which plugin has which number depends on the order
# in which Mitsuba's threads load them.
_STEP = 64


def registry_number(plugin: Any) -> int:
    """Return the number of a plugin in Dr.Jit's registry, which a pointer to it holds.

    Numbers start at one, each kind of plugin has its own.

    Args:
        plugin: BSDF, emitter, shape, medium or other plugin of which Mitsuba has arrays of pointers.

    Raises:
        SceneError: for plugins that kernels cannot point to.
    """
    for kind, pointer in _POINTERS.items():
        if isinstance(plugin, getattr(mi, kind)):
            return int(dr.reinterpret_array(mi.UInt32, getattr(mi, pointer)(plugin))[0])
    raise SceneError(f"registry_number: expected one of {', '.join(_POINTERS)}, got {type(plugin).__name__}.")


def null_pointers() -> list[Any]:
    """Return a pointer to nothing of each kind."""
    return [dr.zeros(getattr(mi, name)) for name in (*_POINTERS.values(), *_MORE_POINTERS)]


class PointerTable:
    """One value per listed plugin, and a default for all others and for null pointers.

    Build tables outside of loops. A plain class on purpose: Dr.Jit loops would take a dataclass apart as loop state.

    Args:
        plugins: plugins of one kind; one that is listed twice takes its last value.
        values: one per plugin, whole numbers or Dr.Jit arrays of width one; derivatives go through where those are
            attached.
        default: a Python number.
    """

    def __init__(self, plugins: Sequence[Any], values: Sequence[Any], default: float = 0) -> None:
        numbers = [registry_number(plugin) for plugin in plugins]
        size = -(-(1 + max(numbers, default=0)) // _STEP) * _STEP
        self.default = default
        if values and dr.is_array_v(values[0]):
            self.values = dr.full(type(values[0]), default, size)
            for number, value in zip(numbers, values, strict=True):
                dr.scatter(self.values, value, mi.UInt32(number))
        else:
            # Laid out here, it needs no kernel of its own.
            entries = np.full(size, default, dtype=np.uint32)
            entries[numbers] = values
            self.values = whole_numbers(entries)
            dr.make_opaque(self.values)

    @staticmethod
    def marking(plugins: Sequence[Any]) -> PointerTable | None:
        """Return a table that tells listed plugins apart (:meth:`lists`), None for no plugins: kernels need none then.
        """
        return PointerTable(plugins, [1] * len(plugins)) if plugins else None

    def look_up(self, pointer: Any, active: Any = True) -> Any:
        """Return the values of an array of pointers; ``default`` where ``active`` is false."""
        number = dr.reinterpret_array(mi.UInt32, pointer)
        known = mi.Mask(active) & (number < dr.width(self.values))
        found = dr.gather(type(self.values), self.values, number, known)
        # A masked gather answers zero by itself.
        return found if self.default == 0 else dr.select(known, found, self.default)

    def lists(self, pointer: Any, active: Any = True) -> Any:
        """Return a mask of the pointers listed in a table of :meth:`marking`."""
        return self.look_up(pointer, active) == 1
