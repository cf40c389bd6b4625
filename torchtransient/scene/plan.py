"""Decisions of ``tt.plan``, each with a line of explanation.

Variant, integrator and a depth by albedo follow from the description; depth, time window and temporal filter may need a
pilot run (:mod:`.pilot`).
"""

from __future__ import annotations

import abc
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from torchtransient.axes import TimeAxis
from torchtransient.checks import is_one_of, shown
from torchtransient.errors import ArgumentError, SceneError
from torchtransient.plugins.parameters import check_slope
from torchtransient.pulses import Pulse
from torchtransient.scene.edits import NO_LIMIT, BuildOptions
from torchtransient.scene.inventory import Finding, SceneInventory
from torchtransient.scene.load import Scene, load
from torchtransient.scene.nodes import is_transient_integrator
from torchtransient.scene.parameters import ParameterInfo, needing_slope, unknown_key
from torchtransient.scene.pilot import (
    BLOCK_ALLOWANCE,
    MOST_BINS,
    Arrivals,
    PilotReport,
    axis_over,
    pilot_run,
    rate_axis_over,
)
from torchtransient.scene.slope import check_filter, filter_for
from torchtransient.scene.variant import active_variant

_SURFACES, _VOLUMES = "transient_path", "transient_prbvolpath"
_ALIASES = {"transient_volpath": _VOLUMES}
_AROUND_CORNERS = "transient_nlos"
# Integrators that add pictures to those of a nested one.
_WITH_PICTURES = ("aov", "moment")
# One bin for all times without a pilot run: far beyond the light of any scene, metres.
_ALL_TIMES = 1e9
# Bins before and after an arrival that its light is spread over: by a tent, and by a Gaussian of half a bin.
_REACH = {"tent": 0.5, "gaussian": 2.0}


@dataclass(frozen=True, kw_only=True)
class Effects(abc.ABC):
    """Decisions about a scene that a renderer uses where its own arguments leave them open.

    Attributes:
        scene: the scene, in the variant of the plan.
        variant, integrator: names of variant and integrator.
        film_choice, max_depth, rr_depth, connections, pulse, irf: settings of the render; None keeps the scene's.
        temporal_filter: name of the temporal filter, empty for films without one.
        filter_is_given: the filter was an argument of the plan, which no other filter replaces.
        sensor: index of the sensor whose light the decisions are about.
    """

    scene: Scene = field(repr=False)
    variant: str
    integrator: str
    film_choice: Any
    max_depth: int | None
    pulse: Pulse | None
    irf: Pulse | None
    temporal_filter: str
    filter_is_given: bool = False
    sensor: int = 0
    rr_depth: int | None = None
    connections: str | None = None

    @abc.abstractmethod
    def __str__(self) -> str:
        """Return the reasons of the decisions, a line each."""

    def planned_scene(self, scene: Any) -> Scene:
        """Return a scene in the variant of the plan. Raises ``SceneError`` for another scene.

        Args:
            scene: anything that :func:`load` takes.
        """
        given = load(scene)
        if not given.same_description(self.scene):
            raise SceneError(
                f"effects: the plan was made for {self.scene!r}, got {given!r}, which is another scene: its depth, "
                "window and variant would be those of the other. Make a plan of this one with tt.plan(scene, ...), or "
                "take plan.renderer()."
            )
        return load(given, variant=self.variant)

    def film_settings(self, film: Any, temporal_filter: str) -> tuple[Any, str]:
        """Return film and temporal filter of a renderer.

        Args:
            film: film of the renderer's arguments, which precedes the plan's; None without one.
            temporal_filter: filter of the renderer's arguments; the plan's replaces "auto".
        """
        film = self.film_choice if film is None else film
        # A box of the plan's own choice stays "auto": parameters that were not planned for may call for a slope.
        decided = self.temporal_filter if self.filter_is_given or self.temporal_filter != "box" else ""
        if temporal_filter == "auto" and decided and (film is None or film.has_bins):
            temporal_filter = decided
        return film, temporal_filter

    def check_sensors(self, sensors: Sequence[int]) -> None:
        """Raise ``SceneError`` for sensors without a plan.

        Args:
            sensors: indices of sensors.
        """
        others = sorted(set(sensors) - {self.sensor})
        if others:
            raise SceneError(
                f"effects: the plan was made for sensor {self.sensor}, got sensors={list(sensors)}: another one sees "
                f"light of other depths and times. Leave sensors out, or plan with tt.plan(scene, sensor={others[0]})."
            )


# ------------------------------------------------------------------------------------------- decisions by the contents


@dataclass(frozen=True)
class Choice:
    """Decision, and the line that explains it.

    Args:
        value: the decision.
        reason: line that explains it.
    """

    value: str
    reason: str


def text_of(findings: Sequence[Finding], most: int = 3) -> str:
    """Return the first ``most`` findings as text, with the number of the others.

    Args:
        findings: the findings.
        most: number of findings that are written out.
    """
    named = "; ".join(str(finding) for finding in findings[:most])
    return named if len(findings) <= most else f"{named}; and {len(findings) - most} more"


def choose_variant(
    inventory: SceneInventory, outputs: Sequence[str], device: str, strict: bool
) -> tuple[Choice, list[str]]:
    """Return the cheapest variant that can show the outputs, and notes on approximations.

    Args:
        inventory: contents of the scene.
        outputs: outputs of the plan.
        device: "llvm" or "cuda".
        strict: carry polarization where it only changes the light between smooth surfaces, too.

    Raises:
        SceneError: for bands of a film without response curves.
    """
    spectral = bool(inventory.measured or inventory.bands or "bands" in outputs)
    if "bands" in outputs and not inventory.bands:
        raise SceneError(
            "tt.plan: bands are asked for, and no film has response curves. Give the film spectra as children, such as "
            "'red': {'type': 'spectrum', 'value': [(600, 0.0), (650, 1.0), (700, 0.0)]}."
        )
    colour, colour_why = _colour(inventory, spectral)
    polarized, polarization_why, notes = _polarization(inventory, outputs, strict)
    if polarized and colour == "rgb":
        colour, colour_why = "spectral", f"{colour_why}, and Mitsuba has no polarized RGB variant"
    name = f"{device}_ad_{colour}" + ("_polarized" if polarized else "")
    return Choice(name, f"variant: {name}; {colour_why}; {polarization_why}"), notes


def _colour(inventory: SceneInventory, spectral: bool) -> tuple[str, str]:
    if inventory.bands:
        return "spectral", f"wavelengths, since the film has bands: {text_of(inventory.bands)}"
    if spectral:
        return "spectral", f"wavelengths, which three numbers cannot stand in for: {text_of(inventory.measured)}"
    if inventory.colours:
        return "rgb", f"colour: {text_of(inventory.colours)}"
    return "mono", "every spectrum is grey, so that one channel carries all of it"


def _polarization(inventory: SceneInventory, outputs: Sequence[str], strict: bool) -> tuple[bool, str, list[str]]:
    if "stokes" in outputs:
        return True, "polarized, since Stokes vectors are asked for", []
    if inventory.integrator == "stokes":
        return True, "polarized, since the scene's own integrator is stokes", []
    if inventory.elements:
        return True, f"polarized, since it changes the intensity: {text_of(inventory.elements)}", []
    if not inventory.interfaces:
        return False, "unpolarized, since nothing polarizes light", []
    if not inventory.interfaces_in_a_row:
        surface = text_of(inventory.interfaces)
        return False, f"unpolarized, which is exact: a single flat surface polarizes, {surface}", []
    if strict:
        return True, f"polarized (strict), since light can meet several of these: {text_of(inventory.interfaces)}", []
    note = (
        "approximation: the light between polarizing surfaces is taken as unpolarized, as unpolarized renderers do; "
        f"strict=True carries it. Found: {text_of(inventory.interfaces)}"
    )
    return False, "unpolarized, see the approximation", [note]


def choose_integrator(inventory: SceneInventory) -> tuple[Choice, list[str]]:
    """Return the integrator for surfaces or for volumes, or another transient one of the scene, and notes.

    Args:
        inventory: contents of the scene.
    """
    notes = [
        f"not used: {text_of(inventory.declared_only)}, declared and referred to by nothing"
    ] if inventory.declared_only else []  # fmt: skip
    own = inventory.integrator or ""
    if own in _WITH_PICTURES:
        notes.append(
            f"not rendered: the pictures that {own!r} adds to those of its nested integrator; "
            "tt.data.scene_labels has depth, normals, shapes and albedos"
        )
    if is_transient_integrator(own) and _ALIASES.get(own, own) not in (_SURFACES, _VOLUMES):
        return Choice(own, f"integrator: {own}, the scene's own"), notes
    if inventory.media:
        return Choice(_VOLUMES, f"integrator: {_VOLUMES}, since the scene has {text_of(inventory.media)}"), notes
    return Choice(_SURFACES, f"integrator: {_SURFACES}, since no medium can be reached from the scene"), notes


def _depth_text(depth: int) -> str:
    """Return a ``max_depth`` as text."""
    return "no limit" if depth == NO_LIMIT else str(depth)


def _depth_by_albedo(inventory: SceneInventory, tail: float) -> tuple[int | None, str]:
    """Return the depth at which little of the emitted power is left, if the albedos bound it, and the reason.

    Args:
        inventory: contents of the scene.
        tail: largest share of the emitted power beyond the depth.

    Returns:
        The depth, None without a bound, and the line that explains it.
    """
    if inventory.albedo >= 1:
        return None, (
            f"max_depth: {_depth_text(inventory.max_depth)}, kept; not bounded, since {inventory.brightest} may "
            "reflect everything and no pilot run was asked for"
        )
    bounces = 1 if inventory.albedo == 0 else max(1, math.ceil(math.log(tail) / math.log(inventory.albedo)))
    depth = bounces + 1
    left = inventory.albedo**bounces
    return depth, (
        f"max_depth: {depth}; no albedo exceeds {inventory.albedo:.4g} ({inventory.brightest}), so that after "
        f"{bounces} bounces at most {left:.2g} of the emitted power is left"
    )


# ------------------------------------------------------------------------------------------ decisions by a pilot run


def _share(part: float, error: float) -> str:
    return f"{part:.2g} +- {error:.1g} of the light" if part > 0 else "no light of the pilot run"


@dataclass(frozen=True)
class Draft:
    """Decisions before a pilot run.

    Attributes:
        film: kind of film (``PlannedFilm``).
        film_choice: settings of the film that were asked for, None to keep or find them.
        described_film: settings of the scene's own film, None where they are not known before it is built.
        described_axis: time axis of the scene's own film, None without one.
        scene, variant, integrator, pulse, irf, parameters, sensor: attributes of the plan of the same names.
    """

    scene: Scene
    variant: str
    integrator: str
    film: Any
    film_choice: Any
    described_film: Any
    described_axis: TimeAxis | None
    pulse: Pulse | None
    irf: Pulse | None
    parameters: tuple[str, ...]
    sensor: int


@dataclass(frozen=True)
class Findings:
    """Decisions by a pilot run, or without one.

    Args:
        max_depth: bound on the depth, None for the scene's.
        film_choice: film of the plan, None to keep the scene's.
        temporal_filter: name of the filter, empty for films without one.
        reasons: one line per decision.
        pilot: results of the pilot run, None without one.
    """

    max_depth: int | None
    film_choice: Any
    temporal_filter: str
    reasons: tuple[str, ...]
    pilot: PilotReport | None


class Finder:
    """Search for depth, window and temporal filter, by a pilot run where it is needed.

    Args:
        draft: decisions that are made already.
        reasons: lines that explain them.
        inventory: contents of the scene.
        tail: largest share of the light in deeper paths.
        missed: largest share of the light outside of the window.
        seed: seed of the pilot run.
        relative: late light counts as much as early light.
    """

    def __init__(
        self,
        draft: Draft,
        reasons: tuple[str, ...],
        inventory: SceneInventory,
        tail: float,
        missed: float,
        seed: int,
        relative: bool = False,
    ):
        self.draft, self.inventory, self.tail, self.missed = draft, inventory, tail, missed
        self.seed, self.relative = seed, relative
        self.reasons: list[str] = list(reasons)
        # Of the pilot run: its arrivals, None without one, and its wall time.
        self.arrivals: Arrivals | None = None
        self.seconds = 0.0
        # Share of light in paths deeper than the depth, and outside of the window, with standard errors.
        self.tail_found: tuple[float, float] = (0.0, 0.0)
        self.missed_found: tuple[float, float] | tuple[None, None] = (None, None)
        # Reach of pulse and impulse response before and after an arrival, metres.
        self.spread = (0.0, 0.0)

    def settle(
        self,
        pilot: bool,
        max_depth: int | str | None,
        time_axis: TimeAxis | str | None,
        bins: tuple[int | None, float | None],
        temporal_filter: str | None,
    ) -> Findings:
        """Return the decisions.

        Args:
            pilot: a pilot run may be made.
            max_depth: a depth, "scene" for the scene's own, or None.
            time_axis: an axis, "scene" for the scene's own, or None.
            bins: number and width of bins of an axis to be found.
            temporal_filter: name of a filter, or None.

        Raises:
            ArgumentError: for settings that have no effect.
            SceneError: for an axis that cannot be found, and for unknown parameters.
            GradientError: for a filter without a slope, with parameters that change path lengths.
        """
        wants_axis = self.draft.film.kind.has_bins and not self.draft.film.all_times and time_axis is None
        wants_rates = self.draft.film.has_rows and self._given_film is None
        if pilot and (max_depth is None or wants_axis or wants_rates):
            self._run()
        depth = self._depth(max_depth)
        self._note_light(depth)
        filter_name = self._filter(temporal_filter)
        axis = self._axis(time_axis, bins, depth, _REACH.get(filter_name, 0.0))
        film = self.draft.film_choice
        if axis is not None:
            film = self.draft.film.film_over(axis, self._rows(depth) if self.draft.film.has_rows else None)
        report = None if self.arrivals is None else self._report(self.arrivals)
        return Findings(depth, film, filter_name, tuple(self.reasons), report)

    def _run(self) -> None:
        started = time.perf_counter()
        scene = load(self.draft.scene, variant=self._pilot_variant)
        kind = self.draft.film.kind
        options = BuildOptions(
            film=self.draft.film.pilot_film(self.draft.film_choice),
            merge=True,
            transient=True,
            integrator=self.draft.integrator,
            pulse=self.draft.pulse,
            irf=self.draft.irf,
        )
        film, self.arrivals = pilot_run(scene, options, self.draft.sensor, kind.seen, self.tail, self.seed)
        early, late = (sum(p.support_opl[side] for p in film.pulses) for side in (0, 1))
        self.spread = (early, late)
        scene.drop(options)
        self.seconds = time.perf_counter() - started

    @property
    def _pilot_variant(self) -> str:
        return self.draft.variant.removesuffix("_polarized")

    def _report(self, arrivals: Arrivals) -> PilotReport:
        """Return the report of the pilot run, and add its line to the reasons."""
        nan = float("nan")
        report = PilotReport(
            variant=self._pilot_variant,
            paths=arrivals.paths,
            events=arrivals.count,
            seconds=self.seconds,
            relative_error=nan if arrivals.dark else arrivals.relative_error(),
            tail=self.tail_found[0],
            tail_error=self.tail_found[1],
            first_opl=nan if arrivals.dark else float(arrivals.opl.min()),
            last_opl=nan if arrivals.dark else float(arrivals.opl.max()),
            missed=self.missed_found[0],
            missed_error=self.missed_found[1],
        )
        error = "no light at all" if arrivals.dark else f"image mean within {report.relative_error:.1%}"
        self.reasons.append(
            f"pilot: {report.paths} paths in {report.variant}, {report.events} arrivals, {error}; light that fewer "
            f"than one path in {max(report.paths // 3, 1)} meets may have been overlooked"
        )
        return report

    # ------------------------------------------------------------------------------------------------------ depth

    def _depth(self, given: int | str | None) -> int | None:
        own = self.inventory.max_depth
        if isinstance(given, str) and given != "scene":
            raise ArgumentError(f"max_depth: expected a number, 'scene' or None, got {given!r}.")
        if given is not None:
            depth = own if given == "scene" else int(given)
            self.reasons.append(f"max_depth: {self._depth_words(depth)}, as asked for{self._deeper(depth)}")
            return depth
        if self.arrivals is None and self._around_a_corner:
            self.reasons.append(
                f"max_depth: {self._depth_words(own)}, kept; what albedos leave of emitted power says little about "
                "light around corners"
            )
            return None
        if self.arrivals is None:
            bound, reason = _depth_by_albedo(self.inventory, self.tail)
            self.reasons.append(reason)
            return bound
        if self.arrivals.dark:
            bound, reason = _depth_by_albedo(self.inventory, self.tail)
            self.reasons.append(f"{reason}; the pilot run saw no light")
            return bound
        from torchtransient.plugins.integrators.pilot import PILOT_DEPTH

        depth = self.arrivals.enough_depth(self.tail)
        late = self.arrivals.enough_depth_of_all_times(self.tail) if self.relative else 0
        if late > depth:
            depth = late
            reason = (
                f"max_depth: {depth}{self._deeper(depth)}, and at most {BLOCK_ALLOWANCE * self.tail:.2g} of that of "
                "any eighth of its time, by the few late arrivals of the pilot run"
            )
        else:
            reason = f"max_depth: {depth}{self._deeper(depth)}, asked for was {self.tail:g}"
        if depth >= PILOT_DEPTH:
            reason += f"; the pilot run went no deeper than {PILOT_DEPTH}, so light beyond it is not bounded"
        if own != NO_LIMIT and own < depth:
            reason += f"; at the scene's own {own} it would be {self.arrivals.share(self.arrivals.depth > own)[0]:.2g}"
        self.reasons.append(reason)
        return depth

    def _depth_words(self, depth: int) -> str:
        unbounded = depth == NO_LIMIT and self.draft.parameters
        return _depth_text(depth) + (" (derivatives: a bound that renderers find)" if unbounded else "")

    def _deeper(self, depth: int) -> str:
        """Measure the light in paths deeper than ``depth``, and return it as text."""
        if self.arrivals is None or self.arrivals.dark or depth < 0:
            return ""
        self.tail_found = self.arrivals.share(self.arrivals.depth > depth)
        text = f"; {_share(*self.tail_found)} in deeper paths"
        unseen = self.arrivals.unseen()
        if not self.tail_found[0] > 0 and unseen > self.tail:
            text += f" (its {self.arrivals.count} arrivals cannot tell that from {unseen:.2g})"
        return text

    @property
    def _around_a_corner(self) -> bool:
        return self.draft.integrator.startswith(_AROUND_CORNERS) and self.inventory.integrator == self.draft.integrator

    def _note_light(self, depth: int | None) -> None:
        """Add the reason which light an integrator for corners finds in which way."""
        if not self._around_a_corner:
            return
        options = BuildOptions(max_depth=depth, merge=True, transient=True, integrator=self.draft.integrator)
        with active_variant(self.draft.variant):
            from torchtransient.plugins.around_corner.division import explanation

            built = self.draft.scene.built(options).scene
            integrator, sensors = built.integrator(), built.sensors()
            contents = integrator.contents(built, sensors[self.draft.sensor])
            self.reasons.append(f"light: {explanation(integrator, built, contents)}")
            self.draft.scene.drop(options)

    # ----------------------------------------------------------------------------------------------------- window

    def _axis(
        self, given: TimeAxis | str | None, bins: tuple[int | None, float | None], depth: int | None, reach: float = 0.0
    ) -> TimeAxis | None:
        """Return the time axis. ``reach``: bins over which the temporal filter spreads an arrival, to either side."""
        if not self.draft.film.kind.has_bins:
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
        if self.draft.described_axis is None:
            raise SceneError(
                f"tt.plan: the scene's film has no time axis, which would be taken {why}. Give "
                "time_axis=tt.TimeAxis(start_opl=..., bin_width_opl=..., num_bins=...), or let a pilot run find one."
            )
        axis = self.draft.described_axis
        self.reasons.append(f"time axis: {axis}, the scene's own, {why}")
        return axis

    def _found_axis(
        self, arrivals: Arrivals, bins: tuple[int | None, float | None], depth: int | None, reach: float = 0.0
    ) -> TimeAxis:
        num_bins, width = bins
        first, last = arrivals.window(depth or -1, self.missed)
        how, film = "", self._given_film
        own = None if film is None else film.resolution_opl()
        why = ", a bin for each line of the chirps" if own is not None else ", bin width of the scene's film"
        if own is None and self.draft.described_axis is not None:
            own = self.draft.described_axis.bin_width_opl
        if width is None and num_bins is None and own is not None:
            width, how = own, why
            if (last - first) / width > MOST_BINS:
                width, num_bins, how = None, MOST_BINS, f", {MOST_BINS} bins since the film's width would take more"
        if self.spread != (0.0, 0.0):
            what = "the lines of the chirps" if self.draft.film.kind.has_line else "pulse and response"
            how += f", widened by {what} from {self.spread[0]:g} to {self.spread[1]:+g} m"
        first, last = first + self.spread[0], last + self.spread[1]
        axis = axis_over(first, last, width, num_bins)
        if reach:
            margin = reach * axis.bin_width_opl
            axis = axis_over(first - margin, last + margin, width, num_bins)
        kept = arrivals.depth <= depth if depth is not None and depth > 0 else arrivals.depth > 0
        part, error = arrivals.share(kept & ((arrivals.opl < axis.start_opl) | (arrivals.opl >= axis.end_opl)))
        self.missed_found = (part, error)
        self.reasons.append(
            f"time axis: {axis}{how}; {_share(part, error)} outside, asked for was {self.missed:g}; the pilot run's "
            f"last arrival came at {float(arrivals.opl.max()):.4g} m"
        )
        return axis

    @property
    def _given_film(self) -> Any:
        """Film that the call gives, or else the scene's own of that kind; None without one."""
        own = self.draft.described_film
        return self.draft.film_choice or (own if isinstance(own, self.draft.film.kind) else None)

    def _rows(self, depth: int | None) -> Any:
        """Return the bins of the rate, or the chirps, of a film of such."""
        given, arrivals = self._given_film, self.arrivals
        rates = None
        if arrivals is not None and not arrivals.dark:
            rates = arrivals.rate[arrivals.depth <= depth] if depth is not None and depth > 0 else arrivals.rate
        moving = rates is not None and bool(rates.any())
        if rates is None and given is None:
            raise SceneError(
                "tt.plan: no light of a pilot run shows the rates of its paths. Give "
                f"{self.draft.film.kind.example}, or let a pilot run find them."
            )
        if rates is not None and moving:
            self.reasons.append(f"rates: {rates.min():.4g} to {rates.max():.4g} m/s in the pilot run")
        if not self.inventory.moves and not moving:
            self.reasons.append(
                "nothing moves: all light is at rate zero; scene.moving({name: tt.Motion(...)}) gives bodies velocities"
            )
        if given is not None:
            why = "the scene's own" if self.draft.film_choice is None else "as asked for"
            self.reasons.append(f"{given.argument}: {given.settings}, {why}")
            return given.settings
        assert rates is not None  # see above
        found = rate_axis_over(float(rates.min()), float(rates.max()))
        self.reasons.append(f"rate axis: {found}, so that it holds these and rest")
        return found

    # ------------------------------------------------------------------------------------------------- derivatives

    def _note_edges(self, infos: Sequence[ParameterInfo]) -> None:
        """Add the reasons of the boundary term, and the edges that it leaves out."""
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
        if not kind.has_bins and given is not None:
            raise ArgumentError(f"tt.plan: a {self.draft.film.name} film takes no temporal filter; leave it out.")
        table = self.draft.scene.parameters() if self.draft.parameters else {}
        for key in self.draft.parameters:
            if key not in table:
                raise SceneError(unknown_key(key, list(table)))
        self._note_edges([table[key] for key in self.draft.parameters])
        moving = needing_slope(table, self.draft.parameters, kind.knows_rates)
        pulsed = bool(self.draft.pulse or self.draft.irf or self.inventory.pulsed or kind.has_line)
        if not kind.has_bins:
            film = self.draft.film_choice or self.draft.described_film
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
