"""``tt.plan``: the cheapest variant, integrator, film, depth and time window that show what is asked for.

Nothing is guessed: a decision follows from what the description contains, from a pilot run (a few thousand paths whose
arrivals are listed one by one), or from the caller, and ``plan.reasons`` says from which.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from torchtransient import plugins
from torchtransient.axes import FrequencyAxis, TimeAxis
from torchtransient.errors import GradientError, SceneError, TorchTransientError, UnitError
from torchtransient.render import plan_choices as choices
from torchtransient.render.build import BuildOptions
from torchtransient.render.census import Census, take_census
from torchtransient.render.engine import no_slope
from torchtransient.render.plan_pilot import MOST_BINS, Arrivals, PilotReport, axis_over
from torchtransient.render.scene_handle import Scene, load, unknown_key
from torchtransient.render.variant import active_variant, is_differentiable

PILOT_PATHS = 32768
PILOT_PIXELS = 2048
# One bin for all times: far beyond the light of any scene when no pilot run says how far it goes.
_ALL_TIMES = 1e9


@dataclass(frozen=True)
class Plan:
    """What :func:`plan` decided. Use it with :meth:`renderer` or ``tt.TransientRenderer(scene, effects=plan)``.

    ``film`` is "transient", "steady" (one bin), "phasor" or "gated". ``max_depth`` None keeps the scene's; so do
    ``time_axis``, ``frequencies`` and ``gates``. ``temporal_filter`` is empty for a phasor film. ``reasons``: one
    line per decision. ``pilot``: what the pilot run found, None without one. ``str(plan)`` prints the reasons.
    """

    scene: Scene = field(repr=False)
    outputs: tuple[str, ...]
    variant: str
    integrator: str
    film: str
    max_depth: int | None
    time_axis: TimeAxis | None
    frequencies: FrequencyAxis | None
    gates: Any
    temporal_filter: str
    parameters: tuple[str, ...]
    reasons: tuple[str, ...]
    pilot: PilotReport | None = None

    def renderer(self, **settings: Any) -> Any:
        """A :class:`TransientRenderer` of the planned scene; ``settings`` are its other arguments and go before the
        plan's.
        """
        from torchtransient.render.renderer import TransientRenderer

        settings.setdefault("parameters", self.parameters)
        return TransientRenderer(self.scene, effects=self, **settings)

    def to_dict(self) -> dict[str, Any]:
        """Everything but the scene, as plain data for JSON."""
        names = ("outputs", "variant", "integrator", "film", "max_depth", "temporal_filter", "parameters", "reasons")
        plain: dict[str, Any] = {name: getattr(self, name) for name in names}
        axis, frequencies = self.time_axis, self.frequencies
        plain["time_axis"] = None if axis is None else {
            "start_opl": axis.start_opl, "bin_width_opl": axis.bin_width_opl, "num_bins": axis.num_bins,
        }  # fmt: skip
        plain["frequencies"] = None if frequencies is None else list(frequencies.frequencies)
        plain["gates"] = None if self.gates is None else repr(self.gates)
        plain["pilot"] = None if self.pilot is None else asdict(self.pilot)
        return plain

    def __str__(self) -> str:
        return "\n".join(self.reasons)


def plan(
    scene: Any,
    outputs: Sequence[str] | str = ("transient",),
    *,
    parameters: Sequence[str] = (),
    time_axis: TimeAxis | str | None = None,
    frequencies: FrequencyAxis | Sequence[float] | None = None,
    gates: Any = None,
    num_bins: int | None = None,
    bin_width_opl: float | None = None,
    max_depth: int | str | None = None,
    variant: str | None = None,
    integrator: str | None = None,
    temporal_filter: str | None = None,
    tail: float = 1e-3,
    missed: float = 1e-3,
    strict: bool = False,
    pilot: bool = True,
    sensor: int = 0,
    seed: int = 0,
) -> Plan:
    """Choose how to render ``scene``, what :func:`load` takes.

    ``outputs``: some of "transient", "steady", "phasor", "stokes", "gates", "bands". ``parameters``: keys that
    gradients will be asked for.

    ``tail``: the largest share of the image's light that may be left to deeper paths; no block of the image (an 8 x
    8 grid) may lose more than ten times that. ``missed``: the same for light outside the time window. Both are
    bounds on what the pilot run saw, with two standard errors to spare. ``pilot=False`` does without that run: the
    depth then follows from the albedos where they bound it, and the time axis is the scene's.

    ``strict``: carry polarization also where it only changes the light between smooth surfaces. Without it such a
    scene is planned unpolarized, as is usual, and ``reasons`` says so.

    Every choice can be taken over: ``variant``, ``integrator``, ``max_depth`` (a number, or "scene" for the scene's
    own), ``time_axis`` (an axis, or "scene"), ``num_bins`` and ``bin_width_opl`` of the axis to be found,
    ``temporal_filter``, ``frequencies``, ``gates``. A bin width that the scene's film has is kept.

    The variant with which a scene was loaded only says on which device to compute. Depths and times hold for the
    description's values: parameters that change brightness or geometry very much call for another plan.

    Raises ``SceneError`` for unknown outputs and parameters, for outputs that need different films, for scenes that
    cannot be read or rendered, and when the pilot run sees no light and no time axis is given; ``UnitError`` for
    shares outside (0, 1); ``GradientError`` for a box filter with parameters that change path lengths.
    """
    for name, share in (("tail", tail), ("missed", missed)):
        if not 0 < share < 1:
            raise UnitError(f"tt.plan: {name} is a share of the light between 0 and 1, got {share!r}.")
    loaded = load(scene)
    asked = choices.checked_outputs(outputs)
    census = census_of(loaded)
    device = loaded.variant.split("_")[0]
    film = choices.choose_film(census, asked)
    best, notes = choices.choose_variant(census, asked, device, strict)
    tracer, more = choices.choose_integrator(census)
    reasons = [_taken("variant", variant, best), *notes, _taken("integrator", integrator, tracer), *more, film.reason]
    draft = Plan(
        scene=load(loaded, variant=variant or best.value),
        outputs=asked,
        variant=variant or best.value,
        integrator=integrator or tracer.value,
        film=film.value,
        max_depth=None,
        time_axis=None,
        frequencies=_frequencies(frequencies, film.value, census),
        gates=gates,
        temporal_filter="",
        parameters=tuple(parameters),
        reasons=tuple(reasons),
    )
    _check_known(draft, gates, census)
    finder = _Finder(draft, census, tail, missed, sensor, seed)
    return finder.settle(pilot, max_depth, time_axis, (num_bins, bin_width_opl), temporal_filter)


def census_of(scene: Scene) -> Census:
    """What the description of a scene contains. Raises ``SceneError`` for one that Mitsuba cannot parse."""
    import mitsuba as mi

    description = scene._description
    with active_variant(scene.variant):
        config = mi.parser.ParserConfig(scene.variant)
        try:
            with description.resolved_files(), plugins.plugin_errors():
                state = description.parse(config)
                mi.parser.transform_upgrade(config, state)
                return take_census(state, _lookup)
        except TorchTransientError as error:
            raise type(error)(f"{description.name}: {error}") from error
        except (RuntimeError, ValueError, TypeError) as error:
            raise SceneError(f"{description.name}: Mitsuba could not read the scene. {error}") from error


def _lookup(name: str) -> Any:
    from pathlib import Path

    import mitsuba as mi

    return Path(str(mi.file_resolver().resolve(name)))


def _taken(name: str, given: str | None, best: choices.Choice) -> str:
    if given is None:
        return best.reason
    return f"{name}: {given}, as asked for; the plan's own would have been {best.reason.removeprefix(f'{name}: ')}"


def _frequencies(given: Any, film: str, census: Census) -> FrequencyAxis | None:
    if given is None:
        if film == "phasor" and census.film != choices.FILM_PLUGINS["phasor"]:
            raise SceneError(
                "tt.plan: phasors are asked for, and neither the film nor the call has frequencies. Give "
                "frequencies=tt.FrequencyAxis(...), or make the film a phasor_hdr_film."
            )
        return None
    if film != "phasor":
        raise SceneError(f"tt.plan: frequencies have no effect on a {film} film; add 'phasor' to the outputs.")
    return given if isinstance(given, FrequencyAxis) else FrequencyAxis(given)


def _check_known(draft: Plan, gates: Any, census: Census) -> None:
    """What the plan calls for has to be part of this installation."""
    import mitsuba as mi

    if not is_differentiable(draft.variant) or draft.variant not in mi.variants():
        usable = ", ".join(v for v in mi.variants() if is_differentiable(v))
        raise SceneError(f"tt.plan: variant {draft.variant!r} cannot be used here; expected one of {usable}.")
    for kind, plugin in (("integrator", draft.integrator), ("film", choices.FILM_PLUGINS[draft.film])):
        if plugins.kind_of(plugin) != kind:
            raise SceneError(
                f"tt.plan: the plan calls for the {kind} {plugin!r}, which is not registered here:\n"
                + "\n".join(draft.reasons)
            )
    if gates is not None and draft.film != "gated":
        raise SceneError(f"tt.plan: gates have no effect on a {draft.film} film; add 'gates' to the outputs.")
    if draft.film == "gated" and gates is None and census.film != choices.FILM_PLUGINS["gated"]:
        raise SceneError("tt.plan: gates are asked for, and neither the film nor the call has some. Give gates=...")


def _share(part: float, error: float) -> str:
    return f"{part:.2g} +- {error:.1g} of the light" if part > 0 else "no light of the pilot run"


class _Finder:
    """The decisions that may need a render: depth, window, temporal filter."""

    def __init__(self, draft: Plan, census: Census, tail: float, missed: float, sensor: int, seed: int):
        self.draft, self.census, self.tail, self.missed = draft, census, tail, missed
        self.sensor, self.seed = sensor, seed
        self.arrivals: Arrivals | None = None
        self.report: PilotReport | None = None
        self.reasons: list[str] = list(draft.reasons)

    def settle(
        self,
        pilot: bool,
        max_depth: int | str | None,
        time_axis: TimeAxis | str | None,
        bins: tuple[int | None, float | None],
        temporal_filter: str | None,
    ) -> Plan:
        wants_axis = self.draft.film == "transient" and time_axis is None
        if pilot and (max_depth is None or wants_axis):
            self._run()
        depth = self._depth(max_depth)
        axis = self._axis(time_axis, bins, depth)
        chosen = self._filter(temporal_filter)
        if self.report is not None:
            self.reasons.append(self._pilot_line())
        return replace(
            self.draft,
            max_depth=depth,
            time_axis=axis,
            temporal_filter=chosen,
            reasons=tuple(self.reasons),
            pilot=self.report,
        )

    def _run(self) -> None:
        """The pilot run, without polarization: it costs most of the time and changes neither depth nor time."""
        started = time.perf_counter()
        variant = self.draft.variant.removesuffix("_polarized")
        scene = load(self.draft.scene, variant=variant)
        options = BuildOptions(
            time_axis=(0.0, 1.0, 1), merge=True, transient=True, integrator=self.draft.integrator
        )  # fmt: skip
        with active_variant(variant):
            from torchtransient.plugins.integrators.pilot import pilot_events

            built = scene.built(options).scene
            events = pilot_events(
                built, built.integrator(), self.sensor, seed=self.seed, pixels=PILOT_PIXELS, paths=PILOT_PATHS
            )
            scene.drop(options)
        self.arrivals = found = Arrivals(events)
        dark = found.dark
        self.report = PilotReport(
            variant=variant,
            paths=found.paths,
            events=len(found.opl),
            seconds=time.perf_counter() - started,
            relative_error=float("nan") if dark else found.relative_error(),
            tail=0.0,
            tail_error=0.0,
            first_opl=float("nan") if dark else float(found.opl.min()),
            last_opl=float("nan") if dark else float(found.opl.max()),
        )

    def _pilot_line(self) -> str:
        report = self.report
        if report is None:
            raise SceneError("tt.plan: no pilot run was made.")
        error = "no light at all" if report.events == 0 else f"image mean within {report.relative_error:.1%}"
        return (
            f"pilot: {report.paths} paths in {report.variant}, {report.events} arrivals, {error}; light that fewer "
            f"than one path in {max(report.paths // 3, 1)} meets may have been overlooked"
        )

    # ------------------------------------------------------------------------------------------------------ depth

    def _depth(self, given: int | str | None) -> int | None:
        own = choices.PLUGIN_DEPTH if self.census.max_depth is None else self.census.max_depth
        if isinstance(given, str) and given != "scene":
            raise SceneError(f"max_depth: expected a number, 'scene' or None, got {given!r}.")
        if given is not None:
            depth = own if given == "scene" else int(given)
            self._note_tail(depth)
            self.reasons.append(f"max_depth: {depth}, as asked for{self._beyond(depth)}")
            return depth
        if self.arrivals is None:
            depth, reason = choices.depth_by_albedo(self.census, self.tail)
            self.reasons.append(reason)
            return depth
        if self.arrivals.dark:
            self.reasons.append(f"max_depth: {own}, kept, since the pilot run saw no light")
            return None
        from torchtransient.plugins.integrators.pilot import PILOT_DEPTH

        depth = self.arrivals.enough_depth(self.tail)
        self._note_tail(depth)
        reason = f"max_depth: {depth}{self._beyond(depth)}, asked for was {self.tail:g}"
        if depth >= PILOT_DEPTH:
            reason += f"; the pilot run went no deeper than {PILOT_DEPTH}, so light beyond it is not bounded"
        if own != -1 and own < depth:
            reason += f"; at the scene's own {own} it would be {self.arrivals.share(self.arrivals.depth > own)[0]:.2g}"
        self.reasons.append(reason)
        return depth

    def _note_tail(self, depth: int) -> None:
        if self.arrivals is not None and self.report is not None and not self.arrivals.dark and depth > 0:
            part, error = self.arrivals.share(self.arrivals.depth > depth)
            self.report = replace(self.report, tail=part, tail_error=error)

    def _beyond(self, depth: int) -> str:
        if self.arrivals is None or self.report is None or self.arrivals.dark or depth < 0:
            return ""
        return f"; {_share(self.report.tail, self.report.tail_error)} in deeper paths"

    # ----------------------------------------------------------------------------------------------------- window

    def _axis(
        self, given: TimeAxis | str | None, bins: tuple[int | None, float | None], depth: int | None
    ) -> TimeAxis | None:
        if self.draft.film in ("phasor", "gated"):
            if given is not None or bins != (None, None):
                raise SceneError(f"tt.plan: a {self.draft.film} film has no time axis; leave time_axis and bins out.")
            return None
        if isinstance(given, TimeAxis):
            self.reasons.append(f"time axis: {given}, as asked for")
            return given
        if given is not None and given != "scene":
            raise SceneError(f"time_axis: expected a tt.TimeAxis, 'scene' or None, got {given!r}.")
        if self.draft.film == "steady":
            last = _ALL_TIMES if self.arrivals is None or self.arrivals.dark else 4 * float(self.arrivals.opl.max())
            return TimeAxis(0.0, last, 1)
        if given == "scene" or self.arrivals is None or self.arrivals.dark:
            return self._own_axis(given, bins)
        return self._found_axis(self.arrivals, bins, depth)

    def _own_axis(self, given: str | None, bins: tuple[int | None, float | None]) -> TimeAxis:
        why = "as asked for" if given == "scene" else "without a pilot run"
        if given is None and self.arrivals is not None:
            why = "since the pilot run saw no light"
        if bins != (None, None):
            raise SceneError(
                f"tt.plan: num_bins and bin_width_opl have no effect on the scene's own axis, taken {why}."
            )
        if self.census.film_axis is None:
            raise SceneError(
                f"tt.plan: the scene's film has no time axis, which would be taken {why}. Give "
                "time_axis=tt.TimeAxis(start_opl=..., bin_width_opl=..., num_bins=...), or let a pilot run find one."
            )
        axis = TimeAxis(*self.census.film_axis)
        self.reasons.append(f"time axis: {axis}, the scene's own, {why}")
        return axis

    def _found_axis(self, arrivals: Arrivals, bins: tuple[int | None, float | None], depth: int | None) -> TimeAxis:
        num_bins, width = bins
        first, last = arrivals.window(depth or -1, self.missed)
        how = ""
        if width is None and num_bins is None and self.census.film_axis is not None:
            width, how = self.census.film_axis[1], ", bin width of the scene's film"
            if (last - first) / width > MOST_BINS:
                width, num_bins, how = None, MOST_BINS, f", {MOST_BINS} bins since the film's width would take more"
        axis = axis_over(first, last, width, num_bins)
        kept = arrivals.depth <= depth if depth is not None and depth > 0 else arrivals.depth > 0
        part, error = arrivals.share(kept & ((arrivals.opl < axis.start_opl) | (arrivals.opl >= axis.end_opl)))
        if self.report is not None:
            self.report = replace(self.report, missed=part, missed_error=error)
        self.reasons.append(
            f"time axis: {axis}{how}; {_share(part, error)} outside, asked for was {self.missed:g}; the pilot run's "
            f"last arrival came at {float(arrivals.opl.max()):.4g} m"
        )
        return axis

    # --------------------------------------------------------------------------------------------- temporal filter

    def _filter(self, given: str | None) -> str:
        if self.draft.film == "phasor":
            if given is not None:
                raise SceneError("tt.plan: a phasor film takes no temporal filter; leave it out.")
            return ""
        table = self.draft.scene.parameters() if self.draft.parameters else {}
        for key in self.draft.parameters:
            if key not in table:
                raise SceneError(unknown_key(key, list(table)))
        moving = [key for key in self.draft.parameters if table[key].moves_path_length]
        own = self.census.temporal_filter or "box"
        if given is not None:
            if given == "box" and moving:
                raise GradientError(no_slope(moving, given))
            self.reasons.append(f"temporal filter: {given}, as asked for")
            return given
        if moving and own == "box":
            self.reasons.append(f"temporal filter: tent, since {moving[0]} changes path lengths and a box has no slope")
            return "tent"
        if self.draft.film != "steady":
            why = "the scene's own" if self.census.temporal_filter else "since no parameter changes a path length"
            self.reasons.append(f"temporal filter: {own}, {why}")
        return own
