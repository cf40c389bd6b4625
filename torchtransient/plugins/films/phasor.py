"""``phasor_hdr_film``: the light behind every pixel at chosen frequencies, without a histogram."""

from __future__ import annotations

import math
import warnings

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.errors import SceneError, TorchTransientWarning
from torchtransient.plugins._registry import register
from torchtransient.plugins.films.base import TimeResolvedFilm
from torchtransient.plugins.films.block import reduce_mode
from torchtransient.plugins.films.phasor_sums import (
    EVENT_BYTES,
    AdjointRows,
    EventBlock,
    Phases,
    PhasorAdjointBlock,
    read_arrivals,
    rotation,
    slots_for,
)
from torchtransient.plugins.films.transform_bins import transform_bins
from torchtransient.plugins.properties import number, whole_number

_LIST = ("frequencies",)
_GRID = ("frequency_first", "frequency_step", "frequency_count")
_WAVELENGTHS = ("wl_mean", "wl_sigma", "temporal_bins", "bin_width_opl")


def frequencies_of(props) -> np.ndarray:
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


def step_of(frequencies: np.ndarray) -> float | None:
    """Return the step of a uniform grid of frequencies, None for other lists.

    Deviations that no phase could show are taken as rounding.
    """
    count = len(frequencies)
    step = (frequencies[-1] - frequencies[0]) / (count - 1) if count > 1 else 0.0
    deviation = np.abs(frequencies - (frequencies[0] + np.arange(count) * step)).max()
    return float(step) if deviation <= 1e-14 * np.abs(frequencies).max() else None


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
def add_event(table, base, opl, value, slope, active):
    """Add one event to every frequency; ``slope`` is None or the contribution times the derivative of its length."""
    f = mi.UInt32(0)
    live = mi.Bool(active)
    while dr.hint(live & (f < table.count), label="phasor put"):
        ν = dr.gather(mi.Float64, table.frequencies, f, live)
        cos, sin = rotation(ν * opl)
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
        self.frequencies = frequencies_of(props)
        self.step = step_of(self.frequencies)
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
        """F, the number of frequencies."""
        return len(self.frequencies)

    def cube_shape(self) -> tuple[int, ...]:
        """Shape of the phasors: (H, W, F, 2 C) or (H, W, Lh, Lw, F, 2 C), real and imaginary part in turn."""
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
        """One event, frequency by frequency: the plain form of what :class:`EventBlock` does for many at once."""
        add_event(self._table(self.band_array(band), exclusive), base, opl_from_start, value, None, active)
        return mi.Float(0), mi.Float(0)

    def put_slope(self, band, base, opl_from_start, d_value, value_d_opl, active):
        add_event(self._table(self.band_array(band)), base, opl_from_start, d_value, value_d_opl, active)

    def read(self, adjoint, base, opl_from_start, active, steady=None):
        """``A = sum over nu of a_re cos - a_im sin`` and its slope ``dA / d opl`` for an arrival: lists over channels.

        ``adjoint`` is ``(flat array, frequency stride, entry stride)``; ``steady`` is always None, since the film keeps
        a steady image.
        """
        rows = AdjointRows(adjoint, base, self.channel_count())
        A, slope = read_arrivals(Phases(self, [opl_from_start]), rows, True, active)
        return A[0], slope[0]

    def to_string(self):
        return (
            f"PhasorHDRFilm[\n  size = {self.size()},\n  crop = {self.crop_size()} at {self.crop_offset()},\n"
            f"  frequencies = {self.frequency_count()} from {self.frequencies.min():g} to {self.frequencies.max():g} "
            f"per metre,\n  start_opl = {self.start_opl}\n]"
        )


register("film", "phasor_hdr_film", PhasorHDRFilm)
