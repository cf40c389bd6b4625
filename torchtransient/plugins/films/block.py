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
    """Block of the samples of one launch, which writes their events to the film.

    A loop calls ``begin`` once, ``put`` (or ``put_slope`` in forward mode) for every event and ``end`` after the last
    one; the integrator calls ``finish`` behind the loop. A histogram writes every event at once.

    Args:
        film: film that is written to.
        band: number of its storage band.
        base: index of each sample's first entry in the band, UInt32.
        match: :class:`.colour.ChannelMatch` of the samples.
        exclusive: every sample has a base of its own.
        origin: path length (Float64, by sample) that those of the events are counted from, None for zero.
    """

    def __init__(self, film, band: int, base, match, exclusive: bool = False, origin=None):
        self.film, self.band, self.base, self.match = film, band, base, match
        self.exclusive, self.origin = exclusive, origin

    def begin(self):
        """Return the loop state of the film: a PyTree that ``put``, ``put_slope`` and ``end`` receive."""
        return {}

    def put(self, events, opl, value, active, crowded=False, rate=None):
        """Write an event.

        Args:
            events: loop state of the film.
            opl: optical path length, minus the film's start, metres (Float64).
            value: contribution, throughput included, a spectrum.
            active: mask of lanes that have the event.
            crowded: most lanes have it, see :class:`~..transport.strategy.Event`.
            rate: derivative of ``opl`` by time, m/s; for films with ``knows_rates``.

        Returns:
            Energy (mean over channels) before and after the film's window.
        """
        channels = self.match.to_channels(value)
        options = {"exclusive": True} if self.exclusive else {}
        if crowded and self.film.knows_crowds:
            options["crowded"] = True
        if rate is not None:
            options["rate"] = rate
        before, after = self.film.put(self.band, self.base, self.counted(opl), channels, active, **options)
        energy = dr.select(active, mean_of(channels), 0)
        return energy * before, energy * after

    def counted(self, opl):
        """Return a path length counted from the film's start, Float64."""
        return opl if self.origin is None else self.origin + mi.Float64(opl)

    def put_slope(self, events, opl, d_value, value_d_opl, active, rate=None, value_d_rate=None):
        """Write the derivative ``k df + f k' dtau`` of an event, with the film's response ``k``.

        Args:
            events: loop state of the film.
            opl: optical path length, minus the film's start, metres (Float64).
            d_value: derivative ``df`` of the contribution, a spectrum.
            value_d_opl: contribution times derivative of the path length, ``f dtau``.
            active: mask of lanes that have the event.
            rate, value_d_rate: rate, and contribution times its derivative; for films with ``knows_rates``.
        """
        d, slope = self.match.to_channels(d_value), self.match.to_channels(value_d_opl)
        options = {}
        if rate is not None:
            options = {"rate": rate, "value_d_rate": self.match.to_channels(value_d_rate)}
        self.film.put_slope(self.band, self.base, self.counted(opl), d, slope, active, **options)

    def end(self, events):
        """Finish the loop state, after the last event of all paths."""

    def finish(self):
        """Write pending events to the film, outside of the loop; may launch a kernel."""


class AdjointBlock:
    """Block of the samples of one launch, which reads the adjoint ``A(tau)`` of the film and its slope ``A'(tau)``.

    Args:
        film: film of the job.
        response: adjoint of the array as (flat array, stride of entries, stride of channels), or None.
        base: index of each sample's first entry in it, UInt32.
        steady: adjoint of the steady image by channel.
        match: :class:`.colour.ChannelMatch` of the samples.
    """

    def __init__(self, film, response, base, steady, match):
        self.film, self.response, self.base, self.steady, self.match = film, response, base, steady, match

    def read(self, opl, active, rate=None):
        """Read the adjoint at an arrival.

        Args:
            opl: optical path length, minus the film's start, metres (Float64).
            active: mask of lanes.
            rate: rate of the arrival, m/s; for films with ``knows_rates``.

        Returns:
            (adjoint, slope per metre), and with a rate the slope by it: spectra that weigh a contribution of a
            primary ray.
        """
        if rate is not None:
            return self._read_rate(opl, active, rate)
        if not self.film.keeps_steady:
            A, slope = self.film.read(self.response, self.base, opl, active, self.steady)
            return self.match.to_spectrum(A), self.match.to_spectrum(slope)
        if self.response is None:
            return self.match.to_spectrum(self.steady), light_type()(0)
        return self.as_spectra(*self.film.read(self.response, self.base, opl, active))

    def _read_rate(self, opl, active, rate):
        if self.response is None:
            return self.match.to_spectrum(self.steady), light_type()(0), light_type()(0)
        A, slope, by_rate = self.film.read(self.response, self.base, opl, active, rate=rate)
        return *self.as_spectra(A, slope), self.match.to_spectrum(by_rate)

    def as_spectra(self, A, slope):
        """Return the adjoint of transient and steady image as spectra.

        Args:
            A: adjoint of the transient, by channel.
            slope: slope by channel, or None.

        Returns:
            (adjoint, slope or None).
        """
        A = [a + s for a, s in zip(A, self.steady, strict=True)]
        return self.match.to_spectrum(A), None if slope is None else self.match.to_spectrum(slope)

    def together(self, most, with_slope):
        """Return the number of arrivals that are read at once, before their vertices; 0 if each is read at its vertex.

        A film whose readings are expensive returns more.

        Args:
            most: largest number of arrivals of a path.
            with_slope: the slope is read as well.
        """
        return 0

    def read_together(self, opls, with_slope, active):
        """Read the adjoint at several arrivals of a path.

        Args:
            opls: optical path lengths, minus the film's start, metres (Float64).
            with_slope: read the slope as well.
            active: mask of lanes.

        Returns:
            (adjoint, slope or None): for each arrival a list over channels.
        """
        raise NotImplementedError


class ArrivalWindow:
    """Window of arrivals that a film counts.

    A path that is longer than ``last`` has no further event that counts. A plain object, which Dr.Jit loops leave
    alone.

    Args:
        first, last: ends, metres after the film's ``start_opl``.
    """

    def __init__(self, first: float, last: float):
        self.first, self.last = float(first), float(last)

    def counts(self, opl):
        """Return a mask of arrivals at ``opl`` (Float64) that count."""
        return (opl >= self.first) & (opl < self.last)

    def over(self, opl):
        """Return a mask of path lengths ``opl`` (Float64) behind which no arrival counts."""
        return opl >= self.last


class GappedWindow(ArrivalWindow):
    """Window in which equal cells of time count or not, for gates with gaps in between.

    Args:
        first, last: ends, metres after the film's ``start_opl``.
        cells: 1 for each cell that counts, 0 for others.
    """

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
    """Place of one event in a film.

    Args:
        flat: array of the film.
        base: index of the histogram's first value in it, UInt32.
        bin_stride, channel_stride: strides in the array.
        bins, channels: numbers of bins and channels.
        exclusive: every lane has a histogram of its own.
    """

    def __init__(self, flat, base, bin_stride, channel_stride, bins, channels, exclusive=False):
        self.flat, self.base = flat, base
        self.bin_stride, self.channel_stride = bin_stride, channel_stride
        self.bins, self.channels = bins, channels
        self.mode = reduce_mode(exclusive)


def reduce_mode(exclusive, direct=False):
    """Return Dr.Jit's mode of adding to an array.

    Args:
        exclusive: every lane has a target of its own.
        direct: every lane adds by itself; otherwise lanes with equal addresses are summed up before.
    """
    if exclusive:
        return dr.ReduceMode.NoConflicts
    return dr.ReduceMode.Direct if direct else dr.ReduceMode.Auto
