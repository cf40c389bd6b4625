"""The arrivals of a recorded path: listed one after the other while it is walked, then the film's adjoint at each."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


class Arrivals:
    """Where they are in a record. A plain object, which Dr.Jit loops leave alone.

    An arrival is known by its place: the event of connection number ``i`` at vertex ``k`` has ``k n + i`` for ``n``
    connections. ``together``: how many are read at once.
    """

    def __init__(self, world, block):
        self.names = [connection.name for connection in world.connections]
        self.with_slope = world.wanted.geometry
        self.most = world.max_depth * len(self.names)
        self.together = block.together(self.most, self.with_slope)
        self.channels = block.film.channel_count()

    def allocate(self):
        """Thread-local memory for them: part of a record."""
        kept = {"arrivals": mi.UInt32(0)}
        kept |= {"arrival.opl": dr.alloc_local(mi.Float64, self.most), "arrival.place": self._memory(mi.UInt32)}
        numbers = ["A"] + (["slope"] if self.with_slope else [])
        return kept | {f"{name}.{c}": self._memory(mi.Float) for name in numbers for c in range(self.channels)}

    def _memory(self, kind):
        return dr.alloc_local(kind, self.most)

    def place(self, k, name):
        """The place of the event of a connection at vertex ``k``."""
        return k * len(self.names) + self.names.index(name)

    def write(self, kept, k, samples):
        """Append the events of vertex ``k``."""
        for name in self.names:
            event, n = samples[name].event, kept["arrivals"]
            kept["arrival.opl"].write(event.opl, n, event.active)
            kept["arrival.place"].write(self.place(k, name), n, event.active)
            kept["arrivals"] = n + dr.select(event.active, mi.UInt32(1), 0)

    def read_some(self, kept, block, first):
        """Let ``block`` read those from number ``first`` on."""
        numbers = [first + e for e in range(self.together)]
        there = [number < kept["arrivals"] for number in numbers]
        opls = [kept["arrival.opl"].read(n, active) for n, active in zip(numbers, there, strict=True)]
        places = [kept["arrival.place"].read(n, active) for n, active in zip(numbers, there, strict=True)]
        A, slope = block.read_together(opls, self.with_slope, there[0])
        for name, found in (("A", A), ("slope", slope)):
            for channels, place, active in zip(found or [], places, there, strict=bool(found)):
                for c, value in enumerate(channels):
                    kept[f"{name}.{c}"].write(value, place, active)

    def adjoint(self, kept, block, place, active):
        """The adjoint at an arrival and its slope (None without geometry), as spectra."""
        A, slope = (
            [kept[f"{name}.{c}"].read(place, active) for c in range(self.channels)] if f"{name}.0" in kept else None
            for name in ("A", "slope")
        )
        return block.as_spectra(A, slope)


@dr.syntax
def read_ahead(arrivals, kept, block):
    """The record with the film's adjoint at all arrivals."""
    first = mi.UInt32(0)
    while dr.hint(first < kept["arrivals"], label="arrivals"):
        arrivals.read_some(kept, block, first)
        first += arrivals.together
    return kept
