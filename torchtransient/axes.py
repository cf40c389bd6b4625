"""Axes of a measurement: equal half-open bins over optical path length or over its rate, or frequencies."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchtransient import checks
from torchtransient.checks import Numbers, as_whole, finite, numbers, shown
from torchtransient.errors import ShapeError, UnitError
from torchtransient.units import LATEST_S, SHORTEST_OPL, SPEED_OF_LIGHT, near_seconds, opl_to_seconds, seconds_to_opl

# Bounds that tell numbers in other units. The bins of real records are 1 ps to 1 us wide: in nanoseconds, picoseconds
# or femtoseconds that is 1e-3 to 1e9, and in seconds taken for metres at most 1e-6.
WIDEST_BIN_S = 1e-6  # 300 m of path; a picosecond in microseconds is as much
LOWEST_HERTZ = 1e3  # 1 GHz in megahertz
MOST_BINS = 2**62  # beyond that an index of a bin has no 64 bits
MOST_PER_METRE = 5e6  # a wavelength of 200 nm; 5 MHz taken for cycles per metre


@dataclass(frozen=True)
class TimeAxis:
    """Axis of equal bins over optical path length.

    Bin ``k`` is ``[start_opl + k bin_width_opl, start_opl + (k + 1) bin_width_opl)``. Length zero is the moment when
    the light leaves the emitter. Frozen, hashable and picklable; two axes are equal if their three numbers are. Tensors
    are float64 on the CPU: at 1 km, float32 resolves 6e-5 m only.

    Args:
        start_opl: start of the first bin, metres.
        bin_width_opl: width of a bin, metres.
        num_bins: number of bins, T.

    Raises:
        UnitError: for lengths that are not finite, and widths that are not positive, below 1e-7 m (a time in seconds)
            or too narrow for float64 at that distance.
        ShapeError: unless ``num_bins`` is a positive whole number.
    """

    start_opl: float
    bin_width_opl: float
    num_bins: int

    def __post_init__(self) -> None:
        start, width, bins = _equal_bins("TimeAxis", ("start_opl", "bin_width_opl"), "m", self)
        if width < SHORTEST_OPL:
            raise UnitError(
                f"TimeAxis: expected bin_width_opl in metres of optical path, at least {SHORTEST_OPL:g} (0.3 fs; "
                f"light itself swings more slowly), got {width!r}. Seconds? TimeAxis.from_seconds takes them."
            )
        # numpy scalars and tensors become plain numbers, so that axes hash and pickle alike wherever they come from
        object.__setattr__(self, "start_opl", start)
        object.__setattr__(self, "bin_width_opl", width)
        object.__setattr__(self, "num_bins", bins)

    @classmethod
    def from_seconds(cls, start_s: float, bin_width_s: float, num_bins: int) -> TimeAxis:
        """Return an axis from times in seconds.

        Args:
            start_s: start of the first bin, seconds, less than 10 ms from zero.
            bin_width_s: width of a bin, seconds, below 1 us.
            num_bins: number of bins.

        Raises:
            UnitError: as the class, and for longer times, which are most likely picoseconds, nanoseconds or metres;
                make such axes in metres.
            ShapeError: as the class.
        """
        start, width = finite("TimeAxis: start_s", start_s), finite("TimeAxis: bin_width_s", bin_width_s)
        near_seconds(width, "bin_width_s", "TimeAxis.from_seconds", limit_s=WIDEST_BIN_S)
        near_seconds(start, "start_s", "TimeAxis.from_seconds", limit_s=LATEST_S)
        return cls(seconds_to_opl(start), seconds_to_opl(width), num_bins)

    @property
    def end_opl(self) -> float:
        """End of the last bin, metres; the first length outside."""
        return self.start_opl + self.num_bins * self.bin_width_opl

    @property
    def start_s(self) -> float:
        """Start of the first bin, seconds."""
        return opl_to_seconds(self.start_opl)

    @property
    def bin_width_s(self) -> float:
        """Width of a bin, seconds."""
        return opl_to_seconds(self.bin_width_opl)

    @property
    def edges_opl(self) -> Tensor:
        """Edges of the bins, (T + 1,) float64, metres."""
        # Not a running sum, which would carry its rounding along the axis.
        return self.start_opl + torch.arange(self.num_bins + 1, dtype=torch.float64, device="cpu") * self.bin_width_opl

    @property
    def centers_opl(self) -> Tensor:
        """Centres of the bins, (T,) float64, metres."""
        middles = torch.arange(self.num_bins, dtype=torch.float64, device="cpu") + 0.5
        return self.start_opl + middles * self.bin_width_opl

    @property
    def edges_s(self) -> Tensor:
        """Edges of the bins, (T + 1,) float64, seconds."""
        return opl_to_seconds(self.edges_opl)

    @property
    def centers_s(self) -> Tensor:
        """Centres of the bins, (T,) float64, seconds."""
        return opl_to_seconds(self.centers_opl)

    def bin_index(self, opl: float | Tensor) -> Tensor:
        """Find the bins of optical path lengths.

        Args:
            opl: optical path lengths, metres, a number or a tensor of any shape on any device; compared in float64 with
                ``edges_opl``. An edge belongs to the bin that starts there.

        Returns:
            Index of the bin, int64, in the shape of ``opl``; -1 before the axis, ``num_bins`` after it.

        Raises:
            UnitError: for NaN.
        """
        if not isinstance(opl, Tensor) or opl.is_complex() or opl.dtype == torch.bool:
            opl = torch.from_numpy(numbers("TimeAxis.bin_index: opl", opl))
        lengths = opl.detach().to(torch.float64)
        if bool(torch.isnan(lengths).any()):
            raise UnitError("TimeAxis.bin_index: expected lengths in metres, got NaN.")
        edges = self.edges_opl.to(lengths.device)
        return torch.bucketize(lengths, edges, right=True) - 1


@dataclass(frozen=True)
class FrequencyAxis:
    """Frequencies of a phasor image in cycles per metre of optical path: one over the wavelength.

    A phasor is the sum of ``radiance * exp(-2 pi i frequency (opl - start_opl))`` over all arrivals; with ``start_opl``
    zero its phase counts from the moment when the light leaves the emitter. Frozen, hashable and picklable.

    Args:
        frequencies: frequencies in cycles per metre, one number or several, zero and negative ones too.
        start_opl: length of phase zero, metres.

    Raises:
        UnitError: for numbers that are not finite or beyond 5e6 (hertz).
        ShapeError: for no frequency at all.
    """

    frequencies: tuple[float, ...]
    start_opl: float = 0.0

    if TYPE_CHECKING:  # the constructor accepts more types than the field keeps

        def __init__(self, frequencies: float | Iterable[float] | Numbers, start_opl: float = 0.0) -> None: ...

    def __post_init__(self) -> None:
        numbers = _row(self.frequencies, "FrequencyAxis")
        if not numbers:
            raise ShapeError("FrequencyAxis: expected at least one frequency, got none.")
        highest = max(numbers, key=abs)
        if abs(highest) > MOST_PER_METRE:
            raise UnitError(
                f"FrequencyAxis: expected cycles per metre of optical path, up to {MOST_PER_METRE:g} (200 nm each), "
                f"got {highest!r}. Hertz? FrequencyAxis.from_hertz takes them."
            )
        object.__setattr__(self, "frequencies", numbers)
        object.__setattr__(self, "start_opl", finite("FrequencyAxis: start_opl", self.start_opl))

    @classmethod
    def uniform(cls, first: float, step: float, count: int, *, start_opl: float = 0.0) -> FrequencyAxis:
        """Return an axis of equal steps, which renders faster than arbitrary frequencies.

        Args:
            first, step: first frequency and distance to the next, cycles per metre.
            count: number of frequencies ``first + k step``.
            start_opl: length of phase zero, metres.

        Raises:
            UnitError, ShapeError: as the class.
        """
        low, width = finite("FrequencyAxis.uniform: first", first), finite("FrequencyAxis.uniform: step", step)
        number = checks.count("FrequencyAxis.uniform: count", count, 1, ShapeError, checks.MOST_MADE)
        return cls(tuple(low + k * width for k in range(number)), start_opl)

    @classmethod
    def from_hertz(cls, frequencies_hz: float | Iterable[float] | Numbers, start_opl: float = 0.0) -> FrequencyAxis:
        """Return an axis from modulation frequencies.

        Args:
            frequencies_hz: frequencies in hertz, one number or several.
            start_opl: length of phase zero, metres.

        Raises:
            UnitError: below 1 kHz but for zero, which are most likely megahertz; give cycles of 300 km and more per
                metre.
        """
        given = _row(frequencies_hz, "FrequencyAxis.from_hertz")
        for f in given:
            if 0 < abs(f) < LOWEST_HERTZ:
                raise UnitError(
                    f"FrequencyAxis.from_hertz: expected frequencies in hertz, zero or at least {LOWEST_HERTZ:g}, got "
                    f"{f!r}. Megahertz? 80 MHz are 80e6. Cycles per metre go to FrequencyAxis(frequencies)."
                )
        return cls(tuple(f / SPEED_OF_LIGHT for f in given), start_opl)

    @property
    def num_frequencies(self) -> int:
        """Number of frequencies, F."""
        return len(self.frequencies)

    @property
    def per_metre(self) -> Tensor:
        """Cycles per metre of optical path, (F,) float64."""
        return torch.tensor(self.frequencies, dtype=torch.float64, device="cpu")

    @property
    def hertz(self) -> Tensor:
        """Frequencies in hertz, (F,) float64."""
        return self.per_metre * SPEED_OF_LIGHT

    @property
    def wavelengths_opl(self) -> Tensor:
        """Metres of optical path per cycle, (F,) float64; infinite at zero frequency."""
        return 1 / self.per_metre.abs()

    def __repr__(self) -> str:
        low, high = min(self.frequencies), max(self.frequencies)
        start = f", start_opl={self.start_opl:g}" if self.start_opl else ""
        return f"FrequencyAxis({self.num_frequencies} from {low:g} to {high:g} per metre{start})"


@dataclass(frozen=True)
class RateAxis:
    """Axis of equal bins over the rate of optical path lengths, d opl / dt in metres per second.

    Bin ``k`` is ``[start + k bin_width, start + (k + 1) bin_width)``. The rate is positive where paths get longer;
    light of such a path is shifted by ``- rate / wavelength``. A target that comes nearer at v, seen from beside the
    light, has the rate -2 v. Frozen, hashable and picklable.

    Args:
        start: start of the first bin, m/s.
        bin_width: width of a bin, m/s.
        num_bins: number of bins, R.

    Raises:
        UnitError: for rates that are not finite, and widths that are not positive or too narrow for float64.
        ShapeError: unless ``num_bins`` is a positive whole number.
    """

    start: float
    bin_width: float
    num_bins: int

    def __post_init__(self) -> None:
        start, width, bins = _equal_bins("RateAxis", ("start", "bin_width"), "m/s", self)
        object.__setattr__(self, "start", start)
        object.__setattr__(self, "bin_width", width)
        object.__setattr__(self, "num_bins", bins)

    @property
    def end(self) -> float:
        """End of the last bin, m/s; the first rate outside."""
        return self.start + self.num_bins * self.bin_width

    @property
    def edges(self) -> Tensor:
        """Edges of the bins, (R + 1,) float64, m/s."""
        return self.start + torch.arange(self.num_bins + 1, dtype=torch.float64, device="cpu") * self.bin_width

    @property
    def centers(self) -> Tensor:
        """Centres of the bins, (R,) float64, m/s."""
        middles = torch.arange(self.num_bins, dtype=torch.float64, device="cpu") + 0.5
        return self.start + middles * self.bin_width


def _equal_bins(owner: str, names: tuple[str, str], unit: str, axis: Any) -> tuple[float, float, int]:
    """Return start, width and number of an axis' bins as plain numbers. Raises UnitError, ShapeError."""
    start, width = (finite(f"{owner}: {name}", getattr(axis, name)) for name in names)
    if width <= 0:
        raise UnitError(f"{owner}: expected {names[1]} > 0 {'metres' if unit == 'm' else unit}, got {width!r}.")
    bins = as_whole(axis.num_bins)
    if bins is None:
        raise ShapeError(f"{owner}: expected num_bins to be a whole number, got {shown(axis.num_bins)}.")
    if not 1 <= bins <= MOST_BINS:
        raise ShapeError(f"{owner}: expected num_bins >= 1 and at most 2^62, got {shown(bins)}.")
    end = start + bins * width
    if not math.isfinite(end) or width < 4 * max(math.ulp(start), math.ulp(end)):
        raise UnitError(
            f"{owner}: bins of {width!r} {unit} between {start!r} {unit} and {end!r} {unit} cannot be told apart in "
            "float64. Use wider bins or an earlier start."
        )
    return start, width, bins


def _row(given: Any, owner: str) -> tuple[float, ...]:
    """Return the numbers of one frequency or of several, from any iterable."""
    plain = given.tolist() if isinstance(given, Tensor) else given
    alone = isinstance(plain, (str, bytes)) or not isinstance(plain, Iterable) or getattr(plain, "ndim", None) == 0
    values = (plain,) if alone else tuple(plain)
    return tuple(finite(f"{owner}: a frequency", value) for value in values)


def fast_length(least: int, multiple: int = 1) -> int:
    """Return a length that transforms are fast at: ``multiple`` times 2^a 3^b 5^c, at least ``least``.

    Args:
        least: smallest length.
        multiple: divisor of the length; even for real transforms, which halve it.
    """
    units = -(-least // multiple)
    while True:
        rest = units
        for prime in (2, 3, 5):
            while rest % prime == 0:
                rest //= prime
        if rest == 1:
            return units * multiple
        units += 1
