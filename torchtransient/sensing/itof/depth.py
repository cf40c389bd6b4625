"""Phase, amplitude, depth and speed from the taps of an indirect time-of-flight camera.

With taps ``I_n = (B + A cos(phi - 2 pi n / N)) / N`` the sum ``(2 / N) sum_n I_n exp(2 pi i n / N)`` is the *tap
phasor* ``(A / N) exp(i phi)`` (its phase is minus that of a phasor image, whose exponent is negative). The differences
of pixels with two taps have the same one. Depth is half the way there and back: ``d = c phi / (4 pi f)``, unique up to
``c / (2 f)``.

Gradients: a phase jumps by a turn at the end of its range, so that a loss on it (or on depth) pulls pixels near the
jump the long way round. `tt.losses.phasor_loss` has no jump; `wrapped_difference` gives the short way. A
pixel without modulated light has phase and derivative zero.

Sources: Lange & Seitz (2001); Payne, Dorrington & Cree, "Illumination waveform optimization for time-of-flight range
imaging cameras" (SPIE 2011); Jongenelen et al., "Analysis of errors in ToF range imaging with dual-frequency
modulation" (IEEE TIM 2011); Heide et al., "Doppler time-of-flight imaging" (ACM TOG 34, 2015).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchtransient.errors import ShapeError, UnitError
from torchtransient.floating import in_single, product, single
from torchtransient.sensing.checks import check_choice, check_count, check_number, reals, tensor_of
from torchtransient.sensing.itof.codes import phase_steps
from torchtransient.sensing.itof.correlation import Frequencies, check_frequencies
from torchtransient.units import SPEED_OF_LIGHT

Readout = Literal["single", "two_tap", "differential"]
Frames = Tensor | NDArray[Any]

_TURN = 2 * math.pi


def tap_phasor(taps: Frames, num_taps: int, readout: Readout = "single") -> Tensor:
    """Phasor of frames: ``(2 / N) sum_n X_n exp(2 pi i n / N)``.

    Steps of one function at equal shifts (sine, square); two steps are a quarter of a turn apart. Equal light gives
    equal results in every readout. Harmonics ``m N +- 1`` alias into the result (wiggling; four steps for two). Half
    precision becomes complex64.

    Args:
        taps: frames of a camera, see `read_itof`.
        num_taps: number of phase steps N.
        readout: "single", "two_tap" or "differential".

    Returns:
        (..., C, F, H, W) complex.

    Raises:
        ShapeError: for another number of frames.
        UnitError: for numbers that are none of frames.
    """
    steps = steps_of(taps, num_taps, readout, "tap_phasor")
    if num_taps > 2:
        # The mean has no part in the sum; without it, equal taps give exactly zero and float32 keeps its digits.
        steps = steps - steps.mean(-3, keepdim=True)
    angles = _TURN * phase_steps(num_taps)
    weights = (2 / num_taps) * torch.stack([angles.cos(), angles.sin()])
    both = product(weights.to(steps), steps.flatten(-2))
    real, imag = both.reshape(*both.shape[:-1], *steps.shape[-2:]).unbind(-3)
    return torch.complex(real, imag)


def offset_of(taps: Frames, num_taps: int, readout: Readout = "single") -> Tensor:
    """Level of a pixel without modulation, the mean of its taps, or of ``A + B`` of two.

    Half precision becomes float32.

    Args:
        taps: frames of a camera, see `read_itof`.
        num_taps: number of phase steps N.
        readout: "single" or "two_tap".

    Returns:
        (..., C, F, H, W).

    Raises:
        ShapeError: for another number of frames.
        UnitError: for differences, in which it has cancelled.
    """
    if readout == "differential":
        raise UnitError("offset_of: expected frames of taps, got differences, in which the offset has cancelled.")
    if readout == "two_tap":
        return sums_of(taps, num_taps, "offset_of").mean(-3)
    return steps_of(taps, num_taps, readout, "offset_of").mean(-3)


def steps_of(taps: Frames, num_taps: int, readout: Readout, where: str) -> Tensor:
    """Measurement of each phase step, in float32 or better.

    A black level has to be off "single" frames only if their offset is to mean light.

    Args:
        taps: frames (..., C, F N, H, W) of taps or of exposures of one tap, N >= 3 ("single"); (..., C, F 2N, H, W) of
            A and B in turn, N >= 2, whose difference it is ("two_tap"); (..., C, F N, H, W) of such differences
            ("differential"). Raw frames of whole numbers are taken, as tensors or arrays.
        num_taps: number of phase steps N.
        readout: "single", "two_tap" or "differential".
        where: name of the caller, for errors.

    Returns:
        (..., C, F, N, H, W).

    Raises:
        ShapeError: for another number of frames.
        UnitError: for numbers that are none of frames.
    """
    split = _split(taps, num_taps, readout, where)
    return split[..., 0, :, :] - split[..., 1, :, :] if readout == "two_tap" else split[..., 0, :, :]


def sums_of(taps: Frames, num_taps: int, where: str) -> Tensor:
    """Sums ``A + B`` of frames of two taps.

    Args:
        taps: (..., C, F 2N, H, W).
        num_taps: number of phase steps N.
        where: name of the caller, for errors.

    Returns:
        (..., C, F, N, H, W).
    """
    split = _split(taps, num_taps, "two_tap", where)
    return split[..., 0, :, :] + split[..., 1, :, :]


def _split(taps: Frames, num_taps: int, readout: str, where: str) -> Tensor:
    """Frames as (..., C, F, N, taps of a pixel, H, W)."""
    check_choice(readout, Readout, "readout", where)
    frames = _precise(as_frames(taps), where)
    each, least = (2 if readout == "two_tap" else 1), (3 if readout == "single" else 2)
    count = check_count(num_taps, "num_taps", where)
    if count < least or frames.ndim < 4 or not frames.shape[-3] or frames.shape[-3] % (count * each):
        raise ShapeError(
            f"{where}: expected {readout} frames (..., C, {each} F N, H, W) with N = {num_taps} >= {least} phase "
            f"steps, got {tuple(frames.shape)}."
        )
    frequencies = frames.shape[-3] // (count * each)
    return frames.reshape(*frames.shape[:-3], frequencies, count, each, *frames.shape[-2:])


def as_frames(taps: Frames) -> Tensor:
    """Return a tensor as it is, and an array as one.

    Args:
        taps: frames.
    """
    return taps if isinstance(taps, Tensor) else tensor_of(np.asarray(taps))


def _precise(frames: Tensor, where: str) -> Tensor:
    """Frames in float32 or better, in which differences of 16-bit numbers cannot wrap."""
    if frames.is_complex() or frames.dtype == torch.bool:
        raise UnitError(f"{where}: expected frames of real numbers, got {frames.dtype}.")
    if not frames.is_floating_point():
        # float32 holds every 16-bit number and the sum of two.
        return frames.to(torch.float32 if frames.dtype.itemsize <= 2 else torch.float64)
    return single(frames)


def phase_of(phasor: Tensor) -> Tensor:
    """Angle of a complex tensor in [0, 2 pi); zero, with derivative zero, where it is zero.

    Args:
        phasor: complex, any shape.

    Returns:
        Shape of ``phasor``, radians.
    """
    real, imag, there, scale = _scaled(phasor)
    # At scale one the squares in the derivative of atan2 cannot underflow; the angle does not depend on it.
    angle = torch.atan2(torch.where(there, imag, 0.0) / scale, torch.where(there, real, 1.0) / scale)
    # Not where(..., turn, 0.0): two plain numbers make a float32 of the turn.
    return below_a_turn(angle + _TURN * (angle < 0).to(angle))


def below_a_turn(phase: Tensor) -> Tensor:
    """Keep phases below a turn: the sum of a tiny negative angle and a turn rounds to the turn itself.

    Args:
        phase: phase in radians, up to a turn.
    """
    return torch.where(phase >= _TURN, phase - _TURN, phase)


def amplitude_of(phasor: Tensor) -> Tensor:
    """Modulus of a complex tensor; derivative zero where it is zero.

    Args:
        phasor: complex, any shape.
    """
    real, imag, there, scale = _scaled(phasor)
    square = (real / scale).square() + (imag / scale).square()
    return torch.where(there, torch.where(there, square, 1.0).sqrt() * scale, 0.0)


def _scaled(phasor: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Real and imaginary part, a mask of the pixels with light, and the size of their larger part, else one."""
    real, imag = phasor.real, phasor.imag
    largest = torch.maximum(real.abs(), imag.abs()).detach()
    there = ~(largest <= torch.finfo(real.dtype).tiny)  # NaN is not darkness
    return real, imag, there, torch.where(there, largest, 1.0)


@in_single
def depth_of_phase(phase: Tensor, frequency_hz: float) -> Tensor:
    """Depth of a phase at one frequency: ``c phase / (4 pi f)``.

    Args:
        phase: phase in radians, any shape.
        frequency_hz: modulation frequency in hertz.

    Returns:
        Metres, in the shape of ``phase``.

    Raises:
        UnitError: for frequencies that are no hertz, and for phasors.
    """
    (phase,) = reals("depth_of_phase", phase=phase)
    f = check_number(frequency_hz, "frequency_hz", "depth_of_phase", low=1e3, high=1e12)
    return phase * (SPEED_OF_LIGHT / (2 * _TURN * f))


def unambiguous_range_m(frequencies_hz: Frequencies) -> float:
    """Depth after which all phases repeat: ``c / (2 gcd)``.

    Args:
        frequencies_hz: modulation frequencies in hertz.

    Returns:
        Metres.

    Raises:
        UnitError: for frequencies that are not whole hertz.
    """
    values = check_frequencies(frequencies_hz, "unambiguous_range_m")
    if any(f != int(f) for f in values):
        raise UnitError(
            f"unambiguous_range_m: expected whole numbers of hertz, which have a common divisor, got {values}. Say "
            "the largest depth instead."
        )
    return SPEED_OF_LIGHT / (2 * math.gcd(*(int(f) for f in values)))


@in_single
def wrapped_difference(a: Tensor, b: Tensor) -> Tensor:
    """Difference of phases the short way round, in [-pi, pi), with derivative one everywhere.

    Args:
        a: phase in radians.
        b: phase in radians that is subtracted; shapes broadcast.
    """
    difference = a - b
    turns = torch.floor((difference + math.pi) / _TURN)
    return difference - _TURN * turns


def shares_of_depth(frequencies_hz: Sequence[float]) -> list[float]:
    """Weights of the depths of several frequencies in their least-squares mean: ``f^2`` over their sum.

    Args:
        frequencies_hz: F frequencies in hertz.
    """
    # A phase of frequency f measures depth with the weight 1 / period^2.
    parts = [f**2 for f in frequencies_hz]
    return [part / sum(parts) for part in parts]


@in_single
def unwrap_depth(
    phase: Tensor, frequencies_hz: Frequencies, *, max_depth_m: float | None = None, min_depth_m: float = 0.0
) -> Tensor:
    """Unwrap phases of several frequencies to depth: the lattice of wraps, searched.

    For every number of turns of the highest frequency within the range the other frequencies take their nearest number
    of turns, and the least-squares depth with the least residual wins. The whole turns are detached; the
    gradient is that of the least-squares depth in the phases. Memory does not grow with the number of candidates.

    Args:
        phase: (..., C, F, H, W), in radians.
        frequencies_hz: F modulation frequencies in hertz.
        max_depth_m: largest depth in metres; None: one range after `min_depth_m`, after which phases repeat.
        min_depth_m: least depth in metres; with noise around zero depth, a little below zero.

    Returns:
        (..., C, H, W), metres.

    Raises:
        ShapeError: for a wrong F.
        UnitError: for an empty range, and for one over which the phases repeat.
    """
    me = "unwrap_depth"
    values = check_frequencies(frequencies_hz, me)
    (phase,) = reals(me, phase=phase)
    if phase.ndim < 4 or phase.shape[-3] != len(values):
        raise ShapeError(f"{me}: expected phases (..., C, {len(values)}, H, W), got {tuple(phase.shape)}.")
    longest = min_depth_m + unambiguous_range_m(values) if max_depth_m is None else max_depth_m
    if not (math.isfinite(longest) and longest > min_depth_m):
        raise UnitError(f"{me}: expected min_depth_m < max_depth_m in metres, got {min_depth_m!r} and {longest!r}.")
    # a tenth more leaves room for noise at both ends
    if longest - min_depth_m > 1.1 * unambiguous_range_m(values):
        raise UnitError(
            f"{me}: expected max_depth_m - min_depth_m of at most {unambiguous_range_m(values):.4g} m, after which the "
            f"phases of {values} Hz repeat, got {longest - min_depth_m:.4g} m. Metres? Or add a frequency."
        )

    turns = phase / _TURN
    periods = [SPEED_OF_LIGHT / (2 * f) for f in values]  # metres per turn
    share = shares_of_depth(values)
    reference = min(range(len(values)), key=lambda i: periods[i])
    with torch.no_grad():
        whole = _search(turns, periods, share, reference, (float(min_depth_m), float(longest)))
    metres = turns.new_tensor([s * p for s, p in zip(share, periods, strict=True)]).reshape(-1, 1, 1)
    depth: Tensor = ((turns + whole) * metres).sum(-3)
    return depth


def _search(
    turns: Tensor, periods: list[float], share: list[float], reference: int, limits: tuple[float, float]
) -> Tensor:
    """Return the whole turns (..., F, H, W) of the least residual."""
    period, part = (turns.new_tensor(v).reshape(-1, 1, 1) for v in (periods, share))
    first = math.floor(limits[0] / periods[reference]) - 1
    last = math.ceil(limits[1] / periods[reference])
    best = torch.full_like(turns.select(-3, 0), math.inf)
    whole = torch.zeros_like(turns)
    for n in range(first, last + 1):
        rough = (turns.select(-3, reference) + n) * periods[reference]
        candidate = torch.round(rough.unsqueeze(-3) / period - turns)
        candidate.select(-3, reference).fill_(n)
        depths = (turns + candidate) * period
        depth = (depths * part).sum(-3)
        residual = ((depths - depth.unsqueeze(-3)) / period).square().sum(-3)
        inside = (depth >= limits[0]) & (depth < limits[1])
        residual = torch.where(inside, residual, math.inf)
        # Rounding leaves residuals of 1e-14 that mean nothing; the nearer of two equal candidates stays.
        better = residual < best - 1e-12
        best = torch.where(better, residual, best)
        whole = torch.where(better.unsqueeze(-3), candidate, whole)
    return whole


# -------------------------------------------------------------------------------------------------- heterodyne cameras


def heterodyne_speed(
    beat: Tensor, plain: Tensor, frequencies_hz: Frequencies, *, duration_s: float, beats: int = 1
) -> Tensor:
    """Find the speed of approach by an exposure with a beat and one without.

    If all light goes there and back at one speed v, the phase turns by ``e = 2 v f T / c`` turns in an exposure of T
    seconds. A beat of m turns leaves ``sinc(m + e)`` of the light, no beat ``sinc(e)``, whose ratio
    ``(-1)^m e / (m + e)`` is solved for v. Brightness that changes evenly is in the imaginary part of the ratio,
    which is left out. Detours of light over other things that move are not told apart: fit those with `tt.over_time`.

    Args:
        beat: complex phasors (..., F, H, W) of ``tt.Exposure(duration_s, beat_hz=beats / duration_s)``, or of its taps
            (`tap_phasor`).
        plain: complex phasors of ``tt.Exposure(duration_s)`` around the same middle, of a shape that broadcasts.
        frequencies_hz: modulation frequency of the F phasors, hertz.
        duration_s: exposure T, seconds.
        beats: whole turns m of the beat in an exposure, one and more.

    Returns:
        m/s, (..., F, H, W), positive for what comes nearer, with gradients; NaN without light. Unique for speeds above
        ``- m c / (2 f T)``, at which the light follows the sensor and does not beat: -500 m/s at 60 MHz and 5 ms.

    Raises:
        UnitError: for numbers out of range, and real tensors.
    """
    me = "heterodyne_speed"
    if not (beat.is_complex() and plain.is_complex()):
        raise UnitError(f"{me}: expected complex phasors, got {beat.dtype} and {plain.dtype}. tap_phasor makes some.")
    values, turns = check_frequencies(frequencies_hz, me), check_count(beats, "beats", me)
    seconds = check_number(duration_s, "duration_s", me, open_low=True)
    dark = plain == 0
    # Masked before the division, so that dark pixels have no gradient in place of NaN.
    real = torch.where(dark, torch.nan, (beat / torch.where(dark, 1, plain)).real)
    ratio = -real if turns % 2 else real
    hertz = torch.tensor(values, dtype=ratio.dtype, device=ratio.device)
    if len(values) > 1:
        hertz = hertz[:, None, None]
    return turns * ratio / (1 - ratio) * (SPEED_OF_LIGHT / (2 * seconds)) / hertz
