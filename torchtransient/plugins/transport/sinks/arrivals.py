"""The arrivals of a recorded path: listed one after the other while it is walked, then the film's adjoint at each."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


class Arrivals:
    """Where they are in a record. A plain object, which Dr.Jit loops leave alone.

    Every vertex records the number of its first arrival, and which connections have one. ``together``: how many are
    read at once.
    """

    name = "arrivals"

    def __init__(self, world, block):
        self.connections = [connection.name for connection in world.connections]
        self.with_slope = world.wanted.geometry
        self.most = world.max_depth * len(self.connections)
        self.together = block.together(self.most, self.with_slope)
        self.channels = block.film.channel_count()
        self.lanes = dr.width(block.base)

    def fields(self):
        """Types of what a vertex records."""
        return {"first": mi.UInt32} | dict.fromkeys(self.connections, mi.Bool)

    def _size(self):
        # What is read at once may end behind the last one.
        return -(-self.most // self.together) * self.together

    def bytes_of_path(self):
        """Bytes of the list."""
        return self._size() * (8 + 4 * self.channels * (2 if self.with_slope else 1))

    def allocate(self):
        """Thread-local memory of a path."""
        numbers = [f"A.{c}" for c in range(self.channels)]
        numbers += [f"slope.{c}" for c in range(self.channels)] if self.with_slope else []
        size = self._size()
        kept = {name: dr.alloc_local(mi.Float, size) for name in numbers}
        # As wide as the lanes: Dr.Jit takes an index of one entry to be the same in all of them.
        return kept | {"arrivals": dr.zeros(mi.UInt32, self.lanes), "opl": dr.alloc_local(mi.Float64, size)}

    def append(self, kept, samples):
        """List the events of a vertex; returns what it records."""
        found = {"first": kept["arrivals"]}
        for name in self.connections:
            event, n = samples[name].event, kept["arrivals"]
            kept["opl"].write(event.opl, n, event.active)
            kept["arrivals"] = n + dr.select(event.active, mi.UInt32(1), 0)
            found[name] = event.active
        return found

    def number(self, found, name):
        """The number of a connection's event, by what its vertex has recorded."""
        before = self.connections[: self.connections.index(name)]
        return found["first"] + sum(dr.select(found[other], mi.UInt32(1), 0) for other in before)

    def read_some(self, kept, block, first, live):
        """Let ``block`` read those from number ``first`` on, of the paths that have it."""
        opls = [kept["opl"].read(first + e, live & (first + e < kept["arrivals"])) for e in range(self.together)]
        A, slope = block.read_together(opls, self.with_slope, live)
        for name, found in (("A", A), ("slope", slope or [])):
            for e, channels in enumerate(found):
                for c, value in enumerate(channels):
                    kept[f"{name}.{c}"].write(value, first + e, live)

    def adjoint(self, kept, block, number, active):
        """The adjoint at an arrival and its slope (None without geometry), as spectra."""
        A = [kept[f"A.{c}"].read(number, active) for c in range(self.channels)]
        slope = None
        if self.with_slope:
            slope = [kept[f"slope.{c}"].read(number, active) for c in range(self.channels)]
        return block.as_spectra(A, slope)


@dr.syntax
def read_ahead(arrivals, kept, block):
    """The record with the film's adjoint at all arrivals."""
    first = mi.UInt32(0)
    while dr.hint(first < kept["arrivals"], label="arrivals"):
        arrivals.read_some(kept, block, first, first < kept["arrivals"])
        first += arrivals.together
    return kept
