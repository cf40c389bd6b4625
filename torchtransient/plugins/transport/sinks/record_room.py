"""Where the record of a path lies: on the stack of the thread that follows it, or in global memory.

Dr.Jit's local arrays are on the stack of a kernel, one for each lane of a vector. Nothing asks whether they fit: beyond
its end the process dies, or what lies there is overwritten. So the room is known before, and a record that is larger
goes to global memory, of which all paths of a launch take their share at once.
"""

from __future__ import annotations

import ctypes
import functools
import os
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.errors import GradientError

# Of a stack the rest is Python's, Dr.Jit's and what kernels keep beside records.
SHARE = 0.75
# Stacks of threads where the system does not say.
_STACKS = {"darwin": 2**19, "win32": 2**20}
_STACK_UNKNOWN = 2**19
# The widest vectors that there are, where Dr.Jit does not say.
_WIDEST = 16
# Of a lane of CUDA: the driver sets as much aside for every thread that may be resident, 2048 on each of its cores.
CUDA_ROOM = 2**14
# Of all paths of a launch.
MEMORY = 2**31


@dataclass(frozen=True)
class RecordRoom:
    """``in_memory``: whether records lie in global memory. ``lanes``: so many paths a launch at most, None for any
    number. ``room``: bytes that the local arrays of one path may take.
    """

    in_memory: bool
    lanes: int | None
    room: int

    @classmethod
    def of(cls, bytes_of_vertex: int, vertices: int) -> RecordRoom:
        """For records of so many bytes a vertex. Raises GradientError for what no memory holds."""
        room, needed = room_of_path(), bytes_of_vertex * vertices
        if needed <= room:
            return cls(False, None, room)
        if needed > MEMORY:
            raise GradientError(
                f"gradients keep a record of {bytes_of_vertex} bytes a bounce, and one path may take {MEMORY >> 30} "
                f"GiB: expected max_depth up to {MEMORY // bytes_of_vertex - 1} for this scene, got {vertices - 1}. "
                "Set max_depth to where the throughput that remains no longer matters; russian roulette (rr_depth) "
                "ends paths long before."
            )
        return cls(True, MEMORY // needed, room)


def bytes_of(kind: Any) -> int:
    """Bytes of one entry of a Dr.Jit type."""
    return dr.itemsize_v(kind) if dr.depth_v(kind) == 1 else dr.size_v(kind) * bytes_of(dr.value_t(kind))


def room_of_path() -> int:
    """Bytes that the local arrays of a path may take in a kernel of the active variant."""
    if (mi.variant() or "").startswith("cuda"):
        return CUDA_ROOM
    return int(SHARE * _smallest_stack()) // _lanes_of_vector()


def _smallest_stack() -> int:
    """Bytes of the smaller stack of those that kernels run on: that of the calling thread, and those of Dr.Jit's."""
    if not sys.platform.startswith("linux"):
        return _STACKS.get(sys.platform, _STACK_UNKNOWN)
    import resource  # Windows has none

    if threading.get_native_id() == os.getpid():
        own = _stack_of_first_thread(os.getpid(), resource.getrlimit(resource.RLIMIT_STACK)[0])
    else:
        own = _stack_of_this_thread()
    # Dr.Jit's threads are made with the default.
    return min(own, _stack_said(lambda library, attributes: library.pthread_getattr_default_np(attributes)))


@functools.lru_cache(maxsize=1)
def _stack_of_first_thread(process: int, limit: int) -> int:
    """Asked once for each limit: the C library reads the list of all that is mapped into the process, which takes a
    millisecond, and ten where many kernels are.
    """
    return _stack_of_this_thread()


def _stack_of_this_thread() -> int:
    return _stack_said(
        lambda library, attributes: library.pthread_getattr_np(ctypes.c_void_p(library.pthread_self()), attributes)
    )


def _stack_said(ask: Callable[[Any, Any], int]) -> int:
    """Bytes of the stack in the attributes that ``ask`` fills."""
    library = ctypes.CDLL(None)
    library.pthread_self.restype = ctypes.c_void_p
    attributes, size = ctypes.create_string_buffer(256), ctypes.c_size_t()
    try:
        said = ask(library, attributes) == 0
        said = said and library.pthread_attr_getstacksize(attributes, ctypes.byref(size)) == 0
    except AttributeError:  # another C library
        return _STACK_UNKNOWN
    library.pthread_attr_destroy(attributes)
    return size.value if said else _STACK_UNKNOWN


def _lanes_of_vector() -> int:
    """Lanes that one thread computes at once."""
    ask = _vector_width()
    return _WIDEST if ask is None else max(1, int(ask()))


@functools.cache
def _vector_width() -> Any:
    """Dr.Jit's own function, which Python does not offer; None where it is not found."""
    library = next(Path(dr.__file__).parent.glob("*drjit-core*"), None)
    try:
        return None if library is None else ctypes.CDLL(str(library))._Z21jit_llvm_vector_widthv
    except (OSError, AttributeError):
        return None


class GlobalArray:
    """As Dr.Jit's local arrays, in global memory: ``size`` entries of type ``kind`` for each of ``lanes``. A plain
    object, which Dr.Jit loops leave alone. What is written in one kernel is read in the next.
    """

    def __init__(self, kind: Any, size: int, lanes: int):
        self.kind, self.lanes = kind, lanes
        leaf = kind
        while dr.depth_v(leaf) > 1:
            leaf = dr.value_t(leaf)
        self.numbers = dr.empty(leaf, bytes_of(kind) // dr.itemsize_v(leaf) * size * lanes)

    def _places(self, index: Any) -> Any:
        return dr.fma(mi.UInt32(index), self.lanes, dr.arange(mi.UInt32, self.lanes))

    def write(self, value: Any, index: Any, active: Any) -> None:
        """Write an entry of every active lane."""
        dr.scatter(self.numbers, self.kind(value), self._places(index), active, mode=dr.ReduceMode.Permute)

    def read(self, index: Any, active: Any) -> Any:
        """An entry of every active lane, zero for others."""
        return dr.gather(self.kind, self.numbers, self._places(index), active)
