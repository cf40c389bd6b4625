"""Records of paths: the numbers of each vertex that derivatives cannot recompute cheaply, written and read.

The record's size is per lane in flight, not per path, and it lives in the kernel's stack: global memory does not grow
with the depth. Only a record that is too large for a stack lies in global memory (:func:`record_room`).
"""

from __future__ import annotations

import ctypes
import functools
import os
import sys
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.errors import GradientError, SceneError
from torchtransient.plugins.transport.sinks import Sink
from torchtransient.plugins.transport.strategy import Local


class RecordSink(Sink):
    """Sink that writes the records of all strategies, which :class:`RecordedVertex` reads by their ``layout``.

    Args:
        block: adjoint block of the film, where arrivals are read before their vertices; None for no list of them.
        lanes: number of paths, for records in global memory; None for local arrays.
    """

    zeros = True

    def __init__(self, block=None, lanes=None):
        self.block, self.lanes = block, lanes

    def begin(self, context):
        self.layout = self._layout(context)
        return self.layout.allocate(context.max_depth + 1, self.lanes)

    def _layout(self, context):
        if self.block is not None and self.lanes is None:
            layout = RecordLayout(context, Arrivals(context, self.block))
            if layout.bytes_of(context.max_depth + 1) <= context.record_room.room:
                return layout
        # Without room for a list of arrivals each is read at its vertex.
        return RecordLayout(context)

    def end(self, state):
        if self.lanes is not None:
            dr.eval([array.numbers for array in state.values()])

    def vertex(self, state, path, samples):
        layout, k, active = self.layout, path.depth, path.active
        values = {"walk": vars(samples["walk"])}
        for strategy in layout.context.strategies():
            values[strategy.name] = strategy.record(samples[strategy.name])
        if layout.arrivals is not None:
            values[layout.arrivals.name] = layout.arrivals.append(state, samples)
        for s, name in layout.types:
            state[f"{s}.{name}"].write(values[s][name], k, active)
        flags = mi.UInt32(0)
        for (s, name), bit in layout.bits.items():
            flags |= dr.select(values[s][name], mi.UInt32(bit), 0)
        state["flags"].write(flags, k, active)


class RecordLayout:
    """Fields of a record by (strategy, name). A plain object, which Dr.Jit loops leave alone.

    Masks share the bits of one word: Dr.Jit 1.5 cannot compile a local array of masks (invalid LLVM IR).

    Args:
        context: :class:`.context.RenderContext` of a job with derivatives.
        arrivals: :class:`Arrivals` of a path, None if each is read at its vertex.
    """

    def __init__(self, context, arrivals=None):
        self.context = context
        self.arrivals = arrivals if arrivals is not None and arrivals.together else None
        types = {("walk", name): kind for name, kind in self._of_walk(context).items()}
        for s in context.strategies():
            types |= {(s.name, name): kind for name, kind in s.fields(context).items()}
        if self.arrivals is not None:
            types |= {(arrivals.name, name): kind for name, kind in arrivals.fields().items()}
        masks = [key for key, kind in types.items() if kind is mi.Bool]
        if len(masks) > 32:
            raise SceneError(f"record of a path: expected at most 32 masks of all strategies, got {len(masks)}.")
        self.bits = {key: 1 << bit for bit, key in enumerate(masks)}
        self.types = {key: kind for key, kind in types.items() if key not in self.bits}

    @staticmethod
    def _of_walk(context):
        fields = {"β": mi.Spectrum, "τ": mi.Float64, "rr": mi.Float, "goes_on": mi.Bool}
        fields |= {} if context.velocities is None else {"rate": mi.Float}
        return fields | ({"η": mi.Float} if context.index_changes else {})

    def bytes_of_vertex(self):
        """Return the bytes of a vertex, without the list of arrivals."""
        return sum(_bytes_of(kind) for kind in [*self.types.values(), mi.UInt32])

    def bytes_of(self, size):
        """Return the bytes of the local arrays of ``size`` vertices."""
        listed = 0 if self.arrivals is None else self.arrivals.bytes_of_path()
        return size * self.bytes_of_vertex() + listed

    def allocate(self, size, lanes=None):
        """Return arrays by field for the vertices of a path.

        Args:
            size: number of vertices.
            lanes: number of paths for arrays in global memory, None for local ones.
        """
        kinds = {f"{s}.{name}": kind for (s, name), kind in self.types.items()} | {"flags": mi.UInt32}
        if lanes is not None:
            return {name: GlobalArray(kind, size, lanes) for name, kind in kinds.items()}
        arrays = {name: dr.alloc_local(kind, size) for name, kind in kinds.items()}
        return arrays if self.arrivals is None else arrays | self.arrivals.allocate()

    def mask(self, flags, s, name):
        """Return a mask of a vertex.

        Args:
            flags: the vertex's word of masks, UInt32.
            s, name: strategy and field.
        """
        return (flags & self.bits[s, name]) != 0


class RecordedVertex(Local):
    """Vertex of a recorded path.

    Args:
        layout: :class:`RecordLayout`.
        store: arrays of the record, by field.
        k: number of the vertex, UInt32.
        active: mask of paths that have it.
        primary_ray: primary ray of the path, Ray3f.

    Attributes:
        β, τ, η: throughput before its segment, optical path length up to it, index along the segment.
        rate: rate of the path up to it, None without velocities.
        rr, goes_on: factor of Russian roulette, mask of paths that continue.
        ray, pi: ray and PreliminaryIntersection3f that found it.
        next: :class:`.strategy.VertexEnd` of the next vertex, set by the derivative.
    """

    def __init__(self, layout, store, k, active, primary_ray):
        super().__init__(layout=layout, store=store, k=k, active=active, primary_ray=primary_ray, next=None)
        # Dr.Jit does not merge equal reads of thread-local memory: each array is read once a vertex.
        self._read = {}
        self.η, self.rate = mi.Float(1), None
        vars(self).update(self.record_of("walk"))
        self.ray, self.pi = layout.context.segment.restore(self, primary_ray)

    def record_of(self, name):
        """Return the record of the strategy called ``name``, as a dictionary."""
        layout = self.layout
        found = {field: self._array(f"{s}.{field}") for s, field in layout.types if s == name}
        masks = [key for key in layout.bits if key[0] == name]
        return found | {field: self.active & layout.mask(self._array("flags"), s, field) for s, field in masks}

    def _array(self, name):
        if name not in self._read:
            self._read[name] = self.store[name].read(self.k, self.active)
        return self._read[name]

    def arrival(self, name):
        """Return the number of a connection's event among the arrivals of the path, None where they are not listed."""
        arrivals = self.layout.arrivals
        return None if arrivals is None else arrivals.number(self.record_of(arrivals.name), name)

    def numbers(self):
        """Return two uniform random numbers that were drawn at this vertex."""
        for c in self.layout.context.connections:
            numbers = c.numbers(self.record_of(c.name))
            if numbers is not None:
                return numbers
        # Without random numbers the bits of the ray's direction serve: they are hashed.
        return [self.ray.d.x, self.ray.d.y]

    def before(self, name, field, at_sensor):
        """Return a recorded mask of the vertex before.

        Args:
            name, field: strategy and field of its record.
            at_sensor: value at the first vertex, before which there is the sensor.
        """
        there = self.active & (self.k > 0)
        flags = self.store["flags"].read(dr.maximum(self.k, 1) - 1, there)
        return ((self.k == 0) & mi.Bool(at_sensor)) | (there & self.layout.mask(flags, name, field))

    def first(self, name, field):
        """Return a number that the strategy ``name`` recorded at the first vertex of the path."""
        return self.store[f"{name}.{field}"].read(mi.UInt32(0), self.active)

    def after(self):
        """Return the next vertex, active where the path continues."""
        return RecordedVertex(self.layout, self.store, self.k + 1, self.goes_on, self.primary_ray)


# --------------------------------------------------------------------------------------------------------------------
# Arrivals of a recorded path: a list that the walk appends to, and the film's adjoint at each of them.

class Arrivals:
    """Layout of the arrivals of a record: a list that the walk appends to, and the film's adjoint at each of them.

    A plain object, which Dr.Jit loops leave alone. Every vertex records the number of its first arrival, and a mask of
    each connection with one.

    Attributes:
        together: number of arrivals that are read at once.
        most: largest number of arrivals of a path.
        with_slope: the adjoint's slope is read as well.
    """

    name = "arrivals"

    def __init__(self, context, block):
        self.connections = [connection.name for connection in context.connections]
        self.with_slope = context.wanted.geometry
        self.most = context.max_depth * len(self.connections)
        self.together = block.together(self.most, self.with_slope)
        self.channels = block.film.channel_count()
        self.lanes = dr.width(block.base)

    def fields(self):
        """Return the types of the fields of a vertex."""
        return {"first": mi.UInt32} | dict.fromkeys(self.connections, mi.Bool)

    def _size(self):
        # The last group that is read at once may be longer than the list.
        return -(-self.most // self.together) * self.together

    def bytes_of_path(self):
        """Return the bytes of the list of a path."""
        return self._size() * (8 + 4 * self.channels * (2 if self.with_slope else 1))

    def allocate(self):
        """Return the local arrays of a path."""
        numbers = [f"A.{c}" for c in range(self.channels)]
        numbers += [f"slope.{c}" for c in range(self.channels)] if self.with_slope else []
        size = self._size()
        state = {name: dr.alloc_local(mi.Float, size) for name in numbers}
        # As wide as the lanes: Dr.Jit takes an index of one entry to be the same in all of them.
        return state | {"arrivals": dr.zeros(mi.UInt32, self.lanes), "opl": dr.alloc_local(mi.Float64, size)}

    def append(self, state, samples):
        """Append the events of a vertex and return the fields of its record.

        Args:
            state: loop state of the sink.
            samples: samples of the strategies at the vertex, by name.
        """
        found = {"first": state["arrivals"]}
        for name in self.connections:
            event, n = samples[name].event, state["arrivals"]
            state["opl"].write(event.opl, n, event.active)
            state["arrivals"] = n + dr.select(event.active, mi.UInt32(1), 0)
            found[name] = event.active
        return found

    def number(self, found, name):
        """Return the number of an event among the arrivals of its path.

        Args:
            found: record of the arrivals at its vertex, by field.
            name: connection of the event.
        """
        before = self.connections[: self.connections.index(name)]
        return found["first"] + sum(dr.select(found[other], mi.UInt32(1), 0) for other in before)

    def read_group(self, store, block, first, live):
        """Read the adjoint at ``together`` arrivals and store it.

        Args:
            store: arrays of the record.
            block: adjoint block of the film.
            first: number of the first arrival, UInt32.
            live: mask of paths that have it.
        """
        opls = [store["opl"].read(first + e, live & (first + e < store["arrivals"])) for e in range(self.together)]
        A, slope = block.read_together(opls, self.with_slope, live)
        for name, found in (("A", A), ("slope", slope or [])):
            for e, channels in enumerate(found):
                for c, value in enumerate(channels):
                    store[f"{name}.{c}"].write(value, first + e, live)

    def adjoint(self, store, block, number, active):
        """Return the adjoint at an arrival, as spectra.

        Args:
            store: arrays of the record, after :func:`read_ahead`.
            block: adjoint block of the film.
            number: number of the arrival, UInt32.
            active: mask of lanes.

        Returns:
            (adjoint, its slope per metre or None without geometry).
        """
        A = [store[f"A.{c}"].read(number, active) for c in range(self.channels)]
        slope = None
        if self.with_slope:
            slope = [store[f"slope.{c}"].read(number, active) for c in range(self.channels)]
        return block.as_spectra(A, slope)


@dr.syntax
def read_ahead(arrivals, store, block):
    """Read the film's adjoint at all arrivals of paths and return the record with it.

    Args:
        arrivals: :class:`Arrivals` of the record's layout.
        store: arrays of the record.
        block: adjoint block of the film.
    """
    first = mi.UInt32(0)
    while dr.hint(first < store["arrivals"], label="arrivals"):
        arrivals.read_group(store, block, first, first < store["arrivals"])
        first += arrivals.together
    return store


# --------------------------------------------------------------------------------------------------------------------
# Memory of the record of a path: the stack of the thread that traces it, or global memory.
#
# Dr.Jit's local arrays are on the stack of a kernel, one for each lane of a vector. Dr.Jit does not check their size:
# beyond the end of the stack the process dies, or other data is overwritten. A record that is larger than the room
# computed here lies in global memory, where all paths of a launch have their records at once.

# Share of a stack for records; Python, Dr.Jit and other variables of kernels use the rest.
SHARE = 0.75
# Bytes of the stack of a thread on systems without a query.
_STACKS = {"darwin": 2**19, "win32": 2**20}
_STACK_UNKNOWN = 2**19
# Lanes of the widest vectors, where Dr.Jit has no query.
_WIDEST = 16
# Bytes of a lane of CUDA: the driver reserves as much for each thread that can be resident, 2048 per multiprocessor.
CUDA_ROOM = 2**14
# Bytes of the records of a launch in global memory.
MEMORY = 2**31


@dataclass(frozen=True)
class RecordRoom:
    """Memory of the records of a job.

    Attributes:
        in_memory: records lie in global memory.
        lanes: largest number of paths of a launch, None for any.
        room: bytes that the local arrays of one path may take.
    """

    in_memory: bool
    lanes: int | None
    room: int


def record_room(context: Any) -> RecordRoom:
    """Return the memory of the records of a job.

    Args:
        context: :class:`.context.RenderContext` of a job with derivatives.

    Raises:
        GradientError: if global memory does not hold the record of one path.
    """
    vertex, vertices, room = RecordLayout(context).bytes_of_vertex(), context.max_depth + 1, room_of_path()
    needed = vertex * vertices
    if needed > max(room, MEMORY):
        raise GradientError(
            f"gradients keep a record of {vertex} bytes a bounce, and one path may take {MEMORY >> 30} "
            f"GiB: expected max_depth up to {MEMORY // vertex - 1} for this scene, got {vertices - 1}. "
            "Set max_depth to where the throughput that remains no longer matters; russian roulette (rr_depth) "
            "ends paths long before."
        )
    return RecordRoom(False, None, room) if needed <= room else RecordRoom(True, MEMORY // needed, room)


def _bytes_of(kind: Any) -> int:
    """Return the bytes of one entry of a Dr.Jit type."""
    return dr.itemsize_v(kind) if dr.depth_v(kind) == 1 else dr.size_v(kind) * _bytes_of(dr.value_t(kind))


def room_of_path() -> int:
    """Return the bytes that the local arrays of a path may take in a kernel of the active variant."""
    if (mi.variant() or "").startswith("cuda"):
        return CUDA_ROOM
    return int(SHARE * _smallest_stack()) // _lanes_of_vector()


def _smallest_stack() -> int:
    """Return the bytes of the smallest stack that kernels run on: calling thread and threads of Dr.Jit."""
    if not sys.platform.startswith("linux"):
        return _STACKS.get(sys.platform, _STACK_UNKNOWN)
    import resource  # Windows has none

    if threading.get_native_id() == os.getpid():
        own = _stack_of_first_thread(os.getpid(), resource.getrlimit(resource.RLIMIT_STACK)[0])
    else:
        own = _stack_size(calling_thread=True)
    # Dr.Jit starts its threads with the default size.
    return min(own, _stack_size(calling_thread=False))


@functools.lru_cache(maxsize=1)
def _stack_of_first_thread(process: int, limit: int) -> int:
    """Return the bytes of its stack, cached: the C library reads the list of the process's mappings, up to 10 ms."""
    return _stack_size(calling_thread=True)


def _stack_size(calling_thread: bool) -> int:
    """Return the bytes of the stack of the calling thread, or of new threads."""
    library = ctypes.CDLL(None)
    library.pthread_self.restype = ctypes.c_void_p
    attributes, size = ctypes.create_string_buffer(256), ctypes.c_size_t()
    try:
        if calling_thread:
            error = library.pthread_getattr_np(ctypes.c_void_p(library.pthread_self()), attributes)
        else:
            error = library.pthread_getattr_default_np(attributes)
        error = error or library.pthread_attr_getstacksize(attributes, ctypes.byref(size))
    except AttributeError:  # another C library
        return _STACK_UNKNOWN
    library.pthread_attr_destroy(attributes)
    return _STACK_UNKNOWN if error else size.value


def _lanes_of_vector() -> int:
    """Return the number of lanes that a thread computes at once."""
    ask = _vector_width()
    return _WIDEST if ask is None else max(1, int(ask()))


@functools.cache
def _vector_width() -> Any:
    """Return the function of Dr.Jit that has no Python binding, None if it is not found."""
    library = next(Path(dr.__file__).parent.glob("*drjit-core*"), None)
    try:
        return None if library is None else ctypes.CDLL(str(library))._Z21jit_llvm_vector_widthv
    except (OSError, AttributeError):
        return None


class GlobalArray:
    """Array of each lane in global memory, in place of a local array of Dr.Jit.

    A plain object, which Dr.Jit loops leave alone. One kernel writes it, the next one reads it.

    Args:
        kind: type of an entry.
        size: number of entries of each lane.
        lanes: number of lanes.
    """

    def __init__(self, kind: Any, size: int, lanes: int):
        self.kind, self.lanes = kind, lanes
        leaf = kind
        while dr.depth_v(leaf) > 1:
            leaf = dr.value_t(leaf)
        self.numbers = dr.empty(leaf, _bytes_of(kind) // dr.itemsize_v(leaf) * size * lanes)

    def _places(self, index: Any) -> Any:
        return dr.fma(mi.UInt32(index), self.lanes, dr.arange(mi.UInt32, self.lanes))

    def write(self, value: Any, index: Any, active: Any) -> None:
        """Write an entry of every active lane."""
        dr.scatter(self.numbers, self.kind(value), self._places(index), active, mode=dr.ReduceMode.Permute)

    def read(self, index: Any, active: Any) -> Any:
        """Return an entry of every active lane, zero for others."""
        return dr.gather(self.kind, self.numbers, self._places(index), active)
