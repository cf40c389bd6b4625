"""A pilot run: a few thousand paths of an integrator, every event listed instead of summed.

The paths are those of the integrator itself; only the film is replaced, by one that writes down each arrival with its
depth. What a plan wants to know (how deep, from when until when) is then a question to a list.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient._collection import no_collection
from torchtransient.plugins.films.colour import ChannelMatch, mean_of
from torchtransient.plugins.integrators.base import Pass

# Depth of a pilot's paths. Russian roulette ends most of them long before.
PILOT_DEPTH = 512
PILOT_RR_DEPTH = 5
# Room for so many events per path at first; more is made when they do not fit, at the price of fewer paths.
_EVENTS_PER_PATH = 64
_MAX_EVENTS = 2**22


@dataclass(frozen=True)
class PilotEvents:
    """Arrivals of a pilot run, in no particular order, N of them from ``paths`` camera paths.

    ``opl`` (N,) float64, metres of optical path. ``energy`` (N,) float64: contribution to the mean over the image of
    the mean over wavelengths or channels. ``depth`` (N,): smallest ``max_depth`` of a render that contains it.
    ``path`` (N,): number of the camera path; ``pixel`` (N,): its pixel on the pilot's film of ``size`` (width, height).
    """

    opl: np.ndarray
    energy: np.ndarray
    depth: np.ndarray
    path: np.ndarray
    pixel: np.ndarray
    paths: int
    size: tuple[int, int]


class _PilotFilm:
    """Stands in for the sensor's film: the same view at another resolution, box filter, no storage."""

    start_opl = 0.0

    def __init__(self, film, size: tuple[int, int]):
        self._size = mi.ScalarVector2u(*size)
        self.curves = getattr(film, "curves", None)

    def crop_size(self):
        return self._size

    def sample_offset(self, sample):
        return sample - 0.5, None


class _PilotLane:
    """Lists events, each path in slots of its own. The loops put twice per vertex, emission found and then emission
    sampled, which gives the depth."""

    def __init__(self, match, curves: bool, lanes: int, slots: int, spp: int):
        self.match, self.curves, self.slots, self.spp = match, curves, slots, spp
        self.lane = dr.arange(mi.UInt32, lanes)
        size = slots * lanes
        self.opl = dr.zeros(mi.Float64, size)
        self.energy = dr.zeros(mi.Float, size)
        self.depth = dr.zeros(mi.UInt32, size)
        self.used = None

    def begin(self):
        return {"puts": mi.UInt32(0), "used": mi.UInt32(0)}

    def put(self, events, opl, value, active):
        puts, used = events["puts"], events["used"]
        energy = self._energy(value)
        active = active & (energy != 0)
        slot, fits = dr.fma(self.lane, self.slots, used), active & (used < self.slots)
        dr.scatter(self.opl, opl, slot, fits)
        dr.scatter(self.energy, energy, slot, fits)
        # Emission found at vertex d needs d + 1 segments, sampled there d + 2.
        dr.scatter(self.depth, (puts >> 1) + (puts & 1) + 1, slot, fits)
        events["puts"] = puts + 1
        events["used"] = used + dr.select(active, mi.UInt32(1), 0)
        return mi.Float(0), mi.Float(0)

    def _energy(self, value):
        """Never negative: wavelengths are averaged, since single ones have colours outside of sRGB."""
        if self.curves:
            return mean_of(self.match.to_channels(value))
        return dr.mean(value * self.match.weight)

    def end(self, events):
        self.used = events["used"]

    def finish(self):
        pass


def pilot_size(film, pixels: int) -> tuple[int, int]:
    """Width and height of a film of about ``pixels`` pixels in the proportions of ``film``, no more than it has."""
    width, height = (int(n) for n in film.crop_size())
    shrink = min(1.0, (pixels / (width * height)) ** 0.5)
    return max(1, round(width * shrink)), max(1, round(height * shrink))


def pilot_events(scene, integrator, sensor, *, seed: int, pixels: int, paths: int) -> PilotEvents:
    """Trace about ``paths`` camera paths of a transient integrator and list what arrives.

    ``sensor`` is a sensor of ``scene`` with one of the library's films. ``max_depth`` is :data:`PILOT_DEPTH` for
    the run, and Russian roulette starts at :data:`PILOT_RR_DEPTH` at the latest. Raises what the integrator raises
    for scenes that it cannot render.
    """
    sensor, film = integrator.resolve(scene, sensor)
    size = pilot_size(film, pixels)
    before = integrator.max_depth, integrator.rr_depth
    integrator.max_depth, integrator.rr_depth = PILOT_DEPTH, min(before[1], PILOT_RR_DEPTH)
    try:
        slots = _EVENTS_PER_PATH
        while True:
            spp = max(1, min(paths, _MAX_EVENTS // slots) // (size[0] * size[1]))
            lane, most = _trace(scene, integrator, sensor, _PilotFilm(film, size), size, spp, seed, slots)
            if most <= slots:
                break
            slots = most + most // 8
    finally:
        integrator.max_depth, integrator.rr_depth = before
    depth = np.array(lane.depth, dtype=np.int64)
    filled = np.flatnonzero(depth)
    path = filled // slots
    return PilotEvents(
        opl=np.array(lane.opl, dtype=np.float64)[filled],
        energy=np.array(lane.energy, dtype=np.float64)[filled],
        depth=depth[filled],
        path=path,
        pixel=path // lane.spp,
        paths=size[0] * size[1] * lane.spp,
        size=size,
    )


@no_collection()
def _trace(scene, integrator, sensor, film, size, spp, seed, slots) -> tuple[_PilotLane, int]:
    """The filled lane, and the largest number of events of a path, which may be more than it had slots for."""
    sampler = sensor.sampler().clone()
    sampler.set_sample_count(spp)
    spp = sampler.sample_count()
    with dr.suspend_grad():
        job = Pass(band=0, first_row=0, rows=size[1], spp=spp, total=spp, seed=seed)
        sampler, ray, ray_weight, scale, _, _, seen = integrator.start(scene, sensor, film, job)
        ray = dr.detach(ray)
        match = ChannelMatch(ray.wavelengths, dr.detach(ray_weight) * scale / (size[0] * size[1]), film.curves)
        lane = _PilotLane(match, film.curves is not None, size[0] * size[1] * spp, slots, spp)
        first = integrator._first_opl(seen, film, ray)
        facts = integrator.facts(scene, sensor)
        # What the sensor's film would not count is asked for too: the answers are about all arrivals.
        facts.window = None
        integrator.trace(scene, sampler, ray, first, lane, facts)
        most = dr.max(lane.used)
        dr.eval(most, lane.opl, lane.energy, lane.depth)
        dr.sync_thread()
    return lane, int(most[0])
