"""What every transient integrator shares: parameters, passes, primary rays and the three entry points."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from torchtransient._collection import no_collection
from torchtransient.errors import GradientError, SceneError, VariantError
from torchtransient.plugins.films.colour import ChannelMatch
from torchtransient.plugins.films.temporal_filter import check_name, check_stddev
from torchtransient.plugins.integrators.media.media_facts import media_facts
from torchtransient.plugins.integrators.push import settle_tangents, tangents
from torchtransient.plugins.integrators.scene_facts import SceneFacts, scene_facts
from torchtransient.plugins.sampling.distant import distant_reference
from torchtransient.plugins.sampling.light_box import LightBox
from torchtransient.plugins.sensors.origin import length_to_sensor_origin, sample_rays, views
from torchtransient.plugins.sensors.stokes_frame import sensor_turn

# Lanes of one kernel launch. Larger jobs run in several passes, which keeps a progress bar moving and indices in 32
# bits.
MAX_LANES = 2**26


@dataclass
class Pass:
    """One kernel launch: ``spp`` of ``total`` samples per pixel for rows of one storage band."""

    band: int
    first_row: int
    rows: int
    spp: int
    total: int
    seed: int


def _launch_counts(sampler, spp: int, most: int) -> list[int]:
    """Samples per pixel of the launches that make up ``spp``, at most ``most`` each, in numbers that the sampler takes.

    Samplers such as multijitter or ldsampler round a number up; what they really draw is what a pixel is divided by.
    """

    def drawn(count):
        sampler.set_sample_count(count)
        return sampler.sample_count()

    if spp <= most:
        return [drawn(spp)]
    while most > 1 and drawn(most) > most:
        # Rounding up would exceed the launch; the sampler takes some smaller number.
        most -= max(1, most // 16)
    counts = []
    while (left := spp - sum(counts)) > 0:
        counts.append(drawn(min(most, left)))
    return counts


class TransientIntegrator(mi.CppADIntegrator):
    """Abstract base of the transient integrators.

    Parameters: ``max_depth`` (6; -1 for no limit), ``rr_depth`` (5), ``hide_emitters`` (false), ``camera_unwarp``
    (false: leave out the leg from the first surface to the sensor), ``discard_direct_light`` (false: leave out emission
    that reaches the sensor without a bounce),
    ``temporal_filter`` (the film's) and ``gaussian_stddev`` (the film's, in bins).

    Subclasses provide ``trace`` (primal), ``sweep`` (reverse mode) and ``push`` (forward mode).
    """

    def __init__(self, props):
        super().__init__(props)
        max_depth = int(props.get("max_depth", 6))
        if max_depth < -1:
            raise SceneError(f"max_depth: expected -1 (no limit) or a number >= 0, got {max_depth}.")
        self.max_depth = max_depth if max_depth != -1 else 0xFFFFFFFF
        self.rr_depth = int(props.get("rr_depth", 5))
        if self.rr_depth <= 0:
            raise SceneError(f"rr_depth: expected a number >= 1, got {self.rr_depth}.")
        self.camera_unwarp = bool(props.get("camera_unwarp", False))
        self.discard_direct_light = bool(props.get("discard_direct_light", False))
        self.temporal_filter = str(props.get("temporal_filter", ""))
        if self.temporal_filter:
            check_name(self.temporal_filter)
        self.gaussian_stddev = None
        if "gaussian_stddev" in props:
            self.gaussian_stddev = float(props["gaussian_stddev"])
            check_stddev(self.gaussian_stddev)
        self._distant = None

    # Whether paths scatter in participating media; others refuse scenes that have them.
    walks_through_media = False

    # ----------------------------------------------------------------------------------- preparation

    def resolve(self, scene, sensor):
        """The sensor and its film, checked; temporal filter settings of the integrator are handed to the film."""
        if not (mi.variant() or "").startswith(("llvm", "cuda")):
            raise VariantError(
                f"transient rendering needs a JIT variant such as llvm_ad_rgb, the active one is {mi.variant()!r}; "
                "call mitsuba.set_variant('llvm_ad_rgb') before loading the scene."
            )
        if isinstance(sensor, int):
            sensors = scene.sensors()
            if not 0 <= sensor < len(sensors):
                raise SceneError(f"sensor index: the scene has {len(sensors)} sensors, got index {sensor}.")
            sensor = sensors[sensor]
        film = sensor.film()
        if not hasattr(film, "transient_bands"):
            raise SceneError(
                "transient integrators need a film of type transient_hdr_film, gated_hdr_film or phasor_hdr_film, the "
                f"sensor has {film.class_name()}; change the film's type in the scene."
            )
        if film.exhaustive_scan:
            raise SceneError(
                "transient_hdr_film: exhaustive_scan needs an integrator with a scanned laser; surface path tracing "
                "has no laser positions. Remove exhaustive_scan."
            )
        if not self.walks_through_media and media_facts(scene, sensor) is not None:
            raise SceneError(
                f"{self.class_name()}: the scene has participating media, which this integrator would pass through as "
                "if they were empty. Use the integrator transient_prbvolpath, or remove the interior and exterior "
                "media of the scene's shapes and sensors."
            )
        film.take_filter(self.temporal_filter, self.gaussian_stddev)
        return sensor, film

    def facts(self, scene, sensor=None) -> SceneFacts:
        """What the loops may leave out for this scene, seen by this sensor.

        The reference sphere of distant lights is fixed when a scene is first seen: moving a shape must not shift the
        clock. The scene itself is not kept, since it owns the integrator and would never be freed; one of its shapes
        is, so that no later scene can be taken for this one because it got the same addresses.
        """
        facts = scene_facts(scene, self.reference(scene))
        if sensor is not None:
            facts.window = sensor.film().arrivals()
            facts.light_box = LightBox.of(scene, facts.bsdfs) if facts.window is not None else None
        if self.walks_through_media:
            facts.media = media_facts(scene, sensor)
        if facts.media is not None:
            facts.media.hide_emitters = bool(self.hide_emitters)
        return facts

    def reference(self, scene):
        """The sphere around the scene as it was first seen, which light from and to infinity is timed by."""
        shapes = scene.shapes()
        key = (scene.ptr, *(shape.ptr for shape in shapes))
        if self._distant is None or self._distant[0] != key:
            self._distant = (key, distant_reference(scene), shapes[:1])
        return self._distant[1]

    def passes(self, sensor, film, seed, spp) -> tuple[list[Pass], int]:
        """The launches of a job, and the largest number of samples per pixel.

        Some samplers round the number of samples of a launch, so that storage bands of different heights may get
        different totals.
        """
        sampler = sensor.sampler().clone()
        if spp:
            sampler.set_sample_count(spp)
        spp = sampler.sample_count()
        width = int(film.crop_size()[0])
        most = min(MAX_LANES, film.lanes_at_most(self.max_depth) or MAX_LANES)
        result = []
        for band, (first_row, rows) in enumerate(film.band_layout()):
            counts = _launch_counts(sampler, spp, max(1, most // (width * rows)))
            rows_per_pass = rows if width * rows * max(counts) <= most else max(1, most // width)
            for row in range(first_row, first_row + rows, rows_per_pass):
                some = min(rows_per_pass, first_row + rows - row)
                result += [Pass(band, row, some, count, sum(counts), 0) for count in counts]
        for i, p in enumerate(result):
            # A single pass keeps the user's seed, so results agree with those of Mitsuba's convention.
            p.seed = seed if len(result) == 1 else int(mi.sample_tea_32(mi.UInt32(seed), mi.UInt32(i))[0][0])
        return result, max(p.total for p in result)

    def start(self, scene, sensor, film, job: Pass):
        """Seeded sampler, primary rays (attached to the sensor), ray weight, pixel indices and sensors of one pass."""
        sampler = sensor.sampler().clone()
        sampler.set_sample_count(job.spp)
        sampler.set_samples_per_wavefront(job.spp)
        width = int(film.crop_size()[0])
        lanes = width * job.rows * job.spp
        sampler.seed(job.seed, lanes)
        index = dr.arange(mi.UInt32, lanes) // dr.opaque(mi.UInt32, job.spp)
        row = index // width
        column = dr.fma(mi.UInt32(mi.Int32(-width)), row, index)
        row += dr.opaque(mi.UInt32, job.first_row)

        offset, weight = film.sample_offset(sampler.next_2d())
        position = mi.Point2f(mi.Float(column), mi.Float(row)) + 0.5 + offset
        # The same map to [0, 1]^2 as Mitsuba's integrators use: relative to the crop window.
        position = position / mi.ScalarVector2f(film.crop_size())
        aperture = sampler.next_2d() if sensor.needs_aperture_sample() else mi.Point2f(0)
        time = sensor.shutter_open()
        if sensor.shutter_open_time() > 0:
            time += sampler.next_1d() * sensor.shutter_open_time()
        wavelength = sampler.next_1d() if mi.is_spectral else mi.Float(0)
        seen = views(sensor, position, lambda: self.reference(scene))
        with dr.resume_grad():
            ray, ray_weight = sample_rays(sensor, seen, time, wavelength, position, aperture)
            if film.curves is not None:
                ray, ray_weight = film.curves.draw(sensor, ray, ray_weight, wavelength)
        scale = mi.Float(1 / job.total) if weight is None else weight / job.total
        return sampler, ray, ray_weight, scale, row, column, seen

    def channel_match(self, seen, film, ray, ray_weight, scale):
        """The map from samples of the primary rays to the film's channels, detached."""
        turn = sensor_turn(seen, dr.detach(ray)) if mi.is_polarized else None
        return ChannelMatch(ray.wavelengths, dr.detach(ray_weight) * scale, film.curves, turn)

    def lane_bases(self, film, job, row, column):
        """Index of a pixel's first bin in its band, and of the pixel in the film."""
        width = int(film.crop_size()[0])
        first = film.band_layout()[job.band][0]
        pixel = dr.fma(row, width, column)
        in_band = pixel - dr.opaque(mi.UInt32, first * width)
        return in_band * film.entries_per_pixel(), pixel

    # ----------------------------------------------------------------------------------- entry points

    @no_collection()
    def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True, progress_callback=None):
        """Render steady ``(H, W, C)`` and transient ``(H, W, T, C)``.

        ``progress_callback(fraction)`` is called after every pass. With ``develop=False`` nothing is returned and the
        result stays in the film.
        """
        with dr.suspend_grad():
            sensor, film = self.resolve(scene, sensor)
            if develop:
                film.check_one_band()
            jobs, samples = self.passes(sensor, film, int(seed), int(spp))
            film.prepare(self.aov_names(), samples)
            for i, job in enumerate(jobs):
                self._render_pass(scene, sensor, film, job)
                if evaluate or len(jobs) > 1:
                    dr.eval(film.bands[job.band][2], film.steady, film.outside)
                if progress_callback:
                    dr.sync_thread()
                    progress_callback((i + 1) / len(jobs))
            film.finish_render()
            return film.develop() if develop else None

    def _render_pass(self, scene, sensor, film, job):
        sampler, ray, ray_weight, scale, row, column, seen = self.start(scene, sensor, film, job)
        match = self.channel_match(seen, film, ray, ray_weight, scale)
        base, pixel = self.lane_bases(film, job, row, column)
        lane = film.create_block(job, base, match, self.max_depth)
        first = self._first_opl(seen, film, ray)
        facts = self.facts(scene, sensor)
        L, before, after = self.trace(scene, sampler, dr.detach(ray), first, lane, facts)
        self._add_steady(film, match.to_channels(L), pixel)
        if film.outside is not None:
            for side, value in enumerate((before, after)):
                dr.scatter_reduce(dr.ReduceOp.Add, film.outside, type(film.outside)(value), pixel * 2 + side)
        lane.finish()

    @staticmethod
    def _add_steady(film, channels, pixel):
        """Add to the steady image, unless the film makes it of its array."""
        if film.keeps_steady:
            for c, value in enumerate(channels):
                index = pixel * film.channel_count() + c
                dr.scatter_reduce(dr.ReduceOp.Add, film.steady, type(film.steady)(value), index)

    def _first_opl(self, seen, film, ray):
        """Optical path before the first ray starts, counted from ``start_opl``: doubles keep late times exact."""
        length = mi.Float(0) if self.camera_unwarp else dr.detach(length_to_sensor_origin(seen, ray))
        return mi.Float64(length) - film.start_opl

    @no_collection()
    def render_backward(self, scene, params, grad_in, sensor=0, seed=0, spp=0):
        """Accumulate the gradient of ``<grad_in, render()>`` into the attached parameters of the scene.

        ``grad_in`` is the pair (steady ``(H, W, C)`` or None, transient or None). The transient adjoint is a TensorXf
        ``(H, W, T, C)``, or the tuple ``(flat array, offset, (row, column, bin, channel) strides)``, which reads any
        layout without a copy. ``params`` is not used: parameters are found through Dr.Jit's graph.

        Raises GradientError when a path length can change and the temporal filter has no slope, or without a bound on
        the depth.
        """
        with dr.suspend_grad():
            sensor, film = self.resolve(scene, sensor)
            with dr.resume_grad():  # the question whether a parameter is attached is answered no while suspended
                facts = self.facts(scene, sensor).with_gradients(scene, sensor)
            self._check_differentiable(film, facts)
            g_steady, g_transient = grad_in
            if g_steady is None and g_transient is None:
                return
            jobs, _ = self.passes(sensor, film, int(seed), int(spp))
            # Derivatives wait at the parameters until all passes are done: following the graph further uses up its
            # edges, and the first pass would be the only one to arrive.
            with dr.isolate_grad():
                for job in jobs:
                    self._backward_pass(scene, sensor, film, job, g_steady, g_transient, facts)
                    dr.eval()

    def _backward_pass(self, scene, sensor, film, job, g_steady, g_transient, facts):
        sampler, ray, ray_weight, scale, row, column, seen = self.start(scene, sensor, film, job)
        match = self.channel_match(seen, film, ray, ray_weight, scale)
        channels = film.channel_count()
        _, pixel = self.lane_bases(film, job, row, column)
        steady = [mi.Float(0)] * channels
        if g_steady is not None:
            steady = [dr.gather(mi.Float, g_steady.array, pixel * channels + c) for c in range(channels)]
        transient, base = None, mi.UInt32(0)
        if g_transient is not None:
            flat, offset, strides = self._adjoint_layout(film, g_transient)
            base = row * strides[0] + column * strides[1] + offset
            transient = (flat, strides[2], strides[3])
        lane = film.create_adjoint_block(transient, base, steady, match)
        first = self._first_opl(seen, film, ray)
        a_o, a_d, a_first, a_turn = self.sweep(scene, sampler, dr.detach(ray), first, lane, facts)
        if facts.sensor_moves:
            with dr.resume_grad():
                objective = dr.dot(a_o, ray.o) + dr.dot(a_d, ray.d)
                if not self.camera_unwarp:
                    objective += a_first * length_to_sensor_origin(seen, ray)
                if mi.is_polarized:
                    objective += a_turn * sensor_turn(seen, ray).angle()
                dr.backward_from(objective)

    @no_collection()
    def render_forward(self, scene, params, sensor=0, seed=0, spp=0, develop=True):
        """Derivatives (steady ``(H, W, C)``, transient) along the tangents set on the scene's attached parameters.

        One pass over the samples for one tangent. ``params`` is not used; with ``develop=False`` the
        result stays in the film. Errors as in :meth:`render_backward`.
        """
        with dr.suspend_grad():
            sensor, film = self.resolve(scene, sensor)
            with dr.resume_grad():
                facts = self.facts(scene, sensor).with_gradients(scene, sensor)
                settle_tangents(scene, facts)
            self._check_differentiable(film, facts)
            jobs, samples = self.passes(sensor, film, int(seed), int(spp))
            film.prepare(self.aov_names(), samples)
            for job in jobs:
                self._forward_pass(scene, sensor, film, job, facts)
                dr.eval(film.bands[job.band][2], film.steady)
            film.finish_render()
            return film.develop() if develop else None

    def _forward_pass(self, scene, sensor, film, job, facts):
        sampler, ray, ray_weight, scale, row, column, seen = self.start(scene, sensor, film, job)
        match = self.channel_match(seen, film, ray, ray_weight, scale)
        base, pixel = self.lane_bases(film, job, row, column)
        lane = film.create_block(job, base, match, self.max_depth, tangents=True)
        first = self._first_opl(seen, film, ray)
        t_ray, d_first, t_turn = (mi.Vector3f(0), mi.Vector3f(0)), mi.Float(0), None
        if facts.sensor_moves:
            with dr.resume_grad():
                length = length_to_sensor_origin(seen, ray)
                attached = [ray.o, ray.d, length]
                if mi.is_polarized:
                    attached.append(sensor_turn(seen, ray).angle())
                t_o, t_d, t_first, *t_angle = tangents(attached)
                t_turn = t_angle[0] if mi.is_polarized else None
                t_ray = (mi.Vector3f(t_o), mi.Vector3f(t_d))
                d_first = mi.Float(0) if self.camera_unwarp else t_first
        dL = self.push(scene, sampler, dr.detach(ray), first, lane, facts, t_ray, d_first, t_turn)
        self._add_steady(film, match.to_channels(dL), pixel)
        lane.finish()

    @staticmethod
    def _adjoint_layout(film, g_transient):
        if isinstance(g_transient, tuple):
            return g_transient
        expected = film.cube_shape()
        if tuple(g_transient.shape) != expected:
            raise GradientError(
                f"render_backward: adjoint of shape {expected} expected, got {tuple(g_transient.shape)}."
            )
        _, w, t, c = expected
        return g_transient.array, 0, (w * t * c, t * c, c, 1)

    def _check_differentiable(self, film, facts):
        if facts.geometry and not film.has_slope:
            raise GradientError(
                "A parameter that changes optical path lengths (geometry, light or sensor pose, index of refraction) "
                f"needs a response over time with a slope; the film has {film.response_name!r}. {film.slope_remedy}"
            )
        if self.max_depth == 0xFFFFFFFF:
            raise GradientError(
                "Gradients keep one record per bounce and need a bound: max_depth is -1 (no limit). Set max_depth to a "
                "finite number, for instance to where the remaining throughput no longer matters."
            )

    def to_string(self):
        return (
            f"{type(self).__name__}[\n  max_depth = {self.max_depth},\n  rr_depth = {self.rr_depth},\n"
            f"  camera_unwarp = {self.camera_unwarp},\n  discard_direct_light = {self.discard_direct_light}\n]"
        )
