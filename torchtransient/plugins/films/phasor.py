"""``phasor_hdr_film``: the light behind every pixel at chosen frequencies, without a histogram.

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
import warnings

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.errors import SceneError, TorchTransientWarning
from torchtransient.plugins._registry import register
from torchtransient.plugins.films.base import TimeResolvedFilm
from torchtransient.plugins.films.block import AdjointBlock, FilmBlock, reduce_mode
from torchtransient.plugins.films.transform_bins import transform_bins
from torchtransient.plugins.properties import number, whole_number

_LIST = ("frequencies",)
_GRID = ("frequency_first", "frequency_step", "frequency_count")
_WAVELENGTHS = ("wl_mean", "wl_sigma", "temporal_bins", "bin_width_opl")


def _frequencies_of(props) -> np.ndarray:
    """Return the frequencies that a film's properties ask for: float64, cycles per metre. Raises ``SceneError``."""
    given = [names for names in (_LIST, _GRID, _WAVELENGTHS) if any(name in props for name in names)]
    if len(given) > 1:
        sets = " and ".join(", ".join(name for name in names if name in props) for names in given)
        raise SceneError(f"phasor_hdr_film: {sets} exclude each other; give one of the sets.")
    if given == [_LIST]:
        return _parsed(props["frequencies"])
    if given == [_GRID]:
        missing = [name for name in _GRID if name not in props]
        if missing:
            raise SceneError(
                f"phasor_hdr_film: a uniform grid needs {', '.join(_GRID)}; {', '.join(missing)} is missing."
            )
        count = whole_number(props, "frequency_count", 0)
        if count < 1:
            raise SceneError(f"phasor_hdr_film: frequency_count must be at least 1, got {count}.")
        return _checked(number(props, "frequency_first") + np.arange(count) * number(props, "frequency_step"))
    found = transform_bins(
        number(props, "wl_mean", 100.0),
        number(props, "wl_sigma", 1000.0),
        whole_number(props, "temporal_bins", 4096),
        number(props, "bin_width_opl", 0.003),
    )
    if not given:
        numbers = ", ".join(f"{number:.4g}" for number in found)
        warnings.warn(
            f"phasor_hdr_film: no frequencies are given, so the film keeps those of mitransient's defaults, {numbers} "
            "cycles per metre. Give 'frequencies': '...', numbers with commas in cycles per metre, or wl_mean and "
            "wl_sigma to mean these.",
            TorchTransientWarning,
            stacklevel=2,
        )
    return found


def _parsed(given) -> np.ndarray:
    """Numbers from a string with commas or spaces, or from an array of any kind."""
    try:
        if isinstance(given, str):
            values = [float(word) for word in given.replace(",", " ").split()]
        else:
            values = np.array(given, dtype=np.float64).ravel()
    except (TypeError, ValueError):
        raise SceneError(f"phasor_hdr_film: frequencies: expected numbers, got {given!r}.") from None
    return _checked(values)


def _checked(values) -> np.ndarray:
    """Finite, and at least one."""
    values = np.asarray(values, dtype=np.float64)
    if values.size < 1:
        raise SceneError("phasor_hdr_film: frequencies: expected at least one, got none.")
    if not np.isfinite(values).all():
        raise SceneError(f"phasor_hdr_film: frequencies: expected finite numbers, got {values.tolist()}.")
    return values


def _step_of(frequencies: np.ndarray) -> float | None:
    """Return the step of a uniform grid of frequencies, None for other lists.

    Deviations that no phase could show are taken as rounding.
    """
    count = len(frequencies)
    step = (frequencies[-1] - frequencies[0]) / (count - 1) if count > 1 else 0.0
    deviation = np.abs(frequencies - (frequencies[0] + np.arange(count) * step)).max()
    return float(step) if deviation <= 1e-14 * np.abs(frequencies).max() else None


# ----------------------------------------------------------------------------------- sums over events and frequencies

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
    """Return the number of events that are kept for a path.

    Args:
        most_events: events of a path at most.
    """
    return min(max(most_events, 1), MAX_EVENTS)


def _rotation(turns):
    """Return (cos, sin) of ``2 pi turns``; whole turns are taken off a double before single precision takes over."""
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
        re, im = _sum_events(self, frequencies, first, last)
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
        """Return a frequency, cycles per metre, Float64.

        Args:
            j: number of the frequency in the block.
        """
        if self.step is None:
            return self.values[j]
        return self.first + mi.Float64(self.start + j) * self.step

    def rotations(self, opl):
        """Return (cos, sin) of the phase at every frequency of the block.

        Args:
            opl: arrival, metres, Float64.
        """
        if self.step is None:
            return [_rotation(ν * opl) for ν in self.values]
        z = _rotation(self.frequency(0) * opl)
        result = [z]
        w = _rotation(self.step * opl)
        for _ in range(1, self.size):
            z = dr.fma(z[0], w[0], -z[1] * w[1]), dr.fma(z[0], w[1], z[1] * w[0])
            result.append(z)
        return result


@dr.syntax
def _sum_events(events, frequencies, first, last):
    """Return the sums of ``value * exp(-2 pi i nu opl)`` over the events of the paths from ``first`` to ``last``.

    Real and imaginary parts, each a list over the frequencies of the block of lists over the event's values.
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
        self.step = None if film.step is None else [_rotation(film.step_array * opl) for opl in opls]

    def at(self, ν):
        """Return (cos, sin) of every arrival at a frequency, in double precision up to whole turns.

        Args:
            ν: frequency, cycles per metre, Float64.
        """
        return [_rotation(ν * opl) for opl in self.opls]

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
        """Return the real and imaginary parts of one frequency, for every channel.

        Args:
            f: number of the frequency, UInt32.
            live: mask of lanes.
        """
        index = self.base + f * self.stride
        numbers = [dr.gather(mi.Float, self.flat, index + i * self.entry, live) for i in range(2 * self.channels)]
        return list(zip(numbers[::2], numbers[1::2], strict=True))


def _add_frequency(A, slope, row, phases, ω):
    """Add a frequency to ``A`` (a list over channels for each arrival) and, unless None, to ``slope``."""
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
def _read_arrivals(phases, rows, with_slope, active):
    """Return (A, its slope or None): lists over the arrivals of lists over the channels."""
    A = [[mi.Float(0) for _ in range(rows.channels)] for _ in phases.opls]
    slope = [[mi.Float(0) for _ in range(rows.channels)] for _ in phases.opls] if with_slope else None
    f = mi.UInt32(0)
    live = mi.Bool(active)
    while dr.hint(live & (f < phases.count), label="phasor read"):
        z = phases.at(dr.gather(mi.Float64, phases.frequencies, f, live))
        stop = dr.minimum(f + phases.steps, phases.count)
        while dr.hint(live & (f < stop), label="phasor steps"):
            ω = mi.Float(2 * math.pi * dr.gather(mi.Float64, phases.frequencies, f, live)) if with_slope else None
            _add_frequency(A, slope, rows.at(f, live), z, ω)
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
        return _read_arrivals(Phases(self.film, opls), rows, with_slope, active)


# ----------------------------------------------------------------------------------------------------------- the film

# The events of one kernel launch wait in memory until the next kernel sums them up; larger jobs take several launches.
MAX_EVENT_BYTES = 2**28


class Table:
    """Phasors (or their adjoint) and their frequencies. A plain object: its arrays must not become loop state."""

    def __init__(self, flat, frequencies, count, channels, exclusive=False):
        self.flat, self.frequencies, self.count, self.channels = flat, frequencies, count, channels
        self.mode = reduce_mode(exclusive)

    def add(self, value, index, active):
        """Add single-precision values, also to an array of doubles."""
        dr.scatter_reduce(dr.ReduceOp.Add, self.flat, type(self.flat)(value), index, active, self.mode)


@dr.syntax
def _add_event(table, base, opl, value, slope, active):
    """Add one event to every frequency; ``slope`` is None or the contribution times the derivative of its length."""
    f = mi.UInt32(0)
    live = mi.Bool(active)
    while dr.hint(live & (f < table.count), label="phasor put"):
        ν = dr.gather(mi.Float64, table.frequencies, f, live)
        cos, sin = _rotation(ν * opl)
        for c in range(table.channels):
            re, im = value[c] * cos, -value[c] * sin
            if dr.hint(slope is not None, mode="scalar"):
                ω = mi.Float(2 * math.pi * ν)
                re -= slope[c] * ω * sin
                im -= slope[c] * ω * cos
            index = base + (f * table.channels + c) * 2
            table.add(re, index, live)
            table.add(im, index + 1, live)
        f += 1


class PhasorHDRFilm(TimeResolvedFilm):
    r"""Phasor film (:monosp:`phasor_hdr_film`): ``P(nu) = sum of radiance * exp(-2 pi i nu (opl - start_opl))``.

    Parameters beside those of ``hdrfilm`` (size, crop, ``rfilter``) say which frequencies are kept, in cycles per metre
    of optical path (one over the wavelength). Give one of these sets:

    ``frequencies`` (string of numbers with commas, or an array)
        Any frequencies, zero and negative ones too.
    ``frequency_first``, ``frequency_step`` (float), ``frequency_count`` (int)
        A uniform grid.
    ``wl_mean`` (float, 100), ``wl_sigma`` (float, 1000), ``temporal_bins`` (int, 4096), ``bin_width_opl`` (0.003)
        As in mitransient 1.x, also when nothing is given: the frequencies of the discrete Fourier transform of that
        many bins that lie within ``1 / wl_mean +- 3 sigma``, ``sigma = 1 / (6 wl_sigma)``, and not below zero.

    ``start_opl`` (float, 0)
        Where the phase is zero, in metres of optical path: at 0, when the light leaves the emitter.

    A uniform grid, however it is given, is faster than other lists: one complex multiplication for each step.

    nested spectra (spectral variants)
        Response curves of the sensor's channels, see :class:`.colour.SensorResponse`.

    A phasor is integrated over time: its value at frequency zero is the steady image, and nothing is lost outside a
    window. It is what a histogram's transform would be with infinitely narrow bins. ``develop()`` returns steady
    ``(H, W, C)`` and phasors ``(H, W, F, 2 C)`` of the crop window: real and imaginary part for every channel in turn,
    C = 1 in monochromatic variants, the number of response curves where there are some, and 3 otherwise (linear sRGB
    in spectral variants).

    Phases are counted in double precision, in whole turns and a rest; the rest is good to 1e-6 cycles. Path lengths
    come from single-precision positions: at 1 km a coordinate is good to 3e-5 m, 3e-3 cycles of a wavelength of 1 cm.

    The film is smooth in time: gradients through the path length need no temporal filter, and filter settings of an
    integrator are ignored. The spatial filter and double precision above 2^16 samples per pixel are as in
    ``transient_hdr_film``.

    Memory: the phasors, and up to 256 MB of events of the kernel in flight (twice that in forward mode); never a
    histogram.

    Not supported: alpha channel, half precision.
    """

    plugin = "phasor_hdr_film"
    measures = "phasor"
    has_window = False

    def __init__(self, props):
        super().__init__(props)
        self.frequencies = _frequencies_of(props)
        self.step = _step_of(self.frequencies)
        # In memory, so that kernels do not depend on their values and number.
        self.frequency_array = mi.Float64(self.frequencies)
        self.frequency_total = mi.UInt32(len(self.frequencies))
        self.step_array = mi.Float64(self.step or 0.0)
        dr.make_opaque(self.frequency_array, self.frequency_total, self.step_array)

    def traverse(self, cb):
        super().traverse(cb)
        cb.put("start_opl", self.start_opl, mi.ParamFlags.NonDifferentiable)

    # ---------------------------------------------------------------------------------------- storage

    def frequency_count(self) -> int:
        """Return the number of frequencies, F."""
        return len(self.frequencies)

    def cube_shape(self) -> tuple[int, ...]:
        """Return the shape of the phasors: (H, W, F, 2 C) or (H, W, Lh, Lw, F, 2 C).

        Real and imaginary part of each channel in turn.
        """
        size = self.crop_size()
        entries = (self.frequency_count(), 2 * self.channel_count())
        return (int(size[1]), int(size[0]), *self.laser_shape(), *entries)

    def lanes_at_most(self, most_events: int) -> int | None:
        per_path = slots_for(most_events) * (EVENT_BYTES + 4 * self.channel_count())
        return max(1, MAX_EVENT_BYTES // per_path)

    # ----------------------------------------------------------------------------------- splat and read

    def create_event_block(self, job, base, match, most_events, tangents=False, exclusive=False, origin=None):
        return EventBlock(self, job, base, match, most_events, tangents, origin)

    def create_adjoint_block(self, response, base, steady, match):
        return PhasorAdjointBlock(self, response, base, steady, match)

    def _table(self, flat, exclusive=False):
        return Table(flat, self.frequency_array, self.frequency_total, self.channel_count(), exclusive)

    def put(self, band, base, opl_from_start, value, active, exclusive=False):
        """Add one event, frequency by frequency: as :class:`EventBlock` does for many at once."""
        _add_event(self._table(self.band_array(band), exclusive), base, opl_from_start, value, None, active)
        return mi.Float(0), mi.Float(0)

    def put_slope(self, band, base, opl_from_start, d_value, value_d_opl, active):
        _add_event(self._table(self.band_array(band)), base, opl_from_start, d_value, value_d_opl, active)

    def read(self, adjoint, base, opl_from_start, active, steady=None):
        """Return ``A = sum over nu of a_re cos - a_im sin`` and its slope ``dA / d opl`` for an arrival.

        Args:
            adjoint: adjoint of the array as (flat array, frequency stride, entry stride).
            steady: always None, since the film keeps a steady image.

        Returns:
            Lists over channels.
        """
        rows = AdjointRows(adjoint, base, self.channel_count())
        A, slope = _read_arrivals(Phases(self, [opl_from_start]), rows, True, active)
        return A[0], slope[0]

    def to_string(self):
        return (
            f"PhasorHDRFilm[\n  size = {self.size()},\n  crop = {self.crop_size()} at {self.crop_offset()},\n"
            f"  frequencies = {self.frequency_count()} from {self.frequencies.min():g} to {self.frequencies.max():g} "
            f"per metre,\n  start_opl = {self.start_opl}\n]"
        )


register("film", "phasor_hdr_film", PhasorHDRFilm)
