"""What becomes of the events and vertices of a walk."""

from __future__ import annotations

from typing import Any


class Sink:
    """A loop calls ``begin`` once, ``event`` for every event, ``vertex`` once a vertex, after its last event, and
    ``end`` after the loop. ``kept`` is the sink's loop state: a dictionary of Dr.Jit values that it may change.
    """

    # Static: whether events of value zero matter, since their derivatives may not be zero.
    zeros = False
    # Static: whether it does anything with vertices.
    keeps_vertices = True

    def begin(self, world: Any) -> dict[str, Any]:
        """The loop state before the first vertex."""
        return {}

    def event(self, kept: dict[str, Any], event: Any) -> None:
        """An :class:`~..strategy.Event`."""

    def vertex(self, kept: dict[str, Any], path: Any, samples: dict[str, Any]) -> None:
        """The vertex that ``path`` has reached; ``samples``: what every strategy made of it, by name."""

    def end(self, kept: dict[str, Any]) -> None:
        """The paths are over."""
