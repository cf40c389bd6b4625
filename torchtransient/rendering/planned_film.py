"""Films in plans: which one the outputs call for, and what a plan has to know of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from torchtransient.axes import TimeAxis
from torchtransient.rendering.films import FILMS, FilmLayout, Gates, Histogram, Phasors

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
        if kind.has_bins:
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
        # The pulses of a gated film widen what its gates see.
        return settings if self.kind is Gates else Histogram(_ANY_AXIS)


def planned(outputs: Sequence[str]) -> PlannedFilm:
    """Return the film of a plan for some outputs."""
    kind = next((kind for kind in FILMS if kind.output in outputs), Histogram)
    if kind is not Histogram:
        note = "; no time axis is stored" if kind is Phasors else ""
        return PlannedFilm(kind, kind.measures, f"film: {kind.measures}, since {kind.plural} are asked for{note}")
    if "steady" in outputs and kind.output not in outputs:
        reason = "film: steady, one bin for all times, since nothing over time is asked for"
        return PlannedFilm(kind, "steady", reason, all_times=True)
    asked = "transients are" if kind.output in outputs else f"{outputs[0]} over time is"
    return PlannedFilm(kind, kind.measures, f"film: transient, since {asked} asked for")
