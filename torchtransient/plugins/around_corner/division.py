"""Division of a capture's light among hidden samples, chains and paths, by numbers of bounces.

Samples and chains are shared by all scanned points; paths are traced for each.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from torchtransient.plugins.around_corner.late_light import FIRST

# Light of the laser's spot, of a hidden point, of the scanned point: what shared samples find.
BOUNCES = 3


@dataclass(frozen=True)
class Division:
    """Division of light by numbers of bounces.

    Attributes:
        shared: numbers of bounces whose light comes from shared samples and chains; empty if all comes from paths.
        longest: largest number of bounces that is left for paths, 0 for none.
        why_not: reason against shared samples, in words; None without one.
    """

    shared: range
    longest: int
    why_not: str | None = None

    @staticmethod
    def of(shared: range, first: int, last: int, wall_lights_itself: bool) -> Division:
        """Divide light into shared samples and paths.

        Light of one bounce is that of the laser's spot, light of two goes from wall to wall.

        Args:
            shared: numbers of bounces for shared samples and chains.
            first, last: numbers of bounces that are rendered.
            wall_lights_itself: points of the wall see each other.
        """
        if last >= shared.stop:
            return Division(shared, last)
        before = range(max(first, 2 if wall_lights_itself else 3), shared.start)
        return Division(shared, max(before, default=0))

    @property
    def third_bounce(self) -> bool:
        """Return whether light of three bounces comes from shared samples."""
        return BOUNCES in self.shared

    @property
    def chained(self) -> range:
        """The numbers of bounces whose light comes from chains."""
        return range(max(self.shared.start, BOUNCES + 1), max(self.shared.stop, BOUNCES + 1))

    @property
    def walks(self) -> bool:
        """Return whether paths have to be followed."""
        return self.longest > 0


# ------------------------------------------------------------------------------------------ explanation of the division

SHARED = "from hidden samples that all scanned points share"


def explanation(integrator: Any, scene: Any, contents: Any) -> str:
    """Describe in one line how light of three bounces and later light are found.

    Args:
        integrator: integrator of the capture.
        scene: built scene.
        contents: its :class:`~..transport.scene_contents.SceneContents`.
    """
    division, (least, most) = integrator.division(scene, contents), integrator.asked_bounces()
    parts = []
    if least <= BOUNCES and (most is None or most >= BOUNCES):
        how = SHARED if division.third_bounce else f"from paths{_why(integrator, division)}"
        parts.append(f"light of three bounces {how}")
    else:
        parts.append("light of three bounces is not asked for")
    first = max(least, FIRST)
    if most is not None and most < first:
        return f"{parts[0]}; no later light"
    chained = division.chained
    if chained:
        parts.append(f"light of {_range(chained[0], chained[-1])} from chains that they share")
        first = chained[-1] + 1
    if most is None or most >= first:
        parts.append(f"light of {_range(first, most)} from paths")
    return "; ".join(parts)


def _range(first: int, last: int | None) -> str:
    if last is None:
        return f"{first} and more bounces"
    return f"{first} bounces" if first == last else f"{first} to {last} bounces"


def _why(integrator: Any, division: Division) -> str:
    """Return why paths are followed in place of shared samples."""
    if integrator.third_bounce == "paths":
        return ", as third_bounce asks for"
    return f", since {division.why_not}"
