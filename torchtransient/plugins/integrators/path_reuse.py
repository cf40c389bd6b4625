"""``transient_path_reuse``: time-resolved path tracing in which neighbouring pixels share their later light."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi

from torchtransient.errors import SceneError
from torchtransient.interfaces import RENDER
from torchtransient.plugins._registry import register
from torchtransient.plugins.integrators import path
from torchtransient.plugins.integrators.base import UNLIMITED
from torchtransient.plugins.integrators.job import Pass
from torchtransient.plugins.properties import whole_number
from torchtransient.plugins.shared_paths.groups import Group, Sharing, pixel_order, seed_of, spread
from torchtransient.plugins.shared_paths.lists import LastArrival, PackedCube, PackedSink, SuffixList, bring
from torchtransient.plugins.transport.context import PathSettings, RenderContext
from torchtransient.plugins.transport.emitter_connections import EmitterSampled
from torchtransient.plugins.transport.sinks import FilmSink
from torchtransient.plugins.transport.strategy import Local
from torchtransient.plugins.transport.walk import start, walk

# Light that too few vertices are left for is not shared.
LEAST_DEPTH = 3
# Memory of the pairs and lists of one launch, and of its histograms, bytes.
MAX_BYTES = 2**27
# That of all launches of a recorded call, which keeps it until the last one is done. Tracing costs little beside more.
MAX_RECORDED_BYTES = 2**28
# Pixels of a launch: more would lie beyond the caches of a processor.
PIXELS = {"llvm": 2**14, "cuda": 2**16}
# Rounds that are summed up in single precision.
MOST_ROUNDS = 2**10


class TransientPathReuse(path.TransientPath):
    r"""Time-resolved path tracer with path reuse (:monosp:`transient_path_reuse`).

    Light behind a Lambertian second vertex is shared by groups of pixels whose first vertices lie and face alike: every
    pixel of a group connects to the second vertices of all, and to the light that several paths have found behind each.
    All other light, direct light above all, comes from the paths of ``transient_path``, which end at such vertices.
    Both parts are unbiased and add up to the light of ``transient_path``; noise of the pixels of a group is correlated.

    Parameters beside those of ``transient_path``:

    ``group_size`` (64): pixels of a group, a power of two.
    ``suffixes`` (16): paths that begin at each shared vertex, a power of two.
    ``samples_per_round`` (32): every so many samples of a pixel it draws one shared vertex.

    Samples per pixel are those of the paths; use the sampler ``owen``, which the shared part draws from as well. Films,
    filters, pulses and gates as in ``transient_path``; monochromatic, RGB and spectral variants.

    Derivatives, in both modes, are those of ``transient_path``, with its noise. The same seed gives the same light up
    to the order in which the events of a list are added (1e-7 of a value).

    Not supported: polarized variants, media, an unlimited ``max_depth``, phasor films, films of several storage bands,
    surfaces that shift wavelengths (all ``SceneError``). Light that refracts at rough surfaces, and light seen from
    inside of glass, is not shared.
    """

    pixels_are_independent = False

    def __init__(self, props):
        super().__init__(props)
        self.group_size = _power_of_two(props, "group_size", 64)
        self.suffixes = _power_of_two(props, "suffixes", 16)
        self.samples_per_round = whole_number(props, "samples_per_round", 32, least=1)

    def resolve(self, scene, sensor):
        sensor, film = super().resolve(scene, sensor)
        reason = self._why_not(scene, sensor, film)
        if reason is not None:
            raise SceneError(f"transient_path_reuse: {reason}, or use transient_path.")
        return sensor, film

    def _why_not(self, scene, sensor, film):
        """Return the reason why light cannot be shared, with a remedy; None if it can."""
        delays = self.contents(scene, sensor).delays
        if self.connections != "ordinary":
            return f"expected connections='ordinary', got {self.connections!r}, which is of one pixel"
        if mi.is_polarized:
            return f"the variant {mi.variant()} is polarized; load the scene in one without"
        if self.max_depth == UNLIMITED:
            return "max_depth is -1 (no limit), and lists of events need one; set it"
        if film.measures not in ("transient", "gated"):
            return f"expected a film of histograms or gates, got {film.plugin}; take a transient_hdr_film"
        if len(film.band_layout()) > 1:
            return f"the film {film.cube_shape()} exceeds one storage band of 2^32 values; crop it, use fewer bins"
        if delays is not None and delays.shifts:
            return "a surface shifts wavelengths, and a group has one set of them; take it out"
        return None

    # --------------------------------------------------------------------------------------------- preparation

    def render_context(self, scene, contents, wanted=None, window=None, settings=None, velocities=None):
        if wanted is not None or settings is not None or self.max_depth < LEAST_DEPTH:
            return super().render_context(scene, contents, wanted, window, settings, velocities)
        sharing = Sharing(scene, contents, self.group_size, self.suffixes)
        if not sharing.possible:
            return super().render_context(scene, contents, wanted, window, velocities=velocities)
        sensor = contents.sensor
        film = sensor.film()
        sharing.order, sharing.real = pixel_order(scene, contents, sensor, film, self.group_size)
        # Emission of the shared vertex itself is found by the paths that end there.
        behind = PathSettings(self.max_depth - 1, max(1, self.rr_depth - 1), False, True, True)
        last = None if window is None else LastArrival(window.last)
        sharing.behind = RenderContext(scene, contents, behind, self.strategies(contents), None, last)
        sharing.behind.start(Local(strata=None, meter_normal=None))
        settings = replace(self.settings(), sharing=sharing)
        segment, scattering, connections = self.strategies(contents)
        another = EmitterSampled()
        another.name += "_2"
        return RenderContext(scene, contents, settings, (segment, scattering, [*connections, another]), None, window)

    def prepared(self, scene, sensor=0, seed=0, spp=0, kind=RENDER, grad_in=(None, None)):
        job = super().prepared(scene, sensor, seed, spp, kind, grad_in)
        if job.context.sharing is not None:
            # Made before anything is traced.
            self.sampler_of(scene, job.sensor, "owen")
        return job

    def refusal_of(self, job):
        sharing = job.context.sharing
        if sharing is not None:
            taken = self._bytes_per_pixel(sharing) * dr.width(sharing.order) * self._rounds(job.samples)
            if taken > MAX_RECORDED_BYTES:
                return "a recording of the shared light would take much memory, and tracing costs little beside it"
        return super().refusal_of(job)

    def _rounds(self, samples):
        return max(1, round(samples / self.samples_per_round))

    @staticmethod
    def _bytes_per_pixel(sharing):
        """Return the memory of pairs and lists of a pixel, bytes."""
        floats = len(mi.UnpolarizedSpectrum(0)) + 1
        return 4 * (sharing.size * (floats + 1) + sharing.suffixes * (sharing.behind.most_events() + 2) * floats)

    def _pixels(self, film, sharing):
        """Return the number of pixels of a launch: whole groups."""
        per_pixel = self._bytes_per_pixel(sharing)
        if PackedCube.fits(film):
            per_pixel = max(per_pixel, film.temporal_bins * 16)
        most = PIXELS["cuda" if mi.variant().startswith("cuda") else "llvm"]
        return max(1, min(most, MAX_BYTES // per_pixel) // sharing.size) * sharing.size

    # ------------------------------------------------------------------------------------------------- renders

    def shared_light(self, context, film):
        if context.sharing is None:
            return []
        return [lambda job: self._add_shared(context, film, job)]

    def _add_shared(self, context, film, job):
        sharing, rounds = context.sharing, self._rounds(job.samples)
        pixels, total = self._pixels(film, sharing), dr.width(sharing.order)
        launches, number = -(-total // pixels), 0
        for first in range(0, total, pixels):
            lane = dr.arange(mi.UInt32, min(pixels, total - first)) + dr.opaque(mi.UInt32, first)
            order, real = dr.gather(mi.UInt32, sharing.order, lane), dr.gather(mi.Bool, sharing.real, lane)
            dr.eval(order, real)
            packed = None
            for i in range(rounds):
                if PackedCube.fits(film) and i % MOST_ROUNDS == 0:
                    packed = PackedCube(film, dr.width(order))
                number += 1
                base = self._add_round(context, film, Local(
                    order=order, real=real, seed=seed_of(job.seed, 4 * number), pixel_seed=seed_of(job.seed, 1),
                    round=i, rounds=rounds, packed=packed,
                ))  # fmt: skip
                if packed is not None and (i + 1 == rounds or (i + 1) % MOST_ROUNDS == 0):
                    packed.add_to_film(base, real)
                    dr.eval(film.bands[0][2])
                if job.progress:
                    dr.sync_thread()
                    job.progress(number / (launches * rounds))

    def _add_round(self, context, film, part):
        """Add the light of one round of some groups; return the index of each pixel's first entry."""
        sharing, scene, sensor = context.sharing, context.scene, context.contents.sensor
        rays = self._rays(context, sensor, film, part)
        match = self.channel_match(context.contents, film, rays)
        launch = Pass(0, 0, int(film.crop_size()[1]), 1, part.rounds, None)
        base, pixel = self.pixel_indices(film, launch, rays)
        anchors = self.primary_path(context, film, rays)
        dr.eval(anchors, base)
        sampler = self.sampler_of(scene, sensor, "owen")
        group = Group(context, anchors, part.real, sampler, seed_of(part.seed, 1))
        events = self._suffixes(context, film, group, sampler, seed_of(part.seed, 2))
        if part.packed is not None:
            block, sink = None, PackedSink(part.packed, match, group.first)
        else:
            most = group.size * sharing.suffixes * events.slots
            block = film.create_event_block(launch, base, match, most, exclusive=True, origin=group.first)
            sink = FilmSink(block)
        state = bring(group, events, sharing.suffixes, sink, sink.begin(context))
        sink.end(state)
        film.add_steady(pixel, [dr.select(part.real, c, 0) for c in match.to_channels(state["L"])])
        film.add_outside(pixel, *(dr.select(part.real, state[side], 0) for side in ("before", "after")))
        if block is not None:
            block.finish()
        dr.eval(film.bands[0][2], film.steady, film.outside, None if part.packed is None else part.packed.flat)
        return base

    def _rays(self, context, sensor, film, part):
        """Return a primary ray of each pixel, one of a set that all rounds spread over the pixel."""
        sampler, wavelength = self.sampler_of(context.scene, sensor, "owen"), None
        lanes = dr.width(part.order)
        turn = dr.zeros(mi.UInt32, lanes) + dr.opaque(mi.UInt32, part.round)
        if mi.is_spectral:  # a group has one set of wavelengths
            group = dr.gather(mi.UInt32, part.order, dr.arange(mi.UInt32, lanes) & mi.UInt32(2**32 - self.group_size))
            sampler.seed_sets(seed_of(part.pixel_seed, 1), group, turn)
            wavelength = sampler.next_1d()
        sampler.seed_sets(part.pixel_seed, part.order, turn)
        width = dr.opaque(mi.UInt32, int(film.crop_size()[0]))
        row = part.order // width
        place = row, part.order - row * width
        return self.rays_through(
            context.scene, context.contents, sensor, film, sampler, place, part.rounds, wavelength
        )

    def _suffixes(self, context, film, group, sampler, seed):
        """Return the lists of the light behind the points of groups."""
        sharing = context.sharing
        owner = dr.arange(mi.UInt32, group.lanes * sharing.suffixes) // sharing.suffixes
        ray, leg = (dr.gather(type(x), x, owner) for x in (group.z_ray, group.z_leg))
        begin = dr.gather(mi.Float64, group.earliest, owner)
        last = film.last_arrival()
        sink = SuffixList(dr.width(owner), sharing.behind.most_events(), begin, last)
        spread(sampler, seed, dr.width(owner), sharing.size * sharing.suffixes)
        suffix = start(sharing.behind, ray, begin, mi.Float(1))
        suffix.leg = leg
        suffix.active &= dr.gather(mi.Bool, group.z_alive, owner)
        walk(sharing.behind, sampler, suffix, sink)
        return sink


def _power_of_two(props, name, default):
    value = whole_number(props, name, default, least=1)
    if value & (value - 1):
        raise SceneError(f"transient_path_reuse: {name}: expected a power of two, got {value}.")
    return value


register("integrator", "transient_path_reuse", TransientPathReuse)
