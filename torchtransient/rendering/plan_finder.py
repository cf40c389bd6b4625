"""The decisions of a plan that may need a pilot run: depth, time axis, temporal filter."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

from torchtransient.axes import TimeAxis
from torchtransient.checks import is_one_of, shown
from torchtransient.errors import ArgumentError, SceneError
from torchtransient.plugins.parameters import check_slope
from torchtransient.pulses import Pulse
from torchtransient.rendering import plan_choices as choices
from torchtransient.rendering.build_options import BuildOptions
from torchtransient.rendering.films.choice import FilmChoice, PlannedFilm
from torchtransient.rendering.inventory import SceneInventory
from torchtransient.rendering.parameters import ParameterInfo, needing_slope, unknown_key
from torchtransient.rendering.plan_pilot import MOST_BINS, Arrivals, PilotReport, axis_over, pilot_run
from torchtransient.rendering.scene_handle import Scene, load
from torchtransient.rendering.slope import check_filter, filter_for
from torchtransient.rendering.translation import NO_LIMIT
from torchtransient.rendering.variant import active_variant

_AROUND_CORNERS = "transient_nlos"
# One bin for all times: far beyond the light of any scene when no pilot run says how far it goes.
_ALL_TIMES = 1e9
# Bins before and after an arrival that its light is spread over: by a tent, and by a Gaussian of half a bin.
_REACH = {"tent": 0.5, "gaussian": 2.0}


def _share(part: float, error: float) -> str:
    return f"{part:.2g} +- {error:.1g} of the light" if part > 0 else "no light of the pilot run"


@dataclass(frozen=True)
class Draft:
    """What is decided before a pilot run: the arguments of a :class:`~torchtransient.rendering.plan.Plan` but ``film``,
    which is the plan's word and class of the film, while ``film_choice`` holds its settings, None to keep or find them.
    """

    scene: Scene
    variant: str
    integrator: str
    film: PlannedFilm
    film_choice: FilmChoice | None
    pulse: Pulse | None
    irf: Pulse | None
    parameters: tuple[str, ...]
    sensor: int


@dataclass(frozen=True)
class Findings:
    """What is decided with a pilot run, or without one."""

    max_depth: int | None
    film_choice: FilmChoice | None
    temporal_filter: str
    reasons: tuple[str, ...]
    pilot: PilotReport | None


class Finder:
    """The decisions that may need a render: depth, window, temporal filter."""

    def __init__(
        self, draft: Draft, reasons: tuple[str, ...], inventory: SceneInventory, tail: float, missed: float, seed: int
    ):
        self.draft, self.inventory, self.tail, self.missed = draft, inventory, tail, missed
        self.seed = seed
        self.arrivals: Arrivals | None = None
        self.report: PilotReport | None = None
        self.reasons: list[str] = list(reasons)
        # How far before and after its arrival a pulse or an impulse response spreads light.
        self.spread = (0.0, 0.0)

    def settle(
        self,
        pilot: bool,
        max_depth: int | str | None,
        time_axis: TimeAxis | str | None,
        bins: tuple[int | None, float | None],
        temporal_filter: str | None,
    ) -> Findings:
        wants_axis = self.draft.film.kind.has_axis and not self.draft.film.all_times and time_axis is None
        if pilot and (max_depth is None or wants_axis):
            self._run()
        depth = self._depth(max_depth)
        self._note_light(depth)
        filter_name = self._filter(temporal_filter)
        axis = self._axis(time_axis, bins, depth, _REACH.get(filter_name, 0.0))
        if self.report is not None:
            self.reasons.append(self._pilot_line())
        film = self.draft.film_choice if axis is None else self.draft.film.kind.from_argument(axis)
        return Findings(depth, film, filter_name, tuple(self.reasons), self.report)

    def _run(self) -> None:
        """The pilot run."""
        started = time.perf_counter()
        variant = self.draft.variant.removesuffix("_polarized")
        scene = load(self.draft.scene, variant=variant)
        kind = self.draft.film.kind
        options = BuildOptions(
            film=kind.film_of_pilot(self.draft.film_choice),
            merge=True,
            transient=True,
            integrator=self.draft.integrator,
            pulse=self.draft.pulse,
            irf=self.draft.irf,
        )
        film, found = pilot_run(scene, options, self.draft.sensor, kind, self.tail, self.seed)
        early, late = (sum(p.support_opl[side] for p in film.pulses) for side in (0, 1))
        self.spread = (early, late)
        scene.drop(options)
        self.arrivals = found
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
        dark = self.arrivals is None or self.arrivals.dark
        error = "no light at all" if dark else f"image mean within {report.relative_error:.1%}"
        return (
            f"pilot: {report.paths} paths in {report.variant}, {report.events} arrivals, {error}; light that fewer "
            f"than one path in {max(report.paths // 3, 1)} meets may have been overlooked"
        )

    # ------------------------------------------------------------------------------------------------------ depth

    def _depth(self, given: int | str | None) -> int | None:
        own = self.inventory.max_depth
        if isinstance(given, str) and given != "scene":
            raise ArgumentError(f"max_depth: expected a number, 'scene' or None, got {given!r}.")
        if given is not None:
            asked = own if given == "scene" else int(given)
            self._note_tail(asked)
            self.reasons.append(f"max_depth: {self._in_words(asked)}, as asked for{self._beyond(asked)}")
            return asked
        if self.arrivals is None and self._around_a_corner:
            self.reasons.append(
                f"max_depth: {self._in_words(own)}, kept; what albedos leave of emitted power says little about light "
                "around corners"
            )
            return None
        if self.arrivals is None:
            depth, reason = choices.depth_by_albedo(self.inventory, self.tail)
            self.reasons.append(reason)
            return depth
        if self.arrivals.dark:
            self.reasons.append(f"max_depth: {self._in_words(own)}, kept, since the pilot run saw no light")
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

    def _in_words(self, depth: int) -> str:
        unbounded = depth == NO_LIMIT and self.draft.parameters
        return choices.depth_in_words(depth) + (" (derivatives: a bound that renderers find)" if unbounded else "")

    def _note_tail(self, depth: int) -> None:
        if self.arrivals is not None and self.report is not None and not self.arrivals.dark and depth >= 0:
            part, error = self.arrivals.share(self.arrivals.depth > depth)
            self.report = replace(self.report, tail=part, tail_error=error)

    def _beyond(self, depth: int) -> str:
        if self.arrivals is None or self.report is None or self.arrivals.dark or depth < 0:
            return ""
        return f"; {_share(self.report.tail, self.report.tail_error)} in deeper paths"

    @property
    def _around_a_corner(self) -> bool:
        return self.draft.integrator.startswith(_AROUND_CORNERS) and self.inventory.integrator == self.draft.integrator

    def _note_light(self, depth: int | None) -> None:
        """How an integrator that has several ways finds which light."""
        if not self._around_a_corner:
            return
        options = BuildOptions(max_depth=depth, merge=True, transient=True, integrator=self.draft.integrator)
        with active_variant(self.draft.variant):
            from torchtransient.plugins.around_corner.explanation import explanation

            built = self.draft.scene.built(options).scene
            integrator, sensors = built.integrator(), built.sensors()
            contents = integrator.contents(built, sensors[self.draft.sensor])
            self.reasons.append(f"light: {explanation(integrator, built, contents)}")
            self.draft.scene.drop(options)

    # ----------------------------------------------------------------------------------------------------- window

    def _axis(
        self, given: TimeAxis | str | None, bins: tuple[int | None, float | None], depth: int | None, reach: float = 0.0
    ) -> TimeAxis | None:
        """``reach``: bins over which the temporal filter spreads an arrival, to either side."""
        if not self.draft.film.kind.has_axis:
            if given is not None or bins != (None, None):
                raise ArgumentError(
                    f"tt.plan: a {self.draft.film.name} film has no time axis; leave time_axis and bins out."
                )
            return None
        if isinstance(given, TimeAxis):
            self.reasons.append(f"time axis: {given}, as asked for")
            return given
        if given is not None and not is_one_of(given, ("scene",)):
            raise ArgumentError(f"time_axis: expected a tt.TimeAxis, 'scene' or None, got {shown(given)}.")
        if self.draft.film.all_times:
            last = _ALL_TIMES if self.arrivals is None or self.arrivals.dark else 4 * float(self.arrivals.opl.max())
            return TimeAxis(0.0, last, 1)
        if given == "scene" or self.arrivals is None or self.arrivals.dark:
            return self._own_axis(given, bins)
        return self._found_axis(self.arrivals, bins, depth, reach)

    def _own_axis(self, given: str | None, bins: tuple[int | None, float | None]) -> TimeAxis:
        why = "as asked for" if given == "scene" else "without a pilot run"
        if given is None and self.arrivals is not None:
            why = "since the pilot run saw no light"
        if bins != (None, None):
            raise ArgumentError(
                f"tt.plan: num_bins and bin_width_opl have no effect on the scene's own axis, taken {why}."
            )
        if self.inventory.film_axis is None:
            raise SceneError(
                f"tt.plan: the scene's film has no time axis, which would be taken {why}. Give "
                "time_axis=tt.TimeAxis(start_opl=..., bin_width_opl=..., num_bins=...), or let a pilot run find one."
            )
        axis = self.inventory.film_axis
        self.reasons.append(f"time axis: {axis}, the scene's own, {why}")
        return axis

    def _found_axis(
        self, arrivals: Arrivals, bins: tuple[int | None, float | None], depth: int | None, reach: float = 0.0
    ) -> TimeAxis:
        num_bins, width = bins
        first, last = arrivals.window(depth or -1, self.missed)
        how = ""
        if width is None and num_bins is None and self.inventory.film_axis is not None:
            width, how = self.inventory.film_axis.bin_width_opl, ", bin width of the scene's film"
            if (last - first) / width > MOST_BINS:
                width, num_bins, how = None, MOST_BINS, f", {MOST_BINS} bins since the film's width would take more"
        if self.spread != (0.0, 0.0):
            how += f", widened by pulse and response from {self.spread[0]:g} to {self.spread[1]:+g} m"
        first, last = first + self.spread[0], last + self.spread[1]
        axis = axis_over(first, last, width, num_bins)
        if reach:
            margin = reach * axis.bin_width_opl
            axis = axis_over(first - margin, last + margin, width, num_bins)
        kept = arrivals.depth <= depth if depth is not None and depth > 0 else arrivals.depth > 0
        part, error = arrivals.share(kept & ((arrivals.opl < axis.start_opl) | (arrivals.opl >= axis.end_opl)))
        if self.report is not None:
            self.report = replace(self.report, missed=part, missed_error=error)
        self.reasons.append(
            f"time axis: {axis}{how}; {_share(part, error)} outside, asked for was {self.missed:g}; the pilot run's "
            f"last arrival came at {float(arrivals.opl.max()):.4g} m"
        )
        return axis

    # ------------------------------------------------------------------------------------------------- derivatives

    def _note_edges(self, infos: Sequence[ParameterInfo]) -> None:
        """Say which parameters call for the boundary term, and what it leaves out."""
        if followed := [info.key for info in infos if info.has_boundary_term]:
            self.reasons.append(f"boundary term: on, since edges move with {', '.join(followed)}")
        self.reasons += [
            f"approximation: the derivative by {info.key} is wrong {', '.join(info.edges_missing)}"
            for info in infos
            if info.edges_missing
        ]

    # --------------------------------------------------------------------------------------------- temporal filter

    def _filter(self, given: str | None) -> str:
        kind = self.draft.film.kind
        if not kind.has_filter and given is not None:
            raise ArgumentError(f"tt.plan: a {self.draft.film.name} film takes no temporal filter; leave it out.")
        table = self.draft.scene.parameters() if self.draft.parameters else {}
        for key in self.draft.parameters:
            if key not in table:
                raise SceneError(unknown_key(key, list(table)))
        self._note_edges([table[key] for key in self.draft.parameters])
        moving = needing_slope(table, self.draft.parameters)
        pulsed = bool(self.draft.pulse or self.draft.irf or self.inventory.pulsed)
        if not kind.has_filter:
            film = self.draft.film_choice or self.inventory.film_settings
            jump = "" if film is None or pulsed else film.jump()
            check_slope(moving, not jump, jump, kind.slope_remedy)
            return ""
        own = self.inventory.temporal_filter or "box"
        if given is not None:
            check_filter(moving, given, pulsed)
            self.reasons.append(f"temporal filter: {given}, as asked for")
            return given
        chosen = filter_for(moving, own, pulsed)
        if chosen != own:
            self.reasons.append(
                f"temporal filter: {chosen}, since {moving[0]} changes path lengths and a {own} has no slope"
            )
        elif not self.draft.film.all_times:
            why = "the scene's own" if self.inventory.temporal_filter else "since no parameter changes a path length"
            self.reasons.append(f"temporal filter: {own}, {why}")
        return chosen
