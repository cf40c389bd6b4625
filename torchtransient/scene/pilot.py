"""Pilot runs: depth of paths and time window that hold a scene's light.

A run lists arrivals one by one (:class:`torchtransient.plugins.integrators.pilot.PilotEvents`). Depth and window are
read off the list for the image as a whole and for its blocks, since light that matters to a corner of the picture may
not matter to its mean.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from torchtransient.axes import RateAxis, TimeAxis
from torchtransient.errors import ArgumentError, GradientError
from torchtransient.gates import Gate
from torchtransient.scene.edits import NO_LIMIT, BuildOptions, built_depth
from torchtransient.scene.load import Scene, load
from torchtransient.scene.physics import MISSED, PhysicsWatch
from torchtransient.scene.variant import active_variant

PILOT_PATHS = 32768
PILOT_PIXELS = 2048
# From this depth on a run is made again without Russian roulette. That lets at most 0.95 of the paths go on at a
# bounce, so that the light of brighter surfaces is left to few paths of great weight: none beyond depth 200 or so.
DEEP = 48
# The image is divided into so many blocks along each side; a block may lose so many times the image's share.
BLOCKS = 8
BLOCK_ALLOWANCE = 10.0
# Bins of an axis without a given bin width, and the most that an axis gets without being asked.
DEFAULT_BINS = 300
MOST_BINS = 4096
# Bins of an axis of rates.
RATE_BINS = 64


@dataclass(frozen=True)
class PilotReport:
    """Results of a pilot run.

    Attributes:
        variant: variant of the run.
        paths, events: number of traced paths, and of arrivals that the film sees.
        seconds: wall time with building and compiling.
        relative_error: standard error of the image's mean over that mean.
        tail, tail_error: share of the light in paths deeper than the chosen depth, and its standard error.
        first_opl, last_opl: earliest and latest arrival, metres.
        missed, missed_error: share of the light outside of the chosen window, and its error; None without a window.
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
    """Arrivals of a pilot run: energies and times, and the shares of the light in parts of them.

    Attributes:
        opl, energy, depth, path, rate: optical path length (metres), energy, depth, number and rate (m/s) of the path,
            all (N,).
        paths: number of traced paths.
        total: energy of all arrivals.
    """

    def __init__(self, events: Any):
        self.opl, self.energy, self.depth, self.path = events.opl, events.energy, events.depth, events.path
        self.rate, self.paths = events.rate, events.paths
        self.total = float(self.energy.sum())
        width, height = events.size
        across, down = min(BLOCKS, width), min(BLOCKS, height)
        x, y = events.pixel % width, events.pixel // width
        self.block = (y * down // height) * across + x * across // width
        self.blocks = across * down
        self.block_total = np.bincount(self.block, self.energy, self.blocks)

    def through(self, gates: Sequence[Gate]) -> Arrivals:
        """Return the arrivals as some gates see them: energy times the sum of their sensitivities.

        Args:
            gates: the gates.
        """
        seen = copy.copy(self)
        seen.energy = self.energy * sum(gate.value(self.opl) for gate in gates)
        seen.total = float(seen.energy.sum())
        seen.block_total = np.bincount(self.block, seen.energy, self.blocks)
        return seen

    def shifted(self, seconds: Sequence[float]) -> Arrivals:
        """Return the arrivals as spectra of beats have them: each one later by its rate times each of some times.

        The spectra share the energy.

        Args:
            seconds: delay per rate of each spectrum: metres of path over m/s.
        """
        seen, count = copy.copy(self), len(seconds)
        seen.opl = np.concatenate([self.opl + s * self.rate for s in seconds])
        seen.energy = np.tile(self.energy / count, count)
        for name in ("depth", "path", "rate", "block"):
            setattr(seen, name, np.tile(getattr(self, name), count))
        return seen

    @property
    def dark(self) -> bool:
        """There is no light."""
        return not self.total > 0

    @property
    def count(self) -> int:
        """Number of arrivals with energy."""
        return int(np.count_nonzero(self.energy))

    def share(self, chosen: np.ndarray) -> tuple[float, float]:
        """Return the share of the energy in the chosen arrivals, a mask (N,), and its standard error over paths.

        Args:
            chosen: mask (N,) of arrivals.
        """
        return self._share(chosen, slice(None), self.paths, self.total)

    def _share(self, chosen: np.ndarray, part: Any, paths: int, total: float) -> tuple[float, float]:
        sums = np.bincount(self.path[part][chosen[part]], self.energy[part][chosen[part]])
        mean = float(sums.sum())
        spread = float((sums**2).sum()) - mean * mean / paths
        return mean / total, math.sqrt(max(spread, 0.0)) / total

    def relative_error(self) -> float:
        """Return the standard error of the mean energy over the mean."""
        return self.share(np.ones(len(self.energy), dtype=bool))[1]

    def unseen(self) -> float:
        """Return the share of the light that may lie where there are no arrivals, in 19 of 20 runs at most."""
        # Of n paths of equal energy none falls into a share of 3 / n with probability exp(-3).
        return min(3 * self.relative_error() ** 2, 1.0)

    def negligible(self, chosen: np.ndarray, share: float) -> bool:
        """Return whether the chosen arrivals hold at most a share of the light, with two standard errors to spare.

        No block of the image may lose more than ten times that share, beyond two standard errors.

        Args:
            chosen: mask (N,) of arrivals.
            share: largest share of the light.
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
        """Return the smallest depth beyond which light is negligible, or else the largest depth of all arrivals.

        Args:
            tail: largest share of the light beyond the depth.
        """
        low, high = 1, int(self.depth.max())
        while low < high:
            middle = (low + high) // 2
            if self.negligible(self.depth > middle, tail):
                high = middle
            else:
                low = middle + 1
        return low

    def enough_depth_of_all_times(self, tail: float) -> int:
        """Return the smallest depth that leaves out at most ten times ``tail`` of the light in each eighth of the time.

        The time ends where ``tail`` of all light is yet to come. The share of an eighth is that of its own arrivals,
        without an allowance for their noise: late eighths have few, and the last may lose several times more.

        Args:
            tail: share of all light that may arrive after the last eighth; an eighth may lose ten times that share of
                its own light.
        """
        first, last = self.window(-1, tail)
        depth = 1
        for part in range(BLOCKS):
            begin, end = (first + (last - first) * k / BLOCKS for k in (part, part + 1))
            inside = (self.opl >= begin) & (self.opl <= end)
            order = np.argsort(self.depth[inside])
            behind = self.energy[inside].sum() - np.cumsum(self.energy[inside][order])
            enough = self.depth[inside][order][behind <= BLOCK_ALLOWANCE * tail * self.energy[inside].sum()]
            depth = max(depth, int(enough[0])) if len(enough) else depth
        return depth

    def beyond(self, deepest: int) -> tuple[float, float]:
        """Return the share of the light in paths deeper than the run's ``deepest``, and its standard error.

        Light that has fallen to a share by the middle falls by that once more.

        Args:
            deepest: largest depth that the run has followed.
        """
        part, error = self.share(self.depth > deepest // 2)
        return part * part, 2 * part * error

    # ----------------------------------------------------------------------------------------------------- window

    def window(self, depth: int, missed: float) -> tuple[float, float]:
        """Return the time window of the light.

        Args:
            depth: paths of more vertices are left out; none are for -1.
            missed: largest share of the light after the window, see :meth:`negligible`.

        Returns:
            Earliest arrival, and the arrival after which light is negligible, metres.
        """
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


def rate_axis_over(low: float, high: float) -> RateAxis:
    """Return 64 bins that hold rest and all rates (m/s) from ``low`` to ``high``; a rate of zero is in a bin's middle.

    Of rest alone one bin, 1 m/s wide.

    Args:
        low, high: smallest and largest rate, m/s.
    """
    low, high = min(low, 0.0), max(high, 0.0)
    if low == high:
        return RateAxis(-0.5, 1.0, 1)
    width = _round_up((high - low) / (RATE_BINS - 4))
    first, last = math.floor(low / width + 0.5), math.floor(high / width + 0.5)
    first -= (RATE_BINS - 1 - last + first) // 2
    return RateAxis(float(f"{(first - 0.5) * width:.12g}"), float(f"{width:.12g}"), RATE_BINS)


def pilot_run(
    scene: Scene,
    options: BuildOptions,
    sensor: int,
    weigh: Callable[[Any, Arrivals], Arrivals],
    tail: float,
    seed: int = 0,
) -> tuple[Any, Arrivals]:
    """Trace a few thousand paths of a scene and list their arrivals.

    Args:
        scene: a scene in an unpolarized variant: polarization takes most of the time and changes neither depth nor
            arrival.
        options: options of the build.
        sensor: index of the sensor.
        weigh: function of (film, arrivals) that returns the arrivals as the film sees them.
        tail: share of light that will be left to deeper paths.
        seed: seed of the run.

    Returns:
        The film of the sensor, and the arrivals.

    Raises:
        ArgumentError: for an unknown sensor.
    """
    with active_variant(scene.variant):
        from torchtransient.plugins.integrators.pilot import pilot_events

        built = scene.built(options).scene
        sensors = built.sensors()
        if not 0 <= sensor < len(sensors):
            raise ArgumentError(f"sensor: the scene has {len(sensors)}, numbered from 0; got {sensor}. Give an index.")
        film = sensors[sensor].film()
        size = {"seed": seed, "pixels": PILOT_PIXELS, "paths": PILOT_PATHS}
        found = weigh(film, Arrivals(pilot_events(built, built.integrator(), sensor, **size)))
        if not found.dark and found.enough_depth(tail) >= DEEP:
            events = pilot_events(built, built.integrator(), sensor, **size, roulette=False)
            found = weigh(film, Arrivals(events))
    return film, found


def axis_over(first: float, last: float, bin_width_opl: float | None, num_bins: int | None) -> TimeAxis:
    """Return a time axis that holds two arrivals. It starts at a multiple of the bin width, unless it has one bin.

    Args:
        first, last: earliest and latest arrival, metres.
        bin_width_opl: width of a bin in metres, None for the window over the number of bins, rounded up to
            three digits.
        num_bins: number of bins, None for as many as the width needs, or 300 without a width.
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


# ------------------------------------------------------------------------------------------ depth for derivatives

# Largest share of the light that a bound leaves to deeper paths, as that of `tt.plan`.
TAIL = 1e-3


@dataclass(frozen=True)
class DepthBound:
    """Bound on the depth of paths for derivatives of a scene that states none.

    Attributes:
        depth: the bound.
        beyond, error: share of a pilot run's light in deeper paths, the larger one of all light and of that in the time
            window, and its standard error.
    """

    depth: int
    beyond: float
    error: float


def depth_bound(
    scene: Scene, options: BuildOptions, sensors: Sequence[int], film: Any, watch: PhysicsWatch
) -> DepthBound | None:
    """Return the bound on the depth for derivatives of a scene, found at the first call; None for a stated depth.

    A derivative keeps a record of every bounce and needs to know how many there are at most. The bound holds for a call
    whose values can have derivatives, for its value too. Other renders have none: Russian roulette ends their paths.

    Args:
        scene: the scene.
        options: options of its build.
        sensors: indices of the sensors that are rendered.
        film: layout of their films (:class:`~torchtransient.rendering.films.FilmLayout`).
        watch: warns of the bound.

    Raises:
        GradientError: for a scene without light, and for a loaded polarized one.
        PhysicsError: with ``physics="error"``, for more light beyond the bound than a time window may miss.
    """
    key = options, tuple(sensors)
    if key not in scene.depth_bounds:
        scene.depth_bounds[key] = _found_bound(scene, options, sensors, film)
    bound: DepthBound | None = scene.depth_bounds[key]
    if bound is not None and watch.enabled:
        watch.warn(
            f"max_depth {bound.depth}",
            "derivatives need a bound on the depth of paths, and the scene states none: value and derivative have "
            f"max_depth {bound.depth}, which leaves {bound.beyond:.2g} +- {bound.error:.1g} of the light to deeper "
            "paths of the described values. An optimiser that reaches brighter ones keeps the bound, with more light "
            "beyond it: give max_depth= for these then. Renders without derivatives have none.",
            is_error=bound.beyond > MISSED,
        )
    return bound


def _found_bound(scene: Scene, options: BuildOptions, sensors: Sequence[int], film: Any) -> DepthBound | None:
    with active_variant(scene.variant):
        if built_depth(scene.built(options).scene.integrator()) != NO_LIMIT:
            return None
    unpolarized = scene.variant.removesuffix("_polarized")
    if scene.is_shared and unpolarized != scene.variant:
        raise GradientError(
            "gradients need a bound on the depth of paths, and the integrator, which was taken as it is, has none. "
            f"Expected a max_depth: no pilot run finds one in {scene.variant}."
        )
    lit = []
    for sensor in sensors:
        _, arrivals = pilot_run(load(scene, variant=unpolarized), options, sensor, film.seen, TAIL)
        lit += [part for part in film.parts(arrivals) if not part.dark]
    if not lit:
        raise GradientError(
            "gradients need a bound on the depth of paths; the scene states none, and a pilot run saw no light. Set "
            "max_depth, of the renderer or of the scene's integrator."
        )
    with active_variant(unpolarized):
        from torchtransient.plugins.integrators.pilot import PILOT_DEPTH
    beyond, error = max(arrivals.beyond(PILOT_DEPTH) for arrivals in lit)
    if beyond > TAIL / 10:
        return DepthBound(PILOT_DEPTH, beyond, error)
    depth = max(arrivals.enough_depth(TAIL) for arrivals in lit)
    return DepthBound(depth, *max(arrivals.share(arrivals.depth > depth) for arrivals in lit))
