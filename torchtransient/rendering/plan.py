"""``tt.plan``: cheapest variant, integrator, film, depth and time window that show the outputs.

Nothing is guessed: a decision follows from what the description contains, from a pilot run (a few thousand paths whose
arrivals are listed one by one), or from the caller; ``plan.reasons`` names the source.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import torch

from torchtransient import plugins
from torchtransient.axes import FrequencyAxis, RateAxis, TimeAxis
from torchtransient.checks import Numbers, arguments_of, as_whole, count, is_one_of, several, shown, text
from torchtransient.chirps import Chirps
from torchtransient.errors import ArgumentError, SceneError, UnitError
from torchtransient.gates import Gate
from torchtransient.pulses import Pulse
from torchtransient.rendering.arguments import checked_depth, checked_filter, checked_keys, requested_film
from torchtransient.rendering.error_bars import local_mean
from torchtransient.rendering.film_layout import measured
from torchtransient.rendering.films import (
    FILMS,
    Beats,
    FilmLayout,
    Gates,
    Histogram,
    Phasors,
    Rates,
    RowsOfHistograms,
    layout_of_plugin,
)
from torchtransient.rendering.job import mix_seed
from torchtransient.rendering.renderer import TransientRenderer
from torchtransient.scene.edits import NO_LIMIT, checked_pulse
from torchtransient.scene.inventory import scene_inventory
from torchtransient.scene.load import cropped, load
from torchtransient.scene.opaque import opaque
from torchtransient.scene.pilot import PilotReport, rate_axis_over
from torchtransient.scene.plan import Choice, Draft, Effects, Finder, choose_integrator, choose_variant
from torchtransient.scene.samplers import reason_for
from torchtransient.scene.variant import resolve_variant

# Outputs that every film can show beside its own measurement.
_ANY_FILM = ("steady", "stokes", "bands")
# Decisions of a draft that a plan takes over as they are.
_FROM_DRAFT = ("scene", "variant", "integrator", "pulse", "irf", "parameters", "sensor")
_PLAIN = (
    "outputs", "variant", "integrator", "film", "max_depth", "rr_depth", "connections", "temporal_filter", "parameters",
    "sensor", "reasons",
)  # fmt: skip
_PATH, _VOLUMES, _REUSE = "transient_path", "transient_prbvolpath", "transient_path_reuse"
# Time of path reuse and of ellipsoidal connections over that of plain paths with as many samples, at most.
_TIME_OF_REUSE, _TIME_OF_ELLIPSOIDS = 2.0, 5.0
# Depth that no path reaches.
_NO_ROULETTE = 2**30
# Short runs that tell which of them pays: of each renderer, samples per pixel, largest side of the pictures.
_RUNS, _SPP, _PIXELS = 4, 64, 64
_SEED = 0x5A4E
# Nothing is stored in a pilot run: the film only has to be one that integrators take.
_ANY_AXIS = TimeAxis(0.0, 1.0, 1)


@dataclass(frozen=True)
class PlannedFilm:
    """Film of a plan.

    Args:
        kind: class of the film.
        name: name of the film in the plan.
        reason: line that explains the choice.
        all_times: one bin for the light of all times, where nothing over time is asked for.
    """

    kind: type[FilmLayout]
    name: str
    reason: str
    all_times: bool = False

    def missing_settings(self) -> str:
        """Return a message for settings that neither the scene nor the call has; empty for those that a plan finds."""
        kind = self.kind
        if kind.has_bins and kind is not Beats:
            return ""
        return (
            f"tt.plan: {kind.plural} are asked for, and neither the film nor the call has {kind.argument}. Give "
            f"{kind.example}, or make the film a {kind.plugin}."
        )

    def pilot_film(self, settings: FilmLayout | None) -> FilmLayout | None:
        """Return the film of a pilot run, None to keep that of the scene.

        Args:
            settings: film of the plan, None where the scene's is kept or an axis is to be found.
        """
        # The pulses of a gated film widen what its gates see; those of beats are lines of their chirps.
        if self.kind is Rates:
            return Rates(rate_axis_over(0.0, 0.0), _ANY_AXIS)
        return settings if self.kind in (Gates, Beats) else Histogram(_ANY_AXIS)

    @property
    def has_rows(self) -> bool:
        """The film has rates or chirps beside its bins."""
        return issubclass(self.kind, RowsOfHistograms)

    def film_over(self, axis: TimeAxis, settings: Any) -> FilmLayout:
        """Return the film with a time axis; ``settings``: those of a film of rows, None for others."""
        return self.kind(axis) if settings is None else self.kind(settings, axis)  # type: ignore[call-arg]


def planned(outputs: Sequence[str]) -> PlannedFilm:
    """Return the film of a plan for some outputs.

    Args:
        outputs: names of outputs, such as "transient".
    """
    kind = next((kind for kind in FILMS if kind.output in outputs), Histogram)
    if kind is not Histogram:
        note = "; no time axis is stored" if kind is Phasors else ""
        return PlannedFilm(kind, kind.measures, f"film: {kind.measures}, since {kind.plural} are asked for{note}")
    if "steady" in outputs and kind.output not in outputs:
        reason = "film: steady, one bin for all times, since nothing over time is asked for"
        return PlannedFilm(kind, "steady", reason, all_times=True)
    asked = "transients are" if kind.output in outputs else f"{outputs[0]} over time is"
    return PlannedFilm(kind, kind.measures, f"film: transient, since {asked} asked for")


@dataclass(frozen=True, kw_only=True)
class Plan(Effects):
    """Decisions of :func:`plan`. :meth:`renderer` makes a renderer of them, as does ``effects=`` of the renderer.

    ``str(plan)`` prints the reasons.

    Attributes:
        outputs: outputs of the plan.
        film: "transient", "steady" (one bin), "phasor", "gated", "rates" or "beats".
        parameters: keys of the parameters that will have gradients.
        reasons: one line per decision.
        pilot: results of the pilot run, None without one.
        scene, variant, integrator, temporal_filter: scene, and names of variant, integrator and filter, as the renderer
            uses them; the filter is empty for phasor and gated films.
        max_depth: bound on the depth, None for the scene's.
        sensor: sensor of the plan, which the renderer takes; another one is refused.
    """

    outputs: tuple[str, ...]
    film: str
    parameters: tuple[str, ...]
    reasons: tuple[str, ...]
    pilot: PilotReport | None = None

    @property
    def time_axis(self) -> TimeAxis | None:
        """Time axis of the film, None to keep the scene's or for a film without one."""
        axis: TimeAxis | None = self._setting("axis")
        return axis

    @property
    def frequencies(self) -> FrequencyAxis | None:
        """Frequencies of a phasor film, None to keep the scene's."""
        frequencies: FrequencyAxis | None = self._setting("frequencies")
        return frequencies

    @property
    def gates(self) -> tuple[Gate, ...] | None:
        """Gates of a gated film, None to keep the scene's."""
        gates: tuple[Gate, ...] | None = self._setting("gates")
        return gates

    @property
    def rates(self) -> RateAxis | None:
        """Bins of the rate of a rate film, else None."""
        rates: RateAxis | None = self._setting("rate_axis")
        return rates

    @property
    def chirps(self) -> Chirps | None:
        """Chirps of a beat film, else None."""
        chirps: Chirps | None = self._setting("chirps")
        return chirps

    def _setting(self, name: str) -> Any:
        return None if self.film_choice is None else self.film_choice.attributes().get(name)

    def renderer(self, **settings: Any) -> TransientRenderer:
        """Return a :class:`TransientRenderer` of the planned scene.

        Args:
            settings: arguments of :class:`TransientRenderer`, which take precedence over the plan.

        Returns:
            The renderer, with the plan's parameters unless ``settings`` has others.

        Raises:
            TypeError: for arguments that :class:`TransientRenderer` does not have.
            ArgumentError, SceneError, GradientError: as :class:`TransientRenderer` raises them.
        """
        settings.setdefault("parameters", self.parameters)
        with arguments_of("Plan.renderer", TransientRenderer.__init__, ("scene", "effects")):
            return TransientRenderer(self.scene, effects=self, **settings)

    def to_dict(self) -> dict[str, Any]:
        """Return all decisions but the scene as plain data for JSON."""
        plain: dict[str, Any] = {name: getattr(self, name) for name in _PLAIN}
        for kind in FILMS:
            plain[kind.argument] = self.film_choice.plain() if isinstance(self.film_choice, kind) else None
        for name in ("pulse", "irf"):
            plain[name] = None if getattr(self, name) is None else asdict(getattr(self, name))
        found = {} if self.pilot is None else asdict(self.pilot)
        # A dark scene has no relative error, and JSON no number for that.
        plain["pilot"] = {key: None if value != value else value for key, value in found.items()} or None
        return plain

    def __str__(self) -> str:
        return "\n".join(self.reasons)

    def __eq__(self, other: object) -> bool:
        """Return whether both are the same decisions about one scene."""
        if not isinstance(other, Plan):
            return NotImplemented
        rest = [field.name for field in fields(self) if field.name != "scene"]
        same = all(getattr(self, name) == getattr(other, name) for name in rest)
        return same and self.scene.same_description(other.scene)

    def __hash__(self) -> int:
        return hash((self.variant, self.integrator, self.film, self.outputs, self.reasons))


@opaque
def plan(
    scene: Any,
    outputs: Sequence[str] | str | None = None,
    *,
    parameters: Sequence[str] = (),
    time_axis: TimeAxis | str | None = None,
    frequencies: FrequencyAxis | Numbers | None = None,
    gates: Gate | Sequence[Gate] | None = None,
    rates: RateAxis | None = None,
    chirps: Chirps | None = None,
    pulse: Pulse | None = None,
    irf: Pulse | None = None,
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
    film: FilmLayout | None = None,
    error: str = "squared",
) -> Plan:
    """Choose the cheapest variant, integrator, depth and film that show the requested outputs.

    Depths and times hold for the described values: parameters that change brightness or geometry very much call for
    another plan.

    Args:
        scene: scene, as for :func:`load`. The variant that it was loaded with only sets the device.
        outputs: some of "transient", "steady", "phasor", "stokes", "gates", "rates", "beats", "bands"; None for
            those that the given settings of a film call for, or else "transient".
        parameters: keys of the parameters that will have gradients.
        time_axis: axis of the film, "scene" for the scene's own, None to find one.
        frequencies, gates: settings of a phasor or gated film.
        rates: bins of the rate of a rate film, None for those of the scene's film, or to find some.
        chirps: chirps of a beat film; the axis to be found is one over ``opl +- k rate``.
        pulse, irf: shapes of pulse and impulse response, which the renderer uses; they widen the axis.
        num_bins, bin_width_opl: bins of an axis to be found; a width (metres) of the scene's film is kept.
        max_depth: bound on the depth, "scene" for the scene's own, None to find one.
        variant, integrator, temporal_filter: names, None to choose.
        tail: largest share of the image's light that may be left to deeper paths; no block of the image (an 8 x 8
            grid) may lose more than ten times that. A bound on the light of the pilot run, with two standard errors to
            spare.
        missed: largest share of the light that may lie outside of the time window, bounded in the same way.
        strict: carry polarization also where it only changes the light between smooth surfaces. Without it such a
            scene is planned unpolarized, as is usual, with a line in ``reasons``.
        pilot: False for no pilot run: the depth then follows from the albedos where they bound it, and the time axis
            is the scene's.
        sensor: index of the sensor that is planned for, and rendered.
        seed: seed of the pilot run.
        film: film and its settings, in place of ``frequencies``, ``gates``, ``rates`` and ``chirps``.
        error: error that is to be small: "squared", which bright bins make, or "relative", to which every bin adds
            alike. For the latter there is no Russian roulette below the depth, and pixels share light
            (``transient_path_reuse``) where short runs show that it pays, as they show for the ellipsoidal
            connections of gates.

    Returns:
        The plan; ``str(plan)`` prints its reasons.

    Raises:
        ArgumentError: for unknown outputs, and settings that have no effect.
        SceneError: for unknown parameters, outputs that need different films, scenes that cannot be read or rendered,
            and when the pilot run sees no light and no time axis is given.
        UnitError: for shares outside (0, 1).
        VariantError: for unknown variants.
        GradientError: for a box filter, or gates that open or close at once, with parameters that change path lengths.
    """
    for name, share in (("tail", tail), ("missed", missed)):
        if not 0 < share < 1:
            raise UnitError(f"tt.plan: {name} is a share of the light between 0 and 1, got {share!r}.")
    if not is_one_of(error, ("squared", "relative")):
        raise ArgumentError(f"tt.plan: error: expected 'squared' or 'relative', got {shown(error)}.")
    if not isinstance(max_depth, str):
        max_depth = checked_depth(max_depth)
    num_bins = None if num_bins is None else count("tt.plan: num_bins", num_bins, 1, ArgumentError)
    if (index := as_whole(sensor)) is None:
        raise ArgumentError(f"tt.plan: sensor: expected the index of a sensor, got {shown(sensor)}.")
    sensor = index
    if variant is not None:
        resolve_variant(variant)
    if integrator is not None:
        text("tt.plan: integrator", integrator, "the plugin name of an integrator")
    if temporal_filter is not None:
        checked_filter(temporal_filter)
    loaded = load(scene)
    named = {"frequencies": frequencies, "gates": gates, "rates": rates, "chirps": chirps}
    given = requested_film(film, named)
    wanted = _checked_outputs(outputs, given)
    inventory = scene_inventory(loaded, sensor)
    own_axis = None if given is None else given.attributes().get("axis")
    if own_axis is not None:
        if time_axis is not None:
            raise ArgumentError("tt.plan: film and time_axis both give a time axis; leave out one of them.")
        time_axis = own_axis
    planned_film = planned(wanted)
    if error == "relative" and (planned_film.all_times or planned_film.kind.is_complex):
        raise ArgumentError(
            f"tt.plan: error='relative' is about bins and gates, and a {planned_film.name} film sums over all times; "
            "leave it out."
        )
    best, notes = choose_variant(inventory, wanted, loaded.variant.split("_")[0], strict)
    tracer, more = choose_integrator(inventory)
    reasons = (
        _reason("variant", variant, best), *notes, _reason("integrator", integrator, tracer), *more,
        planned_film.reason, reason_for(inventory.sampler),
    )  # fmt: skip
    own_film = layout_of_plugin(inventory.film or "")
    described = None if own_film is None else own_film.from_properties(inventory.film_props)
    draft = Draft(
        scene=load(loaded, variant=best.value if variant is None else variant),
        variant=best.value if variant is None else variant,
        integrator=tracer.value if integrator is None else integrator,
        film=planned_film,
        film_choice=_film_settings(planned_film, given, inventory.film, wanted),
        described_film=described,
        described_axis=None if described is None else described.attributes().get("axis"),
        pulse=checked_pulse("pulse", pulse),
        irf=checked_pulse("irf", irf),
        parameters=checked_keys(parameters),
        sensor=sensor,
    )
    _check_registered(draft, reasons)
    finder = Finder(draft, reasons, inventory, tail, missed, seed, error == "relative")
    found = finder.settle(pilot, max_depth, time_axis, (num_bins, bin_width_opl), temporal_filter)
    kept = {name: getattr(draft, name) for name in _FROM_DRAFT}
    result = Plan(
        outputs=wanted, film=planned_film.name, filter_is_given=temporal_filter is not None, **kept, **vars(found)
    )
    if inventory.connections == "ellipsoidal" and planned_film.kind is not Gates:
        reason = "connections: ordinary, in place of the scene's ellipsoidal ones, which are for gates"
        result = replace(result, connections="ordinary", reasons=(*result.reasons, reason))
    if error == "relative":
        result = _without_roulette(result)
    others = _other_ways(result, error == "relative", inventory.connections is None)
    chooses = integrator is None and pilot
    return _with_least_variance(result, others, error == "relative", seed) if chooses else _without(result, others)


def _without_roulette(given: Plan) -> Plan:
    depth = given.max_depth
    if depth is None or depth == NO_LIMIT:
        reason = "Russian roulette: kept, since nothing else bounds the depth"
        return replace(given, reasons=(*given.reasons, reason))
    reason = "Russian roulette: none, since it leaves late light to few paths of great weight"
    return replace(given, rr_depth=_NO_ROULETTE, reasons=(*given.reasons, reason))


def _other_ways(given: Plan, relative: bool, connects: bool) -> list[tuple[str, dict[str, Any], float]]:
    """Return alternatives that may have less variance than a plan: name, changes of the plan, and most time over that
    of the plan.

    Args:
        given: plan with plain paths and ordinary connections.
        relative: the variance of each bin counts over its squared mean.
        connects: connections are open, since the scene names none.
    """
    found: list[tuple[str, dict[str, Any], float]] = []
    if relative and given.integrator == _PATH:
        found.append(("path reuse", {"integrator": _REUSE}, _TIME_OF_REUSE))
    if connects and given.film == "gated" and given.integrator in (_PATH, _VOLUMES):
        found.append(("ellipsoidal connections", {"connections": "ellipsoidal"}, _TIME_OF_ELLIPSOIDS))
    return found


def _without(given: Plan, others: Sequence[tuple[str, dict[str, Any], float]]) -> Plan:
    why = "no short runs tell whether it pays, which are for plans with a pilot run and without a given integrator"
    return replace(given, reasons=(*given.reasons, *(f"{name}: not used; {why}" for name, _, _ in others)))


def _with_least_variance(
    given: Plan, others: Sequence[tuple[str, dict[str, Any], float]], relative: bool, seed: int
) -> Plan:
    """Return a plan with one of ``others`` where short runs show that it pays. ``seed``: seed of the runs."""
    small, chosen = replace(given, scene=cropped(given.scene, _PIXELS), parameters=()), given
    best, used, reasons = 1.0, "", list(given.reasons)
    found: dict[str, str] = {}
    for name, changes, time in others:
        try:
            renderers = [p.renderer(physics="ignore") for p in (small, replace(small, **changes))]
            plain, less = _variances(renderers[0], renderers[1], seed, relative)
        except SceneError as error:
            found[name] = str(error)
            continue
        if not plain + less > 0:
            found[name] = "no light in the short runs"
            continue
        # What plain paths do not find at all is found by the others alone.
        gain = 0.0 if not less > 0 else plain / (time * less) if plain > 0 else math.inf
        if gain > best:
            best, used, chosen = gain, name, replace(given, **changes)
        kind = "relative variance" if relative else "variance"
        found[name] = (
            f"the {kind} with {_SPP} samples per pixel is {less:.2g} with it and {plain:.2g} without, and it takes up "
            f"to {time:g} times the time"
        )
    reasons += [f"{name}: {'used' if name == used else 'not used'}; {why}" for name, why in found.items()]
    if chosen.integrator != given.integrator:
        reasons = [line for line in reasons if not line.startswith("integrator: ")]
        reasons.append(f"integrator: {chosen.integrator}, see path reuse")
    return replace(chosen, reasons=tuple(reasons))


def _variances(one: TransientRenderer, other: TransientRenderer, seed: int, relative: bool) -> tuple[float, float]:
    """Return the mean variance of bins or gates of two renderers of one scene.

    ``relative``: over the squared mean of a bin and its neighbours, and 1 % of the mean over all; gates have neighbours
    in the picture alone.
    """
    runs = _runs(one, mix_seed(seed, _SEED)), _runs(other, seed)
    size = torch.ones(())
    if relative:
        near = local_mean(torch.cat(runs).mean(0), (-3, -2, -1) if one.film.has_bins else (-2, -1))
        size = near.square() + (0.01 * near.mean()).square()
    found = [float((x.var(0) / size).mean()) for x in runs]
    return found[0], found[1]


def _runs(renderer: TransientRenderer, seed: int) -> torch.Tensor:
    """Return the bins of some renders, means over channels, (runs, T, H, W)."""
    with torch.no_grad():
        outputs = (renderer(seed=mix_seed(seed, run), spp=_SPP) for run in range(_RUNS))
        return torch.stack([measured(out, renderer.film.measures).mean(0) for out in outputs])


def known_outputs() -> tuple[str, ...]:
    """Return the outputs that a plan can be asked for."""
    return (*(kind.output for kind in FILMS), *_ANY_FILM)


def _checked_outputs(outputs: Sequence[str] | str | None, given: FilmLayout | None) -> tuple[str, ...]:
    """Return the outputs of a plan; ``given``: film that the call asks for, None without one."""
    if outputs is None:
        return ("transient" if given is None else given.output,)
    wanted = (outputs,) if isinstance(outputs, str) else tuple(several("tt.plan: outputs", outputs, "names"))
    films, known = tuple(kind.output for kind in FILMS), known_outputs()
    if not wanted or not all(is_one_of(name, known) for name in wanted):
        raise ArgumentError(f"tt.plan: outputs are some of {', '.join(known)}; got {shown(list(wanted))}.")
    measured = [name for name in wanted if name in films]
    if len(set(measured)) > 1:
        raise ArgumentError(
            f"tt.plan: a film measures one of {', '.join(films)}, got {' and '.join(measured)}; make a plan for each."
        )
    return wanted


def _film_settings(
    film: PlannedFilm, given: FilmLayout | None, plugin: str | None, outputs: Sequence[str]
) -> FilmLayout | None:
    """Return the settings that a call gives, None to keep those of the scene's film, a ``plugin``, or to find them."""
    if given is not None and type(given) is not film.kind:
        others = (name for name in outputs if name in _ANY_FILM)
        raise ArgumentError(
            f"tt.plan: outputs={tuple(outputs)} call for a {film.name} film, on which {given.argument} have no effect; "
            f"ask for outputs={(given.output, *others)}."
        )
    if given is None and plugin != film.kind.plugin and film.missing_settings():
        raise SceneError(film.missing_settings())
    return given


def _reason(name: str, given: str | None, best: Choice) -> str:
    if given is None:
        return best.reason
    return f"{name}: {given}, as asked for; the plan's own would have been {best.reason.removeprefix(f'{name}: ')}"


def _check_registered(draft: Draft, reasons: Sequence[str]) -> None:
    """Raise ``SceneError`` for plugins of a plan that this installation does not have."""
    for kind, plugin in (("integrator", draft.integrator), ("film", draft.film.kind.plugin)):
        if plugins.kind_of(plugin) != kind:
            raise SceneError(
                f"tt.plan: the plan calls for the {kind} {plugin!r}, which is not registered here:\n"
                + "\n".join(reasons)
            )
