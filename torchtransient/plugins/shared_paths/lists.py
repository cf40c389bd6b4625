"""Lists of the light behind shared points, the walk of pixels over them, and the histograms that it fills."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.films.block import ArrivalWindow
from torchtransient.plugins.films.colour import mean_of
from torchtransient.plugins.transport.sinks import Sink
from torchtransient.plugins.transport.strategy import Event


class Rows:
    """Rows of a length and a colour in memory, each read and written by one access.

    A plain class: Dr.Jit loops leave it alone.
    """

    def __init__(self, count: int) -> None:
        self.colours = len(mi.UnpolarizedSpectrum(0))
        self.kind = {1: mi.Vector2f, 3: mi.Vector4f, 4: mi.Vector4f}[self.colours]
        self.width = len(self.kind(0))
        self.flat = dr.empty(mi.Float, count * self.width)
        # Four colours fill a row.
        self.lengths = dr.empty(mi.Float, count) if self.colours == self.width else None

    def arrays(self) -> list[Any]:
        """Return the arrays that hold the rows."""
        return [self.flat] if self.lengths is None else [self.flat, self.lengths]

    def write(self, row: Any, length: Any, value: Any, active: Any = True) -> None:
        """Write a length (Float) and a colour to a row."""
        if self.lengths is None:
            dr.scatter(self.flat, self.kind(*value, length), row, active)
        else:
            dr.scatter(self.flat, self.kind(*value), row, active)
            dr.scatter(self.lengths, length, row, active)

    def read(self, row: Any, active: Any = True) -> tuple[Any, Any]:
        """Return the length and the colour of a row."""
        found = dr.gather(self.kind, self.flat, row, active)
        colour = mi.UnpolarizedSpectrum(*(found[c] for c in range(self.colours)))
        return found[self.colours] if self.lengths is None else dr.gather(mi.Float, self.lengths, row, active), colour

    def length(self, row: Any) -> Any:
        """Return the length of a row."""
        if self.lengths is not None:
            return dr.gather(mi.Float, self.lengths, row)
        return dr.gather(mi.Float, self.flat, row * self.width + self.colours)


class LastArrival(ArrivalWindow):
    """Window without a beginning: light too early for one pixel may be in time for another one of its group."""

    def __init__(self, last: float):
        super().__init__(-float("inf"), last)

    def counts(self, opl):
        return opl < self.last


class SuffixList(Sink):
    """Sink that lists the events of paths behind shared points.

    Lane ``i`` fills rows from ``i slots`` on, with lengths counted from the shared point. Events that are too late for
    all anchors of a group are summed up: steady images, and the light behind a window, need them.

    Args:
        lanes: number of paths.
        slots: largest number of events of a path.
        start: path length at which the first anchor sees each path's point, minus the film's start (Float64); paths
            begin with it.
        last: length from which on nothing reaches the film's window, None for no end.

    Attributes:
        rows: lengths and values.
        counts: number of rows of each lane.
        rest: rows of the sums, one for each lane, None without an end.
    """

    keeps_vertices = False

    def __init__(self, lanes: int, slots: int, start: Any, last: float | None) -> None:
        self.slots, self.start = slots, start
        self.last = None if last is None else dr.opaque(mi.Float64, last)
        self.lane = dr.arange(mi.UInt32, lanes)
        self.rows, self.counts = Rows(lanes * slots), dr.zeros(mi.UInt32, lanes)
        self.rest = None if last is None else Rows(lanes)

    def begin(self, context):
        return {"used": mi.UInt32(0), "rest": mi.UnpolarizedSpectrum(0)}

    def event(self, state, event):
        listed = event.active & (dr.max(event.value) > 0)
        if self.last is not None:
            late = event.opl >= self.last
            state["rest"] = state["rest"] + dr.select(event.active & late, event.value, 0)
            listed &= ~late
        used = state["used"]
        listed &= used < self.slots
        self.rows.write(dr.fma(self.lane, self.slots, used), mi.Float(event.opl - self.start), event.value, listed)
        state["used"] = used + dr.select(listed, mi.UInt32(1), 0)

    def end(self, state):
        dr.scatter(self.counts, state["used"], self.lane)
        if self.rest is not None:
            self.rest.write(self.lane, mi.Float(0), state["rest"])
        dr.eval(self.rows.arrays(), self.counts, None if self.rest is None else self.rest.arrays())


@dr.syntax
def bring(group, events, suffixes, sink, state):
    """Let every anchor of a group walk over the lists of the group's points, into a sink.

    Args:
        group: :class:`.groups.Group`.
        events: :class:`SuffixList`.
        suffixes: lanes of the list of each point.
        sink: sink whose lengths are counted from the anchors.
        state: state of the sink before; the state after it is returned.
    """
    size, slots = group.size, events.slots
    lane, k = dr.arange(mi.UInt32, group.lanes), mi.UInt32(0)
    first = lane // size * size
    scale = dr.opaque(mi.Float, 1 / suffixes)
    while dr.hint(k < size, label="points"):
        r, F = group.rows.read(lane * size + k)
        weight = F * (dr.gather(mi.Float, group.inverse, first + k) * scale)
        s = (first + k) * suffixes
        s_end = dr.select(dr.max(weight) > 0, s + suffixes, s)
        while dr.hint(s < s_end, label="lists"):
            e = s * slots
            e_end = e + dr.gather(mi.UInt32, events.counts, s)
            while dr.hint(e < e_end, label="events"):
                length, value = events.rows.read(e)
                _put(sink, state, r + length, weight * value)
                e += 1
            if dr.hint(events.rest is not None, mode="scalar"):
                sink.too_late(state, weight * events.rest.read(s)[1])
            s += 1
        k += 1
    return state


def _put(sink, state, opl, value):
    sink.event(state, Event(value=value, opl=opl, active=mi.Bool(True), depth=mi.UInt32(0)))


# ----------------------------------------------------------------------------------------------------------------------
# Histograms of some pixels with four floats a bin: an event is one access to memory instead of three.


class PackedCube:
    """Histograms of some pixels of a film with the box filter and up to four channels.

    Args:
        film: film.
        pixels: number of pixels.
    """

    def __init__(self, film: Any, pixels: int) -> None:
        self.film, self.bins = film, film.temporal_bins
        self.flat = dr.zeros(mi.Float, pixels * self.bins * 4)

    @staticmethod
    def fits(film: Any) -> bool:
        """Return True for histograms with the box filter of two to four channels."""
        box = film.measures == "transient" and film.filter.name == "box" and not film.pulses
        return box and 2 <= film.channel_count() <= 4

    def add_to_film(self, base: Any, active: Any) -> None:
        """Add to the film.

        Args:
            base: index of the first entry of each pixel in the film's first band, UInt32.
            active: mask of pixels.
        """
        channels, flat = self.film.channel_count(), self.film.band_array(0)
        lane = dr.arange(mi.UInt32, dr.width(base) * self.bins)
        pixel = lane // dr.opaque(mi.UInt32, self.bins)
        row = dr.gather(mi.Vector4f, self.flat, lane)
        active = dr.gather(mi.Bool, active, pixel)
        at = dr.gather(mi.UInt32, base, pixel) + (lane - pixel * dr.opaque(mi.UInt32, self.bins)) * channels
        for c in range(channels):
            value = type(flat)(row[c])
            dr.scatter_reduce(dr.ReduceOp.Add, flat, value, at + c, active, dr.ReduceMode.NoConflicts)


class PackedSink(Sink):
    """Sink that adds events to a :class:`PackedCube`; lane ``i`` has pixel ``i`` for itself.

    Its state is that of :class:`~..transport.sinks.FilmSink`.

    Args:
        cube: the cube.
        match: :class:`~..films.colour.ChannelMatch` of the lanes.
        origin: path length that those of events are counted from, minus the film's start (Float64).
    """

    keeps_vertices = False

    def __init__(self, cube: PackedCube, match: Any, origin: Any) -> None:
        self.cube, self.match = cube, match
        x = cube.film.bin_position(origin)
        # Farther away, single precision does not know the bin anyway.
        start = dr.clip(dr.floor(x), -(2.0**30), 2.0**30)
        self.fraction, self.low = mi.Float(x - start), mi.Float(-start)
        self.high = mi.Float(cube.bins - start)
        # Whole numbers wrap around and back again.
        self.first = dr.arange(mi.UInt32, dr.width(origin)) * cube.bins + mi.UInt32(mi.Int32(start))
        self.scale = dr.opaque(mi.Float, 1 / cube.film.bin_width_opl)
        dr.eval(self.fraction, self.low, self.high, self.first)

    def begin(self, context):
        return {"L": mi.UnpolarizedSpectrum(0), "before": mi.Float(0), "after": mi.Float(0)}

    def event(self, state, event):
        k = dr.floor(dr.fma(event.opl, self.scale, self.fraction))
        channels = self.match.to_channels(event.value)
        early, late = k < self.low, k >= self.high
        row = mi.Vector4f(*channels, *[mi.Float(0)] * (4 - len(channels)))
        at = self.first + mi.UInt32(mi.Int32(k))
        dr.scatter_reduce(dr.ReduceOp.Add, self.cube.flat, row, at, ~(early | late), dr.ReduceMode.NoConflicts)
        energy = mean_of(channels)
        state["L"] = state["L"] + event.value
        state["before"] = state["before"] + dr.select(early, energy, 0)
        state["after"] = state["after"] + dr.select(late, energy, 0)

    def too_late(self, state, value):
        state["L"] = state["L"] + value
        state["after"] = state["after"] + mean_of(self.match.to_channels(value))
