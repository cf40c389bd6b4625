"""What a plan hands to a renderer."""

from __future__ import annotations

import abc
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from torchtransient.errors import SceneError
from torchtransient.pulses import Pulse
from torchtransient.rendering.films import FilmLayout
from torchtransient.rendering.scene_handle import Scene, load


@dataclass(frozen=True, kw_only=True)
class Effects(abc.ABC):
    """The decisions about one scene that a renderer takes over where its own arguments do not say otherwise.

    ``film_choice``, ``max_depth``, ``pulse`` and ``irf`` None keep what the scene has; ``temporal_filter`` is empty for
    films without one, and ``filter_is_given`` says that it was asked for, so that no other one may take its place.
    ``sensor``: the one whose light the decisions are about.
    """

    scene: Scene = field(repr=False)
    variant: str
    integrator: str
    film_choice: FilmLayout | None
    max_depth: int | None
    pulse: Pulse | None
    irf: Pulse | None
    temporal_filter: str
    filter_is_given: bool = False
    sensor: int = 0

    @abc.abstractmethod
    def __str__(self) -> str:
        """The reasons of the decisions."""

    def planned_scene(self, scene: Any) -> Scene:
        """A scene in the variant of the plan. Raises ``SceneError`` for one that was not planned for."""
        given = load(scene)
        if not given.same_description(self.scene):
            raise SceneError(
                f"effects: the plan was made for {self.scene!r}, got {given!r}, which is another scene: its depth, "
                "window and variant would be those of the other. Make a plan of this one with tt.plan(scene, ...), or "
                "take plan.renderer()."
            )
        return load(given, variant=self.variant)

    def film_settings(self, film: FilmLayout | None, temporal_filter: str) -> tuple[FilmLayout | None, str]:
        """Film and temporal filter of a renderer: its own where it has some, else the plan's."""
        film = self.film_choice if film is None else film
        # A box of the plan's own choice stays "auto": parameters that were not planned for may call for a slope.
        decided = self.temporal_filter if self.filter_is_given or self.temporal_filter != "box" else ""
        if temporal_filter == "auto" and decided and (film is None or film.has_bins):
            temporal_filter = decided
        return film, temporal_filter

    def check_sensors(self, sensors: Sequence[int]) -> None:
        """Raise ``SceneError`` for a sensor that was not planned for."""
        others = sorted(set(sensors) - {self.sensor})
        if others:
            raise SceneError(
                f"effects: the plan was made for sensor {self.sensor}, got sensors={list(sensors)}: another one sees "
                f"light of other depths and times. Leave sensors out, or plan with tt.plan(scene, sensor={others[0]})."
            )
