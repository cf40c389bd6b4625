"""``tt.plan``: the cheapest variant, integrator, film, depth and time window that show what is asked for.

Nothing is guessed: a decision follows from what the description contains, from a pilot run (a few thousand paths whose
arrivals are listed one by one), or from the caller, and ``plan.reasons`` says from which.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

from torchtransient import plugins
from torchtransient.axes import FrequencyAxis, TimeAxis
from torchtransient.checks import Numbers, arguments_of, as_whole, count, shown, text
from torchtransient.errors import ArgumentError, SceneError, TorchTransientError, UnitError
from torchtransient.gates import Gate
from torchtransient.pulses import Pulse
from torchtransient.rendering import plan_choices as choices
from torchtransient.rendering.arguments import checked_depth, checked_filter, checked_keys, film_asked_for
from torchtransient.rendering.effects import Effects
from torchtransient.rendering.films.choice import FilmChoice
from torchtransient.rendering.films.choices import all_films, planned
from torchtransient.rendering.inventory import SceneInventory, take_inventory
from torchtransient.rendering.mitsuba_words import one_line
from torchtransient.rendering.node_checks import check_nodes
from torchtransient.rendering.opaque import opaque
from torchtransient.rendering.plan_finder import Draft, Finder
from torchtransient.rendering.plan_pilot import PilotReport
from torchtransient.rendering.pulse_properties import checked_pulse
from torchtransient.rendering.renderer import TransientRenderer
from torchtransient.rendering.scene_handle import Scene, load
from torchtransient.rendering.taken import ReadyScene
from torchtransient.rendering.variant import active_variant, resolve_variant

# Decisions of a draft that a plan takes over as they are.
_OF_THE_DRAFT = ("scene", "variant", "integrator", "pulse", "irf", "parameters", "sensor")
_PLAIN = ("outputs", "variant", "integrator", "film", "max_depth", "temporal_filter", "parameters", "sensor", "reasons")


@dataclass(frozen=True, kw_only=True)
class Plan(Effects):
    """What :func:`plan` decided. Use it with :meth:`renderer` or ``tt.TransientRenderer(scene, effects=plan)``.

    ``film`` is "transient", "steady" (one bin), "phasor" or "gated". ``max_depth`` None keeps the scene's; so do
    ``time_axis``, ``frequencies`` and ``gates``. ``temporal_filter`` is empty for phasor and gated films.
    ``reasons``: one line per decision. ``pilot``: what the pilot run found, None without one. ``sensor``: the one
    that was planned for, which the renderer takes; another one is refused. ``str(plan)`` prints the reasons.
    """

    outputs: tuple[str, ...]
    film: str
    parameters: tuple[str, ...]
    reasons: tuple[str, ...]
    pilot: PilotReport | None = None

    @property
    def time_axis(self) -> TimeAxis | None:
        """The time axis of the film, None to keep the scene's or for a film without one."""
        axis: TimeAxis | None = self._setting("axis")
        return axis

    @property
    def frequencies(self) -> FrequencyAxis | None:
        """The frequencies of a phasor film, None to keep the scene's."""
        frequencies: FrequencyAxis | None = self._setting("frequencies")
        return frequencies

    @property
    def gates(self) -> tuple[Gate, ...] | None:
        """The gates of a gated film, None to keep the scene's."""
        gates: tuple[Gate, ...] | None = self._setting("gates")
        return gates

    def _setting(self, name: str) -> Any:
        return None if self.film_choice is None else self.film_choice.attributes().get(name)

    def renderer(self, **settings: Any) -> TransientRenderer:
        """A :class:`TransientRenderer` of the planned scene; ``settings`` are its other arguments and go before the
        plan's.
        """
        settings.setdefault("parameters", self.parameters)
        with arguments_of("Plan.renderer", TransientRenderer.__init__, ("scene", "effects")):
            return TransientRenderer(self.scene, effects=self, **settings)

    def to_dict(self) -> dict[str, Any]:
        """Everything but the scene, as plain data for JSON."""
        plain: dict[str, Any] = {name: getattr(self, name) for name in _PLAIN}
        for kind in all_films():
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
        """The same decisions about one scene, in whichever process they were made."""
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
    outputs: Sequence[str] | str = ("transient",),
    *,
    parameters: Sequence[str] = (),
    time_axis: TimeAxis | str | None = None,
    frequencies: FrequencyAxis | Numbers | None = None,
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
    film: FilmChoice | None = None,
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
    ``temporal_filter``, ``frequencies``, ``gates``, or ``film``, an object that says the same. ``pulse`` and ``irf``
    are handed to the renderer, and widen the axis. A bin width that the scene's film has is kept. ``sensor``: the one
    that is planned for, and rendered.

    The variant with which a scene was loaded only says on which device to compute. Depths and times hold for the
    description's values: parameters that change brightness or geometry very much call for another plan.

    Raises ``ArgumentError`` for unknown outputs, ``SceneError`` for unknown parameters, for outputs that need different
    films, for scenes that cannot be read or rendered, and when the pilot run sees no light and no time axis is given;
    ``UnitError`` for shares outside (0, 1); ``VariantError`` for unknown variants; ``GradientError`` for a box filter,
    or gates that open or close at once, with parameters that change path lengths.
    """
    for name, share in (("tail", tail), ("missed", missed)):
        if not 0 < share < 1:
            raise UnitError(f"tt.plan: {name} is a share of the light between 0 and 1, got {share!r}.")
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
    asked = choices.checked_outputs(outputs)
    inventory = inventory_of(loaded, sensor)
    device = loaded.variant.split("_")[0]
    given = film_asked_for(film, {"frequencies": frequencies, "gates": gates})
    if given is not None and given.has_axis:
        if time_axis is not None:
            raise ArgumentError("tt.plan: film and time_axis both give a time axis; leave out one of them.")
        time_axis = given.argument_value()
    kind = planned(asked)
    best, notes = choices.choose_variant(inventory, asked, device, strict)
    tracer, more = choices.choose_integrator(inventory)
    reasons = (_taken("variant", variant, best), *notes, _taken("integrator", integrator, tracer), *more, kind.reason)
    draft = Draft(
        scene=load(loaded, variant=best.value if variant is None else variant),
        variant=best.value if variant is None else variant,
        integrator=tracer.value if integrator is None else integrator,
        film=kind,
        film_choice=choices.film_settings(kind, given, inventory.film, asked),
        pulse=checked_pulse("pulse", pulse),
        irf=checked_pulse("irf", irf),
        parameters=checked_keys(parameters),
        sensor=sensor,
    )
    _check_known(draft, reasons)
    finder = Finder(draft, reasons, inventory, tail, missed, seed)
    found = finder.settle(pilot, max_depth, time_axis, (num_bins, bin_width_opl), temporal_filter)
    kept = {name: getattr(draft, name) for name in _OF_THE_DRAFT}
    return Plan(outputs=asked, film=kind.name, filter_is_given=temporal_filter is not None, **kept, **vars(found))


def inventory_of(scene: Scene, sensor: int = 0) -> SceneInventory:
    """What the description of a scene contains, and the film of one of its sensors. Raises ``SceneError`` for one that
    Mitsuba cannot parse.
    """
    import mitsuba as mi

    description = scene._description
    description.check_described("tt.plan")
    assert not isinstance(description, ReadyScene)  # refused above
    with active_variant(scene.variant):
        config = mi.parser.ParserConfig(scene.variant)
        try:
            with description.resolved_files(), plugins.plugin_errors():
                state = description.parse(config)
                check_nodes(state)
                mi.parser.transform_upgrade(config, state)
                return take_inventory(state, _lookup, sensor)
        except TorchTransientError as error:
            raise type(error)(f"{description.name}: {error}") from error
        except (RuntimeError, ValueError, TypeError) as error:
            raise SceneError(f"{description.name}: Mitsuba could not read the scene. {one_line(error)}") from error


def _lookup(name: str) -> Any:
    from pathlib import Path

    import mitsuba as mi

    return Path(str(mi.file_resolver().resolve(name)))


def _taken(name: str, given: str | None, best: choices.Choice) -> str:
    if given is None:
        return best.reason
    return f"{name}: {given}, as asked for; the plan's own would have been {best.reason.removeprefix(f'{name}: ')}"


def _check_known(draft: Draft, reasons: Sequence[str]) -> None:
    """What the plan calls for has to be part of this installation."""
    for kind, plugin in (("integrator", draft.integrator), ("film", draft.film.kind.plugin)):
        if plugins.kind_of(plugin) != kind:
            raise SceneError(
                f"tt.plan: the plan calls for the {kind} {plugin!r}, which is not registered here:\n"
                + "\n".join(reasons)
            )
