"""What brings light of a scan to a film, whichever way: scene, film, scan points, and the laser's energy."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from torchtransient.errors import SceneError, ShapeError, VariantError
from torchtransient.plugins.around_corner.wall_points import WallPoints
from torchtransient.plugins.films.colour import ChannelMatch


class ScanJob:
    """``film``: one with a pixel for each scan point, row by row, on which ``prepare`` was called (and
    ``finish_render`` will be): light is added to what it holds. ``sensors``: the scan points; ``energy`` (J, a number
    or an ``UnpolarizedSpectrum``): of the laser, by colour. ``scene``: everything that can stand in the way, the wall
    too. ``progress(fraction)`` is called after every kernel launch. Raises SceneError, ShapeError, VariantError.
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
        """Run what is recorded."""
        dr.eval(self.film.bands[band][2], self.film.steady, self.film.outside)
        if self.progress:
            dr.sync_thread()
            self.progress(fraction)
