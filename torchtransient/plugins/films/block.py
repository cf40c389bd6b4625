"""Samples in flight as a film sees them: blocks that write events and read adjoints, and windows of arrivals.

Plain objects, which Dr.Jit loops leave alone: the arrays in them are targets of scatters, not loop state. What a film
carries along a path is in ``events``, which belongs to the loop.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.films.colour import mean_of
from torchtransient.plugins.polarized import light_type


class FilmBlock:
    """The samples of one pass: which band of the film they write to, from which entry on, with which weight; whether
    each of them has a ``base`` of its own (``exclusive``); from which length on theirs are counted (``origin``).

    A loop calls ``begin`` once, ``put`` (or ``put_slope`` in forward mode) for every event and ``end`` after the last
    one; whoever launched the loop calls ``finish`` when all of it is recorded. A histogram writes every event at once.
    """

    def __init__(self, film, band: int, base, match, exclusive: bool = False, origin=None):
        self.film, self.band, self.base, self.match = film, band, base, match
        self.exclusive, self.origin = exclusive, origin

    def begin(self):
        """Return the state that the film carries along a path: loop state, handed back at every event."""
        return {}

    def put(self, events, opl, value, active, crowded=False):
        """Write a contribution; returns what fell before and after the window (mean over channels). ``crowded``: most
        lanes have one, see :class:`~..transport.strategy.Event`.
        """
        channels = self.match.to_channels(value)
        before, after = self.store(opl, channels, active, crowded)
        energy = dr.select(active, mean_of(channels), 0)
        return energy * before, energy * after

    def store(self, opl, channels, active, crowded):
        """Write to the film; returns the fractions before and after the window."""
        # Films that know nothing of it add as always.
        how = {"exclusive": True} if self.exclusive else {}
        if crowded and self.film.knows_crowds:
            how["crowded"] = True
        return self.film.put(self.band, self.base, self.counted(opl), channels, active, **how)

    def counted(self, opl):
        """A path length from the film's start on, ``Float64``."""
        return opl if self.origin is None else self.origin + mi.Float64(opl)

    def put_slope(self, events, opl, d_value, value_d_opl, active):
        """Forward mode: write ``k df + f k' dtau``."""
        d, slope = self.match.to_channels(d_value), self.match.to_channels(value_d_opl)
        self.film.put_slope(self.band, self.base, self.counted(opl), d, slope, active)

    def end(self, events):
        """The paths are over."""

    def finish(self):
        """Bring what was written to the film. Called outside of the loop, may launch a kernel."""


class AdjointBlock:
    """Reads ``A(tau)`` and ``A'(tau)`` of the incoming adjoint for the samples in flight."""

    def __init__(self, film, response, base, steady, match):
        self.film, self.response, self.base, self.steady, self.match = film, response, base, steady, match

    def read(self, opl, active):
        """Adjoint and its slope in opl, as spectra that weigh a contribution of one primary ray."""
        if not self.film.keeps_steady:
            A, slope = self.film.read(self.response, self.base, opl, active, self.steady)
            return self.match.to_spectrum(A), self.match.to_spectrum(slope)
        if self.response is None:
            return self.match.to_spectrum(self.steady), light_type()(0)
        return self.as_spectra(*self.film.read(self.response, self.base, opl, active))

    def as_spectra(self, A, slope):
        """The two by channel, the adjoint of the steady image added, as spectra; ``slope`` may be None."""
        A = [a + s for a, s in zip(A, self.steady, strict=True)]
        return self.match.to_spectrum(A), None if slope is None else self.match.to_spectrum(slope)

    def together(self, most, with_slope):
        """Return the number of arrivals, out of ``most`` of a path, that are read at once and ahead.

        0 where each is read by itself; more in films where reading costs more than keeping.
        """
        return 0

    def read_together(self, opls, with_slope, active):
        """(A, its slope or None) by channel, for each of several arrivals."""
        raise NotImplementedError


class ArrivalWindow:
    """Arrivals between ``first`` and ``last`` (metres after the film's ``start_opl``) count, others do not.

    No later event of a path can count once the path itself is longer than ``last``. A plain object, which Dr.Jit loops
    leave alone.
    """

    def __init__(self, first: float, last: float):
        self.first, self.last = float(first), float(last)

    def counts(self, opl):
        """Return a mask of arrivals at ``opl`` (``Float64``) that can count."""
        return (opl >= self.first) & (opl < self.last)

    def over(self, opl):
        """Return a mask of lengths ``opl`` after which nothing can count."""
        return opl >= self.last


class GappedWindow(ArrivalWindow):
    """A window in which equal cells of time count or not, for gates with gaps in between."""

    def __init__(self, first: float, last: float, cells):
        super().__init__(first, last)
        self._cells = mi.UInt32(cells)
        self._scale = len(cells) / (self.last - self.first)

    def counts(self, opl):
        inside = super().counts(opl)
        cell = mi.UInt32(dr.select(inside, (opl - self.first) * self._scale, 0))
        cell = dr.minimum(cell, dr.width(self._cells) - 1)
        return dr.gather(mi.UInt32, self._cells, cell, inside) == 1


class BinLayout:
    """Place of one event in a film: arrays, index of the histogram's first value, strides, bins and channels."""

    def __init__(self, flat, base, bin_stride, channel_stride, bins, channels, exclusive=False):
        self.flat, self.base = flat, base
        self.bin_stride, self.channel_stride = bin_stride, channel_stride
        self.bins, self.channels = bins, channels
        self.mode = reduce_mode(exclusive)


def reduce_mode(exclusive, direct=False):
    """Return the mode of lanes that share their target with others (``Auto``: atomically, equal addresses together),
    or that have one of their own. ``direct``: each lane by itself.
    """
    if exclusive:
        return dr.ReduceMode.NoConflicts
    return dr.ReduceMode.Direct if direct else dr.ReduceMode.Auto
