"""Sinks: consumers of the events and vertices of a walk."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.films.colour import mean_of
from torchtransient.plugins.polarized import light_type
from torchtransient.plugins.transport.carry import total_of
from torchtransient.plugins.transport.strategy import rate_of


class Sink:
    """Base of sinks, which ignores everything.

    The loop calls ``begin`` once, ``event`` for every event, ``vertex`` once a vertex, after its last event, and
    ``end`` after the loop. ``state`` is the sink's loop state: a dictionary of Dr.Jit values that it may change.
    """

    # Static: events of value zero matter, since their derivatives can differ from zero.
    zeros = False
    # Static: vertices matter.
    keeps_vertices = True

    def begin(self, context: Any) -> dict[str, Any]:
        """Return the loop state before the first vertex."""
        return {}

    def event(self, state: dict[str, Any], event: Any) -> None:
        """Receive an :class:`.strategy.Event` of the current vertex."""

    def vertex(self, state: dict[str, Any], path: Any, samples: dict[str, Any]) -> None:
        """Receive the vertex that ``path`` reached.

        Args:
            state: loop state of the sink.
            path: :class:`.walk.Path` before the vertex.
            samples: samples of the strategies there, by name, as :meth:`.strategy.Strategy.record` takes them;
                ``walk``: those of the loop.
        """

    def too_late(self, state: dict[str, Any], value: Any) -> None:
        """Receive light that arrives behind the window of the film, whenever that is."""

    def end(self, state: dict[str, Any]) -> None:
        """Finish the loop state."""


# --------------------------------------------------------------------------------------------------------------------
# Film.

class FilmSink(Sink):
    """Sink that writes events to a film, through its block.

    Its state has the sum ``L`` over all times, and the energy ``before`` and ``after`` the film's window.

    Args:
        block: :class:`~..films.block.FilmBlock` of the launch.
    """

    keeps_vertices = False

    def __init__(self, block):
        self.block = block

    def begin(self, context):
        return {"L": light_type()(0), "before": mi.Float(0), "after": mi.Float(0), "block": self.block.begin()}

    def event(self, state, event):
        state["L"] = state["L"] + event.value
        before, after = self.block.put(
            state["block"], event.opl, event.value, event.active, event.crowded, **rate_of(event)
        )
        state["before"] = state["before"] + before
        state["after"] = state["after"] + after

    def too_late(self, state, value):
        state["L"] = state["L"] + value
        state["after"] = state["after"] + mean_of(self.block.match.to_channels(value))

    def end(self, state):
        self.block.end(state["block"])


# --------------------------------------------------------------------------------------------------------------------
# Sum of events, weighted by the film's adjoint.

class AdjointSumSink(Sink):
    """Sink that sums ``A(opl) value`` over the events of a path, with the adjoint ``A`` of the film.

    A boundary term traces paths from both sides of an edge: the sum is the contribution of their light to a loss. Its
    state is ``sum``.

    Args:
        block: :class:`~..films.block.AdjointBlock` of the launch.
    """

    def __init__(self, block):
        self.block = block

    def begin(self, context):
        return {"sum": mi.Float(0)}

    def event(self, state, event):
        A, *_ = self.block.read(event.opl, event.active, **rate_of(event))
        state["sum"] = state["sum"] + dr.select(event.active, total_of(A, event.value), 0)


# --------------------------------------------------------------------------------------------------------------------
# List of events with their depths.

class EventListSink(Sink):
    """Sink that lists events, in slots of each lane.

    Args:
        lanes: number of paths.
        slots: number of events that fit for each path.
        energy_of: function of an event's value that returns its energy, Float; events without energy are left out.

    Attributes:
        opl: optical path length, minus the film's start, Float64.
        energy: energy, Float.
        depth: depth of the event, 0 in empty slots.
        rate: rate of the path, m/s, Float; zero where the context has no velocities.
        used: number of events of each lane, which may exceed ``slots``.
    """

    def __init__(self, lanes: int, slots: int, energy_of):
        self.slots, self.energy_of = slots, energy_of
        self.lane = dr.arange(mi.UInt32, lanes)
        self.opl = dr.zeros(mi.Float64, slots * lanes)
        self.energy = dr.zeros(mi.Float, slots * lanes)
        self.depth = dr.zeros(mi.UInt32, slots * lanes)
        self.rate = dr.zeros(mi.Float, slots * lanes)
        self.used = None

    def begin(self, context):
        return {"used": mi.UInt32(0)}

    def event(self, state, event):
        energy, used = self.energy_of(event.value), state["used"]
        found = event.active & (energy != 0)
        slot, fits = dr.fma(self.lane, self.slots, used), found & (used < self.slots)
        dr.scatter(self.opl, event.opl, slot, fits)
        dr.scatter(self.energy, energy, slot, fits)
        dr.scatter(self.depth, event.depth, slot, fits)
        if event.rate is not None:
            dr.scatter(self.rate, event.rate, slot, fits)
        state["used"] = used + dr.select(found, mi.UInt32(1), 0)

    def end(self, state):
        self.used = state["used"]
