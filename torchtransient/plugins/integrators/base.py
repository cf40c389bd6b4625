"""Base of the transient integrators: parameters, primary rays, launches and the three entry points."""

from __future__ import annotations

import warnings

import drjit as dr
import mitsuba as mi

from torchtransient.errors import (
    GradientError,
    GradientWarning,
    SceneError,
    TorchTransientWarning,
    VariantError,
    level_of_user,
)
from torchtransient.interfaces import BACKWARD, FORWARD, JOBS, RENDER, IntegratorInterface, is_time_resolved
from torchtransient.plugins.described_scene import note_scene
from torchtransient.plugins.films.colour import ChannelMatch
from torchtransient.plugins.films.temporal_filters import check_name, check_stddev
from torchtransient.plugins.frozen_state import arrays_below, says_it_can_be_recorded
from torchtransient.plugins.guards import no_collection
from torchtransient.plugins.integrators.job import (
    IncomingAdjoint,
    Job,
    Pass,
    Prepared,
    laser_count,
    passes_of,
    seed_array,
    share_of,
    state_of,
)
from torchtransient.plugins.parameter_effect import class_of
from torchtransient.plugins.parameters import ParameterTracker, check_slope, check_stand_ins, moving_names
from torchtransient.plugins.properties import number, truth, whole_number
from torchtransient.plugins.sensors.origin import (
    PrimaryRays,
    index_at_sensor,
    meter_normal,
    sample_rays,
    sensor_rotation,
    start_at_sensor,
    views,
)
from torchtransient.plugins.transport.boundary.moving_edges import MovingEdges, missing
from torchtransient.plugins.transport.context import PathSettings, RenderContext, Wanted
from torchtransient.plugins.transport.derivative import (
    forward,
    objective_of,
    propagate_tangents,
    reverse,
    tangent_of,
)
from torchtransient.plugins.transport.record import RecordSink
from torchtransient.plugins.transport.scene_contents import SceneCache, SceneContents
from torchtransient.plugins.transport.sinks import FilmSink
from torchtransient.plugins.transport.velocities import AT_REST, Velocities, movers_of, unmeasured
from torchtransient.plugins.transport.walk import first_leg, start, walk

UNLIMITED = 0xFFFFFFFF


@IntegratorInterface.register
class TransientIntegrator(mi.CppADIntegrator):
    """Abstract base of the transient integrators.

    Parameters: ``max_depth`` (6; -1 for no limit), ``rr_depth`` (5), ``hide_emitters`` (false), ``camera_unwarp``
    (false: leave out the leg from the first surface to the sensor), ``discard_direct_light`` (false: leave out emission
    that reaches the sensor without a bounce),
    ``temporal_filter`` (the film's), ``gaussian_stddev`` (the film's, in bins), ``sampler`` ("scene": those of the
    sensors; the plugin name of one in their place, or "auto": ``owen`` in place of ``independent``).

    Subclasses return the parts of their walk from :meth:`strategies`, see :mod:`..transport.strategy`; derivatives in
    both modes follow.
    """

    def __init__(self, props):
        super().__init__(props)
        max_depth = whole_number(props, "max_depth", 6)
        self.max_depth = max_depth if max_depth != -1 else UNLIMITED
        self.rr_depth = whole_number(props, "rr_depth", 5, least=1)
        self.camera_unwarp = truth(props, "camera_unwarp", default=False)
        self.discard_direct_light = truth(props, "discard_direct_light", default=False)
        self.temporal_filter = str(props.get("temporal_filter", ""))
        if self.temporal_filter:
            check_name(self.temporal_filter)
        self.gaussian_stddev = None
        if "gaussian_stddev" in props:
            self.gaussian_stddev = number(props, "gaussian_stddev")
            check_stddev(self.gaussian_stddev)
        self.sampler = str(props.get("sampler", ""))
        self._seen = None

    # Paths scatter in participating media; otherwise scenes with media are refused.
    walks_through_media = False
    # The laser of a scan lights one position after the other; beams without width are seen.
    scans_exhaustively = False
    aims_lasers = False
    # Every pixel has samples of its own.
    pixels_are_independent = True
    # Derivatives warn of moving edges that they do not follow, and of velocities without effect; False if the caller
    # warns, by its keys.
    warns_of_edges = True

    def traverse(self, cb):
        super().traverse(cb)
        note_scene(self, cb)

    # ----------------------------------------------------------------------------------- preparation

    def resolve(self, scene, sensor):
        """Check a sensor and its film, and set the film's temporal filter by that of the integrator.

        Args:
            sensor: sensor, or its index in the scene.

        Returns:
            (sensor, film).

        Raises:
            VariantError: in a variant without JIT compilation.
            SceneError: if there is no such sensor, or if the integrator cannot render the film, media or lights of the
                scene.
        """
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
        if not is_time_resolved(film):
            raise SceneError(
                "transient integrators need a film of type transient_hdr_film, gated_hdr_film, phasor_hdr_film, "
                f"rate_hdr_film or beat_hdr_film, the sensor has {film.class_name()}; change the film's type in the "
                "scene."
            )
        if film.exhaustive_scan and not self.scans_exhaustively:
            raise SceneError(
                "transient_hdr_film: exhaustive_scan needs an integrator with a scanned laser; surface path tracing "
                "has no laser positions. Remove exhaustive_scan."
            )
        if not self.walks_through_media and self.contents(scene, sensor).media is not None:
            raise SceneError(
                f"{class_of(self)}: the scene has participating media, which this integrator would pass through as "
                "if they were empty. Use the integrator transient_prbvolpath, or remove the interior and exterior "
                "media of the scene's shapes and sensors."
            )
        beams = [emitter.id() for emitter in scene.emitters() if getattr(emitter, "needs_aim", False)]
        if beams and not self.aims_lasers:
            raise SceneError(
                f"{class_of(self)}: nothing but transient_nlos_path with nlos_laser_sampling sees the light of the "
                f"laser_beam {beams[0]!r}. Use that, or describe the light as a 'spot', 'projector' or 'angulararea'."
            )
        film.take_filter(self.temporal_filter, self.gaussian_stddev)
        return sensor, film

    def contents(self, scene, sensor) -> SceneContents:
        """Return the contents of the scene, cached by sensor."""
        return self._seen_scene(scene).contents_for(scene, sensor)

    def sampler_of(self, scene, sensor, plugin=None):
        """Return a copy of the sampler that draws for a sensor, with the sensor's number of samples.

        Args:
            plugin: name of a sampler plugin in place of the integrator's ``sampler``, which None takes.
        """
        return self._seen_scene(scene).sampler(sensor, self.sampler if plugin is None else plugin).clone()

    def parameters(self, scene) -> ParameterTracker:
        """Return the tracker of the scene's parameters with gradients."""
        return self._seen_scene(scene).tracker(scene)

    def silhouettes(self, scene, sensors=None) -> MovingEdges:
        """Return the gaps of derivatives at moving edges.

        Args:
            sensors: sensors that see the edges, None for all.
        """
        return missing(f"{class_of(self)} follows no edges", "Use transient_path or transient_prbvolpath.")

    def reference(self, scene):
        """Return the bounding sphere of the described scene, the origin of time for light at infinity."""
        return self._seen_scene(scene).reference

    def _seen_scene(self, scene) -> SceneCache:
        if self._seen is None or not self._seen.is_of(scene):
            self._seen = SceneCache(scene, self)
        return self._seen

    def settings(self) -> PathSettings:
        """Return the integrator's parameters for a walk."""
        return PathSettings(
            self.max_depth, self.rr_depth, bool(self.hide_emitters), self.discard_direct_light, self.camera_unwarp
        )

    def render_context(
        self, scene, contents, wanted=None, window=None, settings=None, velocities=None
    ) -> RenderContext:
        """Build the :class:`~..transport.context.RenderContext` of a job.

        Args:
            contents: :class:`~..transport.scene_contents.SceneContents`.
            wanted: :class:`~..transport.context.Wanted` derivatives, None for a render.
            window: :class:`~..films.block.ArrivalWindow` of the film, or None.
            settings: settings of the walk, None for the integrator's own.
            velocities: :class:`~..transport.velocities.Velocities`, None for films without rates.
        """
        strategies = self.strategies(contents)
        return RenderContext(scene, contents, settings or self.settings(), strategies, wanted, window, velocities)

    def frozen_state(self, scene, sensor=0) -> list:
        """Return the arrays that kernels read beside the scene's parameters, for ``dr.freeze(..., state_fn=...)``.

        See :mod:`..frozen_state`.
        """
        sensor, film = self.resolve(scene, sensor)
        return arrays_below([self.contents(scene, sensor), vars(film)])

    def start(self, scene, contents, sensor, film, job: Pass) -> PrimaryRays:
        """Draw the primary rays of a launch.

        Args:
            contents: :class:`~..transport.scene_contents.SceneContents`.
            sensor, film: sensor and its film.
            job: the launch.

        Returns:
            :class:`~..sensors.origin.PrimaryRays`, attached to the sensor.
        """
        sampler = self.sampler_of(scene, sensor)
        sampler.set_sample_count(job.spp)
        sampler.set_samples_per_wavefront(job.spp)
        width, lasers = int(film.crop_size()[0]), laser_count(film)
        lanes = width * job.rows * job.spp * lasers
        sampler.seed(job.seed, lanes)
        spp, lane = dr.opaque(mi.UInt32, job.spp), dr.arange(mi.UInt32, lanes)
        index, laser = lane // spp, None
        stratum = lane - index * spp
        if film.exhaustive_scan:
            laser, index = index % lasers, index // lasers
        row = index // width
        column = dr.fma(mi.UInt32(mi.Int32(-width)), row, index)
        row += dr.opaque(mi.UInt32, job.first_row)
        rays = self.rays_through(scene, contents, sensor, film, sampler, (row, column), job.total)
        rays.laser, rays.strata = laser, (stratum, spp)
        return rays

    def rays_through(self, scene, contents, sensor, film, sampler, pixel, total, wavelength=None):
        """Draw a primary ray through each of some pixels.

        Args:
            contents: :class:`~..transport.scene_contents.SceneContents`.
            sensor, film: sensor and its film.
            sampler: seeded sampler of the lanes.
            pixel: pixel of each ray as (row, column), UInt32.
            total: samples of a pixel that are added up.
            wavelength: number that chooses the wavelengths, None to draw one.

        Returns:
            :class:`~..sensors.origin.PrimaryRays`, attached to the sensor.
        """
        row, column = pixel
        offset, weight = self.offset_in_pixel(film, sensor, sampler)
        position = mi.Point2f(mi.Float(column), mi.Float(row)) + 0.5 + offset
        # The same map to [0, 1]^2 as Mitsuba's integrators use: relative to the crop window.
        position = position / mi.ScalarVector2f(film.crop_size())
        aperture = sampler.next_2d() if sensor.needs_aperture_sample() else mi.Point2f(0)
        time = sensor.shutter_open()
        if sensor.shutter_open_time() > 0:
            time += sampler.next_1d() * sensor.shutter_open_time()
        if wavelength is None:
            wavelength = sampler.next_1d() if mi.is_spectral else mi.Float(0)
        seen = views(sensor, position, lambda: self.reference(scene))
        with dr.resume_grad():
            ray, ray_weight = sample_rays(sensor, seen, time, wavelength, position, aperture)
            if film.curves is not None:
                ray, ray_weight = film.curves.draw(sensor, ray, ray_weight, wavelength)
            η, clip = index_at_sensor(seen, contents.surroundings, scene), None
            if contents.media is not None and contents.media.at_sensor is not None:
                ray, clip = start_at_sensor(seen, ray)
        scale = dr.opaque(mi.Float, 1 / total)
        if weight is not None:
            scale *= weight
        rays = PrimaryRays(sampler, ray, ray_weight, scale, row, column, seen, η, clip=clip)
        rays.meter_normal = meter_normal(sensor, rays.ray, position)
        return rays

    def offset_in_pixel(self, film, sensor, sampler):
        """Draw a place in a pixel, from two numbers of the sampler.

        Returns:
            (offset from the pixel's centre, Point2f, pixels; weight, Float, None for one).
        """
        return film.sample_offset(sampler.next_2d())

    def channel_match(self, contents, film, rays):
        """Return the detached :class:`~..films.colour.ChannelMatch` from spectra of primary rays to channels."""
        ray = dr.detach(rays.ray)
        rotation = sensor_rotation(rays.seen, ray) if mi.is_polarized else None
        weight = dr.detach(rays.weight) * rays.scale
        return ChannelMatch(ray.wavelengths, weight, film.curves or contents.observer, rotation)

    def pixel_indices(self, film, job, rays):
        """Return where primary rays write to.

        Args:
            job: launch of the rays.
            rays: :class:`~..sensors.origin.PrimaryRays`.

        Returns:
            (index of the pixel's first entry in its storage band, index of the pixel in the film), UInt32.
        """
        width = int(film.crop_size()[0])
        first = film.band_layout()[job.band][0]
        pixel = dr.fma(rays.row, width, rays.column)
        in_band = pixel - dr.opaque(mi.UInt32, first * width)
        base = in_band * film.entries_per_pixel()
        if (entry := film.first_entry()) is not None:
            base += entry
        return base if rays.laser is None else film.pixel_base(base, rays.laser), pixel

    def first_opl(self, film, rays):
        """Return the optical path length before the primary ray's origin, minus ``start_opl``, metres (Float64)."""
        length = mi.Float(0)
        if not self.camera_unwarp:
            length = rays.length()
        return mi.Float64(length) - film.start_opl

    def beside(self, context, sensor, film, seed, samples):
        """Return further terms of the derivatives of a job, such as the boundary term.

        Args:
            context: :class:`~..transport.context.RenderContext` of the job.
            sensor, film: sensor and its film.
            seed: seed of the job.
            samples: largest number of samples of a pixel.

        Returns:
            Objects with ``tables()`` (attached to the parameters), ``backward(incoming)``, ``forward()`` and
            ``can_be_recorded``.

        Raises:
            GradientError: if a term is needed and cannot be computed.
        """
        return []

    def primary_path(self, context, film, rays):
        """Return the :class:`~..transport.walk.Path` of detached primary rays, and prepare the strategies for them.

        Args:
            context: :class:`~..transport.context.RenderContext` of the job.
            film: film of the sensor.
            rays: :class:`~..sensors.origin.PrimaryRays` of a launch.
        """
        ray, η = dr.detach(rays.ray), dr.detach(rays.η)
        context.start(rays)
        path = start(context, ray, self.first_opl(film, rays), η)
        path.leg = first_leg(context, rays.sampler, ray, rays.leg)
        return path

    def shared_light(self, context, film):
        """Return functions that add light to the film which no path finds; each takes a :class:`.job.Job`.

        Args:
            context: :class:`~..transport.context.RenderContext` of the job.
            film: film of the sensor, ready to be written to.
        """
        return []

    # ----------------------------------------------------------------------------------- entry points

    @no_collection()
    def prepared(self, scene, sensor=0, seed=0, spp=0, kind=RENDER, grad_in=(None, None)):
        """Look up, check and tabulate the data that a job needs, outside of recorded code.

        Other arguments and errors are those of :meth:`render`, :meth:`render_backward` and :meth:`render_forward`.

        Args:
            kind: one of :data:`~torchtransient.interfaces.JOBS`.
            grad_in: adjoint of the images, in reverse mode.

        Returns:
            :class:`.job.Prepared`, the argument of :meth:`run`.
        """
        if kind not in JOBS:
            raise SceneError(f"prepared: expected a kind of job, one of {', '.join(JOBS)}, got {kind!r}.")
        with dr.suspend_grad():
            sensor, film = self.resolve(scene, sensor)
            contents, wanted = self.contents(scene, sensor), None
            if kind == RENDER:
                self._seen_scene(scene).follow_derivatives(scene, False)
                contents = self.contents(scene, sensor)
            else:
                contents, wanted = self._wanted(scene, sensor, film)
            self._warn_of_rest(scene, contents, film)
            with dr.resume_grad():
                velocities = Velocities.of_job(scene, contents, film)
            context = self.render_context(scene, contents, wanted, film.arrivals(), velocities=velocities)
            lanes = None if context.record_room is None else context.record_room.lanes
            sampler = self.sampler_of(scene, sensor)
            launches, samples = passes_of(sampler, film, seed, int(spp), context.most_events(), lanes)
            film.tabulate_filter()
            job = Prepared(kind, self, scene, sensor, film, context, launches, seed_array(seed), samples)
            job.plugins = self._seen_scene(scene).python_plugins(scene, [sampler])
            if wanted is not None:
                job.beside = self.beside(context, sensor, film, seed, samples)
            if kind == BACKWARD:
                job.incoming = IncomingAdjoint(film, *grad_in)
            if kind == FORWARD:
                with dr.resume_grad():
                    propagate_tangents(self.parameters(scene), job.tables())
            job.refusal = self.refusal_of(job)
            return job

    def refusal_of(self, job) -> str | None:
        """Return the reason why ``dr.freeze`` cannot record a job, None if it can."""
        for plugin in job.plugins:
            if not says_it_can_be_recorded(plugin):
                return f"the plugin {type(plugin).__name__} does not say that it can be (can_be_recorded)"
        if job.context.record_room is not None and job.context.record_room.in_memory:
            return "records of so many bounces lie in global memory"
        if not all(part.can_be_recorded for part in job.beside):
            return "derivatives beside paths read numbers of the scene"
        return None

    @staticmethod
    def state_of(jobs):
        """Return (structure, arrays) of prepared jobs, see :func:`.job.state_of`."""
        return state_of(jobs)

    @no_collection()
    def run(self, prepared, progress=None):
        """Execute a prepared job; this is what ``dr.freeze`` records.

        A render or a tangent stays in the film, gradients arrive at the parameters of the scene and at the tables of
        the job.

        Args:
            prepared: :class:`.job.Prepared` by :meth:`prepared`.
            progress: function of the share of a render that is done, or None.
        """
        with dr.suspend_grad():
            if prepared.kind != RENDER:
                (_backward if prepared.kind == BACKWARD else _forward)(prepared)
                return

            context, film, launches = prepared.context, prepared.film, prepared.launches
            film.start_render(prepared.samples)

            # ------------------------------------------------------------------------- samples that pixels share
            shared = self.shared_light(context, film)
            parts = len(shared) + bool(context.walks)
            for i, add in enumerate(shared):
                add(Job(launches, prepared.seed, prepared.samples, share_of(progress, i, parts)))

            # ------------------------------------------------------------------------- paths
            progress = share_of(progress, len(shared), parts)
            for i, launch in enumerate(launches if context.walks else ()):
                rays, match, base, pixel = _primary_rays(prepared, launch)
                block = film.create_event_block(launch, base, match, context.most_events())
                path = self.primary_path(context, film, rays)
                _, state = walk(context, rays.sampler, path, FilmSink(block))
                film.add_steady(pixel, match.to_channels(state["L"]))
                film.add_outside(pixel, state["before"], state["after"])
                block.finish()
                # Not later: kernels hold addresses of shapes, which `mi.render` may free with the scene.
                dr.eval(film.bands[launch.band][2], film.steady, film.outside)
                if progress:
                    dr.sync_thread()
                    progress((i + 1) / len(launches))
            film.finish_render()

    @no_collection()
    def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True, progress_callback=None):
        """Render an image of a sensor.

        Args:
            sensor: sensor, or its index in the scene.
            seed: whole number, or UInt32 of width one.
            spp: samples per pixel, 0 for those of the sampler.
            develop: return the images; otherwise the result stays in the film.
            evaluate: without effect, an argument of Mitsuba's; the kernels run at once.
            progress_callback: function of the share that is done, called after every launch; or None.

        Returns:
            Steady ``(H, W, C)`` and transient ``(H, W, T, C)`` TensorXf, or None.
        """
        with dr.suspend_grad():
            if develop:
                self.resolve(scene, sensor)[1].check_one_band()
            job = self.prepared(scene, sensor, seed, spp)
            self.run(job, progress_callback)
            return job.film.develop() if develop else None

    @no_collection()
    def render_backward(self, scene, params, grad_in, sensor=0, seed=0, spp=0):
        """Accumulate the gradient of ``<grad_in, render()>`` into the attached parameters of the scene.

        Args:
            params: not used; parameters are found through Dr.Jit's graph.
            grad_in: adjoints as (steady ``(H, W, C)`` or None, transient or None). The transient is a TensorXf ``(H, W,
                T, C)``, or the tuple ``(flat array, offset, (row, column, bin, channel) strides)``, which reads any
                layout without a copy.
            sensor, seed, spp: sensor or its index, seed, and samples per pixel (0 for those of the sampler), see
                :meth:`render`.

        Raises:
            GradientError: if a path length can change and the temporal filter has no slope, or without a bound on the
                depth.
        """
        job = self.prepared(scene, sensor, seed, spp, BACKWARD, grad_in)
        if grad_in[0] is not None or grad_in[1] is not None:
            self.run(job)

    def _wanted(self, scene, sensor, film):
        """Return (contents, wanted derivatives). Raises GradientError if film or depth have none."""
        self._seen_scene(scene).follow_derivatives(scene, True)
        contents = self.contents(scene, sensor)
        with dr.resume_grad():  # while suspended, no parameter counts as attached
            tracker = self.parameters(scene)
            effects = tracker.attached()
            tracker.check_black()
        check_stand_ins(effects)
        felt = [one for one in effects if film.knows_rates or one[2].role != "velocity"]
        check_slope(moving_names(felt), film.has_slope, film.response_name, film.slope_remedy)
        if self.max_depth == UNLIMITED:
            raise GradientError(
                "Gradients keep one record per bounce and need a bound: max_depth is -1 (no limit). Set max_depth to a "
                "finite number, for instance to where the remaining throughput no longer matters."
            )
        if contents.untraceable:
            raise GradientError(
                f"{contents.untraceable[0]!r}: Mitsuba's directionalarea cannot be asked for its light in a "
                "direction, which derivatives ask all lights for. Describe it as 'diff_directionalarea', as tt.load "
                "does, or leave it out: paths from a sensor never meet its light."
            )
        if self.warns_of_edges:
            self._warn_of_edges(scene, sensor, effects)
            self._warn_of_velocities(scene, film, effects)
        return contents, Wanted(effects, sensor, contents, film.knows_rates)

    def _warn_of_edges(self, scene, sensor, effects):
        """Warn once a scene of the gaps in the derivative of each attached parameter."""
        warned = self._seen_scene(scene).warned_of_edges
        new = [one for one in effects if one[2].moves_silhouette and (one[0].ptr, one[1]) not in warned]
        if not new:
            return
        warned.update((node.ptr, key) for node, key, _ in new)
        edges, found = self.silhouettes(scene, [sensor]), {}
        for node, key, effect in new:
            for gap in edges.lacking(node, key, effect):
                found.setdefault(gap, []).append(f"{node.id()}.{key}".lstrip("."))
        for gap, keys in found.items():
            warnings.warn(gap.message(keys), GradientWarning, stacklevel=3)

    def _warn_of_velocities(self, scene, film, effects):
        """Warn once a scene of each attached velocity that the film does not measure."""
        warned = self._seen_scene(scene).warned_of_velocities
        found = [(node, key) for node, key, effect in effects if effect.role == "velocity" and not film.knows_rates]
        new = [(node, key) for node, key in found if (node.ptr, key) not in warned]
        warned.update((node.ptr, key) for node, key in new)
        if new:
            names = [f"{node.id()}.{key}".lstrip(".") for node, key in new]
            warnings.warn(unmeasured(names), GradientWarning, stacklevel=level_of_user())

    def _warn_of_rest(self, scene, contents, film):
        """Warn once a scene of films of rates where nothing moves."""
        seen = self._seen_scene(scene)
        if film.knows_rates and not seen.warned_of_rest and not movers_of(scene, contents):
            seen.warned_of_rest = True
            warnings.warn(AT_REST, TorchTransientWarning, stacklevel=level_of_user())

    @no_collection()
    def render_forward(self, scene, params, sensor=0, seed=0, spp=0, develop=True):
        """Render the derivative along the tangents that are set on the scene's attached parameters.

        One pass over the samples for one tangent. Tangents are set on values of the scene or on variables that they are
        computed from, and are propagated from there. A caller who does so before clears the edges
        (``ADFlag.ClearEdges``) and keeps the variables between: Dr.Jit's default flags remove it, with a warning here,
        and without any flag it is counted twice.

        Args:
            params: not used; parameters are found through Dr.Jit's graph.
            sensor, seed, spp, develop: sensor or its index, seed, samples per pixel (0 for those of the sampler), and
                whether images are returned, see :meth:`render`.

        Returns:
            Steady ``(H, W, C)`` and transient ``(H, W, T, C)`` TensorXf, or None.

        Raises:
            GradientError: as :meth:`render_backward` raises it.
        """
        with dr.suspend_grad():
            job = self.prepared(scene, sensor, seed, spp, FORWARD)
            self.run(job)
            return job.film.develop() if develop else None

    def to_string(self):
        return (
            f"{type(self).__name__}[\n  max_depth = {self.max_depth},\n  rr_depth = {self.rr_depth},\n"
            f"  camera_unwarp = {self.camera_unwarp},\n  discard_direct_light = {self.discard_direct_light}\n]"
        )


# --------------------------------------------------------------------------------------------------------------------
# Launches of a job. Each launch of a derivative records its paths and walks over the record again.

def _primary_rays(job, launch):
    """Return (primary rays, map to the film's channels, first entry and pixel of each lane)."""
    integrator, context = job.integrator, job.context
    rays = integrator.start(context.scene, context.contents, job.sensor, job.film, launch)
    match = integrator.channel_match(context.contents, job.film, rays)
    base, pixel = integrator.pixel_indices(job.film, launch, rays)
    return rays, match, base, pixel


def _record_sink(job, rays, block=None):
    """Return the sink that records paths, with their arrivals for the adjoint ``block``."""
    return RecordSink(block, dr.width(rays.ray) if job.context.record_room.in_memory else None)


def _backward(job):
    """Execute a prepared job in reverse mode, with gradients suspended."""
    integrator, context = job.integrator, job.context
    # Derivatives wait at the arrays that kernels read until the scope ends after the last launch; Dr.Jit carries on
    # then: following the graph further uses up its edges, and only those of the first launch would arrive.
    with dr.isolate_grad(), context.contents.hidden_from_mitsuba():
        for launch in job.launches if context.walks else ():
            rays, match, _, pixel = _primary_rays(job, launch)
            block = job.incoming.block(rays, pixel, match)
            path, sink = integrator.primary_path(context, job.film, rays), _record_sink(job, rays, block)
            count, record = walk(context, rays.sampler, path, sink)
            adjoint = reverse(context, sink.layout, record, count, block, dr.detach(rays.ray))
            with dr.resume_grad():
                if context.wanted.sensor or dr.grad_enabled(rays.η):
                    # A sensor on a moving shape may have rays to given points, which do not move.
                    flags = dr.ADFlag.Default | dr.ADFlag.AllowNoGrad
                    dr.backward_from(objective_of(context, rays, adjoint), flags)
            # Dropped before the next launch is traced.
            del rays, match, pixel, block, path, sink, count, record, adjoint
            dr.eval()
        for part in job.beside:
            part.backward(job.incoming)


def _forward(job):
    """Execute a prepared job in forward mode, with gradients suspended: the film holds the tangent afterwards."""
    integrator, context, film = job.integrator, job.context, job.film
    film.start_render(job.samples)
    with context.contents.hidden_from_mitsuba():
        for launch in job.launches if context.walks else ():
            rays, match, base, pixel = _primary_rays(job, launch)
            block = film.create_event_block(launch, base, match, context.most_events(), tangents=True)
            tangent = tangent_of(context, rays)
            path, sink = integrator.primary_path(context, film, rays), _record_sink(job, rays)
            count, record = walk(context, rays.sampler, path, sink)
            dL = forward(context, sink.layout, record, count, block, dr.detach(rays.ray), tangent)
            film.add_steady(pixel, match.to_channels(dL))
            block.finish()
            del rays, match, base, pixel, block, tangent, path, sink, count, record, dL
            dr.eval(film.bands[launch.band][2], film.steady)
        for part in job.beside:
            part.forward()
    film.finish_render()
