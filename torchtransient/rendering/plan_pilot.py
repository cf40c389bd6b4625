"""What a pilot run says about a scene: how deep its paths have to be, and when its light arrives.

Both answers are read off a list of events (:class:`torchtransient.plugins.integrators.pilot.PilotEvents`), for the
image as a whole and for its blocks, since light that matters to a corner of the picture may not matter to its mean.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from torchtransient.axes import TimeAxis
from torchtransient.errors import ArgumentError
from torchtransient.gates import Gate
from torchtransient.rendering.variant import active_variant

if TYPE_CHECKING:
    from torchtransient.rendering.build_options import BuildOptions
    from torchtransient.rendering.films import FilmLayout
    from torchtransient.rendering.scene_handle import Scene

PILOT_PATHS = 32768
PILOT_PIXELS = 2048
# From this depth on a run is made again without Russian roulette. That lets at most 0.95 of the paths go on at a
# bounce, so that the light of brighter surfaces is left to few paths of great weight: none beyond depth 200 or so.
DEEP = 48
# The image is divided into so many blocks along each side; a block may lose so many times the image's share.
BLOCKS = 8
BLOCK_ALLOWANCE = 10.0
# Bins of an axis whose bin width nobody has said, and the most that an axis gets without being asked.
DEFAULT_BINS = 300
MOST_BINS = 4096


@dataclass(frozen=True)
class PilotReport:
    """What a pilot run found.

    ``paths``, ``events``: how many were traced and listed; ``seconds``: wall time with building and compiling.
    ``relative_error``: standard error of the image's mean over that mean. ``tail``, ``tail_error``: share of the light
    in paths deeper than the depth that was chosen, and its standard error. ``missed``, ``missed_error``: the same for
    light outside the chosen window, None without one. ``first_opl``, ``last_opl``: earliest and latest arrival, metres.
    """

    variant: str
    paths: int
    events: int
    seconds: float
    relative_error: float
    tail: float
    tail_error: float
    first_opl: float
    last_opl: float
    missed: float | None = None
    missed_error: float | None = None


class Arrivals:
    """Events of a pilot run, ready for questions about parts of their energy."""

    def __init__(self, events: Any):
        self.opl, self.energy, self.depth, self.path = events.opl, events.energy, events.depth, events.path
        self.paths = events.paths
        self.total = float(self.energy.sum())
        width, height = events.size
        across, down = min(BLOCKS, width), min(BLOCKS, height)
        x, y = events.pixel % width, events.pixel // width
        self.block = (y * down // height) * across + x * across // width
        self.blocks = across * down
        self.block_total = np.bincount(self.block, self.energy, self.blocks)

    def through(self, gates: Sequence[Gate]) -> Arrivals:
        """The same arrivals as some gates see them: energy times the sum of their sensitivities."""
        seen = copy.copy(self)
        seen.energy = self.energy * sum(gate.value(self.opl) for gate in gates)
        seen.total = float(seen.energy.sum())
        seen.block_total = np.bincount(self.block, seen.energy, self.blocks)
        return seen

    @property
    def dark(self) -> bool:
        """Whether no light was met at all."""
        return not self.total > 0

    def share(self, chosen: np.ndarray) -> tuple[float, float]:
        """Share of the energy in the chosen events, and its standard error over paths."""
        return self._share(chosen, slice(None), self.paths, self.total)

    def _share(self, chosen: np.ndarray, part: Any, paths: int, total: float) -> tuple[float, float]:
        sums = np.bincount(self.path[part][chosen[part]], self.energy[part][chosen[part]])
        mean = float(sums.sum())
        spread = float((sums**2).sum()) - mean * mean / paths
        return mean / total, math.sqrt(max(spread, 0.0)) / total

    def relative_error(self) -> float:
        """Standard error of the mean energy over the mean."""
        return self.share(np.ones(len(self.energy), dtype=bool))[1]

    def negligible(self, chosen: np.ndarray, share: float) -> bool:
        """Whether the chosen events hold at most ``share`` of the light, with two standard errors to spare, and no
        block of the image loses more than ten times that, beyond two standard errors.
        """
        part, error = self.share(chosen)
        if part + 2 * error > share:
            return False
        lost = np.bincount(self.block[chosen], self.energy[chosen], self.blocks)
        suspect = np.flatnonzero(lost > BLOCK_ALLOWANCE * share * self.block_total)
        for block in suspect:
            inside = self.block == block
            per_block = self.paths / self.blocks
            part, error = self._share(chosen, inside, per_block, float(self.block_total[block]))
            if part - 2 * error > BLOCK_ALLOWANCE * share:
                return False
        return True

    # ------------------------------------------------------------------------------------------------------ depth

    def enough_depth(self, tail: float) -> int:
        """The smallest depth beyond which light is negligible; the deepest that was seen when none is."""
        low, high = 1, int(self.depth.max())
        while low < high:
            middle = (low + high) // 2
            if self.negligible(self.depth > middle, tail):
                high = middle
            else:
                low = middle + 1
        return low

    def beyond(self, deepest: int) -> tuple[float, float]:
        """Share of the light in paths deeper than the run's ``deepest``, and its standard error: light that has fallen
        to a share by the middle falls by that once more.
        """
        part, error = self.share(self.depth > deepest // 2)
        return part * part, 2 * part * error

    # ----------------------------------------------------------------------------------------------------- window

    def window(self, depth: int, missed: float) -> tuple[float, float]:
        """From the earliest arrival to the time after which light is negligible, among paths up to ``depth``."""
        kept = self.depth <= depth if depth > 0 else np.ones(len(self.depth), dtype=bool)
        times = np.sort(self.opl[kept & (self.energy > 0)])
        low, high = 0, len(times) - 1
        while low < high:
            middle = (low + high) // 2
            if self.negligible(kept & (self.opl > times[middle]), missed):
                high = middle
            else:
                low = middle + 1
        return float(times[0]), float(times[low])


def pilot_run(
    scene: Scene, options: BuildOptions, sensor: int, kind: type[FilmLayout], tail: float, seed: int = 0
) -> tuple[Any, Arrivals]:
    """(film, arrivals) of a pilot run of a scene in a variant without polarization, which costs most of the time and
    changes neither depth nor time. ``kind``: what the film measures; ``tail``: the share of light that will be left to
    deeper paths. Raises ``ArgumentError`` for unknown sensors.
    """
    with active_variant(scene.variant):
        from torchtransient.plugins.integrators.pilot import pilot_events

        built = scene.built(options).scene
        sensors = built.sensors()
        if not 0 <= sensor < len(sensors):
            raise ArgumentError(f"sensor: the scene has {len(sensors)}, numbered from 0; got {sensor}. Give an index.")
        film = sensors[sensor].film()
        size = {"seed": seed, "pixels": PILOT_PIXELS, "paths": PILOT_PATHS}
        found = kind.seen(film, Arrivals(pilot_events(built, built.integrator(), sensor, **size)))
        if not found.dark and found.enough_depth(tail) >= DEEP:
            events = pilot_events(built, built.integrator(), sensor, **size, roulette=False)
            found = kind.seen(film, Arrivals(events))
    return film, found


def axis_over(first: float, last: float, bin_width_opl: float | None, num_bins: int | None) -> TimeAxis:
    """A time axis from ``first`` to ``last``, both inside, in metres.

    The bin width is ``bin_width_opl``, or else what divides the window into ``num_bins`` bins (300 when None), rounded
    up to three digits. Bins start at a multiple of the width, except for a single one.
    """
    count = num_bins or DEFAULT_BINS
    if num_bins == 1 and bin_width_opl is None:
        return TimeAxis(first, _round_up(max((last - first) * 1.001, abs(last) * 1e-3, 1e-6)), 1)
    if bin_width_opl is None:
        # Light of a single moment still needs a width: a thousandth of its age, at least a micrometre.
        shortest = max(abs(last) * 1e-3 / count, 1e-6)
        # One bin is lost to the start at a multiple of the width.
        bin_width_opl = _round_up(max((last - first) / (count - 1), shortest))
    start_bin = math.floor(first / bin_width_opl + 1e-9)
    while start_bin * bin_width_opl > first:
        start_bin -= 1
    if num_bins is None:
        num_bins = 1
        while (start_bin + num_bins) * bin_width_opl <= last:
            num_bins = max(num_bins + 1, math.floor(last / bin_width_opl) - start_bin)
    # Without the noise of the last binary digit, which would show in every printout.
    return TimeAxis(float(f"{start_bin * bin_width_opl:.12g}"), float(f"{bin_width_opl:.12g}"), num_bins)


def _round_up(length: float) -> float:
    unit = 10.0 ** (math.floor(math.log10(length)) - 2)
    return math.ceil(length / unit - 1e-9) * unit
