"""``transient_hdr_film``: a histogram over optical path length behind every pixel."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.errors import SceneError, StorageError
from torchtransient.plugins._registry import register
from torchtransient.plugins.films.temporal_filter import check_stddev, make_temporal_filter

# Dr.Jit arrays are indexed with 32 bits; a larger cube is stored in bands of whole rows.
MAX_ARRAY_ENTRIES = 2**32 - 1
# Above this many samples per pixel single precision sums lose mass: 2^16 equal terms are good to 2e-4 (5e-5 on 16-wide
# processors, which add up a packet first), 2^20 to 3e-4, 2^26 only to 1.5e-2. Larger jobs are summed in double
# precision.
MAX_SINGLE_PRECISION_SAMPLES = 2**16


class TransientHDRFilm(mi.Film):
    r"""Time-resolved film (:monosp:`transient_hdr_film`).

    Parameters beside those of ``hdrfilm`` (size, crop, ``rfilter``):

    ``temporal_bins`` (int, 2048), ``bin_width_opl`` (float, 0.003), ``start_opl`` (float, 0)
        Bins ``[start_opl + k bin_width_opl, start_opl + (k + 1) bin_width_opl)`` over optical path length in metres.
    ``temporal_filter`` (``box`` | ``tent`` | ``gaussian``; box), ``gaussian_stddev`` (float, 0.5 bins)
        How an arrival spreads over the bins, see :mod:`.temporal_filter`.
    ``exhaustive_scan`` (bool, false), ``laser_scan_width``, ``laser_scan_height`` (int, 0)
        One histogram for every pair of sensor and laser position; layout ``(H, W, Lh, Lw, T, C)``.

    A bin holds radiance integrated over the bin: the sum over all bins is the steady image. Storage is ``(H, W, T, C)``
    of the crop window with C = 1 in monochromatic variants and 3 otherwise (linear sRGB in spectral ones), in polarized
    ones four times as many: all of S0, then S1, S2, S3, in the sensor's frame. There are no alpha or weight channels.
    Light outside the window is not stored but counted: ``energy_before`` and ``energy_after`` are sums over pixels of
    the mean over channels (of S0). With the sum over the stored bins they make up the steady image,
    whatever the temporal filter: what it spreads over the rim of the window counts as outside.

    The spatial reconstruction filter is applied by sampling it (each sample is moved by an offset drawn from the filter
    and weighted by its sign), so every filter works, negative lobes too, at the price of a box. It converges to the
    same image as splatting with ``sample_border`` (which is always on here); the noise of neighbouring pixels is
    independent.

    Sums are kept in single precision up to 2^16 samples per pixel (rounding at most 2e-4 of a bin, far below the
    noise), above in double precision, which doubles the memory while rendering.

    Not supported: alpha channel, half precision.
    """

    def __init__(self, props):
        super().__init__(props)
        self.temporal_bins = int(props.get("temporal_bins", 2048))
        self.bin_width_opl = float(props.get("bin_width_opl", 0.003))
        self.start_opl = float(props.get("start_opl", 0.0))
        self._filter_name = str(props.get("temporal_filter", "box"))
        self._gaussian_stddev = float(props.get("gaussian_stddev", 0.5))
        self.exhaustive_scan = bool(props.get("exhaustive_scan", False))
        self.laser_scan_width = int(props.get("laser_scan_width", 0))
        self.laser_scan_height = int(props.get("laser_scan_height", 0))
        self._check()
        self.filter = make_temporal_filter(self._filter_name, self._gaussian_stddev)
        self.bands = []
        self.steady = None
        self.outside = None
        self._offset_distribution = None

    # ------------------------------------------------------------------------------------- parameters

    def _check(self):
        if self.temporal_bins < 1:
            raise SceneError(f"transient_hdr_film: temporal_bins must be at least 1, got {self.temporal_bins}.")
        if not 0 < self.bin_width_opl < float("inf"):
            raise SceneError(
                f"transient_hdr_film: bin_width_opl must be a positive length in metres, got {self.bin_width_opl}."
            )
        if not abs(self.start_opl) < float("inf"):
            raise SceneError(f"transient_hdr_film: start_opl must be a finite length in metres, got {self.start_opl}.")
        check_stddev(self._gaussian_stddev)
        laser = self.laser_scan_width, self.laser_scan_height
        if self.exhaustive_scan and min(laser) < 1:
            raise SceneError(
                "transient_hdr_film: exhaustive_scan needs laser_scan_width and laser_scan_height of at least 1, "
                f"got {laser[0]} x {laser[1]}."
            )
        if not self.exhaustive_scan and max(laser) > 0:
            raise SceneError(
                "transient_hdr_film: laser_scan_width and laser_scan_height have no effect without exhaustive_scan; "
                "set exhaustive_scan to true or leave them out."
            )

    @property
    def temporal_filter(self) -> str:
        """Name of the temporal filter: box, tent or gaussian."""
        return self._filter_name

    @temporal_filter.setter
    def temporal_filter(self, name: str):
        self.filter = make_temporal_filter(name, self._gaussian_stddev)
        self._filter_name = name

    @property
    def gaussian_stddev(self) -> float:
        """Standard deviation of the gaussian temporal filter in bins; without effect on the others."""
        return self._gaussian_stddev

    @gaussian_stddev.setter
    def gaussian_stddev(self, stddev: float):
        check_stddev(stddev)
        self._gaussian_stddev = float(stddev)
        self.filter = make_temporal_filter(self._filter_name, self._gaussian_stddev)

    def end_opl(self) -> float:
        """End of the last bin in metres."""
        return self.start_opl + self.bin_width_opl * self.temporal_bins

    def traverse(self, cb):
        super().traverse(cb)
        for name in ("temporal_bins", "bin_width_opl", "start_opl"):
            cb.put(name, getattr(self, name), mi.ParamFlags.NonDifferentiable)

    def base_channels_count(self):
        return self.channel_count()

    # ---------------------------------------------------------------------------------------- storage

    def channel_count(self) -> int:
        """1 in monochromatic variants and 3 otherwise, times 4 Stokes components in polarized ones."""
        return (1 if mi.is_monochromatic else 3) * (4 if mi.is_polarized else 1)

    def laser_count(self) -> int:
        """Number of laser positions of an exhaustive scan, otherwise 1."""
        return self.laser_scan_width * self.laser_scan_height if self.exhaustive_scan else 1

    def cube_shape(self) -> tuple[int, ...]:
        """Shape of the transient: (H, W, T, C) or (H, W, Lh, Lw, T, C)."""
        size = self.crop_size()
        laser = (self.laser_scan_height, self.laser_scan_width) if self.exhaustive_scan else ()
        return (int(size[1]), int(size[0]), *laser, self.temporal_bins, self.channel_count())

    def entries_per_pixel(self) -> int:
        """Floats behind one pixel."""
        return self.laser_count() * self.temporal_bins * self.channel_count()

    def band_rows(self) -> int:
        """Rows of one storage band: as many as 32-bit indices allow."""
        per_row = int(self.crop_size()[0]) * self.entries_per_pixel()
        rows = MAX_ARRAY_ENTRIES // per_row
        if rows < 1:
            raise StorageError(
                f"transient_hdr_film: one row of {int(self.crop_size()[0])} pixels with {self.entries_per_pixel()} "
                "values each exceeds 2^32 values; use fewer bins, a narrower crop or a smaller laser grid."
            )
        return min(rows, int(self.crop_size()[1]))

    def band_layout(self) -> list[tuple[int, int]]:
        """The storage bands as (first row, rows); one, unless the cube exceeds 32-bit indices."""
        height, rows = self.cube_shape()[0], self.band_rows()
        return [(first, min(rows, height - first)) for first in range(0, height, rows)]

    def prepare(self, aovs=(), samples: int = 0):
        """Allocate zeroed storage for one render of ``samples`` per pixel. Returns the number of channels."""
        if len(aovs):
            raise SceneError(f"transient_hdr_film: arbitrary output variables are not supported, got {list(aovs)}.")
        height, width = self.cube_shape()[:2]
        real = mi.Float64 if samples > MAX_SINGLE_PRECISION_SAMPLES else mi.Float
        per_row = width * self.entries_per_pixel()
        self.bands = [(first, rows, dr.zeros(real, rows * per_row)) for first, rows in self.band_layout()]
        self.steady = dr.zeros(real, height * width * self.channel_count())
        # By pixel: one sum over all samples would drown small terms, and be one address that every thread waits for.
        self.outside = dr.zeros(real, height * width * 2)
        return self.channel_count()

    def settle(self):
        """End of a render: sums kept in double precision become single precision."""
        if dr.type_v(self.steady) != dr.type_v(mi.Float):
            self.bands = [(first, rows, mi.Float(flat)) for first, rows, flat in self.bands]
            self.steady, self.outside = mi.Float(self.steady), mi.Float(self.outside)
            dr.eval(self.steady, self.outside, *(band[2] for band in self.bands))

    def clear(self):
        """Drop the storage; tensors developed before keep their memory."""
        self.bands, self.steady, self.outside = [], None, None

    def transient_bands(self):
        """The storage as (first row, rows, flat array) for each band."""
        return self.bands

    def check_one_band(self):
        """Raise ``StorageError`` when the cube does not fit into one tensor."""
        if self.band_rows() < int(self.crop_size()[1]):
            raise StorageError(
                f"transient_hdr_film: the cube {self.cube_shape()} exceeds the 2^32 values of one tensor; render with "
                "develop=False and read the film's transient_bands(), or use a smaller crop."
            )

    def develop(self, raw: bool = False):
        """The pair (steady ``(H, W, C)``, transient ``cube_shape()``), without a copy.

        A cube of more than 2^32 entries cannot be one Dr.Jit tensor: use :meth:`transient_bands`.
        """
        if self.steady is None:
            raise SceneError("transient_hdr_film: nothing was rendered yet; call render() first.")
        self.check_one_band()
        shape = self.cube_shape()
        steady = mi.TensorXf(self.steady, (shape[0], shape[1], shape[-1]))
        return steady, mi.TensorXf(self.bands[0][2], shape)

    @property
    def energy_before(self) -> float:
        """Light that arrived before ``start_opl``: sum over pixels, mean over channels."""
        return self._energy_outside(0)

    @property
    def energy_after(self) -> float:
        """Light that arrived at or after :meth:`end_opl`: sum over pixels, mean over channels."""
        return self._energy_outside(1)

    def _energy_outside(self, side: int) -> float:
        return 0.0 if self.outside is None else float(np.array(self.outside, dtype=np.float64)[side::2].sum())

    # ----------------------------------------------------------------------------------- pixel sampling

    def sample_offset(self, sample):
        """Offset from the pixel's centre drawn from the spatial filter, and the sample's weight."""
        rfilter = self.rfilter()
        if rfilter.is_box_filter():
            return sample - 0.5, None
        if self._offset_distribution is None:
            radius = rfilter.radius()
            x = dr.linspace(mi.Float, -radius, radius, 513)
            h = rfilter.eval(x)
            dr.eval(h)
            # A floor keeps the density positive wherever the filter is not zero between two nodes.
            density = dr.maximum(dr.abs(h), 1e-4 * dr.max(dr.abs(h)))
            fine = np.array(rfilter.eval(dr.linspace(mi.Float, -radius, radius, (1 << 14) + 1)), dtype=np.float64)
            self._offset_distribution = (
                mi.ContinuousDistribution(mi.ScalarVector2f(-radius, radius), density),
                float((fine.sum() - 0.5 * (fine[0] + fine[-1])) * 2 * radius / (fine.size - 1)),
            )
        distribution, integral = self._offset_distribution
        x, pdf_x = distribution.sample_pdf(sample.x)
        y, pdf_y = distribution.sample_pdf(sample.y)
        weight = rfilter.eval(x) * rfilter.eval(y) / (pdf_x * pdf_y * integral * integral)
        return mi.Point2f(x, y), weight

    # ----------------------------------------------------------------------------------- splat and read

    def bin_position(self, opl_from_start):
        """Arrival in units of bins from ``opl - start_opl`` (``Float64``)."""
        return opl_from_start / mi.Float64(self.bin_width_opl)

    def pixel_base(self, base, laser):
        """Index of the histogram of one laser position, where ``base`` is that of a pixel's first one."""
        return base if laser is None else base + laser * (self.temporal_bins * self.channel_count())

    def put(self, cube, base, opl_from_start, value, active, laser=None):
        """Add ``value`` (a list of channel values) at ``opl - start_opl`` to the histogram that begins at ``base``.

        ``laser`` is the index ``row * laser_scan_width + column`` of the laser position in an exhaustive scan, None
        otherwise. Returns the fractions of ``value`` that belong to bins before the window and to bins after it; they
        are not stored.
        """
        x = self.bin_position(opl_from_start)
        bins, channels = self.temporal_bins, self.channel_count()
        base = self.pixel_base(base, laser)
        before, after = mi.Float(0), mi.Float(0)
        first, taps = self.filter.weights(x)
        # Comparisons happen on doubles, before the cast: a negative number cast to an unsigned one would wrap into a
        # bin.
        for offset, weight, _ in taps:
            k = first + offset
            before += dr.select(k < 0, weight, 0)
            after += dr.select(k >= bins, weight, 0)
            inside = active & (k >= 0) & (k < bins)
            index = dr.fma(mi.UInt32(k), channels, base)
            for c in range(channels):
                v = value[c] if len(taps) == 1 else value[c] * weight
                dr.scatter_reduce(dr.ReduceOp.Add, cube, type(cube)(v), index + c, inside)
        return before, after

    def read(self, adjoint, base, opl_from_start, active):
        """``A`` and its slope ``dA / d opl`` for an arrival: lists over channels.

        ``adjoint`` is ``(flat array, bin stride, channel stride)`` and ``base`` the index of the histogram's first
        value in it.
        """
        flat, bin_stride, channel_stride = adjoint
        x = self.bin_position(opl_from_start)
        channels = self.channel_count()
        A, slope = [mi.Float(0)] * channels, [mi.Float(0)] * channels
        first, taps = self.filter.weights(x)
        for offset, weight, dweight in taps:
            k = first + offset
            inside = active & (k >= 0) & (k < self.temporal_bins)
            index = dr.fma(mi.UInt32(k), bin_stride, base)
            for c in range(channels):
                a = dr.gather(mi.Float, flat, index + c * channel_stride, inside)
                A[c] = dr.fma(a, weight, A[c])
                if self.filter.has_slope:
                    slope[c] = dr.fma(a, dweight * (1 / self.bin_width_opl), slope[c])
        return A, slope

    def put_slope(self, cube, base, opl_from_start, d_value, value_d_opl, active, laser=None):
        """Forward mode: add ``k df + f k' dtau`` to the derivative cube; arguments as for :meth:`put`."""
        x = self.bin_position(opl_from_start)
        channels = self.channel_count()
        base = self.pixel_base(base, laser)
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
