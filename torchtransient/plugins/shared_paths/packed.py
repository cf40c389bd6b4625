"""Histograms of some pixels with four floats a bin: an event is one access to memory instead of three."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.films.colour import mean_of
from torchtransient.plugins.transport.sinks import Sink


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
        return film.measures == "transient" and film.filter.name == "box" and not film.pulses and _fits(film)

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


def _fits(film: Any) -> bool:
    return 2 <= film.channel_count() <= 4


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
