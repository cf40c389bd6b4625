"""Base of time-resolved films: storage in bands of rows, the steady image, sampling of the spatial filter."""

from __future__ import annotations

import abc
import math

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.errors import SceneError, StorageError
from torchtransient.interfaces import FilmInterface
from torchtransient.plugins.described_scene import note_scene
from torchtransient.plugins.drjit_pool import threads_for_files
from torchtransient.plugins.films.block import AdjointBlock, FilmBlock
from torchtransient.plugins.films.colour import SensorResponse
from torchtransient.plugins.frozen_state import says_it_can_be_recorded
from torchtransient.plugins.parameter_effect import ANY_KEY, VALUE, declare_effects
from torchtransient.plugins.properties import number, truth, whole_number


def _plain_image(film):
    """Return an ``hdrfilm`` of the same size, crop and filter in single precision: RGB, or luminance in mono variants.
    """
    size, crop, offset = film.size(), film.crop_size(), film.crop_offset()
    return mi.load_dict(
        {
            "type": "hdrfilm",
            "width": int(size[0]),
            "height": int(size[1]),
            "crop_width": int(crop[0]),
            "crop_height": int(crop[1]),
            "crop_offset_x": int(offset[0]),
            "crop_offset_y": int(offset[1]),
            "pixel_format": "luminance" if mi.is_monochromatic else "rgb",
            "component_format": "float32",
            "sample_border": film.sample_border(),
            "rfilter": film.rfilter(),
        }
    )


def bitmap_of(steady, names):
    """Return a steady image as a bitmap.

    Args:
        steady: TensorXf (H, W, C), channels of S0, S1, S2 and S3 in polarized variants.
        names: names of the channels.
    """
    if tuple(names) in (("L",), ("R", "G", "B")) and steady.shape[2] == len(names):
        return mi.Bitmap(steady)
    stokes = [f"{name}.S{s}" for s in range(4) for name in names] if steady.shape[2] > len(names) else list(names)
    return mi.Bitmap(steady, mi.Bitmap.PixelFormat.MultiChannel, channel_names=stokes)


# Dr.Jit arrays are indexed with 32 bits; a larger cube is stored in bands of whole rows.
MAX_ARRAY_ENTRIES = 2**32 - 1
# Above this many samples per pixel single precision sums lose mass: 2^16 equal terms are good to 2e-4 (5e-5 on 16-wide
# processors, which add up a packet first), 2^20 to 3e-4, 2^26 only to 1.5e-2. Larger jobs are summed in double
# precision.
MAX_SINGLE_PRECISION_SAMPLES = 2**16
# Pixels that a reconstruction filter may reach: more is no filter of an image, and its table loses its digits.
MOST_RADIUS = 4096
# From this many values on zeros are written by all threads, in a kernel of their own.
MANY_VALUES = 2**23


def zeros(real, size):
    """Return an array of zeros; large ones are written by all threads.

    ``dr.zeros`` lets one thread write them, which waits for every page of new memory.

    Args:
        real: type of the array.
        size: number of entries.
    """
    if dr.backend_v(real) is not dr.JitBackend.LLVM or size < MANY_VALUES:
        return dr.zeros(real, size)
    values = dr.gather(real, dr.opaque(real, 0), dr.zeros(mi.UInt32, size))
    dr.eval(values)
    return values


@FilmInterface.register
class TimeResolvedFilm(mi.Film):
    """Abstract base of films that keep an array behind every pixel beside the steady image.

    ``exhaustive_scan`` (bool, false), ``laser_scan_width``, ``laser_scan_height`` (int, 0): one array for every pair of
    sensor and laser position, ``(H, W, Lh, Lw, ...)``; the steady image is the sum over the laser's positions.

    A subclass owes the abstract members: ``plugin``, ``measures``, ``cube_shape``, and ``put``, which adds an arrival
    to the array, with its derivative ``put_slope`` and its adjoint ``read``. A class that lacks one of them is refused
    where it is registered. Everything else has a default; integrators and the renderer use no member beyond these.

    Path lengths are handed over as ``opl - start_opl`` in double precision. The array is stored in bands of whole
    rows, since Dr.Jit's indices have 32 bits; a *band* is given by its number, a *base* is the index of a pixel's first
    value in it. While a film holds a render, it has ``bands`` ((first row, rows, flat array) each), ``steady`` and
    ``outside`` (light before and after the window by pixel, None for films without a window).

    Children that are spectra are the response curves of the film's channels (``curves``,
    :class:`.colour.SensorResponse`).

    Integrators that know nothing of time (``path``, ``aov``, ``prb``, those of users) render an image to it, as to an
    ``hdrfilm``: RGB whatever the response curves, luminance in monochromatic variants, then what ``aov`` adds.
    """

    # One array for every pair of sensor and laser position.
    exhaustive_scan = False
    # There is a steady image beside the array, of light at any time; otherwise it is the sum over the array.
    keeps_steady = True
    # There is a window that light can miss, which is then counted in `outside`.
    has_window = True
    # `put` takes `exclusive`: every lane has an array of its own, so that sums need not be atomic.
    knows_exclusive_lanes = False
    # `put` takes `crowded`: most lanes add something at once.
    knows_crowds = False
    # Arrivals come with the rates at which their lengths change: `put`, `put_slope` and `read` take `rate`.
    knows_rates = False
    # The array changes smoothly with path lengths; otherwise the end of an error message that says what to do.
    has_slope = True
    slope_remedy = "Set temporal_filter to 'tent' or 'gaussian'."
    # Pulse of the light and impulse response of the sensor that spread every arrival.
    pulses = ()

    # ------------------------------------------------------------------------------------------ what a film owes

    @property
    @abc.abstractmethod
    def plugin(self) -> str:
        """Name of the plugin, for messages."""

    @property
    @abc.abstractmethod
    def measures(self) -> str:
        """Name of the measurement: ``transient``, ``phasor``, ``gated``, or the word of a film of one's own."""

    @abc.abstractmethod
    def cube_shape(self) -> tuple[int, ...]:
        """Return the shape of the array of the crop window: (H, W, entries, channels).

        In an exhaustive scan it is (H, W, Lh, Lw, entries, channels).
        """

    @abc.abstractmethod
    def put(self, band, base, opl_from_start, value, active, exclusive=False):
        """Add a contribution to the array.

        Args:
            band: number of the band.
            base: index of the pixel's first value in the band, UInt32.
            opl_from_start: ``opl - start_opl`` of the arrival, metres (Float64).
            value: contribution by channel, list of Float.
            active: mask of lanes.
            exclusive: no two lanes have the same base; for films with ``knows_exclusive_lanes`` alone. Films with
                ``knows_crowds`` take ``crowded`` too.

        Returns:
            The fractions of the contribution before and after the window, which are not stored.
        """

    @abc.abstractmethod
    def put_slope(self, band, base, opl_from_start, d_value, value_d_opl, active):
        """Add the derivative of an event, ``k df + f k' dtau`` with the film's response ``k``, in forward mode.

        Args:
            band, base, opl_from_start, active: number of the band, index of the pixel's first value there, optical path
                length of the arrival (metres) and mask of lanes, see :meth:`put`.
            d_value: ``df`` by channel.
            value_d_opl: ``f dtau`` by channel.
        """

    @abc.abstractmethod
    def read(self, adjoint, base, opl_from_start, active, steady=None):
        """Read the adjoint of :meth:`put` at an arrival.

        Args:
            adjoint: adjoint of the array as (flat array, stride of entries, stride of channels), or None.
            base: index of the pixel's first value in the array, UInt32.
            opl_from_start: ``opl - start_opl`` of the arrival, metres (Float64).
            active: mask of lanes.
            steady: adjoint of the sum over the array by channel, for films without a steady image of their own.

        Returns:
            ``A`` and its slope ``dA / d opl``, lists over channels.
        """

    # ------------------------------------------------------------------------------------------------ parameters

    def __init__(self, props):
        super().__init__(props)
        self.start_opl = number(props, "start_opl", 0.0)
        self.exhaustive_scan = truth(props, "exhaustive_scan", default=False)
        self.laser_scan_width = whole_number(props, "laser_scan_width", 0, least=0)
        self.laser_scan_height = whole_number(props, "laser_scan_height", 0, least=0)
        self._check_laser_grid()
        self.curves = SensorResponse.from_properties(props)
        self.bands = []
        self._lent = None
        self.steady = None
        self.outside = None
        self._image = None  # where an integrator that knows nothing of time has rendered
        self._offset_distribution = None

    def _check_laser_grid(self):
        laser = self.laser_scan_width, self.laser_scan_height
        if self.exhaustive_scan and min(laser) < 1:
            raise SceneError(
                f"{self.plugin}: exhaustive_scan needs laser_scan_width and laser_scan_height of at least 1, got "
                f"{laser[0]} x {laser[1]}."
            )
        if not self.exhaustive_scan and max(laser) > 0:
            raise SceneError(
                f"{self.plugin}: laser_scan_width and laser_scan_height have no effect without exhaustive_scan; set "
                "exhaustive_scan to true or leave them out."
            )

    def traverse(self, cb):
        super().traverse(cb)
        note_scene(self, cb)
        if self.curves is not None:
            for name, curve in zip(self.curves.names, self.curves.textures, strict=True):
                cb.put(name, curve, mi.ParamFlags.NonDifferentiable)

    # ---------------------------------------------------------- for integrators that know nothing of time

    def base_channels_count(self):
        return 1 if mi.is_monochromatic else 3

    def prepare(self, aovs=()):
        """Begin an image of an integrator without time, and return its number of channels.

        Args:
            aovs: names of further channels, behind the film's own.
        """
        self.clear()
        self._image = _plain_image(self)
        return self._image.prepare(list(aovs))

    def _begun_image(self):
        if self._image is None:
            raise SceneError(
                f"{self.plugin}: expected an image that was begun, prepare(aovs); integrators that know of time take "
                "start_render(samples) and create_event_block(...)."
            )
        return self._image

    def create_block(self, size=(0, 0), normalize=False, borders=False):
        """Return a block of the image, which :meth:`put_block` takes."""
        return self._begun_image().create_block(mi.ScalarVector2u(size), normalize, borders)

    def put_block(self, block):
        """Add a block to the image."""
        self._begun_image().put_block(block)

    def bitmap(self, raw: bool = False):
        """Return the image, or the steady image of a time-resolved render, as a ``mi.Bitmap``."""
        if self._image is not None:
            return self._image.bitmap(raw)
        return bitmap_of(self.develop(raw)[0], self.channel_names())

    def write(self, path):
        """Write :meth:`bitmap` to a file; the time-resolved array is in no picture."""
        with threads_for_files():
            self.bitmap().write(str(path))

    def schedule_storage(self):
        if self._image is not None:
            self._image.schedule_storage()
        elif self.steady is not None:
            dr.schedule(self.steady, self.outside, *(band[2] for band in self.bands))

    # ------------------------------------------------------------------------------------- for integrators

    @property
    def temporal_filter(self) -> str:
        """Name of the temporal filter, empty for films without one."""
        return ""

    @property
    def response_name(self) -> str:
        """Name of the response over time in messages."""
        return self.temporal_filter

    def take_filter(self, name: str, stddev: float | None):
        """Replace the temporal filter; films without one ignore the call.

        Args:
            name: name of the filter, empty to leave it.
            stddev: standard deviation of the filter in bins, None to leave it.
        """

    def arrivals(self):
        """Return the :class:`~.block.ArrivalWindow` of a film without a steady image, None where all light counts."""
        return

    def last_arrival(self) -> float | None:
        """Return the path length, minus ``start_opl``, behind which the array counts no light; None for no end."""
        window = self.arrivals()
        return None if window is None else window.last

    def lanes_at_most(self, most_events: int) -> int | None:
        """Return the largest number of paths of up to ``most_events`` events in a launch, None for no limit."""
        return None

    def create_event_block(
        self, job, base, match, most_events: int, tangents=False, exclusive=False, origin=None
    ) -> FilmBlock:
        """Return the block that samples of a launch write to.

        Args:
            job: launch, with the number of its band.
            base: index of each sample's first entry in the band.
            match: :class:`~.colour.ChannelMatch` of the samples.
            most_events: events of a path at most.
            tangents: events are derivatives (``put_slope``) instead of contributions (``put``).
            exclusive: every sample has a base of its own.
            origin: path length (``Float64``, by sample) that those of the events are counted from, which may come in
                single precision then; None for zero.
        """
        return FilmBlock(self, job.band, base, match, exclusive and self.knows_exclusive_lanes, origin)

    def create_adjoint_block(self, response, base, steady, match) -> AdjointBlock:
        """Return the block that samples of a launch read the adjoint from.

        Args:
            response: adjoint of the array as (flat array, stride of entries, stride of channels), or None.
            base: index of each sample's first entry in it.
            steady: adjoint of the steady image by channel.
            match: :class:`~.colour.ChannelMatch` of the samples.
        """
        return AdjointBlock(self, response, base, steady, match)

    # ---------------------------------------------------------------------------------------- storage

    def channel_count(self) -> int:
        """Return the number of channels, times four in polarized variants: all of S0, then S1, S2, S3."""
        return len(self.channel_names()) * (4 if mi.is_polarized else 1)

    def channel_names(self) -> tuple[str, ...]:
        """Return the names of the channels: response curves, else ("L",) in monochromatic variants and ("R", "G", "B").
        """
        if self.curves is not None:
            return self.curves.names
        return ("L",) if mi.is_monochromatic else ("R", "G", "B")

    def laser_count(self) -> int:
        """Return the number of laser positions of an exhaustive scan, otherwise 1."""
        return self.laser_scan_width * self.laser_scan_height if self.exhaustive_scan else 1

    def row_count(self) -> int:
        """Return the number of rows of (entries, channels) of one pixel and laser position."""
        return 1

    def laser_shape(self) -> tuple[int, ...]:
        """Return the dimensions of the array that belong to the laser: (Lh, Lw), or none."""
        return (self.laser_scan_height, self.laser_scan_width) if self.exhaustive_scan else ()

    def storage_shape(self) -> tuple[int, ...]:
        """Return the shape of the array while it is rendered; `finish_render` makes it :meth:`cube_shape`."""
        return self.cube_shape()

    def stored_adjoint(self, adjoint):
        """Return the adjoint of the array that is rendered to, from the adjoint of the film's array.

        Args:
            adjoint: adjoint in the shape :meth:`cube_shape`, as (flat array, offset, strides); the result has the
                shape :meth:`storage_shape`.
        """
        return adjoint

    def entries_per_array(self) -> int:
        """Return the number of floats of one pixel and laser position while it is rendered."""
        return self.row_count() * math.prod(self.storage_shape()[-2:])

    def entries_per_pixel(self) -> int:
        """Return the number of floats behind one pixel."""
        return self.laser_count() * self.entries_per_array()

    def pixel_base(self, base, laser):
        """Return the index of the array of one laser position.

        Args:
            base: index of the pixel's first value, UInt32.
            laser: ``row * laser_scan_width + column``, UInt32; None without a scan.
        """
        return base if laser is None else base + laser * self.entries_per_array()

    def band_rows(self) -> int:
        """Return the number of rows of one storage band: as many as 32-bit indices allow.

        Raises:
            StorageError: if one row has more than 2^32 values.
        """
        per_row = int(self.crop_size()[0]) * self.entries_per_pixel()
        rows = MAX_ARRAY_ENTRIES // per_row
        if rows < 1:
            raise StorageError(
                f"{self.plugin}: one row of {int(self.crop_size()[0])} pixels with {self.entries_per_pixel()} "
                "values each exceeds 2^32 values; use fewer bins or frequencies, a narrower crop or a smaller laser "
                "grid."
            )
        return min(rows, int(self.crop_size()[1]))

    def band_layout(self) -> list[tuple[int, int]]:
        """Return first row and number of rows of every band."""
        height, rows = self.cube_shape()[0], self.band_rows()
        return [(first, min(rows, height - first)) for first in range(0, height, rows)]

    def start_render(self, samples: int = 0):
        """Allocate zeroed storage.

        Args:
            samples: samples per pixel; sums of more than 2^16 are in double precision.

        Raises:
            StorageError: if such sums are asked for in an array that is lent (:meth:`lend`).
        """
        height, width = self.cube_shape()[:2]
        real = mi.Float64 if samples > MAX_SINGLE_PRECISION_SAMPLES else mi.Float
        per_row = width * self.entries_per_pixel()
        self._image = None
        self.clear()  # the memory of the last render is that of this one
        if self._lent is None:
            self.bands = [(first, rows, zeros(real, rows * per_row)) for first, rows in self.band_layout()]
        else:
            if real is not mi.Float:
                raise StorageError(
                    f"{self.plugin}: the array that was lent is summed up in single precision, up to "
                    f"{MAX_SINGLE_PRECISION_SAMPLES} samples per pixel; got {samples}. Render to one of its own."
                )
            self.bands = [(0, height, self._lent[0])]
        self.steady = dr.zeros(real, height * width * self.channel_count())
        # By pixel: one sum over all samples would drown small terms, and be one address that every thread waits for.
        self.outside = dr.zeros(real, height * width * 2) if self.has_window else None

    def add_steady(self, pixel, channels):
        """Add light to the steady image, unless the film sums it up of its array.

        Args:
            pixel: index of the pixels, UInt32.
            channels: light by channel, list of Float.
        """
        if self.keeps_steady:
            for c, value in enumerate(channels):
                index = pixel * self.channel_count() + c
                dr.scatter_reduce(dr.ReduceOp.Add, self.steady, type(self.steady)(value), index)

    def add_outside(self, pixel, before, after):
        """Count light that the window missed, in films with one.

        Args:
            pixel: index of the pixels, UInt32.
            before, after: energy before and after the window, Float.
        """
        if self.outside is not None:
            for side, value in enumerate((before, after)):
                dr.scatter_reduce(dr.ReduceOp.Add, self.outside, type(self.outside)(value), pixel * 2 + side)

    def finish_render(self):
        """Round sums to single precision, and sum up the steady image of a film that keeps none."""
        if dr.type_v(self.steady) != dr.type_v(mi.Float):
            self.bands = [(first, rows, mi.Float(flat)) for first, rows, flat in self.bands]
            self.steady = mi.Float(self.steady)
            if self.outside is not None:
                self.outside = mi.Float(self.outside)
            dr.eval(self.steady, self.outside, *(band[2] for band in self.bands))
        if not self.keeps_steady:
            self._sum_up()

    def _sum_up(self):
        width, channels = int(self.crop_size()[0]), self.channel_count()
        for first, rows, flat in self.bands:
            total = dr.sum(mi.TensorXf(flat, (rows * width, self.entries_per_pixel() // channels, channels)), axis=1)
            index = dr.arange(mi.UInt32, rows * width * channels) + first * width * channels
            dr.scatter(self.steady, total.array, index)

    def clear(self):
        """Drop the storage; tensors that were developed before keep their memory."""
        self.bands, self.steady, self.outside = [], None, None
        if self._image is not None:
            self._image.clear()

    def can_borrow(self, samples):
        """Return True if renders of ``samples`` per pixel can add to an array that is lent (:meth:`lend`)."""
        # Samplers may round up; a sum over the array needs one that starts with the film; classes made out of this one
        # may have storage of their own.
        in_single = 4 * samples <= MAX_SINGLE_PRECISION_SAMPLES and says_it_can_be_recorded(self)
        return in_single and len(self.band_layout()) == 1 and self.keeps_steady

    def lend(self, storage):
        """Let renders add to memory of the caller.

        Args:
            storage: memory as (flat array of zeros, index of the film's first entry); None for arrays of the film's
                own again.
        """
        self._lent = storage

    def first_entry(self):
        """Return the index of the film's first value in its band (``UInt32``), which is added to a base; None for 0."""
        return None if self._lent is None else dr.opaque(mi.UInt32, self._lent[1])

    def release_storage(self):
        """Return the arrays of a finished render, as :meth:`adopt_storage` takes them; the film keeps none of them.

        Other arrays of the film stay: Dr.Jit writes attributes of plugins back after a recorded call.
        """
        arrays = [self.steady, self.outside, *(band[2] for band in self.bands)]
        self.clear()
        return arrays

    def adopt_storage(self, arrays):
        """Take the ``arrays`` of :meth:`release_storage` as those of a render."""
        self.steady, self.outside, *stored = arrays
        self.bands = [(first, rows, flat) for (first, rows), flat in zip(self.band_layout(), stored, strict=True)]

    def transient_bands(self):
        """Return the storage as (first row, rows, flat array) for each band."""
        return self.bands

    def band_array(self, band: int):
        """Return the flat array of a band, which :meth:`put` adds to."""
        return self.bands[band][2]

    def check_one_band(self):
        """Raise ``StorageError`` where the array does not fit into one tensor."""
        if self.band_rows() < int(self.crop_size()[1]):
            raise StorageError(
                f"{self.plugin}: the cube {self.cube_shape()} exceeds the 2^32 values of one tensor; render with "
                "develop=False and read the film's transient_bands(), or use a smaller crop."
            )

    def develop(self, raw: bool = False):
        """Return the images of a render, without a copy.

        Returns:
            (steady ``(H, W, C)``, array of shape ``cube_shape()``); the image ``(H, W, C)`` alone where an integrator
            without time has rendered.

        Raises:
            SceneError: if nothing was rendered.
            StorageError: if the array has more than 2^32 entries: use :meth:`transient_bands`.
        """
        if self._image is not None:
            return self._image.develop(raw)
        if self.steady is None:
            raise SceneError(f"{self.plugin}: nothing was rendered yet; call render() first.")
        self.check_one_band()
        shape = self.cube_shape()
        steady = mi.TensorXf(self.steady, (shape[0], shape[1], self.channel_count()))
        return steady, mi.TensorXf(self.bands[0][2], shape)

    def energies_outside(self):
        """Return light before and after the window: sums over pixels, means over channels (of S0)."""
        if self.outside is None:
            return 0.0, 0.0
        before, after = np.array(self.outside).reshape(-1, 2).sum(0, dtype=np.float64)
        return float(before), float(after)

    @property
    def energy_before(self) -> float:
        """Light before the window."""
        return self.energies_outside()[0]

    @property
    def energy_after(self) -> float:
        """Light after the window."""
        return self.energies_outside()[1]

    # ----------------------------------------------------------------------------------- pixel sampling

    def tabulate_filter(self):
        """Tabulate the density of :meth:`sample_offset` once; called before anything is recorded.

        Raises:
            SceneError: for filters whose radius or values are out of range.
        """
        rfilter = self.rfilter()
        if rfilter.is_box_filter() or self._offset_distribution is not None:
            return
        radius = rfilter.radius()
        x = dr.linspace(mi.Float, -radius, radius, 513)
        h = rfilter.eval(x)
        dr.eval(h)
        largest = float(np.max(np.abs(np.array(h))))
        if not (0 < radius <= MOST_RADIUS and 1e-6 < largest < 1e6):
            raise SceneError(
                f"{self.plugin}: expected a reconstruction filter with a radius above 0 and up to {MOST_RADIUS} pixels "
                f"and values around one, got {rfilter.class_name()} of radius {radius:g} and values up to {largest:g}. "
                "Mend its radius, stddev, lobes, B or C."
            )
        # A floor keeps the density positive wherever the filter is not zero between two nodes.
        density = dr.maximum(dr.abs(h), 1e-4 * dr.max(dr.abs(h)))
        fine = np.array(rfilter.eval(dr.linspace(mi.Float, -radius, radius, (1 << 14) + 1)), dtype=np.float64)
        self._offset_distribution = (
            mi.ContinuousDistribution(mi.ScalarVector2f(-radius, radius), density),
            float((fine.sum() - 0.5 * (fine[0] + fine[-1])) * 2 * radius / (fine.size - 1)),
        )

    def sample_offset(self, sample):
        """Draw an offset from the pixel's centre, by the absolute value of the spatial filter.

        Args:
            sample: two uniform numbers, Point2f.

        Returns:
            (offset, Point2f, pixels; weight, Float, negative where the filter is; None for one).
        """
        rfilter = self.rfilter()
        if rfilter.is_box_filter():
            return sample - 0.5, None
        self.tabulate_filter()
        distribution, integral = self._offset_distribution
        x, pdf_x = distribution.sample_pdf(sample.x)
        y, pdf_y = distribution.sample_pdf(sample.y)
        weight = rfilter.eval(x) * rfilter.eval(y) / (pdf_x * pdf_y * integral * integral)
        return mi.Point2f(x, y), weight


# Where the film's axis and window lie; nothing of it carries gradients.
declare_effects(TimeResolvedFilm, {ANY_KEY: VALUE})
