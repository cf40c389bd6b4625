"""Sums over the events and the frequencies of a phasor film: of events in flight, and of the adjoint at arrivals.

The kernel that traces paths writes every event (optical path length, channel values) into memory of its path. A second
kernel takes a block of frequencies of a pixel each, walks the events of that pixel and keeps its sums in registers: no
two of its threads write to the same place as long as a pixel has few samples, and a uniform grid of frequencies costs
one complex multiplication for each event and step. Summing inside of the first kernel would need one atomic addition
for each path, frequency and channel.

The adjoint is ``A(tau) = sum over nu of a_re cos - a_im sin``. The frequencies of a pixel are read from memory once for
several arrivals of a path (:meth:`PhasorAdjointBlock.read_together`), and on a grid each costs an arrival one complex
multiplication instead of a sine and a cosine.
"""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.films.block import AdjointBlock, FilmBlock

# Events of a path that are kept; what exceeds them is added one by one, which is slower.
MAX_EVENTS = 16
# Bytes of an event besides its channel values.
EVENT_BYTES = 8
# Samples of a pixel that one thread of the second kernel sums up.
GROUP = 64
# Complex sums that one thread of the second kernel keeps, frequencies times channel values. What an event costs beside
# them is paid for once a thread.
BLOCK = 48
# Frequencies of a thread at most: those of a grid start from a phase in double precision and go on by multiplication,
# which must not build up rounding.
MOST_FREQUENCIES = 16


def slots_for(most_events: int) -> int:
    """Events kept for a path that has ``most_events`` at most."""
    return min(max(most_events, 1), MAX_EVENTS)


def rotation(turns):
    """Cosine and sine of ``2 pi turns``: whole turns are taken off a double before single precision takes over."""
    angle = mi.Float(turns - dr.round(turns)) * (2 * math.pi)
    sin, cos = dr.sincos(angle)
    return cos, sin


class EventBlock(FilmBlock):
    """Keeps the events of each path of one pass and sums them up in ``finish``."""

    def __init__(self, film, job, base, match, most_events, tangents, origin=None):
        super().__init__(film, job.band, base, match, origin=origin)
        self.first_row, _, self.cube = film.bands[job.band]
        self.job, self.tangents = job, tangents
        self.slots = slots_for(most_events)
        self.overflows = most_events > self.slots
        # Arrays of a row: those of all laser positions of a pixel stand together.
        self.width = int(film.crop_size()[0]) * film.laser_count()
        self.paths = self.width * job.rows * job.spp
        # In memory: as a literal, every number of samples would compile kernels of its own.
        self.stride = dr.opaque(mi.UInt32, self.paths)
        numbers = film.channel_count() * (2 if tangents else 1)
        self.count = dr.empty(mi.UInt32, self.paths)
        self.opl = dr.empty(mi.Float64, self.slots * self.paths)
        self.values = [dr.empty(mi.Float, self.slots * self.paths) for _ in range(numbers)]

    def begin(self):
        return {"count": mi.UInt32(0), "path": dr.arange(mi.UInt32, self.paths)}

    def put(self, events, opl, value, active, crowded=False):
        channels, opl = self.match.to_channels(value), self.counted(opl)
        more = self._store(events, opl, channels, active)
        if self.overflows:
            self.film.put(self.band, self.base, opl, channels, more)
        return mi.Float(0), mi.Float(0)

    def put_slope(self, events, opl, d_value, value_d_opl, active):
        d, slope, opl = self.match.to_channels(d_value), self.match.to_channels(value_d_opl), self.counted(opl)
        more = self._store(events, opl, d + slope, active)
        if self.overflows:
            self.film.put_slope(self.band, self.base, opl, d, slope, more)

    def _store(self, events, opl, values, active):
        """Append an event to its path; returns where there was no room left."""
        largest = dr.abs(values[0])
        for value in values[1:]:
            largest = dr.maximum(largest, dr.abs(value))
        some = active & (largest > 0)
        n = events["count"]
        fits = some & (n < self.slots)
        # Events of the same number lie side by side: those that few paths reach are memory that is never touched.
        index = dr.fma(n, self.stride, events["path"])
        dr.scatter(self.opl, opl, index, fits)
        for target, value in zip(self.values, values, strict=True):
            dr.scatter(target, value, index, fits)
        events["count"] = n + dr.select(fits, mi.UInt32(1), 0)
        return some & ~fits

    def end(self, events):
        dr.scatter(self.count, events["count"], events["path"])

    def finish(self):
        # The first kernel: everything that the integrator has asked for in this pass.
        dr.eval(self.count, self.opl, *self.values, self.cube, self.film.steady)
        job, film = self.job, self.film
        groups = -(-job.spp // GROUP)
        per_block = min(max(1, BLOCK // len(self.values)), MOST_FREQUENCIES, film.frequency_count())
        blocks = -(-film.frequency_count() // per_block)
        index = dr.arange(mi.UInt32, self.width * job.rows * groups * blocks)
        rest = index // dr.opaque(mi.UInt32, blocks)
        block = index - rest * dr.opaque(mi.UInt32, blocks)
        pixel = rest // dr.opaque(mi.UInt32, groups)
        group = rest - pixel * dr.opaque(mi.UInt32, groups)
        spp = dr.opaque(mi.UInt32, job.spp)
        first = pixel * spp + group * GROUP
        last = dr.minimum(first + GROUP, (pixel + 1) * spp)
        base = (pixel + dr.opaque(mi.UInt32, (job.first_row - self.first_row) * self.width)) * film.entries_per_array()
        if (entry := film.first_entry()) is not None:
            base += entry
        start = block * per_block
        frequencies = FrequencyBlock(film, start, per_block)
        re, im = sum_events(self, frequencies, first, last)
        self._add_block(frequencies, base, re, im, conflicts=groups > 1)

    def _add_block(self, block, base, re, im, conflicts):
        channels = self.film.channel_count()
        mode = dr.ReduceMode.Auto if conflicts else dr.ReduceMode.NoConflicts
        real = type(self.cube)
        for j in range(block.size):
            f = block.start + j
            inside = f < block.count
            for c in range(channels):
                x, y = re[j][c], im[j][c]
                if self.tangents:
                    ω = mi.Float(2 * math.pi * block.frequency(j))
                    x += ω * im[j][channels + c]
                    y -= ω * re[j][channels + c]
                index = base + (f * channels + c) * 2
                dr.scatter_reduce(dr.ReduceOp.Add, self.cube, real(x), index, inside, mode)
                dr.scatter_reduce(dr.ReduceOp.Add, self.cube, real(y), index + 1, inside, mode)


class FrequencyBlock:
    """``size`` frequencies from number ``start`` on; a plain object, its arrays are constant in loops."""

    def __init__(self, film, start, size):
        self.start, self.size = start, size
        self.count = film.frequency_total
        self.step = None
        if film.step is not None:
            self.first = dr.opaque(mi.Float64, float(film.frequencies[0]))
            self.step = dr.opaque(mi.Float64, film.step)
        else:
            numbers = [start + j for j in range(size)]
            self.values = [dr.gather(mi.Float64, film.frequency_array, k, k < self.count) for k in numbers]

    def frequency(self, j):
        """Frequency number ``j`` of the block, a double."""
        if self.step is None:
            return self.values[j]
        return self.first + mi.Float64(self.start + j) * self.step

    def rotations(self, opl):
        """(cos, sin) of the phase at every frequency of the block."""
        if self.step is None:
            return [rotation(ν * opl) for ν in self.values]
        z = rotation(self.frequency(0) * opl)
        result = [z]
        w = rotation(self.step * opl)
        for _ in range(1, self.size):
            z = dr.fma(z[0], w[0], -z[1] * w[1]), dr.fma(z[0], w[1], z[1] * w[0])
            result.append(z)
        return result


@dr.syntax
def sum_events(events, frequencies, first, last):
    """Sums of ``value * exp(-2 pi i nu opl)`` over the events of the paths from ``first`` to ``last``.

    Returns real and imaginary parts, each a list over the frequencies of the block of lists over the event's values.
    """
    numbers = len(events.values)
    re = [[mi.Float(0) for _ in range(numbers)] for _ in range(frequencies.size)]
    im = [[mi.Float(0) for _ in range(numbers)] for _ in range(frequencies.size)]
    path, n = mi.UInt32(first), mi.UInt32(0)
    count = dr.gather(mi.UInt32, events.count, path)
    while dr.hint(path < last, label="phasor sums"):
        live = n < count
        index = dr.fma(n, events.stride, path)
        opl = dr.gather(mi.Float64, events.opl, index, live)
        values = [dr.gather(mi.Float, array, index, live) for array in events.values]
        for j, (cos, sin) in enumerate(frequencies.rotations(opl)):
            for c in range(numbers):
                re[j][c] = dr.fma(values[c], cos, re[j][c])
                im[j][c] = dr.fma(-values[c], sin, im[j][c])
        n += 1
        over = n >= count
        path += dr.select(over, mi.UInt32(1), 0)
        n = dr.select(over, 0, n)
        count = dr.select(over, dr.gather(mi.UInt32, events.count, path, over & (path < last)), count)
    return re, im


# Frequencies of a grid from one phase in double precision to the next. The phase of a step is off by 2.5e-7 at most
# (its turns as a float, their product with 2 pi, sine and cosine), and a product of rotations rounds by sqrt(5) 2^-24:
# 15 of them stay below 6e-6, which is 1e-6 cycles.
STEPS = 16
# Sums that are kept while frequencies go by: a value, or a value and a slope, for each channel of each arrival. They
# are more than processors have registers: sums in the nearest memory cost less than to read frequencies more often.
SUMS = 48
# Arrivals that share what is read: more of them would mostly be missing.
MOST_ARRIVALS = 8


class Phases:
    """Frequencies of a film, and the phases of some arrivals. A plain object: constant in loops."""

    def __init__(self, film, opls):
        self.frequencies, self.count, self.opls = film.frequency_array, film.frequency_total, opls
        self.steps = 1 if film.step is None else STEPS
        self.step = None if film.step is None else [rotation(film.step_array * opl) for opl in opls]

    def at(self, ν):
        """(cos, sin) of every arrival at the frequency ``ν``, in double precision up to whole turns."""
        return [rotation(ν * opl) for opl in self.opls]

    def next(self, phases):
        """Return the phases at the next frequency of a grid."""
        if self.step is None:
            return phases
        return [
            (dr.fma(cos, c, -sin * s), dr.fma(cos, s, sin * c))
            for (cos, sin), (c, s) in zip(phases, self.step, strict=True)
        ]


class AdjointRows:
    """The adjoint phasors of each lane's pixel. A plain object: its arrays are constant in loops."""

    def __init__(self, adjoint, base, channels):
        self.flat, self.stride, self.entry = adjoint
        self.base, self.channels = base, channels

    def at(self, f, live):
        """Real and imaginary parts of frequency number ``f``, for every channel."""
        index = self.base + f * self.stride
        numbers = [dr.gather(mi.Float, self.flat, index + i * self.entry, live) for i in range(2 * self.channels)]
        return list(zip(numbers[::2], numbers[1::2], strict=True))


def add_frequency(A, slope, row, phases, ω):
    """``A`` (a list over channels for each arrival) and, unless None, ``slope`` with another frequency."""
    for n, (cos, sin) in enumerate(phases):
        for c, (a, b) in enumerate(row):
            A[n][c] = dr.fma(a, cos, dr.fma(-b, sin, A[n][c]))
    if slope is None:
        return
    scaled = [(a * ω, b * ω) for a, b in row]
    for n, (cos, sin) in enumerate(phases):
        for c, (a, b) in enumerate(scaled):
            slope[n][c] = dr.fma(-a, sin, dr.fma(-b, cos, slope[n][c]))


@dr.syntax
def read_arrivals(phases, rows, with_slope, active):
    """(A, its slope or None): lists over the arrivals of lists over the channels."""
    A = [[mi.Float(0) for _ in range(rows.channels)] for _ in phases.opls]
    slope = [[mi.Float(0) for _ in range(rows.channels)] for _ in phases.opls] if with_slope else None
    f = mi.UInt32(0)
    live = mi.Bool(active)
    while dr.hint(live & (f < phases.count), label="phasor read"):
        z = phases.at(dr.gather(mi.Float64, phases.frequencies, f, live))
        stop = dr.minimum(f + phases.steps, phases.count)
        while dr.hint(live & (f < stop), label="phasor steps"):
            ω = mi.Float(2 * math.pi * dr.gather(mi.Float64, phases.frequencies, f, live)) if with_slope else None
            add_frequency(A, slope, rows.at(f, live), z, ω)
            z = phases.next(z)
            f += 1
    return A, slope


class PhasorAdjointBlock(AdjointBlock):
    """Reads the arrivals of a path together, before they are asked for."""

    def together(self, most, with_slope):
        if self.response is None:
            return 0
        sums = self.film.channel_count() * (2 if with_slope else 1)
        return min(max(SUMS // sums, 1), MOST_ARRIVALS, most)

    def read_together(self, opls, with_slope, active):
        rows = AdjointRows(self.response, self.base, self.film.channel_count())
        return read_arrivals(Phases(self.film, opls), rows, with_slope, active)
