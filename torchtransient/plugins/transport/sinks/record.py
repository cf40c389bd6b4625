"""Vertices into thread-local memory, and back: what the derivative modes cannot recompute cheaply.

The record's size is per lane in flight, not per path, and it lives in the kernel's stack: global memory does not grow
with the depth. Only a record that is too large for a stack goes to global memory (:mod:`.record_room`).
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from torchtransient.errors import SceneError
from torchtransient.plugins.transport.sinks.arrivals import Arrivals
from torchtransient.plugins.transport.sinks.record_room import GlobalArray, RecordRoom, bytes_of
from torchtransient.plugins.transport.sinks.sink import Sink
from torchtransient.plugins.transport.strategy import Local


class RecordSink(Sink):
    """Writes what every strategy says of itself. ``layout`` tells :class:`RecordedVertex` how to read it.

    ``block``: the film's adjoint block, where arrivals are to be read ahead; None for no list of them. ``lanes``:
    number of paths, where records lie in global memory.
    """

    zeros = True

    def __init__(self, block=None, lanes=None):
        self.block, self.lanes = block, lanes

    def begin(self, world):
        self.layout = self._layout(world)
        return self.layout.allocate(world.max_depth + 1, self.lanes)

    def _layout(self, world):
        if self.block is not None and self.lanes is None:
            layout = RecordLayout(world, Arrivals(world, self.block))
            if layout.bytes_of(world.max_depth + 1) <= world.record_room.room:
                return layout
        # Arrivals are read one after the other where a list of them has no room.
        return RecordLayout(world)

    def end(self, kept):
        if self.lanes is not None:
            dr.eval([array.numbers for array in kept.values()])

    def vertex(self, kept, path, samples):
        self.layout.write(kept, path, samples)


class RecordLayout:
    """The fields of a record by (strategy, name). A plain object, which Dr.Jit loops leave alone.

    Masks share the bits of one word: Dr.Jit 1.5 cannot compile a local array of masks (invalid LLVM IR).
    """

    def __init__(self, world, arrivals=None):
        self.world = world
        self.arrivals = arrivals if arrivals is not None and arrivals.together else None
        types = {("walk", name): kind for name, kind in self._of_walk(world).items()}
        for s in world.strategies():
            types |= {(s.name, name): kind for name, kind in s.fields(world).items()}
        if self.arrivals is not None:
            types |= {(arrivals.name, name): kind for name, kind in arrivals.fields().items()}
        masks = [key for key, kind in types.items() if kind is mi.Bool]
        if len(masks) > 32:
            raise SceneError(f"record of a path: expected at most 32 masks of all strategies, got {len(masks)}.")
        self.bits = {key: 1 << bit for bit, key in enumerate(masks)}
        self.types = {key: kind for key, kind in types.items() if key not in self.bits}

    @staticmethod
    def _of_walk(world):
        fields = {"β": mi.Spectrum, "τ": mi.Float64, "rr": mi.Float, "goes_on": mi.Bool}
        return fields | ({"η": mi.Float} if world.index_changes else {})

    def bytes_of_vertex(self):
        """Bytes that a vertex takes, without the list of arrivals."""
        return sum(bytes_of(kind) for kind in [*self.types.values(), mi.UInt32])

    def bytes_of(self, size):
        """Bytes of the local arrays for ``size`` vertices."""
        listed = 0 if self.arrivals is None else self.arrivals.bytes_of_path()
        return size * self.bytes_of_vertex() + listed

    def allocate(self, size, lanes=None):
        """Local arrays for ``size`` vertices; in global memory where ``lanes`` is given."""
        kinds = {f"{s}.{name}": kind for (s, name), kind in self.types.items()} | {"flags": mi.UInt32}
        if lanes is not None:
            return {name: GlobalArray(kind, size, lanes) for name, kind in kinds.items()}
        arrays = {name: dr.alloc_local(kind, size) for name, kind in kinds.items()}
        return arrays if self.arrivals is None else arrays | self.arrivals.allocate()

    def write(self, store, path, samples):
        """Write the vertex that ``path`` has reached."""
        k, active = path.depth, path.active
        values = {"walk": vars(samples["walk"])}
        values |= {s.name: s.record(samples[s.name]) for s in self.world.strategies()}
        if self.arrivals is not None:
            values[self.arrivals.name] = self.arrivals.append(store, samples)
        for s, name in self.types:
            store[f"{s}.{name}"].write(values[s][name], k, active)
        flags = mi.UInt32(0)
        for (s, name), bit in self.bits.items():
            flags |= dr.select(values[s][name], mi.UInt32(bit), 0)
        store["flags"].write(flags, k, active)

    def mask(self, flags, s, name):
        """One mask out of the word ``flags`` of a vertex."""
        return (flags & self.bits[s, name]) != 0


class RecordedVertex(Local):
    """Vertex ``k`` read back: ``active, β, τ, η, rr, goes_on``, ``ray`` and ``pi`` (how it was found), and ``next``
    (:class:`~..derivative.vertex.VertexEnd`, where the next vertex lies).
    """

    def __init__(self, layout, store, k, active, primary_ray):
        super().__init__(layout=layout, store=store, k=k, active=active, primary_ray=primary_ray, next=None)
        # Dr.Jit does not merge equal reads of thread-local memory: each array is read once a vertex.
        self._read = {}
        self.η = mi.Float(1)
        vars(self).update(self.of("walk"))
        self.ray, self.pi = layout.world.segment.restore(self, primary_ray)

    def of(self, name):
        """The record of the strategy called ``name``, as a dictionary."""
        layout = self.layout
        found = {field: self._array(f"{s}.{field}") for s, field in layout.types if s == name}
        masks = [key for key in layout.bits if key[0] == name]
        return found | {field: self.active & layout.mask(self._array("flags"), s, field) for s, field in masks}

    def _array(self, name):
        if name not in self._read:
            self._read[name] = self.store[name].read(self.k, self.active)
        return self._read[name]

    def arrival(self, name):
        """The number of a connection's event among the arrivals of the path, None where they are not listed."""
        arrivals = self.layout.arrivals
        return None if arrivals is None else arrivals.number(self.of(arrivals.name), name)

    def numbers(self):
        """Two uniform random numbers that were drawn at this vertex."""
        for c in self.layout.world.connections:
            numbers = c.numbers(self.of(c.name))
            if numbers is not None:
                return numbers
        # Nothing was drawn: the bits of the ray's direction are as good, since they are hashed.
        return [self.ray.d.x, self.ray.d.y]

    def before(self, name, field, at_sensor):
        """A mask of the vertex before, ``at_sensor`` where there is none."""
        there = self.active & (self.k > 0)
        flags = self.store["flags"].read(dr.maximum(self.k, 1) - 1, there)
        return ((self.k == 0) & mi.Bool(at_sensor)) | (there & self.layout.mask(flags, name, field))

    def first(self, name, field):
        """A number that the strategy ``name`` recorded at the first vertex of the path."""
        return self.store[f"{name}.{field}"].read(mi.UInt32(0), self.active)

    def after(self):
        """The next vertex, where the path goes on."""
        return RecordedVertex(self.layout, self.store, self.k + 1, self.goes_on, self.primary_ray)


def record_room(world):
    """The :class:`RecordRoom` of a job's records. Raises GradientError where there is none."""
    return RecordRoom.of(RecordLayout(world).bytes_of_vertex(), world.max_depth + 1)
