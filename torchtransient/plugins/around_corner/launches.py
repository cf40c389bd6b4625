"""Kernel launches of a capture: pixels, samples, and lanes of each pixel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.errors import SceneError, ShapeError, VariantError
from torchtransient.plugins.around_corner.geometry import WallPoints
from torchtransient.plugins.films.colour import ChannelMatch

# Lanes that keep all cores busy: with fewer scan points each gets several lanes, which then add atomically.
_BUSY = {dr.JitBackend.LLVM: 2**12}
_BUSY_GPU = 2**17
# Connections of one launch, so that a progress bar moves: some ten seconds of one core.
_CONNECTIONS = 2**28
# Samples that a lane lists as events, for films that sum events up afterwards.
EVENTS = 16


@dataclass
class Launch:
    """Launch of some rows of pixels and some samples.

    Attributes:
        band: storage band of the film.
        first_row, rows: first row of pixels and number of rows.
        spp: lanes of a pixel, under the name that films read.
        width: pixels of a row.
        band_first_row: first row of the band.
        first, last: range of the samples, ``last`` exclusive.
        most_events: most events that a lane puts onto the film.
        lists_events: the film lists events, and the lanes of a pixel are neighbours.
    """

    band: int
    first_row: int
    rows: int
    spp: int
    width: int
    band_first_row: int
    first: int
    last: int
    most_events: int
    lists_events: bool

    @property
    def chunks(self) -> int:
        """Number of lanes of a pixel."""
        return self.spp

    def lanes(self) -> tuple[Any, Any, Any]:
        """Return pixel, first sample and last sample (exclusive) of each lane, ``UInt32``."""
        pixels = self.width * self.rows
        lane = dr.arange(mi.UInt32, pixels * self.chunks)
        if self.chunks == 1:
            pixel, chunk = lane, mi.UInt32(0)
        elif self.lists_events:
            # The events of a pixel stand together.
            chunks = dr.opaque(mi.UInt32, self.chunks)
            pixel = lane // chunks
            chunk = lane - pixel * chunks
        else:
            # Neighbouring lanes have the same samples, which are loaded once.
            count = dr.opaque(mi.UInt32, pixels)
            chunk = lane // count
            pixel = lane - chunk * count
        size = -(-(self.last - self.first) // self.chunks)
        first = dr.opaque(mi.UInt32, self.first) + chunk * dr.opaque(mi.UInt32, size)
        last = dr.minimum(first + dr.opaque(mi.UInt32, size), dr.opaque(mi.UInt32, self.last))
        return pixel + dr.opaque(mi.UInt32, self.first_row * self.width), first, last

    def base(self, film: Any, pixel: Any) -> Any:
        """Return the index of the first value of each lane's ``pixel`` in the band of the film."""
        base = (pixel - dr.opaque(mi.UInt32, self.band_first_row * self.width)) * film.entries_per_pixel()
        entry = film.first_entry()
        return base if entry is None else base + entry


def launches_of(film: Any, samples: int) -> list[Launch]:
    """Return the launches of ``samples`` samples for each pixel of a film.

    Args:
        film: film of the capture.
        samples: number for each pixel.
    """
    width = int(film.crop_size()[0])
    most = film.lanes_at_most(EVENTS)
    found = []
    for band, (band_first, band_rows) in enumerate(film.band_layout()):
        if most is None:
            found += _with_sums(band, band_first, band_rows, width, samples)
        else:
            found += _with_events(band, band_first, band_rows, width, samples, most)
    return found


def _with_sums(band: int, first_row: int, rows: int, width: int, samples: int) -> list[Launch]:
    """Return launches with a lane for each pixel, or several if there are few pixels."""
    busy = _BUSY.get(dr.backend_v(mi.Float), _BUSY_GPU)
    pixels = width * rows
    block = min(samples, max(1, _CONNECTIONS // pixels))
    chunks = min(max(1, busy // pixels), block)
    return [
        Launch(band, first_row, rows, chunks, width, first_row, k, min(k + block, samples), 1, False)
        for k in range(0, samples, block)
    ]


def _with_events(band: int, band_first: int, rows: int, width: int, samples: int, most: int) -> list[Launch]:
    """Return launches with lanes of ``EVENTS`` samples each, at most ``most`` lanes in a launch."""
    chunks = min(-(-samples // EVENTS), max(1, most // width))
    at_once = max(1, most // (width * chunks))
    found = []
    for row in range(band_first, band_first + rows, at_once):
        height = min(at_once, band_first + rows - row)
        for k in range(0, samples, chunks * EVENTS):
            last = min(k + chunks * EVENTS, samples)
            lanes = -(-(last - k) // EVENTS)
            found.append(Launch(band, row, height, lanes, width, band_first, k, last, EVENTS, True))
    return found


# ----------------------------------------------------------------------------------------------------------------------
# Jobs of a scan: scene, film, scan points, and the laser's energy.


class ScanJob:
    """Render of a scan, which adds light to a film.

    Args:
        scene: everything that can stand in the way, the wall too.
        film: film with a pixel for each scan point, row by row; between its ``prepare`` and ``finish_render``.
        sensors: the scan points.
        energy: energy of the laser by colour (J), a number or an ``UnpolarizedSpectrum``.
        progress: function of the fraction that is done, called after every launch; or None.

    Raises:
        VariantError: in spectral and polarized variants.
        ShapeError: for another number of scan points.
        SceneError: for a film that no render was started on.
    """

    def __init__(self, scene: Any, film: Any, sensors: WallPoints, energy: Any = 1.0, progress: Any = None) -> None:
        name = type(self).__name__
        if mi.is_spectral or mi.is_polarized:
            raise VariantError(
                f"{name}: expected a mono or RGB variant without polarization, got {mi.variant()}. Use the "
                "general path integrator."
            )
        width, height = (int(size) for size in film.crop_size())
        if sensors.width != width * height:
            raise ShapeError(
                f"{name}: expected a pixel of the film for every scan point, got {width} x {height} pixels and "
                f"{sensors.width} points."
            )
        if film.steady is None:
            raise SceneError(
                f"{name}: expected a film that a render was started on; call film.start_render(samples) before."
            )
        self.scene, self.film, self.sensors = scene, film, sensors
        self.energy = mi.UnpolarizedSpectrum(energy)
        dr.make_opaque(self.energy)
        self.match = ChannelMatch(None, mi.UnpolarizedSpectrum(1))
        self.window = film.arrivals()
        self.progress = progress

    def done(self, fraction: float, band: int) -> None:
        """Evaluate what was added to a ``band`` of the film, and report the ``fraction`` of the job."""
        dr.eval(self.film.bands[band][2], self.film.steady, self.film.outside)
        if self.progress:
            dr.sync_thread()
            self.progress(fraction)
