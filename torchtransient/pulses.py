"""Shapes over time: pulses of light sources, impulse responses of sensors.

Optical path length in metres; seconds are converted on entry. Neither Mitsuba nor torch is imported: the films of
``plugins/`` and the torch functions of ``sensing/`` build their kernels from the same shapes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchtransient.checks import Numbers, finite, is_one_of, numbers, of_class, positive, several, shown
from torchtransient.errors import ArgumentError, ShapeError, UnitError
from torchtransient.units import LONGEST_PULSE_S, SHORTEST_OPL, near_seconds, seconds_to_opl

Array = NDArray[np.float64]

KINDS = ("gaussian", "rectangular", "tabulated")
# A Gaussian is cut at this many standard deviations and rescaled: 6e-5 of its mass lies beyond.
CUT_STDDEVS = 4.0
FWHM_PER_STDDEV = 2 * math.sqrt(2 * math.log(2))

_erf = np.frompyfunc(math.erf, 1, 1)


@dataclass(frozen=True)
class Pulse:
    """Probability density over optical path length by which light of one moment is spread.

    Make one with :meth:`gaussian`, :meth:`rectangular` or :meth:`tabulated`. Its integral is one; the power of a laser
    is that of the emitter. Frozen, hashable, picklable.

    Args:
        kind: "gaussian", "rectangular" or "tabulated".
        width_opl: full width, at half maximum for a Gaussian, metres.
        center_opl: shift of the shape, metres; zero is the moment that path lengths are counted from.
        opl: lengths of a table, rising, metres.
        values: densities at these lengths, of any scale.

    Raises:
        ArgumentError: for other kinds.
        UnitError: for widths that are not positive, and densities that are negative, not finite or zero everywhere.
        ShapeError: for tables of different lengths.
    """

    kind: str
    width_opl: float = 0.0
    center_opl: float = 0.0
    _: KW_ONLY
    opl: tuple[float, ...] = ()
    values: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if not is_one_of(self.kind, KINDS):
            raise ArgumentError(f"Pulse: expected one of {', '.join(KINDS)}, got {shown(self.kind)}.")
        object.__setattr__(self, "center_opl", finite("Pulse: center_opl", self.center_opl))
        if self.kind == "tabulated":
            self._check_table()
            return
        width = finite("Pulse: width", self.width_opl)
        if width <= 0:
            raise UnitError(f"Pulse: expected a width above 0 metres, got {width!r}.")
        _check_metres(width)
        object.__setattr__(self, "width_opl", width)

    def _check_table(self) -> None:
        opl = numbers("Pulse.tabulated: opl", self.opl).ravel()
        values = numbers("Pulse.tabulated: values", self.values).ravel()
        if opl.size != values.size or opl.size < 2:
            raise ShapeError(
                f"Pulse.tabulated: expected two or more lengths and as many values, got {opl.size} and {values.size}."
            )
        if not (np.all(np.isfinite(opl)) and np.all(np.diff(opl) > 0)):
            raise UnitError("Pulse.tabulated: expected finite lengths in rising order.")
        if not np.all(np.isfinite(values)) or values.min() < 0 or values.max() == 0:
            raise UnitError(
                "Pulse.tabulated: expected finite values, none negative and not all zero (subtract the background of "
                f"a measured pulse first), got values between {values.min():g} and {values.max():g}."
            )
        _check_metres(float(opl[-1] - opl[0]))
        object.__setattr__(self, "opl", tuple(opl.tolist()))
        object.__setattr__(self, "values", tuple(values.tolist()))

    # ------------------------------------------------------------------------------------------- constructors

    @classmethod
    def gaussian(cls, fwhm_opl: float, center_opl: float = 0.0) -> Pulse:
        """Return a Gaussian of full width at half maximum ``fwhm_opl`` (metres), cut at four standard deviations.

        Args:
            fwhm_opl: full width at half maximum, metres.
            center_opl: centre, metres.

        Raises:
            UnitError: for widths that are not positive.
        """
        return cls("gaussian", fwhm_opl, center_opl)

    @classmethod
    def rectangular(cls, width_opl: float, center_opl: float = 0.0) -> Pulse:
        """Return a pulse that is constant over ``width_opl`` (metres).

        Args:
            width_opl: width, metres.
            center_opl: centre, metres.

        Raises:
            UnitError: for widths that are not positive.
        """
        return cls("rectangular", width_opl, center_opl)

    @classmethod
    def tabulated(cls, opl: Numbers, values: Numbers, center_opl: float = 0.0) -> Pulse:
        """Return a measured shape, linear between its values and zero outside.

        Args:
            opl: lengths, (N,), rising, metres.
            values: densities there, (N,), of any scale.
            center_opl: shift of the shape, metres.

        Raises:
            UnitError, ShapeError: as the class.
        """
        lengths = numbers("Pulse.tabulated: opl", opl).ravel()
        heights = numbers("Pulse.tabulated: values", values).ravel()
        return cls("tabulated", 0.0, center_opl, opl=tuple(lengths.tolist()), values=tuple(heights.tolist()))

    @classmethod
    def gaussian_s(cls, fwhm_s: float, center_s: float = 0.0) -> Pulse:
        """Return :meth:`gaussian` from seconds. Raises UnitError for widths of 1 ms and more.

        Args:
            fwhm_s: full width at half maximum, seconds.
            center_s: centre, seconds.
        """
        width = near_seconds(fwhm_s, "fwhm_s", "Pulse.gaussian_s", limit_s=LONGEST_PULSE_S)
        center = near_seconds(center_s, "center_s", "Pulse.gaussian_s")
        return cls.gaussian(seconds_to_opl(width), seconds_to_opl(center))

    @classmethod
    def rectangular_s(cls, width_s: float, center_s: float = 0.0) -> Pulse:
        """Return :meth:`rectangular` from seconds. Raises UnitError for widths of 1 ms and more.

        Args:
            width_s: width, seconds.
            center_s: centre, seconds.
        """
        width = near_seconds(width_s, "width_s", "Pulse.rectangular_s", limit_s=LONGEST_PULSE_S)
        center = near_seconds(center_s, "center_s", "Pulse.rectangular_s")
        return cls.rectangular(seconds_to_opl(width), seconds_to_opl(center))

    @classmethod
    def tabulated_s(cls, times_s: Numbers, values: Numbers, center_s: float = 0.0) -> Pulse:
        """Return :meth:`tabulated` from times in seconds. Raises UnitError for times of 10 ms and more.

        Args:
            times_s: times, (N,), rising, seconds.
            values: densities there, (N,), of any scale.
            center_s: shift of the shape, seconds.
        """
        times = numbers("Pulse.tabulated_s: times_s", times_s).ravel()
        for time in times.tolist():
            near_seconds(time, "times_s", "Pulse.tabulated_s")
        center = near_seconds(center_s, "center_s", "Pulse.tabulated_s")
        return cls.tabulated(seconds_to_opl(times), values, seconds_to_opl(center))

    def shifted(self, opl: float) -> Pulse:
        """Return the same shape, ``opl`` metres later.

        Args:
            opl: delay, metres of optical path; negative for earlier.
        """
        return replace(self, center_opl=self.center_opl + finite("Pulse.shifted: opl", opl))

    # ------------------------------------------------------------------------------------------------ the density

    @property
    def support_opl(self) -> tuple[float, float]:
        """First and last length where the density is not zero, metres."""
        if self.kind == "tabulated":
            return self.opl[0] + self.center_opl, self.opl[-1] + self.center_opl
        half = self.width_opl / 2
        if self.kind == "gaussian":
            half = CUT_STDDEVS * self.width_opl / FWHM_PER_STDDEV
        return self.center_opl - half, self.center_opl + half

    def cumulative(self, opl: Any) -> Array:
        """Evaluate the cumulative distribution.

        Args:
            opl: lengths of any shape, metres.

        Returns:
            Share of the pulse up to each length, float64: 0 before the support, 1 after it.
        """
        x = numbers("Pulse.cumulative: opl", opl) - self.center_opl
        if self.kind == "rectangular":
            return np.asarray(np.clip(x / self.width_opl + 0.5, 0, 1), dtype=np.float64)
        if self.kind == "gaussian":
            limit = CUT_STDDEVS / math.sqrt(2)
            u = np.clip(x * (FWHM_PER_STDDEV / (self.width_opl * math.sqrt(2))), -limit, limit)
            return np.asarray(0.5 + 0.5 * np.asarray(_erf(u), dtype=np.float64) / math.erf(limit), dtype=np.float64)
        nodes, density = np.array(self.opl), np.array(self.values)
        steps = np.diff(nodes)
        sums = np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]) * steps)])
        x = np.clip(x, nodes[0], nodes[-1])
        i = np.clip(np.searchsorted(nodes, x, side="right") - 1, 0, nodes.size - 2)
        t = x - nodes[i]
        slope = np.diff(density)[i] / steps[i]
        return np.asarray((sums[i] + t * (density[i] + 0.5 * slope * t)) / sums[-1], dtype=np.float64)


def transform(pulse: Pulse, frequencies: Any) -> NDArray[np.complex128]:
    """Evaluate the Fourier transform of a pulse, the factor by which it changes a phasor.

    A phasor film spreads no arrivals: ``out.phasor`` times this, one factor per frequency, is its measurement of light
    with the pulse.

    Args:
        pulse: the pulse.
        frequencies: frequencies, (F,), cycles per metre.

    Returns:
        (F,) complex128; one at frequency zero.

    Raises:
        ArgumentError: unless ``pulse`` is a pulse.
        UnitError: for frequencies that are not finite.
    """
    low, high = of_class("transform: pulse", pulse, Pulse).support_opl
    wanted = numbers("transform: frequencies", frequencies).ravel()
    if not np.isfinite(wanted).all():
        raise UnitError("transform: expected finite frequencies in cycles per metre, got NaN or infinity.")
    # Sixteen steps for every cycle of the highest frequency, and a factor for the width of a step.
    count = max(4096, math.ceil(16 * (high - low) * float(np.abs(wanted).max(initial=0.0))))
    edges = np.linspace(low, high, count + 1)
    shares = np.diff(pulse.cumulative(edges))
    middle = 0.5 * (edges[1:] + edges[:-1])
    waves = np.array([np.exp(-2j * np.pi * nu * middle) @ shares for nu in wanted])
    return np.asarray(waves * np.sinc(wanted * (high - low) / count), dtype=np.complex128)


def cumulative_of_sum(pulses: Sequence[Pulse], step: float) -> tuple[int, Array]:
    """Evaluate the cumulative distribution of a sum of independent delays: of the convolution of pulses.

    Args:
        pulses: the pulses.
        step: distance of the lengths, metres.

    Returns:
        (first, values): ``values[j]`` belongs to the length ``(first + j) step``; the first one is 0, the last one 1.
        Exact for one pulse, of second order in ``step`` for several.

    Raises:
        UnitError: without a pulse, and for steps that are not positive.
    """
    pulses = several("cumulative_of_sum", pulses, "pulses", Pulse)
    if not pulses:
        raise UnitError("cumulative_of_sum: expected at least one pulse, got none.")
    first, masses, step = 0, np.ones(1), positive("cumulative_of_sum: step", step)
    for pulse in pulses:
        low, high = pulse.support_opl
        a, b = math.floor(low / step), math.ceil(high / step)
        share = np.diff(pulse.cumulative(np.arange(a, max(b, a + 1) + 1) * step))
        masses = share if masses.size == 1 else _convolve(masses, share)
        first += a
    values = np.concatenate([[0.0], np.cumsum(masses)])
    # The mass of a cell stands at its centre: n pulses leave it at (n / 2) cells after the sum of their first nodes.
    extra = len(pulses) - 1
    first += extra // 2
    if extra % 2:
        values = np.concatenate([[0.0], 0.5 * (values[1:] + values[:-1]), [1.0]])
    return first, np.asarray(values / values[-1], dtype=np.float64)


def _convolve(a: Array, b: Array) -> Array:
    size = a.size + b.size - 1
    if min(a.size, b.size) <= 64:
        return np.convolve(a, b)
    product = np.fft.irfft(np.fft.rfft(a, size) * np.fft.rfft(b, size), size)
    return np.asarray(np.maximum(product, 0.0), dtype=np.float64)


def _check_metres(width: float) -> None:
    if width < SHORTEST_OPL:
        raise UnitError(
            f"Pulse: expected a width in metres of optical path, at least {SHORTEST_OPL:g} (0.3 fs), got {width!r}. "
            "Seconds? gaussian_s, rectangular_s and tabulated_s take them."
        )
