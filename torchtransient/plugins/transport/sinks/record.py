"""Vertices into thread-local memory, and back: what the derivative modes cannot recompute cheaply.

The record's size is per lane in flight, not per path, and it lives in the kernel's stack: global memory does not grow
with the depth.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.transport.sinks.sink import Sink
from torchtransient.plugins.transport.strategy import Local


class RecordSink(Sink):
    """Writes what every strategy says of itself. ``layout`` tells :class:`RecordedVertex` how to read it."""

    zeros = True

    def begin(self, world):
        self.layout = RecordLayout(world)
        return self.layout.allocate(world.max_depth + 1)

    def vertex(self, kept, path, samples):
        self.layout.write(kept, path, samples)


class RecordLayout:
    """The fields of a record by (strategy, name). A plain object, which Dr.Jit loops leave alone.

    Masks share the bits of one word: Dr.Jit 1.5 cannot compile a local array of masks (invalid LLVM IR).
    """

    def __init__(self, world):
        self.world = world
        types = {("walk", name): kind for name, kind in self._of_walk(world).items()}
        for s in world.strategies():
            types |= {(s.name, name): kind for name, kind in s.fields(world).items()}
        masks = [key for key, kind in types.items() if kind is mi.Bool]
        self.bits = {key: 1 << bit for bit, key in enumerate(masks)}
        self.types = {key: kind for key, kind in types.items() if key not in self.bits}

    @staticmethod
    def _of_walk(world):
        fields = {"β": mi.Spectrum, "τ": mi.Float64, "rr": mi.Float, "goes_on": mi.Bool}
        return fields | ({"η": mi.Float} if world.index_changes else {})

    def allocate(self, size):
        """Local arrays for ``size`` vertices."""
        arrays = {f"{s}.{name}": dr.alloc_local(kind, size) for (s, name), kind in self.types.items()}
        return arrays | {"flags": dr.alloc_local(mi.UInt32, size)}

    def write(self, store, path, samples):
        """Write the vertex that ``path`` has reached."""
        k, active = path.depth, path.active
        values = {"walk": vars(samples["walk"])}
        values |= {s.name: s.record(samples[s.name]) for s in self.world.strategies()}
        for s, name in self.types:
            store[f"{s}.{name}"].write(values[s][name], k, active)
        flags = mi.UInt32(0)
        for (s, name), bit in self.bits.items():
            flags |= dr.select(values[s][name], mi.UInt32(bit), 0)
        store["flags"].write(flags, k, active)

    def read(self, store, s, name, k, active):
        """One field of vertex ``k``."""
        if (s, name) in self.bits:
            return active & ((store["flags"].read(k, active) & self.bits[s, name]) != 0)
        return store[f"{s}.{name}"].read(k, active)


class RecordedVertex(Local):
    """Vertex ``k`` read back: ``active, β, τ, η, rr, goes_on``, ``ray`` and ``pi`` (how it was found), and ``next``
    (:class:`~..derivative.vertex.VertexEnd`, where the next vertex lies).
    """

    def __init__(self, layout, store, k, active, primary_ray):
        super().__init__(layout=layout, store=store, k=k, active=active, primary_ray=primary_ray, next=None)
        self.η = mi.Float(1)
        vars(self).update(self.of("walk"))
        self.ray, self.pi = layout.world.segment.restore(self, primary_ray)

    def of(self, name):
        """The record of the strategy called ``name``, as a dictionary."""
        layout = self.layout
        keys = [key for key in (*layout.types, *layout.bits) if key[0] == name]
        return {field: layout.read(self.store, s, field, self.k, self.active) for s, field in keys}

    def numbers(self):
        """Two uniform random numbers that were drawn at this vertex."""
        for s, field in self.layout.types:
            if field == "u":
                u = self.layout.read(self.store, s, field, self.k, self.active)
                return [u.x, u.y]
        # Nothing was drawn: the bits of the ray's direction are as good, since they are hashed.
        return [self.ray.d.x, self.ray.d.y]

    def before(self, name, field, at_sensor):
        """A mask of the vertex before, ``at_sensor`` where there is none."""
        k = dr.maximum(self.k, 1) - 1
        there = self.active & (self.k > 0)
        return ((self.k == 0) & mi.Bool(at_sensor)) | self.layout.read(self.store, name, field, k, there)

    def after(self):
        """The next vertex, where the path goes on."""
        return RecordedVertex(self.layout, self.store, self.k + 1, self.goes_on, self.primary_ray)
