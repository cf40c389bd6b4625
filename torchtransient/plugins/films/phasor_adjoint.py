"""The adjoint of a phasor film at arrivals: ``A(tau) = sum over nu of a_re cos - a_im sin``, and its slope.

What takes time are the frequencies of a pixel, which every arrival has to see. They are read from memory once for
several arrivals of a path (:meth:`PhasorAdjointBlock.read_together`), and on a grid each costs an arrival one complex
multiplication instead of a sine and a cosine.
"""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi

from torchtransient.plugins.films.block import AdjointBlock
from torchtransient.plugins.films.phasor_events import rotation

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
    """Which frequencies there are, and the phases of some arrivals. A plain object: constant in loops."""

    def __init__(self, film, opls):
        self.frequencies, self.count, self.opls = film.frequency_array, film.frequency_total, opls
        self.steps = 1 if film.step is None else STEPS
        self.step = None if film.step is None else [rotation(film.step_array * opl) for opl in opls]

    def at(self, ν):
        """(cos, sin) of every arrival at the frequency ``ν``, in double precision up to whole turns."""
        return [rotation(ν * opl) for opl in self.opls]

    def next(self, phases):
        """Those at the next frequency of a grid."""
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
