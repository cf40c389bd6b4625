"""Correlation codes of indirect time-of-flight cameras: the weight of light in a tap, by time of arrival.

A tap multiplies the arriving light by its gate; seen from the time of flight, light that left at t = 0 is weighted by
the correlation of the emitted pulse shape with the gate. A code holds one such function per tap, over the phase in
*turns* (modulation frequency times time of flight), periodic with period one and scaled so that it lies in [-1, 1]:
+1 where a tap takes everything, -1 where it takes nothing. Codes know no light levels; `correlation.py` adds those.

Sources: Lange & Seitz, "Solid-state time-of-flight range camera" (2001), sine and square; Gupta, Velten, Nayar &
Breitbach, "What are optimal coding functions for time-of-flight imaging?" (ACM TOG 2018), Hamiltonian codes.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from torchtransient.checks import MOST_MADE, shown
from torchtransient.errors import ShapeError, UnitError
from torchtransient.floating import number_tensor
from torchtransient.sensing.checks import check_count, check_number, refuse_cut_off

_TURN = 2 * math.pi


class CorrelationCode(ABC):
    """Base of codes: one weight in [-1, 1] per tap as a function of the phase in turns. Tensors are float64 on the CPU.

    A code of two taps cannot tell phase, amplitude and offset apart: it is for pixels with two taps, see `TwoTapCode`.

    Attributes:
        num_taps: number of taps N.
        shifts: (N,) float64 turns when all taps are one function moved along, else None; only then does the phase
            follow from the taps by a Fourier sum (`tap_phasor`).
    """

    num_taps: int
    shifts: Tensor | None

    @abstractmethod
    def evaluate(self, turns: Tensor) -> Tensor:
        """Weights at a phase, differentiable.

        Args:
            turns: phase in turns, of any size and sign.

        Returns:
            (N, *turns.shape).
        """

    @abstractmethod
    def bin_means(self, edges_turns: Tensor) -> Tensor:
        """Exact means of the weights between successive edges.

        Args:
            edges_turns: (T + 1,), ascending.

        Returns:
            (N, T).
        """

    @abstractmethod
    def coefficients(self, harmonics: Sequence[int]) -> Tensor:
        """Fourier coefficients ``c`` of ``weight(x) = sum over all integers h of c_h exp(2 pi i h x)``.

        Args:
            harmonics: whole numbers h.

        Returns:
            (N, len(harmonics)) complex128.
        """

    @property
    @abstractmethod
    def harmonics(self) -> tuple[int, ...] | None:
        """Non-negative harmonics that the code has, or None when there are infinitely many."""


class FourierCode(CorrelationCode):
    """Sine with the harmonics that a real camera adds: ``sum_h amplitude_h cos(2 pi h (x - n / N) + phase_h)``.

    Two taps are a quarter of a turn apart instead of a half (`phase_steps`).

    Args:
        num_taps: number of taps N, 2 or more.
        harmonics_of_one_tap: harmonic -> (amplitude, phase in radians).

    Raises:
        UnitError: when the weights could leave [-1, 1] (the amplitudes sum to more than one), or a harmonic is not a
            positive whole number, and for less than two taps.
    """

    shifts: Tensor

    def __init__(self, num_taps: int, harmonics_of_one_tap: Mapping[int, tuple[float, float]]) -> None:
        self.num_taps = _check_taps(num_taps)
        self.parts: dict[int, tuple[float, float]] = {}
        for harmonic, pair in sorted(harmonics_of_one_tap.items()):
            amplitude, phase = (check_number(p, "harmonics_of_one_tap", "FourierCode", low=-math.inf) for p in pair)
            self.parts[check_count(harmonic, "harmonics", "FourierCode")] = (amplitude, phase)
        if not self.parts:
            raise UnitError("FourierCode: expected harmonics 1, 2, ..., got none.")
        total = sum(abs(a) for a, _ in self.parts.values())
        if not total <= 1 + 1e-9:
            raise UnitError(f"FourierCode: expected amplitudes that sum to at most 1, got {total}. Divide them by it.")
        self.shifts = phase_steps(num_taps)

    def evaluate(self, turns: Tensor) -> Tensor:
        x = turns - _along_first(self.shifts, turns)
        return self._sum(x, dict.fromkeys(self.parts, 1.0))

    def bin_means(self, edges_turns: Tensor) -> Tensor:
        edges = _check_edges(edges_turns)
        middle, width = (edges[1:] + edges[:-1]) / 2, edges[1:] - edges[:-1]
        # The mean of a cosine over a bin is its value in the middle times sinc.
        return self._sum(middle - _along_first(self.shifts, middle), {h: torch.sinc(h * width) for h in self.parts})

    def _sum(self, x: Tensor, factor: Mapping[int, Tensor | float]) -> Tensor:
        total = torch.zeros_like(x)
        for h, (amplitude, phase) in self.parts.items():
            total = total + amplitude * factor[h] * torch.cos(_TURN * h * x + phase)
        return total

    def coefficients(self, harmonics: Sequence[int]) -> Tensor:
        columns = []
        for h in harmonics:
            amplitude, phase = self.parts.get(abs(h), (0.0, 0.0)) if h else (0.0, 0.0)
            phase = phase if h > 0 else -phase
            columns.append(0.5 * amplitude * torch.exp(1j * (phase - _TURN * h * self.shifts)))
        return torch.stack(columns, dim=1)

    @property
    def harmonics(self) -> tuple[int, ...]:
        return tuple(self.parts)


class PiecewiseLinearCode(CorrelationCode):
    """Straight lines between knots, periodic: every correlation of rectangular pulses, and sampled measurements.

    Args:
        knots: (N, J) ascending turns within one period; copied to float64.
        values: (N, J) in [-1, 1]; copied to float64.
        shifts: (N,) turns when all taps are one function moved along, else None, see `CorrelationCode`.

    Raises:
        ShapeError: for other shapes.
        UnitError: for knots that do not ascend within one turn or values outside [-1, 1].
    """

    def __init__(self, knots: Tensor, values: Tensor, shifts: Tensor | None = None) -> None:
        me = "PiecewiseLinearCode"
        knots, values = _plain(knots, "knots", me), _plain(values, "values", me)
        if knots.ndim != 2 or knots.shape != values.shape or knots.shape[1] < 2:
            raise ShapeError(
                f"PiecewiseLinearCode: expected knots and values (N, J >= 2), got {tuple(knots.shape)} and "
                f"{tuple(values.shape)}."
            )
        self.num_taps = _check_taps(knots.shape[0])
        if not (bool((knots.diff(dim=1) > 0).all()) and bool((knots[:, -1] - knots[:, 0] < 1).all())):
            raise UnitError("PiecewiseLinearCode: expected knots that ascend within one turn along dim 1.")
        if not bool((values.abs() <= 1 + 1e-9).all()):
            raise UnitError(f"PiecewiseLinearCode: expected values in [-1, 1], got up to {float(values.abs().max())}.")
        self.shifts = None if shifts is None else _plain(shifts, "shifts", me)
        # One period from the first knot on, closed by a copy of it, so that every phase lies between two knots.
        self._start = knots[:, :1]
        self._x = torch.cat([knots, knots[:, :1] + 1], dim=1) - self._start
        self._y = torch.cat([values, values[:, :1]], dim=1)
        width = self._x.diff(dim=1)
        self._slope = self._y.diff(dim=1) / width
        area = (self._y[:, 1:] + self._y[:, :-1]) / 2 * width
        self._integral = torch.cat([torch.zeros_like(area[:, :1]), area.cumsum(dim=1)], dim=1)

    def _locate(self, turns: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return whole periods, index of the line, and distance from its first knot, each (N, M) for turns (M,)."""
        x = turns.to(torch.float64).cpu() - self._start
        periods = torch.floor(x)
        x = x - periods
        index = torch.searchsorted(self._x, x.contiguous(), right=True) - 1
        index = index.clamp(0, self._slope.shape[1] - 1)
        return periods, index, x - self._x.gather(1, index)

    def evaluate(self, turns: Tensor) -> Tensor:
        _, index, distance = self._locate(turns.reshape(-1))
        value = self._y.gather(1, index) + self._slope.gather(1, index) * distance
        return value.reshape(self.num_taps, *turns.shape).to(turns)

    def bin_means(self, edges_turns: Tensor) -> Tensor:
        edges = _check_edges(edges_turns)
        periods, index, distance = self._locate(edges)
        part = self._y.gather(1, index) * distance + self._slope.gather(1, index) * distance.square() / 2
        antiderivative = periods * self._integral[:, -1:] + self._integral.gather(1, index) + part
        return antiderivative.diff(dim=1) / edges.diff()

    def coefficients(self, harmonics: Sequence[int]) -> Tensor:
        # Twice differentiated, the function is a comb of its changes of slope, whose coefficients are a finite sum.
        bend = self._slope - self._slope.roll(1, dims=1)
        at = self._start + self._x[:, :-1]
        columns = []
        for h in harmonics:
            if h == 0:
                columns.append(self._integral[:, -1].to(torch.complex128))
            else:
                columns.append(-(bend * torch.exp(-1j * _TURN * h * at)).sum(dim=1) / (_TURN * h) ** 2)
        return torch.stack(columns, dim=1)

    @property
    def harmonics(self) -> None:
        return None


def sine_code(num_taps: int = 4) -> FourierCode:
    """Make the code of sine modulation: tap n weighs with ``cos(2 pi (x - n / N))``.

    Args:
        num_taps: number of taps N, 2 or more.

    Raises:
        UnitError: for less than two taps.
    """
    return FourierCode(num_taps, {1: (1.0, 0.0)})


def square_code(num_taps: int = 4, light_duty: float = 0.5, gate_duty: float = 0.5) -> PiecewiseLinearCode:
    """Make the code of rectangular light against rectangular gates, tap n moved by n / N turns.

    Two taps are moved by a quarter of a turn. With both duties at one half the weight is a triangle wave, whose odd
    harmonics fall as ``1 / h^2``. The gates are placed so that tap 0 weighs phase zero highest, as in `sine_code`.

    Args:
        num_taps: number of taps N, 2 or more.
        light_duty: turns that the light is on, in (0, 1).
        gate_duty: turns that a gate is open, in (0, 1).

    Raises:
        UnitError: for duties outside (0, 1).
    """
    start = (light_duty - gate_duty) / 2
    shifts = phase_steps(num_taps)
    gates = [[((float(s) + start), (float(s) + start + gate_duty))] for s in shifts]
    return binary_code(light_duty, gates, shifts)


def hamiltonian_code(num_taps: int = 3) -> PiecewiseLinearCode:
    """Make the Hamiltonian code of 3 or 4 taps (Gupta et al. 2018): short light pulses against binary gates.

    3 taps: light on for 1/6 turn, gates half a turn, a third apart. 4 taps: light on for 1/12 turn; two gates are open
    for half a turn, two of them twice within a turn.

    Args:
        num_taps: number of taps, 3 or 4.

    Raises:
        ShapeError: for another number of taps.
    """
    if num_taps == 3:
        shifts = torch.arange(3, dtype=torch.float64) / 3
        return binary_code(1 / 6, [[(float(s), float(s) + 0.5)] for s in shifts], shifts)
    if num_taps == 4:
        twelfths = [[(5, 11)], [(2, 8)], [(0, 3), (7, 10)], [(4, 6), (9, 13)]]
        return binary_code(1 / 12, [[(a / 12, b / 12) for a, b in gate] for gate in twelfths])
    raise ShapeError(f"hamiltonian_code: expected 3 or 4 taps, got {shown(num_taps)}; use binary_code for other gates.")


def binary_code(
    light_duty: float, gates: Sequence[Sequence[tuple[float, float]]], shifts: Tensor | None = None
) -> PiecewiseLinearCode:
    """Make the code of light that is on at the start of a period, against gates of any number of openings.

    Light of phase x falls into an opening with the part of it that overlaps; all of it gives +1, none -1.

    Args:
        light_duty: turns that the light is on.
        gates: per tap its openings as (start, end) in turns, ``0 < end - start < 1``.
        shifts: (N,) turns when all taps are one function moved along, else None, see `CorrelationCode`.

    Raises:
        UnitError: where openings overlap.
    """
    light_duty = check_number(light_duty, "light_duty", "binary_code", high=1.0, open_low=True)
    knots, values = [], []
    for given in gates:
        openings = [tuple(check_number(e, "gates", "binary_code", low=-math.inf) for e in edges) for edges in given]
        corners = sorted({round(e % 1, 12) % 1 for a, b in openings for e in (a, b, a - light_duty, b - light_duty)})
        x = torch.tensor(corners, dtype=torch.float64)
        inside = sum((_overlap(x, light_duty, a, b) for a, b in openings), torch.zeros_like(x))
        if bool((inside > light_duty * (1 + 1e-9)).any()):
            raise UnitError(f"binary_code: the openings {list(openings)} of one gate overlap.")
        knots.append(x)
        values.append((2 * inside / light_duty - 1).clamp(-1, 1))
    most = max(len(k) for k in knots)
    padded = [_pad_knots(k, v, most) for k, v in zip(knots, values, strict=True)]
    return PiecewiseLinearCode(torch.stack([k for k, _ in padded]), torch.stack([v for _, v in padded]), shifts)


def measured_code(samples: Tensor) -> PiecewiseLinearCode:
    """Make a code of correlation functions measured at equal steps of the phase over one period.

    Args:
        samples: (N, S), any unit; each tap is scaled by its largest magnitude.

    Raises:
        ShapeError: for other shapes.
        UnitError: for a tap that is zero.
    """
    table = _plain(samples, "samples", "measured_code")
    if table.ndim != 2 or table.shape[1] < 3:
        raise ShapeError(f"measured_code: expected samples (N, S >= 3), got {tuple(table.shape)}.")
    largest = table.abs().amax(dim=1, keepdim=True)
    if not bool((largest > 0).all()) or not bool(torch.isfinite(table).all()):
        raise UnitError("measured_code: expected finite samples that are not all zero in any tap.")
    knots = torch.arange(table.shape[1], dtype=torch.float64) / table.shape[1]
    return PiecewiseLinearCode(knots.expand_as(table), table / largest)


def _plain(given: object, name: str, where: str) -> Tensor:
    """float64 on the CPU, of a tensor, an array or rows of numbers. GradientError: codes are not learnt."""
    refuse_cut_off(given, name, where)
    table = number_tensor(given, f"{where}: expected {name} as rows of numbers of one length")
    return table.detach().to("cpu", torch.float64)


def _overlap(x: Tensor, light: float, a: float, b: float) -> Tensor:
    """Length of the light interval [x, x + light) in the opening [a, b), both modulo one turn."""
    if not 0 < b - a < 1 or not 0 < light < 1:
        raise UnitError(f"binary_code: expected openings and light of 0 to 1 turn, got ({a}, {b}) and {light}.")
    total = torch.zeros_like(x)
    for k in (-2, -1, 0, 1, 2):
        start = a % 1 + k
        total = total + (torch.minimum(x + light, x.new_tensor(start + b - a)) - x.clamp(min=start)).clamp(min=0)
    return total


def _pad_knots(knots: Tensor, values: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """More knots on the same lines: taps with fewer corners share a table with the others."""
    while len(knots) < count:
        gap = torch.cat([knots, knots[:1] + 1]).diff()
        i = int(gap.argmax())
        after = torch.cat([values, values[:1]])
        knots = torch.cat([knots[: i + 1], knots[i : i + 1] + gap[i] / 2, knots[i + 1 :]])
        values = torch.cat([values[: i + 1], (after[i : i + 1] + after[i + 1 : i + 2]) / 2, values[i + 1 :]])
    return knots, values


def phase_steps(num_taps: int) -> Tensor:
    """Phases of the taps: n / N, and 0 and a quarter for two, which half a turn apart would see the same twice.

    Args:
        num_taps: number of taps N, 2 or more.

    Returns:
        (N,) float64 turns.
    """
    num_taps = _check_taps(num_taps)
    steps = torch.arange(num_taps, dtype=torch.float64)
    return steps / (num_taps if num_taps > 2 else 4)


def _check_taps(num_taps: int) -> int:
    return check_count(num_taps, "num_taps", "CorrelationCode", low=2, most=MOST_MADE)


def _check_edges(edges_turns: Tensor) -> Tensor:
    edges = edges_turns.to("cpu", torch.float64)
    if edges.ndim != 1 or edges.shape[0] < 2 or not bool((edges.diff() > 0).all()):
        raise UnitError("bin_means: expected one ascending row of at least two edges, in turns.")
    return edges


def _along_first(shifts: Tensor, turns: Tensor) -> Tensor:
    return shifts.to(turns).reshape(-1, *(1,) * turns.ndim)


# -------------------------------------------------------------------------------------------------- codes made of codes


class TwoTapCode(CorrelationCode):
    """Pixels of two taps: the 2 N taps A_0, B_0, A_1, B_1, ... of a code of N gates, with B the opposite of A.

    Light is conserved whatever the code. For a pixel whose B is not the opposite of its A, measure both and give 2 N
    functions to `measured_code`.

    Args:
        code: code of any kind with N >= 2 phase steps, exposed one after another.

    Raises:
        UnitError: for a code that has two taps already.
    """

    def __init__(self, code: CorrelationCode) -> None:
        if isinstance(code, TwoTapCode):
            raise UnitError(f"TwoTapCode: expected a code of one tap such as sine_code(4), got {shown(code)}.")
        self.code = code
        self.num_taps = 2 * code.num_taps
        self.shifts = None

    def evaluate(self, turns: Tensor) -> Tensor:
        return _with_opposites(self.code.evaluate(turns))

    def bin_means(self, edges_turns: Tensor) -> Tensor:
        return _with_opposites(self.code.bin_means(edges_turns))

    def coefficients(self, harmonics: Sequence[int]) -> Tensor:
        return _with_opposites(self.code.coefficients(harmonics))

    @property
    def harmonics(self) -> tuple[int, ...] | None:
        return self.code.harmonics


class ReversedCode(CorrelationCode):
    """Code whose phase steps go the other way: tap n is moved by minus its shift.

    Args:
        code: code whose taps are one function moved along.

    Raises:
        UnitError: for other codes (`CorrelationCode.shifts` is None).
    """

    def __init__(self, code: CorrelationCode) -> None:
        if code.shifts is None:
            raise UnitError(
                "ReversedCode: expected a code of one function moved along, whose steps have a direction, got "
                f"{shown(code)}. Give measured or Hamiltonian codes in the order that the camera has."
            )
        self.code = code
        self.num_taps = code.num_taps
        self.shifts = -code.shifts % 1.0
        self._back = 2 * code.shifts

    def evaluate(self, turns: Tensor) -> Tensor:
        return torch.stack([self.code.evaluate(turns + float(s))[n] for n, s in enumerate(self._back)])

    def bin_means(self, edges_turns: Tensor) -> Tensor:
        return torch.stack([self.code.bin_means(edges_turns + float(s))[n] for n, s in enumerate(self._back)])

    def coefficients(self, harmonics: Sequence[int]) -> Tensor:
        turns = self._back[:, None] * torch.tensor(list(harmonics), dtype=torch.float64)
        return self.code.coefficients(harmonics) * torch.exp(1j * _TURN * turns)

    @property
    def harmonics(self) -> tuple[int, ...] | None:
        return self.code.harmonics


def in_direction(code: CorrelationCode, direction: int) -> CorrelationCode:
    """Return a code, or the code with its phase steps reversed.

    Args:
        code: the code.
        direction: 1, or -1 to reverse.

    Raises:
        UnitError: for a code that `ReversedCode` refuses.
    """
    if direction == 1:
        return code
    return TwoTapCode(ReversedCode(code.code)) if isinstance(code, TwoTapCode) else ReversedCode(code)


def _with_opposites(weights: Tensor) -> Tensor:
    return torch.stack([weights, -weights], dim=1).flatten(0, 1)
