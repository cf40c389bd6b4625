"""``tt.TransientRenderer`` and ``tt.render``: a scene as a function of torch tensors."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import nn

from torchtransient.axes import FrequencyAxis, RateAxis, TimeAxis
from torchtransient.checks import Numbers, flag, is_one_of, shown
from torchtransient.chirps import Chirps
from torchtransient.errors import ArgumentError, SceneError, ShapeError, UnitError
from torchtransient.gates import Gate
from torchtransient.modules import CopiesParametrized
from torchtransient.plugins.parameters import check_slope, sun_axes
from torchtransient.pulses import Pulse
from torchtransient.rendering import engine
from torchtransient.rendering.arguments import (
    Values,
    checked_depth,
    checked_filter,
    checked_grad_seed,
    checked_keys,
    checked_sampler,
    checked_samples,
    checked_values,
    requested_film,
    sensor_list,
    torch_names,
)
from torchtransient.rendering.autograd import RenderCall, run
from torchtransient.rendering.batches import with_differences
from torchtransient.rendering.error_bars import CELL_BINS, CELL_PIXELS, BatchErrors, ErrorCells
from torchtransient.rendering.film_layout import FilmLayout, steady_channels_first
from torchtransient.rendering.job import (
    SEED_RANGE,
    Item,
    RenderJob,
    Seeding,
    draw_seed,
    rounded_count,
    samples_drawn,
    warn_of_range,
    whole_number,
)
from torchtransient.rendering.output import RenderOutput, RenderStats
from torchtransient.rendering.passes import PassSums, samples_of_pass
from torchtransient.rendering.progress import Bar
from torchtransient.rendering.tolerance import Loss, Request, ToleranceResult, render_to_tolerance
from torchtransient.scene.edits import BuildOptions, built_depth, checked_pulse
from torchtransient.scene.load import Scene, load
from torchtransient.scene.objects import sampler_plugin
from torchtransient.scene.opaque import opaque
from torchtransient.scene.parameters import ParameterInfo, missing_edges, needing_slope, unknown_key
from torchtransient.scene.physics import PhysicsWatch
from torchtransient.scene.pilot import DepthBound, depth_bound
from torchtransient.scene.plan import Effects
from torchtransient.scene.samplers import correlation_warning
from torchtransient.scene.slope import check_filter, filter_for, has_slope, response_of
from torchtransient.scene.values import as_float, fit_shape, may_have_derivative
from torchtransient.scene.variant import active_variant, device_type, stokes_components


class TransientRenderer(CopiesParametrized):
    """Scene as a differentiable layer: its parameters are the module's, its output is time-resolved light.

    Copies and pickles carry the description. One lock makes threads safe. Second derivatives raise ``GradientError``.

    Args:
        scene: anything that :func:`torchtransient.load` takes. A steady ``hdrfilm`` and ``path`` are taken too: with
            ``time_axis`` they become a ``transient_hdr_film`` of its size and filter and a ``transient_path`` of its
            depth.
        parameters: keys of ``scene.parameters()`` that get an ``nn.Parameter`` each, starting at the scene's value, or
            a mapping from keys to start values. In ``state_dict`` and ``named_parameters`` the dots of a key are
            slashes, since torch forbids dots; ``renderer.values`` maps keys to parameters. ``tt.parametrize`` keeps
            them in range.
        time_axis: replaces the one of the scene's films; phasor films become histograms. At most one of ``time_axis``,
            ``frequencies``, ``gates``, ``rates``, ``chirps``, ``slow_times`` and ``film``, but for the axis of rates
            and chirps and the frequencies of slow times.
        frequencies: a :class:`FrequencyAxis`, or numbers in cycles per metre; the films become phasor films, and
            ``out.phasor`` takes the place of ``out.transient``.
        gates: :class:`Gate` objects; the films become gated films with ``out.gated``.
        rates: bins of the rate of path lengths (:class:`RateAxis`), in scenes where things move (``scene.moving``); the
            films become rate films with ``out.rates`` over the bins of ``time_axis``, or of the scene's histogram.
        chirps: :class:`Chirps` of a frequency-modulated lidar; the films become beat films with ``out.beats``.
        slow_times: times in seconds, beside ``frequencies``: phasors at each of them, as a radar's pulses see things
            that move, ``out.slow_phasor``.
        film: film as an object of ``torchtransient.rendering.films``, in place of these settings; films of one's own
            are asked for so.
        max_depth: replaces the integrator's. Where that is no limit, calls whose values can be differentiated by use a
            bound that a pilot run finds, for value and derivative: ``out.stats.max_depth``, beyond which
            ``out.stats.light_beyond`` of the light lies.
        spp, spp_grad: samples per pixel of the render and of its derivatives; None takes the scene's and the render's.
        temporal_filter: "box", "tent", "gaussian", or "auto": the scene's own, except that a box becomes a tent as soon
            as a parameter can change a path length (shapes, light position, sensor pose, index of refraction), because
            a box has no slope in time. Asking for such a derivative through an explicit box raises ``GradientError``.
            Phasors are smooth in time and take no filter.
        steady: False for a histogram without a steady image of its own: paths end with the window, and ``out.steady``
            is the sum over the bins.
        pulse, irf: shape of the light's pulse and impulse response of the sensor (:class:`Pulse`), for every film
            instead of its own; each arrival is spread by both while rendering, light beyond the axis counts as outside,
            and every filter has a slope then. After a render ``sensing.apply_pulse`` does the same to a transient.
        sensors: an index (None: the first, or a plan's), a list of indices, or "all": a list adds a leading sensor
            dimension, and its films must measure the same in one shape.
        grad_seed: None draws the samples of the derivative independently of the render (which makes gradients of
            squared losses unbiased), "same" takes the render's seed, an integer is taken as it is.
        effects: "auto" keeps the scene's transient film and integrator, and gives a steady scene the integrator that
            its contents call for; a :class:`Plan` of :func:`torchtransient.plan` brings variant, integrator, depth,
            time axis or frequencies, and temporal filter, where the arguments beside it do not say otherwise; it speaks
            of one sensor.
        sampler: plugin name of a sampler that replaces those of the sensors, with the same number of samples. None
            keeps the scene's samplers, except for "independent" and where a sensor names none: these are replaced by
            "owen", whose points fill each pixel's dimensions evenly. "scene" keeps those too. ``out.stats.sampler``
            has the name.
        physics: response to unphysical scenes and values: reflectances, albedos and other shares of the light outside
            of [0, 1], described or given, transforms without an inverse, windows that miss more than 5 % of the light,
            and depths that had to be bounded. "warn" gives a ``PhysicsWarning`` with the key and the number, once for a
            scene; "error" raises ``PhysicsError``, of bounds for those that leave out more than 5 %; "ignore" does not
            look.
        boundary: derivatives by keys that move silhouettes hold the light that moving edges hide and uncover (the
            boundary term, see ``docs/gradients.md``), unless the scene's integrator leaves it out; False leaves it out.
            Where a derivative lacks a part, the first call with values that can be differentiated by warns with the
            keys (``GradientWarning``), and with ``physics="error"`` raises ``GradientError``, unless the part was left
            out.
        spp_boundary: samples per pixel of each pass of the boundary term, None for half of those of the derivative.
        freeze: True records the kernels of a call, so that later calls need no tracing, with the same values, gradients
            and noise; ``out.stats.recorded`` says whether, ``docs/speed.md`` when a recording is made anew.

    Raises:
        ArgumentError, UnitError, ShapeError: for other arguments.
        SceneError: for scenes without a sensor, keys that the scene does not have, and whatever Mitsuba refuses.
        GradientError: for keys without a derivative.
    """

    @opaque
    def __init__(
        self,
        scene: Any,
        parameters: Sequence[str] | Mapping[str, Any] = (),
        *,
        time_axis: TimeAxis | None = None,
        spp: int | None = None,
        spp_grad: int | None = None,
        max_depth: int | None = None,
        temporal_filter: str = "auto",
        sensors: int | Sequence[int] | str | None = None,
        effects: Effects | str = "auto",
        grad_seed: int | str | None = None,
        sampler: str | None = None,
        frequencies: FrequencyAxis | Numbers | None = None,
        pulse: Pulse | None = None,
        irf: Pulse | None = None,
        gates: Sequence[Gate] | None = None,
        rates: RateAxis | None = None,
        chirps: Chirps | None = None,
        slow_times: Numbers | None = None,
        steady: bool = True,
        film: FilmLayout | None = None,
        physics: str = "warn",
        boundary: bool = True,
        spp_boundary: int | None = None,
        freeze: bool = True,
    ):
        super().__init__()
        named = {"time_axis": time_axis, "frequencies": frequencies, "gates": gates, "rates": rates, "chirps": chirps}
        named["slow_times"] = slow_times
        film = requested_film(film, named)
        if isinstance(effects, Effects):
            scene = effects.planned_scene(scene)
            film, temporal_filter = effects.film_settings(film, temporal_filter)
            max_depth = effects.max_depth if max_depth is None else max_depth
            pulse, irf = pulse or effects.pulse, irf or effects.irf
            sensors = effects.sensor if sensors is None else sensors
        elif not is_one_of(effects, ("auto",)):
            raise ArgumentError(f"effects: expected 'auto' or a plan of tt.plan(...), got {shown(effects)}.")
        self._keys = checked_keys(parameters)
        self.scene: Scene = load(scene)
        self.spp, self.spp_grad = checked_samples("spp", spp), checked_samples("spp_grad", spp_grad)
        self.temporal_filter = checked_filter(temporal_filter)
        self.grad_seed = checked_grad_seed(grad_seed)
        self.freeze = bool(freeze)
        self.boundary, self.spp_boundary = flag("boundary", boundary), checked_samples("spp_boundary", spp_boundary)
        if not self.boundary and self.spp_boundary is not None:
            raise ArgumentError(
                "spp_boundary: expected none with boundary=False, which leaves out what they are samples of; leave one "
                "of both out."
            )
        self._asked_of_edges: set[str] = set()
        self._asked_of_velocities: set[str] = set()
        self._watch = PhysicsWatch(physics, self.scene.warned)
        changes: dict[str, Any] = {"pulse": checked_pulse("pulse", pulse), "irf": checked_pulse("irf", irf)}
        changes |= {"film": film, "steady": bool(steady)}
        if isinstance(effects, Effects):
            changes |= {name: getattr(effects, name) for name in ("integrator", "rr_depth")}
            # Made for the gates of the plan.
            changes["connections"] = effects.connections if film is effects.film_choice else None
        self.sampler = checked_sampler(sampler)
        options = BuildOptions(transient=True, max_depth=checked_depth(max_depth), **changes)
        self._options = self.scene.options_for(self._keys, options)
        table = self.scene.parameters() if self._keys else {}
        self._infos: dict[str, ParameterInfo] = {key: table[key] for key in self._keys}
        with active_variant(self.scene.variant):
            self._read_scene(0 if sensors is None else sensors)
            if isinstance(effects, Effects):
                effects.check_sensors(self._sensors)
            start = self._initial_values(parameters)
            self._look_at_scene()
        self._names = torch_names(self._keys)
        for key in self._keys:
            self.register_parameter(self._names[key], nn.Parameter(start[key]))

    # --------------------------------------------------------------------------------------------------- set-up

    def _read_scene(self, sensors: int | Sequence[int] | str) -> None:
        """Read sensors, axis, film and samples off the built scene."""
        built = self.scene.built(self._options)
        found = built.scene.sensors()
        if not found:
            raise SceneError(f"{self.scene!r} has no sensor; add one.")
        self._sensors, self._stack_sensors = sensor_list(sensors, len(found))
        if self.spp_boundary is not None and not hasattr(built.scene.integrator(), "spp_boundary"):
            raise ArgumentError(
                f"spp_boundary: {built.integrator} draws no samples of its own for moving edges; leave it out."
            )
        self.film = engine.check_items(found, [Item(0, sensor, 0, 0) for sensor in self._sensors])
        films = [found[sensor].film() for sensor in self._sensors]
        self._cube_shape = tuple(films[0].cube_shape())
        self._channels = tuple(films[0].channel_names())
        sampler = engine.sampler_of(built.scene, found[self._sensors[0]], self.sampler)
        self._scene_spp = int(sampler.sample_count())
        plugin = sampler_plugin(sampler)
        if warning := correlation_warning(plugin):
            self._watch.warn(f"sampler {plugin}", f"{plugin!r}: {warning}.", is_error=False)
        self._counts = {self._scene_spp: self._scene_spp}
        self._pulsed = all(film.pulses for film in films)
        self._response = response_of(films)
        self._scene_filter = films[0].temporal_filter
        if not self.film.has_bins:
            if self.temporal_filter != "auto":
                raise ArgumentError(
                    f"temporal_filter: a {self.film.measures} film has none, expected 'auto', "
                    f"got {self.temporal_filter!r}."
                )
            return
        of_integrator = getattr(built.scene.integrator(), "temporal_filter", "")
        self._scene_filter = of_integrator or self._scene_filter
        names = sorted({film.temporal_filter for film in films})
        if self.temporal_filter == "auto" and not of_integrator and len(names) > 1:
            raise ArgumentError(
                f"temporal_filter: the films of sensors {list(self._sensors)} have different ones, {', '.join(names)}. "
                "Say which, for instance temporal_filter='box', or use one TransientRenderer per sensor."
            )

    def _look_at_scene(self) -> None:
        if self._watch.enabled:
            built = self.scene.built(self._options)
            slots = self.scene.slots(self._keys, self._options).slots
            if self.film.count > 1 or self.effective_filter in ("", "box"):
                # Of one bin for all times a wider filter spreads up to a half over the rim, which is no loss.
                self._watch.window_name = f"window of {self.film.describe('')}"
            ranges = built.ranges() if self._keys else {}
            self._watch.ranges = {key: ranges[key] for key in self._keys if key in ranges}
            self._watch.transforms = frozenset(slot.key for slot in slots if slot.kind.endswith("transform"))
            self._watch.directions = sun_axes(built.params, self._keys)
            # What is given replaces what is described.
            findings = self.scene.findings(self._options)
            self._watch.check_description({key: text for key, text in findings.items() if key not in self._keys})

    def _initial_values(self, given: Sequence[str] | Mapping[str, Any]) -> dict[str, torch.Tensor]:
        slots = self.scene.slots(self._keys, self._options).slots
        self._shapes = {slot.key: slot.shape for slot in slots}
        device = device_type(self.scene.variant)
        start = {}
        for slot in slots:
            value = torch.tensor(slot.initial, dtype=torch.float32, device=device).reshape(slot.shape)
            if isinstance(given, Mapping) and given[slot.key] is not None:
                own = given[slot.key]
                own = as_float(slot.key, own.to(device) if isinstance(own, torch.Tensor) else own, device)
                value, batched = fit_shape(slot.key, own.clone(), slot.shape)
                if batched:
                    raise ShapeError(
                        f"start value of {slot.key!r}: expected shape {slot.shape}, got {tuple(value.shape)}."
                    )
            start[slot.key] = value
        return start

    # ------------------------------------------------------------------------------------------------------ use

    @property
    def axis(self) -> TimeAxis | None:
        """Time axis of the film, None for a film without one."""
        return self.film.attributes().get("axis")

    @property
    def frequencies(self) -> FrequencyAxis | None:
        """Frequencies of a phasor film, else None."""
        return self.film.attributes().get("frequencies")

    @property
    def gates(self) -> tuple[Gate, ...] | None:
        """Gates of a gated film, else None."""
        return self.film.attributes().get("gates")

    @property
    def rates(self) -> RateAxis | None:
        """Bins of the rate of a rate film, else None."""
        return self.film.attributes().get("rate_axis")

    @property
    def chirps(self) -> Chirps | None:
        """Chirps of a beat film, else None."""
        return self.film.attributes().get("chirps")

    @property
    def values(self) -> Values:
        """Parameters by their Mitsuba keys; of a parametrized one its value, which is no leaf of a graph."""
        return Values(self, self._names)

    @property
    def effective_filter(self) -> str:
        """Temporal filter of renders, with "auto" resolved; empty for a film without one."""
        if self.temporal_filter != "auto":
            return self.temporal_filter
        moving = needing_slope(self._infos, self._keys, self.film.knows_rates)
        return filter_for(moving, self._scene_filter, self._pulsed)

    @opaque
    def variation(
        self,
        *,
        sampler: str | None = None,
        temporal_filter: str | None = None,
        integrator: str | None = None,
        max_depth: int | None = None,
        time_axis: TimeAxis | None = None,
    ) -> TransientRenderer:
        """Return a copy with the same values and other settings. None keeps this renderer's.

        Args:
            sampler: plugin name of a sampler, or "scene".
            temporal_filter: "box", "tent", "gaussian" or "auto".
            integrator: plugin name of a transient integrator; it takes over the parameters of this renderer's.
            max_depth: longest path, in segments; -1 for no limit.
            time_axis: bins in place of those of this renderer's film.

        Returns:
            The copy, with parameters of its own.

        Raises:
            ArgumentError: for other names and depths, and for a filter or a time axis of a film that has no bins.
            SceneError: for an integrator that cannot render the scene.
        """
        if temporal_filter is not None:
            checked_filter(temporal_filter)
        if not self.film.has_bins and temporal_filter not in (None, "auto"):
            raise ArgumentError(f"temporal_filter: the film has none, expected 'auto', got {temporal_filter!r}.")
        if not self.film.has_bins and time_axis is not None:
            raise ArgumentError(f"time_axis: a {self.film.measures} film has no bins, expected None, got {time_axis}.")
        twin = copy.deepcopy(self)
        if sampler is not None:
            twin.sampler = checked_sampler(sampler)
        if temporal_filter is not None:
            twin.temporal_filter = temporal_filter
        changes: dict[str, Any] = {
            "integrator": integrator,
            "max_depth": checked_depth(max_depth),
            "film": None if time_axis is None else self.film.over(time_axis),
        }
        changes = {name: value for name, value in changes.items() if value is not None}
        if changes:
            twin._rebuild(changes)
        return twin

    @opaque
    def _rebuild(self, changes: Mapping[str, Any]) -> None:
        """Change options of the build, in a scene of its own: others keep their built scenes and recordings."""
        self._options = replace(self._options, **changes)
        self.scene = self.scene.apart()
        with active_variant(self.scene.variant):
            self._read_scene(list(self._sensors) if self._stack_sensors else self._sensors[0])

    def has_slope_for(self, keys: Sequence[str]) -> bool:
        """Return whether gradients for ``keys`` exist with the filter or gates in use: a box has none of path lengths.

        Args:
            keys: some keys of the renderer's parameters.

        Returns:
            True if no key changes path lengths, or the film's response has a slope over time.

        Raises:
            UnknownKeyError: for keys that the renderer does not have.
        """
        moving = needing_slope(self._infos, checked_keys(keys, tuple(self._infos)), self.film.knows_rates)
        return not moving or (has_slope(self.effective_filter, self._pulsed) and self._response[0])

    @opaque
    def samples_drawn(self, spp: int) -> int:
        """Return the samples per pixel that a render draws: stratified samplers round up.

        Args:
            spp: samples per pixel that are asked for.

        Returns:
            Samples per pixel, at least ``spp``.

        Raises:
            UnitError: if ``spp`` is no positive integer.
        """
        with active_variant(self.scene.variant):
            return samples_drawn(self._sampler_in_use(), checked_samples("spp", spp))

    def _sampler_in_use(self) -> Any:
        """Return a copy of the sampler that draws, under the scene's variant."""
        scene = self.scene.built(self._options).scene
        return engine.sampler_of(scene, scene.sensors()[self._sensors[0]], self.sampler)

    @opaque
    def forward(
        self,
        values: Mapping[str, Any] | None = None,
        *,
        seed: int | Sequence[int] | None = None,
        spp: int | None = None,
        errors: bool | str = False,
        progress: bool = False,
    ) -> RenderOutput:
        """Render the scene with the module's parameters, or with ``values`` in their place.

        Args:
            values: values by key of ``parameters``, in place of the module's own: tensors, arrays, lists or numbers of
                the shapes that ``scene.parameters()`` lists, or with one leading batch dimension B more; values without
                it are used for every entry. Any real dtype is taken and computed in float32.
            seed: same seed, same tensor. None draws one from torch's generator (``torch.manual_seed``). In a batch
                every entry has its own seed, derived from this one, the first entry the seed itself; or give one seed
                per entry.
            spp: samples per pixel, None for the renderer's.
            errors: True renders in independent batches of samples (two, or eight where pixels share light) and keeps
                their differences in cells of 4 x 4 pixels x 8 bins, so that ``out.standard_error`` knows the error of
                sums; "bins" keeps it bin by bin.
            progress: show a progress bar.

        Returns:
            A :class:`RenderOutput` whose tensors carry gradients to the values.

        Raises:
            SceneError: for unknown keys.
            ShapeError, DeviceError, UnitError: for values of other shapes or devices, and values that are not finite.
            StorageError: when the cube would not fit into memory.
            GradientError: for a derivative through a box.
        """
        tensors, batched, batch = self._collect(values)
        temporal_filter = self.effective_filter
        self._check_slope(temporal_filter, tensors)
        self._check_edges(tensors)
        self._check_velocities(tensors)
        request = self._error_request(errors)
        wanted = checked_samples("spp", spp) or self.spp or self._scene_spp
        if request is not None and wanted < request.batches:
            raise ArgumentError(
                f"errors: expected at least {request.batches} samples per pixel, one for each batch, got spp={wanted}."
            )
        used = used_grad = rounded_count(wanted, self._counts, self.samples_drawn)
        graph = torch.is_grad_enabled()
        if self.spp_grad is not None and any(may_have_derivative(tensor, graph=graph) for tensor in tensors):
            used_grad = rounded_count(self.spp_grad, self._counts, self.samples_drawn)
        seeding = Seeding(self._sensors, 1 if batch is None else batch, self.grad_seed)
        number, per_entry = draw_seed(seed)
        bar = Bar() if progress else None
        job = RenderJob(
            scene=self.scene,
            options=self._options,
            keys=self._keys,
            items=() if number is None else seeding.items(number),
            seeding=seeding,
            batched=tuple(batched),
            spp=used,
            spp_grad=used_grad,
            temporal_filter=temporal_filter or None,
            sampler=self.sampler,
            watch=self._watch,
            progress=bar,
            freeze=self.freeze,
            bound=self._depth_bound(values, tensors),
            boundary=self.boundary,
            spp_boundary=self.spp_boundary,
            errors=request,
        )
        try:
            seed_given = () if per_entry is None else (per_entry,)
            steady, response = run(RenderCall(job, len(seed_given)), *seed_given, *tensors)
        finally:
            if bar is not None:
                bar.close()
        leading = (*(() if batch is None else (batch,)), *((len(self._sensors),) if self._stack_sensors else ()))
        pixels, components = self._cube_shape[0] * self._cube_shape[1], stokes_components(self.scene.variant)
        steady = steady_channels_first(steady, leading, components)
        response = self.film.channels_first(response, leading, components)
        stats = RenderStats.of_job(job, pixels)
        out = RenderOutput.of(self.film, steady, response, stats=stats, channels=self._channels)
        return out if request is None else with_differences(out, request, leading)

    def _error_request(self, errors: bool | str) -> BatchErrors | None:
        """Return the request for error bars of a call, None for none."""
        if not isinstance(errors, bool) and not is_one_of(errors, ("bins",)):
            raise ArgumentError(f"errors: expected True, False or 'bins', got {shown(errors)}.")
        if errors is False:
            return None
        rows = len(self.film.shape) > 1
        if len(self._cube_shape) > 4 + rows:
            raise ArgumentError("errors: expected False for exhaustive scans, whose error bars are not followed.")
        with active_variant(self.scene.variant):
            integrator = self.scene.built(self._options).scene.integrator()
        shared = not getattr(integrator, "pixels_are_independent", False)
        bins, pixels = (CELL_BINS if self.film.has_bins else 1, CELL_PIXELS) if errors is True else (1, 1)
        # Noise that pixels share adds up or cancels: a cell of several would not tell that of one.
        pixels = 1 if shared else pixels
        cells = ErrorCells(bins, pixels, pixels, shared)
        return BatchErrors(cells, stokes_components(self.scene.variant), self.film.is_complex, rows)

    @opaque
    def to_tolerance(
        self,
        values: Mapping[str, Any] | None = None,
        *,
        rtol: float,
        quantile: float = 0.9,
        on: torch.Tensor | Loss | None = None,
        max_seconds: float | None = None,
        max_spp: int | None = None,
        seed: int = 0,
        batch_spp: int | None = None,
        resume: ToleranceResult | None = None,
        progress: bool = True,
    ) -> ToleranceResult:
        """Render passes, without gradients, until the relative error of their mean is small enough.

        The error of a bin is the standard error of the mean over passes, channels averaged, relative to the mean of the
        bin and its neighbours (3 x 3 pixels, and 3 bins of time). The seed of a pass follows from ``seed`` and its
        number: the mean depends on the number of passes alone, not on interruptions. Without ``max_seconds`` and
        ``max_spp`` the render may take arbitrarily long; Ctrl-C ends it with the passes so far.

        Args:
            values: values by key of ``parameters``, in place of the module's own, see :meth:`forward`.
            rtol: relative error, 0.05 for 5 %.
            quantile: share of the bins with light whose error is to be at most that.
            on: None for bins whose local mean is at least 2 % of the mean over all bins; a mask of truth values that
                broadcasts to (T, H, W) or (C, T, H, W) for the bins that count, of phasors and gated films frequencies
                and gates in place of bins (those without any light never count); or a loss, a function of a
                ``RenderOutput`` that returns one number, whose relative error is meant then. It must be linear in the
                render: the mean of another loss over passes is not the loss of their mean.
            max_seconds: wall time of this call, after which it ends with the passes so far, at least one.
            max_spp: largest number of samples per pixel, those of ``resume`` included.
            seed: seed of the passes; the same as that of ``resume``.
            batch_spp: samples per pixel of a pass. None for at least 16 with the sampler ``owen``, 8 with others, and
                up to 256 of small films, to make 2^16 paths.
            resume: result of an earlier call with the same values, to go on from: its passes count.
            progress: show error, target and remaining time.

        Returns:
            A :class:`ToleranceResult`: the mean as ``output``, ``error``, ``reached``, ``reason``, and
            ``standard_error`` of each bin. ``reached`` is False where the time was over before, and where few of the
            passes hold most of the deviations: the error of a heavy tail is not known.

        Raises:
            UnitError, ArgumentError, ShapeError: for other arguments, and a ``resume`` of another render.
            SceneError, DeviceError, StorageError: as :meth:`forward` raises them.
        """
        request = Request(rtol, quantile, on, max_seconds, max_spp)
        number = whole_number(seed)
        if number is None:
            raise UnitError(f"seed: expected one whole number, from which those of passes follow, got {shown(seed)}.")
        warn_of_range([number])
        spp = checked_samples("batch_spp", batch_spp)
        # One switch of variant for all passes.
        with torch.no_grad(), active_variant(self.scene.variant):
            sampler = sampler_plugin(self._sampler_in_use())
            if spp is None:
                spp = samples_of_pass(sampler, self._cube_shape[0] * self._cube_shape[1])
            spp = self.samples_drawn(spp)
            settings: dict[str, Any] = {"variant": self.scene.variant, "sampler": sampler, "sensors": self._sensors}
            settings["temporal_filter"] = self.effective_filter
            built = self.scene.built(self._options)
            settings |= {"integrator": built.integrator, "max_depth": built_depth(built.scene.integrator())}
            settings["build of the scene"] = repr(self._options)
            tensors, _, _ = self._collect(values)
            kept = {key: tensor.detach().clone() for key, tensor in zip(self._keys, tensors, strict=True)}
            return render_to_tolerance(
                lambda seed: self.forward(values, seed=seed, spp=spp),
                PassSums(number % SEED_RANGE, spp, self.film, settings, kept),
                request,
                resume=resume,
                progress=progress,
            )

    def _collect(self, values: Mapping[str, Any] | None) -> tuple[list[torch.Tensor], list[bool], int | None]:
        """Return the tensors of a call in the order of the keys, which of them are batched, and the batch size."""
        given = checked_values(values)
        for key in given:
            if key not in self._shapes:
                hint = unknown_key(key, list(self._shapes), "this renderer")
                raise SceneError(f"values: {hint} It was made with parameters={list(self._keys)}.")
        tensors, batched, batch = [], [], None
        for key in self._keys:
            value = as_float(key, given.get(key, self.values[key]), device_type(self.scene.variant))
            value, has_batch = fit_shape(key, value, self._shapes[key])
            if has_batch:
                if batch is not None and value.shape[0] != batch:
                    raise ShapeError(
                        f"value of {key!r}: batch of {value.shape[0]}, but another value has a batch of {batch}."
                    )
                batch = int(value.shape[0])
            tensors.append(value)
            batched.append(has_batch)
        if batch == 0:
            raise ShapeError("a batch must have at least one entry, got 0.")
        return tensors, batched, batch

    def _check_slope(self, temporal_filter: str, tensors: Sequence[torch.Tensor]) -> None:
        if torch.is_grad_enabled():
            wanted = [key for key, tensor in zip(self._keys, tensors, strict=True) if tensor.requires_grad]
            moving = needing_slope(self._infos, wanted, self.film.knows_rates)
            check_filter(moving, temporal_filter, self._pulsed)
            check_slope(moving, *self._response)

    def _check_edges(self, tensors: Sequence[torch.Tensor]) -> None:
        """Warn once for each key of the gaps of this call's derivatives at moving edges."""
        graph = torch.is_grad_enabled()
        new = [
            key
            for key, tensor in zip(self._keys, tensors, strict=True)
            if self._infos[key].moves_silhouette
            and key not in self._asked_of_edges
            and may_have_derivative(tensor, graph=graph)
        ]
        if not new:
            return
        with active_variant(self.scene.variant):
            built = self.scene.built(self._options)
            integrator = built.scene.integrator()
            with engine.with_settings(engine.boundary_settings(self.boundary, self.spp_boundary, integrator)):
                found = missing_edges(built, new, self._sensors)
        for gap, keys in found.items():
            self._watch.warn_of_gradient(gap.message(keys), is_error=not gap.is_asked_for)
        self._asked_of_edges.update(new)

    def _check_velocities(self, tensors: Sequence[torch.Tensor]) -> None:
        """Warn once of keys with derivatives in this call that are velocities, on a film without rates."""
        graph = torch.is_grad_enabled()
        new = [
            key
            for key, tensor in zip(self._keys, tensors, strict=True)
            if self._infos[key].is_velocity and may_have_derivative(tensor, graph=graph)
        ]
        if self.film.knows_rates or set(new) <= self._asked_of_velocities:
            return
        with active_variant(self.scene.variant):
            from torchtransient.plugins.transport.velocities import unmeasured
        self._watch.warn_of_gradient(unmeasured(new))
        self._asked_of_velocities.update(new)

    def _depth_bound(self, given: Mapping[str, Any] | None, tensors: Sequence[torch.Tensor]) -> DepthBound | None:
        """Return the bound on the depth if values can have derivatives and no depth is stated, else None."""
        own = not set(self._keys) <= set(given or ()) and any(p.requires_grad for p in self.parameters())
        if not own and not any(map(may_have_derivative, tensors)):
            return None
        return depth_bound(self.scene, self._options, self._sensors, self.film, self._watch)

    def extra_repr(self) -> str:
        """Return the scene, the keys and the film, for ``print(renderer)``."""
        return f"{self.scene!r}, parameters={list(self._keys)}, {self.film.describe(self.effective_filter)}"
