"""Events into a list, with their depths."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.transport.sinks.sink import Sink


class EventListSink(Sink):
    """Every lane lists its events in ``slots`` of its own: ``opl`` (Float64, minus the start), ``energy`` (by
    ``energy_of(value)``, a Float), ``depth`` (0 where a slot is empty). Events without energy are left out; ``used``
    counts what a lane found, which may be more than there were slots for.
    """

    def __init__(self, lanes: int, slots: int, energy_of):
        self.slots, self.energy_of = slots, energy_of
        self.lane = dr.arange(mi.UInt32, lanes)
        self.opl = dr.zeros(mi.Float64, slots * lanes)
        self.energy = dr.zeros(mi.Float, slots * lanes)
        self.depth = dr.zeros(mi.UInt32, slots * lanes)
        self.used = None

    def begin(self, world):
        return {"used": mi.UInt32(0)}

    def event(self, kept, event):
        energy, used = self.energy_of(event.value), kept["used"]
        found = event.active & (energy != 0)
        slot, fits = dr.fma(self.lane, self.slots, used), found & (used < self.slots)
        dr.scatter(self.opl, event.opl, slot, fits)
        dr.scatter(self.energy, energy, slot, fits)
        dr.scatter(self.depth, event.depth, slot, fits)
        kept["used"] = used + dr.select(found, mi.UInt32(1), 0)

    def end(self, kept):
        self.used = kept["used"]
