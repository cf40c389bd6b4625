"""``transient_hdr_film``: a histogram over optical path length behind every pixel."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from torchtransient.errors import SceneError, StorageError
from torchtransient.plugins._registry import register
from torchtransient.plugins.films.temporal_filter import make_temporal_filter

# Dr.Jit arrays are indexed with 32 bits; a larger cube is stored in bands of whole rows.
MAX_ARRAY_ENTRIES = 2**32 - 1


class TransientHDRFilm(mi.Film):
    r"""Time-resolved film (:monosp:`transient_hdr_film`).

    Parameters beside those of ``hdrfilm`` (size, crop, ``rfilter``):

    ``temporal_bins`` (int, 2048), ``bin_width_opl`` (float, 0.003), ``start_opl`` (float, 0)
        Bins ``[start_opl + k bin_width_opl, start_opl + (k + 1) bin_width_opl)`` over optical path length in metres.
    ``temporal_filter`` (``box`` | ``tent`` | ``gaussian``; box), ``gaussian_stddev`` (float, 0.5 bins)
        How an arrival spreads over the bins, see :mod:`.temporal_filter`.
    ``exhaustive_scan`` (bool, false), ``laser_scan_width``, ``laser_scan_height`` (int, 0)
        One histogram for every pair of sensor and laser position; layout ``(H, W, Lh, Lw, T, C)``.

    A bin holds radiance integrated over the bin: the sum over all bins is the steady image. Storage is
    ``(H, W, T, C)`` of the crop window with C = 1 in monochromatic variants and 3 otherwise (linear sRGB in
    spectral ones); there are no alpha or weight channels. Light outside the window is not stored but counted: ``energy_before``
    and ``energy_after`` are sums over pixels of the mean over channels.

    The spatial reconstruction filter is applied by sampling it (each sample is moved by an offset drawn from the filter and
    weighted by its sign), so every filter works, negative lobes too, at the price of a box. It converges to the same
    image as splatting; the noise of neighbouring pixels is independent.

    Not supported: alpha channel, half precision.
    """

    def __init__(self, props):
        super().__init__(props)
        self.temporal_bins = int(props.get("temporal_bins", 2048))
        self.bin_width_opl = float(props.get("bin_width_opl", 0.003))
        self.start_opl = float(props.get("start_opl", 0.0))
        self._filter_name = str(props.get("temporal_filter", "box"))
        self.gaussian_stddev = float(props.get("gaussian_stddev", 0.5))
        self.exhaustive_scan = bool(props.get("exhaustive_scan", False))
        self.laser_scan_width = int(props.get("laser_scan_width", 0))
        self.laser_scan_height = int(props.get("laser_scan_height", 0))
        self._check()
        self.filter = make_temporal_filter(self._filter_name, self.gaussian_stddev)
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
        self.filter = make_temporal_filter(name, self.gaussian_stddev)
        self._filter_name = name

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
        """1 in monochromatic variants, 3 otherwise."""
        return 1 if mi.is_monochromatic else 3

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
                f"transient_hdr_film: one row of {int(self.crop_size()[0])} pixels with {self.entries_per_pixel()} values "
                "each exceeds 2^32 values; use fewer bins, a narrower crop or a smaller laser grid."
            )
        return min(rows, int(self.crop_size()[1]))

    def prepare(self, aovs=()):
        """Allocate zeroed storage for one render. Returns the number of channels."""
        if len(aovs):
            raise SceneError(f"transient_hdr_film: arbitrary output variables are not supported, got {list(aovs)}.")
        if mi.is_polarized:
            raise SceneError("transient_hdr_film: polarized variants are not supported; use the unpolarized one.")
        height, width = self.cube_shape()[:2]
        rows = self.band_rows()
        self.bands = []
        for first in range(0, height, rows):
            count = min(rows, height - first)
            self.bands.append((first, count, dr.zeros(mi.Float, count * width * self.entries_per_pixel())))
        self.steady = dr.zeros(mi.Float, height * width * self.channel_count())
        self.outside = dr.zeros(mi.Float, 2)
        return self.channel_count()

    def clear(self):
        """Drop the storage; tensors developed before keep their memory."""
        self.bands, self.steady, self.outside = [], None, None

    def transient_bands(self):
        """The storage as (first row, rows, flat array) for each band."""
        return self.bands

    def develop(self, raw: bool = False):
        """The pair (steady ``(H, W, C)``, transient ``cube_shape()``), without a copy.

        A cube of more than 2^32 entries cannot be one Dr.Jit tensor: use :meth:`transient_bands`.
        """
        if self.steady is None:
            raise SceneError("transient_hdr_film: nothing was rendered yet; call render() first.")
        if len(self.bands) > 1:
            raise StorageError(
                f"transient_hdr_film: the cube {self.cube_shape()} exceeds one array; read it by transient_bands()."
            )
        shape = self.cube_shape()
        steady = mi.TensorXf(self.steady, (shape[0], shape[1], shape[-1]))
        return steady, mi.TensorXf(self.bands[0][2], shape)

    @property
    def energy_before(self) -> float:
        """Light that arrived before ``start_opl``: sum over pixels, mean over channels."""
        return float(self.outside[0]) if self.outside is not None else 0.0

    @property
    def energy_after(self) -> float:
        """Light that arrived at or after :meth:`end_opl`: sum over pixels, mean over channels."""
        return float(self.outside[1]) if self.outside is not None else 0.0

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
            fine = dr.linspace(mi.Float, -radius, radius, 1 << 14)
            mean = dr.mean(rfilter.eval(fine))
            self._offset_distribution = (
                mi.ContinuousDistribution(mi.ScalarVector2f(-radius, radius), density),
                float(mean[0] * 2 * radius),
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

    def put(self, cube, base, opl_from_start, value, active):
        """Add ``value`` (a list of channel values) at ``opl - start_opl`` to the histogram that begins at ``base``.

        Returns the masks (arrived before the window, arrived after it); what a filter spreads over the rim of the window
        is lost there, as it would be for a wider window.
        """
        x = self.bin_position(opl_from_start)
        bins, channels = self.temporal_bins, self.channel_count()
        first, taps = self.filter.weights(x)
        # Comparisons happen on doubles, before the cast: a negative number cast to an unsigned one would wrap into a bin.
        for offset, weight, _ in taps:
            k = first + offset
            inside = active & (k >= 0) & (k < bins)
            index = dr.fma(mi.UInt32(k), channels, base)
            for c in range(channels):
                v = value[c] if len(taps) == 1 else value[c] * weight
                dr.scatter_reduce(dr.ReduceOp.Add, cube, v, index + c, inside)
        return x < 0, x >= bins

    def read(self, adjoint, base, opl_from_start, active):
        """``A`` and its slope ``dA / d opl`` for an arrival: lists over channels.

        ``adjoint`` is ``(flat array, bin stride, channel stride)``.
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

    def put_slope(self, cube, base, opl_from_start, d_value, value_d_opl, active):
        """Forward mode: add ``k df + f k' dtau`` to the derivative cube."""
        x = self.bin_position(opl_from_start)
        channels = self.channel_count()
        first, taps = self.filter.weights(x)
        for offset, weight, dweight in taps:
            k = first + offset
            inside = active & (k >= 0) & (k < self.temporal_bins)
            index = dr.fma(mi.UInt32(k), channels, base)
            for c in range(channels):
                v = d_value[c] * weight + value_d_opl[c] * (dweight * (1 / self.bin_width_opl))
                dr.scatter_reduce(dr.ReduceOp.Add, cube, v, index + c, inside)

    def to_string(self):
        return (
            f"TransientHDRFilm[\n  size = {self.size()},\n  crop = {self.crop_size()} at {self.crop_offset()},\n"
            f"  temporal_bins = {self.temporal_bins},\n  start_opl = {self.start_opl},\n"
            f"  bin_width_opl = {self.bin_width_opl},\n  temporal_filter = {self._filter_name},\n"
            f"  exhaustive_scan = {self.exhaustive_scan}\n]"
        )


register("film", "transient_hdr_film", TransientHDRFilm)
