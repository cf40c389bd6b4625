"""Who finds which light of a capture: hidden samples and chains that scanned points share, or paths."""

from __future__ import annotations

from dataclasses import dataclass

# Light of the laser's spot, of a hidden point, of the scanned point: what shared samples find.
BOUNCES = 3


@dataclass(frozen=True)
class Division:
    """``shared``: the numbers of bounces whose light comes from shared samples and chains, an empty range where all
    comes from paths; ``longest``: the largest number of bounces that is left for paths, 0 for none; ``why_not``: what
    stands against shared samples, in words, or None.
    """

    shared: range
    longest: int
    why_not: str | None = None

    @staticmethod
    def of(shared: range, first: int, last: int, wall_lights_itself: bool) -> Division:
        """Of light of ``first`` to ``last`` bounces: one lights the spot alone, and two go from wall to wall."""
        if last >= shared.stop:
            return Division(shared, last)
        before = range(max(first, 2 if wall_lights_itself else 3), shared.start)
        return Division(shared, max(before, default=0))

    @property
    def third_bounce(self) -> bool:
        """Whether light of three bounces comes from shared samples."""
        return BOUNCES in self.shared

    @property
    def chained(self) -> range:
        """The numbers of bounces whose light comes from chains."""
        return range(max(self.shared.start, BOUNCES + 1), max(self.shared.stop, BOUNCES + 1))

    @property
    def walks(self) -> bool:
        """Whether paths have to be followed."""
        return self.longest > 0
