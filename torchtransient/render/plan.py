"""``tt.plan``: the cheapest variant, integrator, film, depth and time window that show what is asked for.

Nothing is guessed: a decision follows from what the description contains, from a pilot run (a few thousand paths whose
arrivals are listed one by one), or from the caller, and ``plan.reasons`` says from which.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from torchtransient import plugins
from torchtransient.axes import FrequencyAxis, TimeAxis
from torchtransient.errors import SceneError, TorchTransientError, UnitError
from torchtransient.gates import Gate
from torchtransient.pulses import Pulse
from torchtransient.render import plan_choices as choices
from torchtransient.render.arguments import film_choice
from torchtransient.render.census import Census, take_census
from torchtransient.render.plan_finder import Finder
from torchtransient.render.plan_pilot import PilotReport
from torchtransient.render.pulse_properties import checked_pulse
from torchtransient.render.scene_handle import Scene, load
from torchtransient.render.variant import active_variant


@dataclass(frozen=True)
class Plan:
    """What :func:`plan` decided. Use it with :meth:`renderer` or ``tt.TransientRenderer(scene, effects=plan)``.

    ``film`` is "transient", "steady" (one bin), "phasor" or "gated". ``max_depth`` None keeps the scene's; so do
    ``time_axis``, ``frequencies`` and ``gates``. ``temporal_filter`` is empty for phasor and gated films.
    ``reasons``: one line per decision. ``pilot``: what the pilot run found, None without one. ``sensor``: the one
    that was planned for. ``str(plan)`` prints the reasons.
    """

    scene: Scene = field(repr=False)
    outputs: tuple[str, ...]
    variant: str
    integrator: str
    film: str
    max_depth: int | None
    time_axis: TimeAxis | None
    frequencies: FrequencyAxis | None
    gates: tuple[Gate, ...] | None
    pulse: Pulse | None
    irf: Pulse | None
    temporal_filter: str
    parameters: tuple[str, ...]
    reasons: tuple[str, ...]
    pilot: PilotReport | None = None
    sensor: int = 0

    def renderer(self, **settings: Any) -> Any:
        """A :class:`TransientRenderer` of the planned scene; ``settings`` are its other arguments and go before the
        plan's.
        """
        from torchtransient.render.renderer import TransientRenderer

        settings.setdefault("parameters", self.parameters)
        settings.setdefault("sensors", self.sensor)
        return TransientRenderer(self.scene, effects=self, **settings)

    def film_settings(
        self, time_axis: TimeAxis | None, frequencies: Any, gates: Any, temporal_filter: str
    ) -> tuple[TimeAxis | None, Any, Any, str]:
        """What a renderer's film measures: its own arguments where it has some, else the plan's."""
        if frequencies is not None or gates is not None:
            return time_axis, frequencies, gates, temporal_filter
        if time_axis is None:
            time_axis, frequencies, gates = self.time_axis, self.frequencies, self.gates
        # A planned box stays "auto": parameters that were not planned for may call for a slope.
        if temporal_filter == "auto" and self.temporal_filter not in ("box", ""):
            temporal_filter = self.temporal_filter
        return time_axis, frequencies, gates, temporal_filter

    def to_dict(self) -> dict[str, Any]:
        """Everything but the scene, as plain data for JSON."""
        names = ("outputs", "variant", "integrator", "film", "max_depth", "temporal_filter", "parameters", "reasons")
        plain: dict[str, Any] = {name: getattr(self, name) for name in names}
        axis, frequencies = self.time_axis, self.frequencies
        plain["time_axis"] = None if axis is None else {
            "start_opl": axis.start_opl, "bin_width_opl": axis.bin_width_opl, "num_bins": axis.num_bins,
        }  # fmt: skip
        plain["frequencies"] = None if frequencies is None else list(frequencies.frequencies)
        for name in ("pulse", "irf"):
            plain[name] = None if getattr(self, name) is None else asdict(getattr(self, name))
        plain["gates"] = None if self.gates is None else [asdict(gate) for gate in self.gates]
        found = {} if self.pilot is None else asdict(self.pilot)
        # A dark scene has no relative error, and JSON no number for that.
        plain["pilot"] = {key: None if value != value else value for key, value in found.items()} or None
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
    gates: Gate | Sequence[Gate] | None = None,
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
    ``temporal_filter``, ``frequencies``, ``gates``. ``pulse`` and ``irf`` are handed to the renderer, and widen the
    axis. A bin width that the scene's film has is kept.

    The variant with which a scene was loaded only says on which device to compute. Depths and times hold for the
    description's values: parameters that change brightness or geometry very much call for another plan.

    Raises ``SceneError`` for unknown outputs and parameters, for outputs that need different films, for scenes that
    cannot be read or rendered, and when the pilot run sees no light and no time axis is given; ``UnitError`` for
    shares outside (0, 1); ``VariantError`` for unknown variants; ``GradientError`` for a box filter with parameters
    that change path lengths.
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
        gates=film_choice(None, None, gates)["gates"],
        pulse=checked_pulse("pulse", pulse),
        irf=checked_pulse("irf", irf),
        temporal_filter="",
        parameters=tuple(parameters),
        reasons=tuple(reasons),
        sensor=sensor,
    )
    _check_known(draft, gates, census)
    finder = Finder(draft, census, tail, missed, seed)
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
