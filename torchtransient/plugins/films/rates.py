"""Films of rates: light over optical path length and over how fast that length changes."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi

from torchtransient.chirps import Chirps
from torchtransient.errors import SceneError, TorchTransientError
from torchtransient.plugins._registry import register
from torchtransient.plugins.films.block import AdjointBlock, FilmBlock
from torchtransient.plugins.films.histogram import TransientHDRFilm
from torchtransient.plugins.films.phasor import PhasorHDRFilm
from torchtransient.plugins.films.splined import SplinedHDRFilm
from torchtransient.plugins.films.temporal_filters import make_temporal_filter
from torchtransient.plugins.properties import number, whole_number


class Row:
    """Share of an arrival in one of a pixel's arrays.

    Attributes:
        number: number of the array, UInt32.
        inside: mask, the array exists.
        shift: length that is added to the arrival's, metres (Float64).
        k: derivative of ``shift`` by the rate, seconds.
        weight, slope: share of the arrival, and its derivative by the rate.
    """

    def __init__(self, number, inside, shift, k, weight, slope):
        self.number, self.inside, self.shift, self.k, self.weight, self.slope = number, inside, shift, k, weight, slope


def _sheared(scales, rate):
    """Return rows of all the light, one at ``opl + k rate`` for each ``k`` of ``scales`` (Float64, seconds)."""
    return [
        Row(mi.UInt32(n), mi.Bool(True), k * mi.Float64(rate), mi.Float(k), mi.Float(1), mi.Float(0))
        for n, k in enumerate(scales)
    ]


def film_of_rows(base):
    """Return the class of films with several arrays of a film a pixel, by the rate of an arrival.

    A function, since classes of Mitsuba have one base. A subclass says with ``row_count`` how many rows there are and
    with ``rows_of(rate)`` which (:class:`Row`) an arrival of ``rate`` (Float, m/s) goes to.

    Args:
        base: class of a film with one array, ``(H, W, entries, channels)``; the rows come before the entries.
    """

    class FilmOfRows(base):
        knows_rates = True
        knows_exclusive_lanes = False
        # What an arrival counts in the sum over all rows.
        share = 1.0

        def __init__(self, props):
            super().__init__(props)
            if not self.keeps_steady or self.exhaustive_scan:
                raise SceneError(f"{self.plugin}: expected no exhaustive_scan, and steady not to be false.")

        def cube_shape(self):
            shape = super().cube_shape()
            return (*shape[:2], self.row_count(), *shape[2:])

        def create_event_block(self, job, base, match, most_events, tangents=False, exclusive=False, origin=None):
            return FilmBlock(self, job.band, base, match, False, origin)

        def create_adjoint_block(self, response, base, steady, match):
            return AdjointBlock(self, response, base, steady, match)

        def lanes_at_most(self, most_events):
            return None  # events are not kept

        def put(self, band, base, opl_from_start, value, active, rate, **options):
            """Add an arrival to its rows, see :meth:`~.base.TimeResolvedFilm.put`; ``rate``: m/s, Float."""
            return _put(self, super().put, band, base, opl_from_start, value, active, rate, options)

        def put_slope(self, band, base, opl_from_start, d_value, value_d_opl, active, rate, value_d_rate):
            """Add the derivative of an event; ``value_d_rate``: contribution times derivative of the rate."""
            slopes = d_value, value_d_opl, value_d_rate
            _put_slope(self, super().put_slope, band, base, opl_from_start, slopes, active, rate)

        def read(self, adjoint, base, opl_from_start, active, steady=None, rate=None):
            """Return ``A``, its slope by the length and its slope by the rate, lists over channels."""
            return _read(self, super().read, adjoint, base, opl_from_start, active, rate)

    return FilmOfRows


def _stride(film):
    return film.entries_per_array() // film.row_count()


def _put(film, put, band, base, opl, value, active, rate, options):
    before, after = mi.Float(0), mi.Float(0)
    for row in film.rows_of(rate):
        values, inside = [v * row.weight for v in value], active & row.inside
        early, late = put(band, base + row.number * _stride(film), opl + row.shift, values, inside, **options)
        before += dr.select(row.inside, early, 0) * row.weight * film.share
        after += dr.select(row.inside, late, 1) * row.weight * film.share
    return before, after


def _put_slope(film, put_slope, band, base, opl, slopes, active, rate):
    d_value, value_d_opl, value_d_rate = slopes
    for row in film.rows_of(rate):
        d = [row.weight * a + row.slope * b for a, b in zip(d_value, value_d_rate, strict=True)]
        moved = [row.weight * (a + row.k * b) for a, b in zip(value_d_opl, value_d_rate, strict=True)]
        put_slope(band, base + row.number * _stride(film), opl + row.shift, d, moved, active & row.inside)


def _read(film, read, adjoint, base, opl, active, rate):
    flat, row_stride, *strides = adjoint
    A, by_opl, by_rate = ([mi.Float(0)] * film.channel_count() for _ in range(3))
    for row in film.rows_of(rate):
        a, slope = read((flat, *strides), base + row.number * row_stride, opl + row.shift, active & row.inside)
        for c in range(film.channel_count()):
            # Not in place: the zeros are one array.
            A[c] = A[c] + row.weight * a[c]
            by_opl[c] = by_opl[c] + row.weight * slope[c]
            by_rate[c] = by_rate[c] + row.weight * row.k * slope[c] + row.slope * a[c]
    return A, by_opl, by_rate


class RateHDRFilm(film_of_rows(TransientHDRFilm)):
    r"""Film over optical path length and rate (:monosp:`rate_hdr_film`): a histogram for each bin of the rate.

    The rate ``d opl / dt`` (m/s, positive where paths get longer) is that of material points, see
    :mod:`~..transport.velocities`: the rate for waves whose phase the scatterers carry. Their Doppler shift is ``- rate
    / wavelength``.

    Parameters beside those of ``transient_hdr_film``: ``rate_start``, ``rate_width`` (m/s), ``rate_bins`` (int): bins
    ``[rate_start + k rate_width, rate_start + (k + 1) rate_width)``, over which the temporal filter spreads arrivals as
    over the lengths. Layout ``(H, W, rate_bins, T, C)``.

    Not supported: exhaustive scans, ``steady`` = false.
    """

    plugin = "rate_hdr_film"
    measures = "rates"

    def __init__(self, props):
        super().__init__(props)
        self.rate_start, self.rate_width = number(props, "rate_start"), number(props, "rate_width")
        self.rate_bins = whole_number(props, "rate_bins", 0, least=0)
        if not (self.rate_bins and self.rate_width > 0):
            raise SceneError(f"{self.plugin}: expected rate_bins of at least 1 and a positive rate_width, in m/s.")

    def traverse(self, cb):
        super().traverse(cb)
        for name in ("rate_start", "rate_width", "rate_bins"):
            cb.put(name, getattr(self, name), mi.ParamFlags.NonDifferentiable)

    def row_count(self):
        return self.rate_bins

    def take_filter(self, name, stddev):
        super().take_filter(name, stddev)
        self._rate_filter = make_temporal_filter(self.temporal_filter, self.gaussian_stddev)

    @property
    def has_slope(self) -> bool:
        """The temporal filter has a slope; that of a pulse is along the lengths alone."""
        return self._rate_filter.has_slope

    def rows_of(self, rate):
        rows, scale = [], 1 / self.rate_width
        first, taps = self._rate_filter.weights((mi.Float64(rate) - self.rate_start) * scale)
        for offset, weight, slope in taps:
            row = first + offset
            inside = (row >= 0) & (row < self.rate_bins)
            number_ = mi.UInt32(dr.select(inside, row, 0))
            rows.append(Row(number_, inside, mi.Float64(0), 0.0, weight, slope * scale))
        return rows


class BeatHDRFilm(film_of_rows(SplinedHDRFilm)):
    r"""Film of the beats of frequency-modulated light (:monosp:`beat_hdr_film`): two spectra a pixel.

    ``chirp_bandwidth`` (Hz), ``chirp_duration`` (s), ``chirp_wavelength`` (m), ``chirp_window`` (string, hann): chirps
    up and down, see :class:`torchtransient.Chirps`. The axis of the film is that of a target at rest: the beat of an
    arrival on the up chirp is that of a length ``opl + k rate``, on the down chirp of ``opl - k rate``, with ``k`` the
    frequency of the light times duration over bandwidth, and spread by the line shape of the window, to 1e-3 of its
    peak (:mod:`.splined`). Layout ``(H, W, 2, T, C)``.

    Not supported: exhaustive scans, ``steady`` = false, a further impulse response.
    """

    plugin = "beat_hdr_film"
    measures = "beats"
    share = 0.5

    def __init__(self, props):
        names = ("chirp_bandwidth", "chirp_duration", "chirp_wavelength")
        try:
            numbers = [number(props, name) for name in names]
            self.chirps = Chirps(*numbers, window=str(props.get("chirp_window", "hann")))
        except TorchTransientError as error:
            raise SceneError(f"{self.plugin}: {error}") from error
        super().__init__(props)
        self.pulses = [*self.pulses, self.chirps.line_shape]
        self._filters.clear()
        self.take_filter("", None)
        # In memory: kernels do not depend on them.
        self._scales = [dr.opaque(mi.Float64, sign * self.chirps.rate_scale_s) for sign in (1, -1)]

    def row_count(self):
        return 2

    def rows_of(self, rate):
        return _sheared(self._scales, rate)


class SlowPhasorHDRFilm(film_of_rows(PhasorHDRFilm)):
    r"""Phasors at slow times (:monosp:`slow_phasor_hdr_film`): those of each pulse of a radar.

    ``sum of radiance * exp(-2 pi i nu (opl + t rate - start_opl))`` for each ``t`` of ``slow_times`` (numbers with
    commas, seconds), to first order in time. Other parameters are those of ``phasor_hdr_film``. Layout ``(H, W, times,
    F, 2 C)``. Every arrival is added frequency by frequency.

    Not supported: exhaustive scans.
    """

    plugin = "slow_phasor_hdr_film"
    measures = "slow_phasor"

    def __init__(self, props):
        super().__init__(props)
        given = str(props.get("slow_times", "")).replace(",", " ").split()
        try:
            self.slow_times = tuple(float(word) for word in given)
        except ValueError:
            self.slow_times = ()
        if not self.slow_times or not all(map(math.isfinite, self.slow_times)):
            words = " ".join(given)
            raise SceneError(f"{self.plugin}: slow_times: expected finite numbers with commas, got {words!r}.")
        self._scales = [dr.opaque(mi.Float64, t) for t in self.slow_times]

    def row_count(self):
        return len(self.slow_times)

    def rows_of(self, rate):
        return _sheared(self._scales, rate)


register("film", "rate_hdr_film", RateHDRFilm)
register("film", "beat_hdr_film", BeatHDRFilm)
register("film", "slow_phasor_hdr_film", SlowPhasorHDRFilm)
