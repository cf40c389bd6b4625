"""Gates of a time-gated camera: sensitivity over the arrival time of light.

Optical path length in metres from the moment when the light leaves the emitter. Neither Mitsuba nor torch is imported.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchtransient import checks
from torchtransient.checks import Numbers, finite, numbers, shown
from torchtransient.errors import ArgumentError, ShapeError, UnitError
from torchtransient.pulses import CUT_STDDEVS, FWHM_PER_STDDEV, Pulse
from torchtransient.units import SHORTEST_OPL, near_seconds, seconds_to_opl

Array = NDArray[np.float64]

KINDS = ("rectangular", "gaussian", "tabulated")
# A profile that is not straight is handed to a film as straight lines between this many points.
NODES = 2049
# Advice of errors about derivatives in time with a gate that jumps.
SLOPE_REMEDY = (
    "Use gates that rise from zero and fall to zero (gaussian, or tabulated with zeros at both ends), or give the film "
    "a pulse."
)


@dataclass(frozen=True)
class Gate:
    """Sensitivity over the arrival of light: an arrival at ``opl`` counts ``value(opl)`` times.

    Make one with :meth:`rectangular`, :meth:`gaussian` or :meth:`tabulated`. Frozen, hashable, picklable.

    Args:
        kind: "rectangular", "gaussian" or "tabulated".
        start_opl, end_opl: first length with sensitivity and first one after it, metres.
        opl: lengths of a table, rising, metres; centre and full width at half maximum of a Gaussian.
        values: sensitivities of a table.

    Raises:
        ArgumentError: for other kinds.
        UnitError: for an end before its start, widths that are not positive, and values that are negative, not finite
            or zero everywhere.
        ShapeError: for tables of different lengths.
    """

    kind: str
    start_opl: float
    end_opl: float
    _: KW_ONLY
    opl: tuple[float, ...] = ()
    values: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if not isinstance(self.kind, str) or self.kind not in KINDS:
            raise ArgumentError(f"Gate: expected one of {', '.join(KINDS)}, got {shown(self.kind)}.")
        start, end = (finite(f"Gate: {name}", getattr(self, name)) for name in ("start_opl", "end_opl"))
        if not start < end:
            raise UnitError(f"Gate: expected a finite start before a finite end, got {start!r} m to {end!r} m.")
        if end - start < SHORTEST_OPL:
            raise UnitError(
                f"Gate: expected start and end in metres of optical path, at least {SHORTEST_OPL:g} apart (0.3 fs), "
                f"got {start!r} and {end!r}. Seconds? rectangular_s and gaussian_s take them."
            )
        object.__setattr__(self, "start_opl", start)
        object.__setattr__(self, "end_opl", end)

    # ------------------------------------------------------------------------------------------- constructors

    @classmethod
    def rectangular(cls, start_opl: float, end_opl: float) -> Gate:
        """Return a gate that is fully open in ``[start_opl, end_opl)``; it has no slope, hence no gradient in time.

        Args:
            start_opl: first optical path length with sensitivity, metres.
            end_opl: first one after it, metres.

        Raises:
            UnitError: unless the end follows the start.
        """
        return cls("rectangular", start_opl, end_opl)

    @classmethod
    def gaussian(cls, center_opl: float, fwhm_opl: float) -> Gate:
        """Return a gate that is fully open at its centre and closes like a Gaussian.

        Args:
            center_opl: centre, metres.
            fwhm_opl: full width at half maximum, metres; sensitivity is zero from four standard deviations on.

        Raises:
            UnitError: for widths that are not positive.
        """
        center, fwhm = finite("Gate.gaussian: center_opl", center_opl), finite("Gate.gaussian: fwhm_opl", fwhm_opl)
        if not fwhm > 0:
            raise UnitError(f"Gate.gaussian: expected fwhm_opl > 0 metres, got {fwhm!r}.")
        half = CUT_STDDEVS * fwhm / FWHM_PER_STDDEV
        # Center and width are kept too: start and end would give them back with a rounding error.
        return cls("gaussian", center - half, center + half, opl=(center, fwhm))

    @classmethod
    def tabulated(cls, opl: Numbers, values: Numbers) -> Gate:
        """Return a measured profile, linear between its values and zero outside.

        Args:
            opl: lengths, (N,), rising, metres.
            values: sensitivities there, (N,).

        Raises:
            UnitError, ShapeError: as the class.
        """
        lengths = numbers("Gate.tabulated: opl", opl).ravel()
        heights = numbers("Gate.tabulated: values", values).ravel()
        if lengths.size != heights.size or lengths.size < 2:
            raise ShapeError(
                f"Gate.tabulated: expected two or more lengths and as many values, got {lengths.size} and "
                f"{heights.size}."
            )
        if not (np.all(np.isfinite(lengths)) and np.all(np.diff(lengths) > 0)):
            raise UnitError("Gate.tabulated: expected finite lengths in rising order.")
        if not np.all(np.isfinite(heights)) or heights.min() < 0 or heights.max() == 0:
            raise UnitError(
                "Gate.tabulated: expected finite values, none negative and not all zero, got values between "
                f"{heights.min():g} and {heights.max():g}."
            )
        table = tuple(lengths.tolist()), tuple(heights.tolist())
        return cls("tabulated", table[0][0], table[0][-1], opl=table[0], values=table[1])

    @classmethod
    def rectangular_s(cls, start_s: float, end_s: float) -> Gate:
        """Return :meth:`rectangular` from seconds. Raises UnitError for times of 10 ms and more.

        Args:
            start_s: first time with sensitivity, seconds.
            end_s: first one after it, seconds.
        """
        start, end = (near_seconds(t, "start_s and end_s", "Gate.rectangular_s") for t in (start_s, end_s))
        return cls.rectangular(seconds_to_opl(start), seconds_to_opl(end))

    @classmethod
    def gaussian_s(cls, center_s: float, fwhm_s: float) -> Gate:
        """Return :meth:`gaussian` from seconds. Raises UnitError for times of 10 ms and more.

        Args:
            center_s: centre, seconds.
            fwhm_s: full width at half maximum, seconds.
        """
        center, fwhm = (near_seconds(t, "center_s and fwhm_s", "Gate.gaussian_s") for t in (center_s, fwhm_s))
        return cls.gaussian(seconds_to_opl(center), seconds_to_opl(fwhm))

    def shifted(self, opl: float) -> Gate:
        """Return the same gate, opened ``opl`` metres later.

        Args:
            opl: delay, metres of optical path; negative for earlier.
        """
        opl = finite("Gate.shifted: opl", opl)
        if self.kind == "gaussian":
            return Gate.gaussian(self.opl[0] + opl, self.opl[1])
        moved = tuple(length + opl for length in self.opl)
        return Gate(self.kind, self.start_opl + opl, self.end_opl + opl, opl=moved, values=self.values)

    def sequence(self, step_opl: float, count: int) -> tuple[Gate, ...]:
        """Return gates of this shape at equal distances.

        Args:
            step_opl: distance of a gate from the one before, metres.
            count: number of gates.

        Raises:
            ShapeError: for counts that are negative or too large.
        """
        step = finite("Gate.sequence: step_opl", step_opl)
        number = checks.count("Gate.sequence: count", count, 0, ShapeError, checks.MOST_MADE)
        return tuple(self.shifted(k * step) for k in range(number))

    # ------------------------------------------------------------------------------------------------ the profile

    def value(self, opl: Any) -> Array:
        """Evaluate the sensitivity.

        Args:
            opl: arrivals of any shape, metres.

        Returns:
            Sensitivity in the shape of ``opl``, float64; NaN at NaN.
        """
        x = numbers("Gate.value: opl", opl)
        inside = (x >= self.start_opl) & (x < self.end_opl)
        outside = np.where(np.isnan(x), np.nan, 0.0)
        if self.kind == "rectangular":
            return np.where(inside, 1.0, outside)
        if self.kind == "tabulated":
            return np.where(inside, np.interp(x, self.opl, self.values), outside)
        near = np.clip(x, self.start_opl, self.end_opl)
        u = (near - 0.5 * (self.start_opl + self.end_opl)) * (2 * CUT_STDDEVS / (self.end_opl - self.start_opl))
        floor = math.exp(-0.5 * CUT_STDDEVS**2)
        return np.where(inside, np.maximum((np.exp(-0.5 * u * u) - floor) / (1 - floor), 0.0), outside)

    @property
    def is_continuous(self) -> bool:
        """The profile rises from zero and falls to zero without a jump, and so has a slope."""
        if self.kind == "tabulated":
            return self.values[0] == 0 and self.values[-1] == 0
        return self.kind == "gaussian"

    def nodes(self) -> Array:
        """Return the profile (N,) at equal distances from start to end, linear in between; exact for linear ones."""
        if self.kind == "rectangular":
            return np.ones(2)
        if self.kind == "tabulated" and np.allclose(np.diff(self.opl), self.opl[1] - self.opl[0], rtol=1e-9, atol=0):
            return np.array(self.values)
        x = np.linspace(self.start_opl, self.end_opl, NODES)
        values = self.value(x)
        values[-1] = self.values[-1] if self.kind == "tabulated" else 0.0
        return values

    def spread(self, pulse: Pulse) -> Gate:
        """Return the gate for light with a pulse: its sensitivity averaged over the pulse around each arrival.

        Args:
            pulse: shape of the light's pulse over optical path length.

        Returns:
            Tabulated gate, longer by the pulse.
        """
        low, high = pulse.support_opl
        at = np.linspace(self.start_opl - high, self.end_opl - low, NODES)
        if self.kind == "rectangular":
            values = pulse.cumulative(self.end_opl - at) - pulse.cumulative(self.start_opl - at)
        else:
            # On one grid for both: the pulse's shares of each step, the profile at the steps' centres.
            step = (at[-1] - at[0]) / (NODES - 1)
            count = max(1, math.ceil((high - low) / step))
            shares = np.diff(pulse.cumulative(low + step * np.arange(count + 1)))
            profile = self.value(at[0] + low + step * (np.arange(NODES + count - 1) + 0.5))
            values = np.correlate(profile, shares, mode="valid")
        values[[0, -1]] = 0.0
        return Gate.tabulated(at.tolist(), np.maximum(values, 0.0).tolist())

    # --------------------------------------------------------------------------------------------------- as text

    def __str__(self) -> str:
        """Return the gate in the notation of scene files, see :func:`gates_from_text`."""
        if self.kind == "tabulated":
            pairs = zip(self.opl, self.values, strict=True)
            return "tabulated " + " ".join(f"{length!r}:{value!r}" for length, value in pairs)
        if self.kind == "gaussian":
            return f"gaussian {self.opl[0]!r} {self.opl[1]!r}"
        return f"rectangular {self.start_opl!r} {self.end_opl!r}"


def jump_in(gates: Sequence[Gate]) -> str:
    """Return a name for the first gate that opens or closes at once, for messages; empty if all have a slope.

    Args:
        gates: gates of a film.
    """
    return next((f"{gate.kind} gate" for gate in gates if not gate.is_continuous), "")


def gates_to_text(gates: Sequence[Gate]) -> str:
    """Return gates in the notation of scene files.

    Args:
        gates: gates of a film.
    """
    return "; ".join(map(str, gates))


def gates_from_text(text: str) -> tuple[Gate, ...]:
    """Parse gates separated by semicolons, each one of::

        rectangular START END        gaussian CENTER FWHM        tabulated OPL:VALUE OPL:VALUE ...

    Args:
        text: gates, metres of optical path.

    Raises:
        UnitError: for other texts, and gates that :class:`Gate` refuses.
    """
    gates = []
    for part in filter(None, (p.strip() for p in str(text).split(";"))):
        kind, *rest = part.replace(",", " ").split()
        try:
            if kind == "tabulated":
                pairs = [entry.split(":") for entry in rest]
                gates.append(Gate.tabulated([float(a) for a, _ in pairs], [float(b) for _, b in pairs]))
                continue
            first, second = (float(number) for number in rest)
        except ValueError as error:
            if isinstance(error, (UnitError, ShapeError)):
                raise
            raise UnitError(
                "gates: expected 'rectangular START END', 'gaussian CENTER FWHM' or 'tabulated OPL:VALUE ...', "
                f"separated by semicolons, got {part!r}."
            ) from None
        if kind not in KINDS:
            raise UnitError(f"gates: expected a kind out of {', '.join(KINDS)}, got {kind!r}.")
        gates.append(Gate.rectangular(first, second) if kind == "rectangular" else Gate.gaussian(first, second))
    if not gates:
        raise UnitError("gates: expected at least one gate, got none.")
    return tuple(gates)
