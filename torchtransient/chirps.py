"""Chirps of coherent (FMCW) lidars and radars: what turns optical path lengths and their rates into beats."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from torch import Tensor

from torchtransient.axes import LOWEST_HERTZ, TimeAxis
from torchtransient.checks import Numbers, count, finite, is_one_of, numbers, of_class, positive, shown
from torchtransient.errors import ArgumentError, ShapeError, UnitError
from torchtransient.pulses import Array, Pulse
from torchtransient.units import SPEED_OF_LIGHT

# Coefficients a_k of w(t) = sum of a_k cos(2 pi k t / T) for t in [-T/2, T/2]; Harris 1978, Nuttall 1981.
WINDOWS = {
    "rectangular": (1.0,),
    "hann": (0.5, 0.5),
    "hamming": (0.54, 0.46),
    "blackman": (0.42, 0.5, 0.08),
    "blackmanharris": (0.35875, 0.48829, 0.14128, 0.01168),
    "nuttall": (0.3635819, 0.4891775, 0.1365995, 0.0106411),
}
# A table of a line ends four c / B from its middle, or where a thousandth of the line lies outside.
_NEAREST_LINES = 4
_OUTSIDE = 1e-3
_PER_LINE = 32  # values in c / B
_FARTHEST_LINES = 128
_LONGEST_CHIRP_S = 1.0  # a microsecond in microseconds
_LONGEST_WAVE_M = 1.0  # micrometres as metres; radars at 3 GHz have 0.1 m


@dataclass(frozen=True)
class Chirps:
    """Linear chirps of a coherent lidar, one up and one down: ``bandwidth_hz`` in ``duration_s`` around a wavelength.

    The beat of light that arrives with the local oscillator is `B / (T c) (opl + k rate)` during the up chirp and
    `B / (T c) (opl - k rate)` during the down chirp, in hertz, where `rate` is d opl / dt, positive where the path gets
    longer, and `k = f0 T / B` (:attr:`rate_scale_s`). So a spectrum is a histogram over ``opl +- k rate``, with
    :attr:`line_shape` for each arrival. Beats can be negative: of what comes nearer, during the up chirp. Frozen,
    hashable and picklable.

    Args:
        bandwidth_hz: frequencies that a chirp sweeps over, B, hertz.
        duration_s: length of a chirp, T, seconds.
        wavelength_m: wavelength in vacuum in the middle of the chirp, c / f0, metres.
        window: weights of the beat's samples in the transform: "rectangular", "hann", "hamming", "blackman",
            "blackmanharris" or "nuttall", as scipy.signal.windows has them (``sym=False``).

    Raises:
        UnitError: for numbers that are not positive or of another unit: bandwidths below 1 kHz, chirps of a second,
            wavelengths of a metre.
        ArgumentError: for other windows.

    First order in time: a path changes by less than c / B during a chirp, and its rate does not. Source: Pierrottet et
    al., "Linear FMCW laser radar for precision range and vector velocity measurements", MRS Proc. 1076 (2008).
    """

    bandwidth_hz: float
    duration_s: float
    wavelength_m: float
    window: str = field(default="hann", kw_only=True)

    def __post_init__(self) -> None:
        for name, low, high, unit in (
            ("bandwidth_hz", LOWEST_HERTZ, math.inf, f"hertz, at least {LOWEST_HERTZ:g}"),
            ("duration_s", 0.0, _LONGEST_CHIRP_S, f"seconds, below {_LONGEST_CHIRP_S:g}"),
            ("wavelength_m", 0.0, _LONGEST_WAVE_M, f"metres, below {_LONGEST_WAVE_M:g} (1550 nm are 1550e-9)"),
        ):
            number = positive(f"Chirps: {name}", getattr(self, name))
            if not low <= number < high:
                raise UnitError(f"Chirps: expected {name} in {unit}, got {number!r}.")
            object.__setattr__(self, name, number)
        if not is_one_of(self.window, WINDOWS):
            raise ArgumentError(f"Chirps: expected window to be one of {', '.join(WINDOWS)}, got {shown(self.window)}.")

    @property
    def rate_scale_s(self) -> float:
        """Seconds that rates are turned into lengths with, k = f0 T / B; 1.9 for 1 GHz in 10 us at 1550 nm."""
        return SPEED_OF_LIGHT / self.wavelength_m * self.duration_s / self.bandwidth_hz

    @property
    def resolution_opl(self) -> float:
        """Optical path length of one turn of the beat during a chirp, c / B, metres; a bin of the transform."""
        return SPEED_OF_LIGHT / self.bandwidth_hz

    @property
    def hertz_per_metre(self) -> float:
        """Beat frequency of a metre of optical path, B / (T c), hertz per metre."""
        return self.bandwidth_hz / self.duration_s / SPEED_OF_LIGHT

    def beats_hz(self, axis: TimeAxis) -> Tensor:
        """Return the beat frequencies of the centres of bins, (T,) float64, hertz; negative before zero length.

        Args:
            axis: axis of ``opl +- k rate``, as of :attr:`RenderOutput.beats`.
        """
        return of_class("Chirps.beats_hz: axis", axis, TimeAxis).centers_opl * self.hertz_per_metre

    @property
    def line_shape(self) -> Pulse:
        """Power spectrum of a single arrival over optical path length, |transform of the window|^2, of unit integral.

        A table that ends where less than 1e-3 of the line lies outside: 4 c / B from its middle, 101 of a rectangular
        window.
        """
        lines = np.arange(_FARTHEST_LINES * _PER_LINE + 1) / _PER_LINE
        power = self._amplitude(lines) ** 2
        whole = _norm(WINDOWS[self.window]) ** 2
        inside = 2 * np.cumsum(0.5 * (power[1:] + power[:-1])) / _PER_LINE
        last = max(int(np.argmax(inside >= (1 - _OUTSIDE) * whole)) + 1, _NEAREST_LINES * _PER_LINE)
        at = np.concatenate([-lines[last:0:-1], lines[: last + 1]])
        return Pulse.tabulated(at * self.resolution_opl, np.concatenate([power[last:0:-1], power[: last + 1]]))

    def longer(self, times: float) -> Chirps:
        """Return chirps of the same sweep that last ``times`` as long: the same beats in lines as much narrower.

        Light that is rendered with them on an axis of narrow bins has hardly a line of its own, which is what
        `sensing.CoherentReceiver` draws fields of.

        Args:
            times: factor of bandwidth and duration, at least 1 to narrow the lines.

        Raises:
            UnitError: for numbers that are not positive.
        """
        factor = positive("Chirps.longer: times", times)
        return replace(self, bandwidth_hz=factor * self.bandwidth_hz, duration_s=factor * self.duration_s)

    def line_amplitude(self, opl: Numbers) -> Array:
        """Evaluate the transform of the window; its square has unit integral over lines of c / B.

        Args:
            opl: optical path lengths from the middle of the line, of any shape, metres.

        Returns:
            float64 in the shape of ``opl``; real, since the phase counts from the middle of the chirp.
        """
        cosines = WINDOWS[self.window]
        return self._amplitude(numbers("Chirps.line_amplitude: opl", opl) / self.resolution_opl) / _norm(cosines)

    def _amplitude(self, lines: Array) -> Array:
        """Return the transform of the window at frequencies in turns per chirp."""
        total = np.zeros_like(lines)
        for k, a in enumerate(WINDOWS[self.window]):
            total += 0.5 * a * (np.sinc(lines - k) + np.sinc(lines + k))
        return total

    def time_axis(
        self, range_m: tuple[float, float], speed_m_s: tuple[float, float] = (0.0, 0.0), *, bins_per_line: int = 1
    ) -> TimeAxis:
        """Return an axis that holds the spectra of both chirps, for distances and speeds between limits.

        Args:
            range_m: nearest and farthest distance of what is seen, half the optical path length, metres.
            speed_m_s: lowest and highest speed of approach, half the rate with its sign changed, m/s.
            bins_per_line: bins in c / B. One is what a transform of a chirp gives, without zeros appended.

        Returns:
            Axis over ``opl +- k rate`` with the middle of a bin at zero and a margin of four lines at both ends; its
            start is negative where fast things are near.

        Raises:
            UnitError: for limits that are not finite or not in order.
            ShapeError: unless ``bins_per_line`` is a whole number.
        """
        near, far = _limits("range_m", range_m)
        slow, fast = _limits("speed_m_s", speed_m_s)
        parts = count("Chirps.time_axis: bins_per_line", bins_per_line, 1, ShapeError, 2**10)
        width = self.resolution_opl / parts
        shift = 2 * self.rate_scale_s * max(abs(slow), abs(fast))
        first = math.floor((2 * near - shift) / width) - _NEAREST_LINES * parts
        last = math.ceil((2 * far + shift) / width) + _NEAREST_LINES * parts
        return TimeAxis((first - 0.5) * width, width, last - first + 1)


def _norm(cosines: tuple[float, ...]) -> float:
    """Return the root of the mean of the squared window, which is its integral over all lines by Parseval."""
    return math.sqrt(cosines[0] ** 2 + sum(a * a for a in cosines[1:]) / 2)


def _limits(name: str, given: tuple[float, float]) -> tuple[float, float]:
    try:
        low, high = given
    except (TypeError, ValueError):
        raise ShapeError(f"Chirps.time_axis: expected {name} as two numbers, got {shown(given)}.") from None
    low, high = (finite(f"Chirps.time_axis: {name}", value) for value in (low, high))
    if low > high:
        raise UnitError(f"Chirps.time_axis: expected {name} from low to high, got {shown(given)}.")
    return low, high
