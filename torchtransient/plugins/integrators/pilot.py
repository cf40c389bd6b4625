"""A pilot run: a few thousand paths of an integrator, every event listed instead of summed.

The paths are those of the integrator itself; only the film is replaced, by one that writes down each arrival with its
depth. What a plan wants to know (how deep, from when until when) is then a question to a list.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.errors import VariantError
from torchtransient.plugins.films.colour import ChannelMatch, mean_of
from torchtransient.plugins.guards import no_collection
from torchtransient.plugins.integrators.job import Pass, seed_array
from torchtransient.plugins.transport.sinks import EventListSink
from torchtransient.plugins.transport.velocities import Velocities
from torchtransient.plugins.transport.walk import walk

# Depth of a pilot's paths. Russian roulette ends most of them long before.
PILOT_DEPTH = 512
PILOT_RR_DEPTH = 5
# Room for so many events per path at first; more is made when they do not fit, at the price of fewer paths.
_EVENTS_PER_PATH = 64
_MAX_EVENTS = 2**22


@dataclass(frozen=True)
class PilotEvents:
    """Arrivals of a pilot run, N of them in no particular order.

    Attributes:
        opl: optical path length, (N,), metres, float64.
        energy: contribution to the mean over the image of the mean over wavelengths or channels, (N,), float64.
        depth: smallest ``max_depth`` of a render that contains it, (N,).
        path: number of the camera path, (N,).
        pixel: pixel of the path on the pilot's film, (N,).
        rate: rate of the path, (N,), m/s, float64; zero for a sensor whose film measures no rates.
        paths: number of camera paths.
        size: width and height of the pilot's film.
    """

    opl: np.ndarray
    energy: np.ndarray
    depth: np.ndarray
    path: np.ndarray
    pixel: np.ndarray
    rate: np.ndarray
    paths: int
    size: tuple[int, int]


class _PilotFilm:
    """Stands in for the sensor's film: the same view at another resolution, box filter, no storage."""

    start_opl = 0.0
    exhaustive_scan = False

    def __init__(self, film, size: tuple[int, int]):
        self._size = mi.ScalarVector2u(*size)
        self.curves, self.knows_rates = film.curves, film.knows_rates

    def crop_size(self):
        return self._size

    def sample_offset(self, sample):
        return sample - 0.5, None


def _pilot_size(film, pixels: int) -> tuple[int, int]:
    """Width and height of a film of about ``pixels`` pixels in the proportions of ``film``, no more than it has."""
    width, height = (int(n) for n in film.crop_size())
    shrink = min(1.0, (pixels / (width * height)) ** 0.5)
    return max(1, round(width * shrink)), max(1, round(height * shrink))


def pilot_events(scene, integrator, sensor, *, seed: int, pixels: int, paths: int, roulette=True) -> PilotEvents:
    """Trace camera paths of a transient integrator and list the light that arrives.

    ``max_depth`` is :data:`PILOT_DEPTH` for the run, and Russian roulette starts at :data:`PILOT_RR_DEPTH` at the
    latest.

    Args:
        scene: Mitsuba scene.
        integrator: transient integrator of this library.
        sensor: sensor of ``scene`` with one of the library's films, or its number.
        seed: seed of the sampler.
        pixels: pixels of the pilot's film, about.
        paths: camera paths, about.
        roulette: False: paths are not ended at random.

    Raises:
        VariantError: in polarized variants.
        SceneError: for scenes that the integrator cannot render; other errors of the integrator pass through.
    """
    if mi.is_polarized:
        raise VariantError(
            f"pilot_events: expected a variant without polarization, which changes neither depths nor times, got "
            f"{mi.variant()!r}; load the scene in {mi.variant().removesuffix('_polarized')!r}."
        )
    sensor, film = integrator.resolve(scene, sensor)
    size = _pilot_size(film, pixels)
    slots = _EVENTS_PER_PATH
    while True:
        spp = max(1, min(paths, _MAX_EVENTS // slots) // (size[0] * size[1]))
        events, spp, most = _trace(scene, integrator, sensor, _PilotFilm(film, size), size, spp, seed, slots, roulette)
        if most <= slots:
            break
        slots = most + most // 8
    depth = np.array(events.depth, dtype=np.int64)
    filled = np.flatnonzero(depth)
    path = filled // slots
    return PilotEvents(
        opl=np.array(events.opl, dtype=np.float64)[filled],
        energy=np.array(events.energy, dtype=np.float64)[filled],
        depth=depth[filled],
        path=path,
        pixel=path // spp,
        rate=np.array(events.rate, dtype=np.float64)[filled],
        paths=size[0] * size[1] * spp,
        size=size,
    )


@no_collection()
def _trace(scene, integrator, sensor, film, size, spp, seed, slots, roulette) -> tuple[EventListSink, int, int]:
    """The events, the samples per pixel, and the largest number of events of a path, which may be more than it had
    slots for.
    """
    sampler = integrator.sampler_of(scene, sensor)
    sampler.set_sample_count(spp)
    spp = sampler.sample_count()
    with dr.suspend_grad():
        job = Pass(band=0, first_row=0, rows=size[1], spp=spp, total=spp * size[0] * size[1], seed=seed_array(seed))
        contents = integrator.contents(scene, sensor)
        rays = integrator.start(scene, contents, sensor, film, job)
        ray = dr.detach(rays.ray)
        match = ChannelMatch(ray.wavelengths, rays.weight * rays.scale, film.curves)
        sink = EventListSink(size[0] * size[1] * spp, slots, lambda value: _energy(match, value, film.curves))
        # Without a window: what the sensor's film would not count is asked for, too.
        settings = integrator.settings()
        # Light of one number of bounces alone is not to be told apart by its depth.
        deepest = settings.max_depth if getattr(integrator, "only_bounces", None) is not None else PILOT_DEPTH
        first = min(settings.rr_depth, PILOT_RR_DEPTH) if roulette else PILOT_DEPTH
        settings = replace(settings, max_depth=deepest, rr_depth=first)
        velocities = Velocities.of_job(scene, contents, film)
        context = integrator.render_context(scene, contents, settings=settings, velocities=velocities)
        walk(context, rays.sampler, integrator.primary_path(context, film, rays), sink)
        most = dr.max(sink.used)
        dr.eval(most, sink.opl, sink.energy, sink.depth, sink.rate)
        dr.sync_thread()
    return sink, spp, int(most[0])


def _energy(match, value, curves):
    """Never negative: wavelengths are averaged, since single ones have colours outside of sRGB."""
    return dr.mean(value * match.weight) if curves is None else mean_of(match.to_channels(value))
