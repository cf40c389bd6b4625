"""``transient_hdr_film``: a histogram over optical path length behind every pixel."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from torchtransient.errors import SceneError
from torchtransient.plugins._registry import register
from torchtransient.plugins.films.base import TimeResolvedFilm
from torchtransient.plugins.films.block import ArrivalWindow, BinLayout, FilmBlock, reduce_mode
from torchtransient.plugins.films.colour import mean_of
from torchtransient.plugins.films.temporal_filters import (
    PulsedFilter,
    check_name,
    check_stddev,
    make_temporal_filter,
    pulse_of,
    put_long,
    read_long,
)
from torchtransient.plugins.properties import number, truth, whole_number

# Kernels of more bins are looped over instead of written out.
MAX_UNROLLED = 9
# From so many bins on, hardly any two lanes beside each other add to the same one.
MANY_BINS = 64
# Temporal filters of other settings that a film keeps.
MAX_FILTERS = 8


class Filters(dict):
    """Temporal filters by what they were made for: recorded calls depend on the one in use."""

    only_remembers = True


class HistogramBlock(FilmBlock):
    """Events whose lengths are counted from an origin of their sample: its bin is found once, in double precision, and
    from there on bins are counted in single precision, which is as good as the lengths are.
    """

    def __init__(self, film, band, base, match, exclusive, origin):
        super().__init__(film, band, base, match, exclusive, origin)
        x = film.bin_position(origin)
        # Farther away, single precision does not know the bin anyway.
        start = dr.clip(dr.floor(x), -(2.0**30), 2.0**30)
        self.fraction = mi.Float(x - start)
        self.window = mi.Float(-start), mi.Float(film.temporal_bins - start)
        # Whole numbers wrap around and back again.
        self.first = base + mi.UInt32(mi.Int32(start)) * film.channel_count()
        self.scale = mi.Float(1 / film.bin_width_opl)
        dr.eval(self.fraction, self.window, self.first)

    def put(self, events, opl, value, active, crowded=False):
        channels = self.match.to_channels(value)
        x = dr.fma(mi.Float(opl), self.scale, self.fraction)
        cube = self.film.band_array(self.band)
        mode = self.film.reduce_mode(cube, self.exclusive, crowded)
        before, after = self.film.put_bins(cube, self.first, x, self.window, channels, active, mode)
        energy = dr.select(active, mean_of(channels), 0)
        return energy * before, energy * after


class TransientHDRFilm(TimeResolvedFilm):
    r"""Time-resolved film (:monosp:`transient_hdr_film`).

    Parameters beside those of ``hdrfilm`` (size, crop, ``rfilter``):

    ``temporal_bins`` (int, 2048), ``bin_width_opl`` (float, 0.003), ``start_opl`` (float, 0)
        Bins ``[start_opl + k bin_width_opl, start_opl + (k + 1) bin_width_opl)`` over optical path length in metres.
    ``temporal_filter`` (``box`` | ``tent`` | ``gaussian``; box), ``gaussian_stddev`` (float, 0.5 bins)
        How an arrival spreads over the bins, see :mod:`.temporal_filters`.
    ``exhaustive_scan`` (bool, false), ``laser_scan_width``, ``laser_scan_height`` (int, 0)
        One histogram for every pair of sensor and laser position; layout ``(H, W, Lh, Lw, T, C)``.

    ``pulse``, ``irf`` (``gaussian`` | ``rectangular`` | ``tabulated``; none)
        Shape of the light's pulse and impulse response of the sensor, densities over optical path length: every arrival
        is spread by both. ``pulse_fwhm_opl``; ``pulse_width_opl``; ``pulse_opl`` and ``pulse_values`` (numbers between
        spaces or commas) give the shape, ``pulse_center_opl`` (0) shifts it; the same for ``irf``. See
        :class:`.temporal_filters.PulsedFilter`. With one of them every temporal filter has a slope.
    ``steady`` (bool, true)
        False: no steady image is asked for. Paths end where they are longer than the window, no shadow ray is traced
        for light that would arrive outside of it, and ``steady`` is the sum over the bins. No bin's expected value
        changes; light outside the window is not counted then.
    nested spectra (spectral variants)
        Response curves of the sensor's channels, as in ``specfilm``: the name of a spectrum is that of its channel,
        which holds the integral over wavelength (nm) of radiance times curve. See :class:`.colour.SensorResponse`.

    A bin holds radiance integrated over the bin: the sum over all bins is the steady image. Storage is ``(H, W, T,
    C)`` of the crop window with C = 1 in monochromatic variants, the number of response curves where there are
    some, and 3 otherwise (linear sRGB in spectral variants); in polarized variants four times as many: all of S0, then
    S1, S2, S3, in the sensor's frame. There are no alpha or weight channels. Light outside the window is not stored
    but counted: ``energy_before`` and ``energy_after`` are sums over pixels of the mean over channels (of S0). With
    the sum over the stored bins they make up the steady image, whatever the temporal filter: light that it spreads over
    the rim of the window counts as outside.

    The spatial reconstruction filter is applied by sampling it (each sample is moved by an offset drawn from the filter
    and weighted by its sign), so every filter works, negative lobes too, at the price of a box. It converges to the
    same image as splatting with ``sample_border`` (which is always on here); the noise of neighbouring pixels is
    independent.

    Sums are kept in single precision up to 2^16 samples per pixel (rounding at most 2e-4 of a bin, far below the
    noise), above in double precision, which doubles the memory while rendering.

    Not supported: alpha channel, half precision.
    """

    plugin = "transient_hdr_film"
    knows_exclusive_lanes = knows_crowds = True
    measures = "transient"
    pulsed_filter = PulsedFilter

    def __init__(self, props):
        super().__init__(props)
        self.temporal_bins = whole_number(props, "temporal_bins", 2048)
        self.bin_width_opl = number(props, "bin_width_opl", 0.003)
        self._filter_name = str(props.get("temporal_filter", "box"))
        self._gaussian_stddev = number(props, "gaussian_stddev", 0.5)
        self.keeps_steady = self.has_window = truth(props, "steady", default=True)
        self.pulses = [p for p in (pulse_of(props, name, self.plugin) for name in ("pulse", "irf")) if p is not None]
        self._check()
        # Temporal filters by what they were made for, since a renderer changes the film's and puts it back.
        self._filters = Filters()
        self.take_filter("", None)

    # ------------------------------------------------------------------------------------- parameters

    def _check(self):
        if self.temporal_bins < 1:
            raise SceneError(f"transient_hdr_film: temporal_bins must be at least 1, got {self.temporal_bins}.")
        if not 0 < self.bin_width_opl < float("inf"):
            raise SceneError(
                f"transient_hdr_film: bin_width_opl must be a positive length in metres, got {self.bin_width_opl}."
            )
        check_stddev(self._gaussian_stddev)

    @property
    def temporal_filter(self) -> str:
        """Name of the temporal filter: box, tent or gaussian."""
        return self._filter_name

    @temporal_filter.setter
    def temporal_filter(self, name: str):
        self.take_filter(name, None)

    @property
    def gaussian_stddev(self) -> float:
        """Standard deviation of the gaussian temporal filter in bins; without effect on the others."""
        return self._gaussian_stddev

    @gaussian_stddev.setter
    def gaussian_stddev(self, stddev: float):
        self.take_filter("", stddev)

    def take_filter(self, name: str, stddev: float | None):
        name, stddev = name or self._filter_name, self._gaussian_stddev if stddev is None else float(stddev)
        check_name(name)
        check_stddev(stddev)
        # Nothing is changed by a setting that cannot be used.
        self.filter = self._filter_for(name, stddev)
        self._filter_name, self._gaussian_stddev = name, stddev
        self._long = getattr(self.filter, "count", 0) > MAX_UNROLLED

    def _filter_for(self, name: str, stddev: float):
        """A pulse makes a table of the filter: it is made once for every setting that is used, and kept."""
        made_for = name, stddev if name == "gaussian" else None, self.bin_width_opl, tuple(self.pulses)
        found = self._filters.pop(made_for, None)
        if found is None:
            found = make_temporal_filter(name, stddev)
            if self.pulses:
                found = self.pulsed_filter(found, self.pulses, self.bin_width_opl)
        self._filters[made_for] = found
        while len(self._filters) > MAX_FILTERS:
            del self._filters[next(iter(self._filters))]
        return found

    @property
    def has_slope(self) -> bool:
        """The temporal filter has a slope."""
        return self.filter.has_slope

    def arrivals(self):
        if self.keeps_steady:
            return None
        return ArrivalWindow(-self.filter.reach[1] * self.bin_width_opl, self.last_arrival())

    def last_arrival(self):
        return (self.temporal_bins - self.filter.reach[0]) * self.bin_width_opl

    def traverse(self, cb):
        super().traverse(cb)
        for name in ("temporal_bins", "bin_width_opl", "start_opl"):
            cb.put(name, getattr(self, name), mi.ParamFlags.NonDifferentiable)

    # ---------------------------------------------------------------------------------------- storage

    def cube_shape(self) -> tuple[int, ...]:
        """Return the shape of the transient: (H, W, T, C) or (H, W, Lh, Lw, T, C)."""
        size = self.crop_size()
        return (int(size[1]), int(size[0]), *self.laser_shape(), self.temporal_bins, self.channel_count())

    # ----------------------------------------------------------------------------------- splat and read

    def bin_position(self, opl_from_start):
        """Return an arrival in units of bins, Float64.

        Args:
            opl_from_start: ``opl - start_opl``, metres, Float64.
        """
        return opl_from_start / mi.Float64(self.bin_width_opl)

    def create_event_block(self, job, base, match, most_events, tangents=False, exclusive=False, origin=None):
        if origin is None or tangents or self._long:
            return super().create_event_block(job, base, match, most_events, tangents, exclusive, origin)
        return HistogramBlock(self, job.band, base, match, exclusive, origin)

    def reduce_mode(self, cube, exclusive, crowded):
        """Return the mode of lanes that add to ``cube``."""
        # A processor takes lanes one by one: where many add, it costs more to look for those that share a bin than to
        # add each. Of a small array Dr.Jit gives every thread its own.
        looks = dr.backend_v(cube) is dr.JitBackend.LLVM and dr.width(cube) > dr.expand_threshold()
        return reduce_mode(exclusive, crowded and looks and self.temporal_bins >= MANY_BINS)

    def put(self, band, base, opl_from_start, value, active, exclusive=False, crowded=False, laser=None):
        """Add a contribution, see :meth:`~.base.TimeResolvedFilm.put`.

        Args:
            laser: index ``row * laser_scan_width + column`` of the laser position in an exhaustive scan, None
                otherwise.
        """
        cube = self.band_array(band)
        x = self.bin_position(opl_from_start)
        bins, channels = self.temporal_bins, len(value)
        base = self.pixel_base(base, laser)
        if self._long:
            layout = BinLayout(cube, base, channels, 1, bins, channels, exclusive)
            return put_long(layout, self.filter, x, value, None, active)
        mode = self.reduce_mode(cube, exclusive, crowded)
        return self.put_bins(cube, base, x, (0, bins), value, active, mode)

    def put_bins(self, cube, base, x, window, value, active, mode):
        """Add to the bins that the filter reaches.

        Args:
            cube: array of the band.
            base: index of bin 0, UInt32.
            x: arrival in bins, Float or Float64.
            window: stored bins, as (first one, one after the last).
            value: contribution by channel, list of Float.
            active: mask of lanes.
            mode: ``dr.ReduceMode`` of the additions.

        Returns:
            (share of the weight before the window, share behind it), Float.
        """
        channels = len(value)
        low, high = window
        before, after = mi.Float(0), mi.Float(0)
        first, taps = self.filter.weights(x)
        # Comparisons happen on floating point numbers: a negative one cast to an unsigned one would wrap into a bin.
        for offset, weight, _ in taps:
            k = first + offset
            before += dr.select(k < low, weight, 0)
            after += dr.select(k >= high, weight, 0)
            inside = active & (k >= low) & (k < high)
            # Bins may be counted from one in the middle of the window.
            number = mi.UInt32(k) if dr.type_v(k) == dr.VarType.Float64 else mi.UInt32(mi.Int32(k))
            index = dr.fma(number, channels, base)
            for c in range(channels):
                v = value[c] if len(taps) == 1 else value[c] * weight
                dr.scatter_reduce(dr.ReduceOp.Add, cube, type(cube)(v), index + c, inside, mode)
        return before, after

    def read(self, adjoint, base, opl_from_start, active, steady=None):
        flat, bin_stride, channel_stride = (None, 1, 1) if adjoint is None else adjoint
        x = self.bin_position(opl_from_start)
        channels = self.channel_count()
        if self._long:
            layout = BinLayout(flat, base, bin_stride, channel_stride, self.temporal_bins, channels)
            A, slope = read_long(layout, self.filter, x, active, steady)
            return A, [s * (1 / self.bin_width_opl) for s in slope]
        A, slope = [mi.Float(0)] * channels, [mi.Float(0)] * channels
        first, taps = self.filter.weights(x)
        for offset, weight, dweight in taps:
            k = first + offset
            inside = active & (k >= 0) & (k < self.temporal_bins)
            index = dr.fma(mi.UInt32(k), bin_stride, base)
            for c in range(channels):
                a = mi.Float(0) if steady is None else dr.select(inside, steady[c], 0)
                if flat is not None:
                    a += dr.gather(mi.Float, flat, index + c * channel_stride, inside)
                A[c] = dr.fma(a, weight, A[c])
                if self.filter.has_slope:
                    slope[c] = dr.fma(a, dweight * (1 / self.bin_width_opl), slope[c])
        return A, slope

    def put_slope(self, band, base, opl_from_start, d_value, value_d_opl, active, laser=None):
        cube = self.band_array(band)
        x = self.bin_position(opl_from_start)
        channels = self.channel_count()
        base = self.pixel_base(base, laser)
        if self._long:
            slopes = [v * (1 / self.bin_width_opl) for v in value_d_opl]
            layout = BinLayout(cube, base, channels, 1, self.temporal_bins, channels)
            put_long(layout, self.filter, x, d_value, slopes, active)
            return
        first, taps = self.filter.weights(x)
        for offset, weight, dweight in taps:
            k = first + offset
            inside = active & (k >= 0) & (k < self.temporal_bins)
            index = dr.fma(mi.UInt32(k), channels, base)
            for c in range(channels):
                v = d_value[c] * weight + value_d_opl[c] * (dweight * (1 / self.bin_width_opl))
                dr.scatter_reduce(dr.ReduceOp.Add, cube, type(cube)(v), index + c, inside)

    def to_string(self):
        return (
            f"TransientHDRFilm[\n  size = {self.size()},\n  crop = {self.crop_size()} at {self.crop_offset()},\n"
            f"  temporal_bins = {self.temporal_bins},\n  start_opl = {self.start_opl},\n"
            f"  bin_width_opl = {self.bin_width_opl},\n  temporal_filter = {self._filter_name},\n"
            f"  exhaustive_scan = {self.exhaustive_scan}\n]"
        )


register("film", "transient_hdr_film", TransientHDRFilm)
