"""Light outside of the time window, counted over samples of a recipe."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import KW_ONLY, dataclass
from typing import Self

import numpy as np

from torchtransient.errors import PhysicsWarning, TorchTransientWarning, level_of_user

# Share of a sample's light outside of the window from which on the sample counts as cut.
CUT = 0.01
# Quantile of the normal distribution for an interval of 95 %.
_Z = 1.96


@dataclass(frozen=True)
class OutsideLight:
    """Light that the time window misses, over some samples of a recipe.

    ``samples``: how many were looked at; none of films without a window. ``cut``: those of them with more than 1 % of
    their light outside. ``mean``, ``most``: share of the light outside, over samples. ``failed``: how many others could
    not be rendered; ``reason``: why the first of these could not.
    """

    _: KW_ONLY
    samples: int
    cut: int
    mean: float
    most: float
    failed: int = 0
    reason: str = ""

    @classmethod
    def of(cls, shares: Iterable[Sequence[float]], failed: Sequence[str] = ()) -> Self:
        """Of samples' shares (before, after) the window, and why others ``failed``."""
        missed = np.array([sum(pair) for pair in shares], dtype=np.float64)
        reason = failed[0] if failed else ""
        if not len(missed):
            return cls(samples=0, cut=0, mean=0.0, most=0.0, failed=len(failed), reason=reason)
        mean, most, cut = float(missed.mean()), float(missed.max()), int((missed > CUT).sum())
        return cls(samples=len(missed), cut=cut, mean=mean, most=most, failed=len(failed), reason=reason)

    @property
    def expected(self) -> tuple[float, float]:
        """Share of cut samples among all of the recipe, lower and upper end of an interval of 95 % (Wilson 1927)."""
        if not self.samples:
            return 0.0, 1.0
        n, p = self.samples, self.cut / self.samples
        middle, half = p + _Z**2 / (2 * n), _Z * math.sqrt(p * (1 - p) / n + _Z**2 / (4 * n**2))
        low, high = ((middle + sign * half) / (1 + _Z**2 / n) for sign in (-1, 1))
        return max(low, 0.0) if self.cut else 0.0, min(high, 1.0) if self.cut < n else 1.0

    def shares(self) -> str:
        """The figures in words, of these samples alone."""
        if not self.samples:
            return "not looked at"
        return (
            f"more than {CUT:.0%} in {self.cut} of {self.samples} samples, {self.mean:.2%} on average, {self.most:.2%} "
            "at most"
        )

    def __str__(self) -> str:
        text = self.shares()
        if self.samples:
            low, high = self.expected
            text += f"; more than {CUT:.0%} in {low:.1%} to {high:.1%} of all samples (95% confidence)"
        return text + (f"; {self.failed} of {self.failed + self.samples} samples failed" if self.failed else "")

    def warn(self, what: str) -> None:
        """Give a PhysicsWarning where there are cut samples, and a TorchTransientWarning where there are failed ones.
        """
        if self.failed:
            warnings.warn(
                f"{what}: {self.failed} of {self.failed + self.samples} samples that were looked at failed and do not "
                f"count in the light outside of the time window. The first one: {self.reason}",
                TorchTransientWarning,
                level_of_user(),
            )
        if self.cut:
            warnings.warn(
                f"{what}: light outside of the time window: {self}. Samples are kept all the same, each with its "
                "shares under 'outside'. A time_axis= that starts earlier or has more bins holds more.",
                PhysicsWarning,
                level_of_user(),
            )
