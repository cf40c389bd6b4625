"""Phase, amplitude and depth from the taps of an indirect time-of-flight camera, and their noise.

With taps ``I_n = (B + A cos(phi - 2 pi n / N)) / N`` the sum ``(2 / N) sum_n I_n exp(2 pi i n / N)`` is the *tap
phasor* ``(A / N) exp(i phi)`` (its phase is minus that of a phasor image, whose exponent is negative). The differences
of pixels with two taps have the same one. Depth is half the way there and back: ``d = c phi / (4 pi f)``, unique up to
``c / (2 f)``.

Gradients: a phase jumps by a turn at the end of its range, so that a loss on it (or on depth) pulls pixels near the
jump the long way round. `phasor_loss` compares phasors and has no jump; `wrapped_difference` gives the short way. A
pixel without modulated light has phase and derivative zero.

A phase is read off the steps X_n of a pixel, so that to first order its noise is ``d phi = sum_n g_n dX_n``: of the
Fourier sum, ``g_n = 2 sin(theta_n - phi) / (N a)`` with the amplitude a, and

    Var phi = sum_n g_n^2 Var X_n = 2 (offset + k read^2) / (N a^2)        (`phase_noise_rad`)

of shot and read noise, with k = 1 tap or, in two-tap pixels, 2 in a step, and the offset of all light, dark electrons
too, that falls into a step: the difference of two taps cancels the offset and keeps its noise. N = 3 single taps swing
about it with ``cos 3 phi``.

Sources: Lange & Seitz (2001); Payne, Dorrington & Cree, "Illumination waveform optimization for time-of-flight range
imaging cameras" (SPIE 2011); Jongenelen et al., "Analysis of errors in ToF range imaging with dual-frequency
modulation" (IEEE TIM 2011); Frank et al., "Theoretical and experimental error analysis of continuous-wave
time-of-flight range cameras" (Opt. Eng. 2009); Gupta et al. (ACM TOG 2018) for the decoding of general codes.
"""

from __future__ import annotations

import functools
import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass
from typing import Any, Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchtransient.checks import MOST_MADE, Numbers, as_number, is_one_of, real_array, shown
from torchtransient.errors import ArgumentError, PhysicsWarning, ShapeError, UnitError
from torchtransient.floating import holds, in_single, product, without_autocast
from torchtransient.sensing.checks import (
    check_broadcast,
    check_count,
    check_dense,
    check_number,
    complex_tensor,
    going_together,
    no_arrays,
    number_or_tensor,
    reals,
    refuse_cut_off,
    tensor_of,
)
from torchtransient.sensing.itof.codes import CorrelationCode, TwoTapCode, in_direction, phase_steps
from torchtransient.sensing.itof.correlation import Frequencies, ItofCalibration, check_frequencies
from torchtransient.tensor_record import TensorRecord
from torchtransient.units import SPEED_OF_LIGHT

Readout = Literal["single", "two_tap", "differential"]
Frames = Tensor | NDArray[Any]

_TURN = 2 * math.pi


def tap_phasor(taps: Frames, num_taps: int, readout: Readout = "single") -> Tensor:
    """(..., C, F, H, W) complex: ``(2 / N) sum_n X_n exp(2 pi i n / N)`` of frames as `steps_of` takes them.

    Steps of one function at equal shifts (sine, square); two steps are a quarter of a turn apart. Equal light gives
    equal results in every readout. Harmonics ``m N +- 1`` alias into the result (wiggling; four steps for two).
    Half precision becomes complex64. Errors as `steps_of`.
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
    """(..., C, F, H, W): a pixel's level without modulation, the mean of its taps, or of ``A + B`` of two.

    Half precision becomes float32. Errors as `steps_of`, and UnitError for differences, in which it has cancelled.
    """
    check_readout(readout, "offset_of")
    if readout == "differential":
        raise UnitError("offset_of: expected frames of taps, got differences, in which the offset has cancelled.")
    if readout == "two_tap":
        return sums_of(taps, num_taps, "offset_of").mean(-3)
    return steps_of(taps, num_taps, readout, "offset_of").mean(-3)


def steps_of(taps: Frames, num_taps: int, readout: Readout, where: str) -> Tensor:
    """(..., C, F, N, H, W): what each of the N = ``num_taps`` phase steps has measured, in float32 or better.

    ``readout``: "single", frames (..., C, F N, H, W) of taps or of exposures of one tap, N >= 3; "two_tap", frames
    (..., C, F 2N, H, W) of A and B in turn, N >= 2, whose difference it is; "differential", frames (..., C, F N, H, W)
    of such differences. Raw frames of whole numbers are taken, as tensors or arrays; a black level has to be off
    "single" frames only if their offset is to mean light. Raises ShapeError for another number of frames, UnitError
    for numbers that are none of frames.
    """
    split = _split(taps, num_taps, readout, where)
    return split[..., 0, :, :] - split[..., 1, :, :] if readout == "two_tap" else split[..., 0, :, :]


def sums_of(taps: Frames, num_taps: int, where: str) -> Tensor:
    """(..., C, F, N, H, W): ``A + B`` of frames of two taps. Errors as `steps_of`."""
    split = _split(taps, num_taps, "two_tap", where)
    return split[..., 0, :, :] + split[..., 1, :, :]


def check_readout(readout: str, where: str) -> None:
    """UnitError for what is no way of reading pixels out."""
    if not is_one_of(readout, get_args(Readout)):
        known = ", ".join(get_args(Readout))
        raise ArgumentError(f"{where}: expected readout to be one of {known}, got {shown(readout)}.")


def _split(taps: Frames, num_taps: int, readout: str, where: str) -> Tensor:
    """(..., C, F, N, taps of a pixel, H, W)."""
    check_readout(readout, where)
    frames = _precise(as_frames(taps, where), where)
    each, least = (2 if readout == "two_tap" else 1), (3 if readout == "single" else 2)
    count = check_count(num_taps, "num_taps", where)
    known = count >= least and frames.ndim >= 4 and frames.shape[-3] > 0 and frames.shape[-3] % (count * each) == 0
    if not known:
        frames_of = f"F x {each} x N" if each > 1 else "F x N"
        raise ShapeError(
            f"{where}: expected {readout} frames (..., C, {frames_of}, H, W) with N = {num_taps} >= {least} phase "
            f"steps, got {tuple(frames.shape)}."
        )
    frequencies = frames.shape[-3] // (count * each)
    return frames.reshape(*frames.shape[:-3], frequencies, count, each, *frames.shape[-2:])


def as_frames(taps: Frames, where: str) -> Tensor:
    """A tensor as it is, an array as one. UnitError for what holds no numbers."""
    if not isinstance(taps, (Tensor, np.ndarray)) and real_array(taps) is None:
        raise UnitError(f"{where}: expected frames of numbers as a tensor or an array, got {shown(taps)}.")
    return taps if isinstance(taps, Tensor) else tensor_of(np.asarray(taps), where)


def _precise(frames: Tensor, where: str) -> Tensor:
    """Frames in float32 or better, in which differences of 16-bit numbers cannot wrap."""
    check_dense(frames, where)
    if frames.is_complex() or frames.dtype == torch.bool:
        raise UnitError(f"{where}: expected frames of real numbers, got {frames.dtype}.")
    if not frames.is_floating_point():
        # float32 holds every 16-bit number and the sum of two.
        return frames.to(torch.float32 if frames.dtype.itemsize <= 2 else torch.float64)
    return frames.float() if frames.dtype in (torch.float16, torch.bfloat16) else frames


def phase_of(phasor: Tensor) -> Tensor:
    """Angle of a complex tensor in [0, 2 pi), in its shape; zero, with derivative zero, where it is zero."""
    phasor = complex_tensor("phase_of", phasor=phasor)
    real, imag = phasor.real, phasor.imag
    # At scale one the squares in the derivative of atan2 cannot underflow; the angle does not depend on it.
    largest = torch.maximum(real.abs(), imag.abs()).detach()
    there = ~(largest <= torch.finfo(real.dtype).tiny)  # NaN is not darkness
    scale = torch.where(there, largest, 1.0)
    angle = torch.atan2(torch.where(there, imag, 0.0) / scale, torch.where(there, real, 1.0) / scale)
    # Not where(..., turn, 0.0): two plain numbers make a float32 of the turn.
    return below_a_turn(angle + _TURN * (angle < 0).to(angle))


def below_a_turn(phase: Tensor) -> Tensor:
    """Phases of up to a turn in [0, 2 pi): the sum of a tiny negative angle and a turn rounds to the turn itself."""
    return torch.where(phase >= _TURN, phase - _TURN, phase)


def amplitude_of(phasor: Tensor) -> Tensor:
    """Modulus of a complex tensor, in its shape; derivative zero where it is zero."""
    phasor = complex_tensor("amplitude_of", phasor=phasor)
    real, imag = phasor.real, phasor.imag
    largest = torch.maximum(real.abs(), imag.abs()).detach()
    there = ~(largest <= torch.finfo(real.dtype).tiny)  # NaN is not darkness
    scale = torch.where(there, largest, 1.0)
    square = (real / scale).square() + (imag / scale).square()
    return torch.where(there, torch.where(there, square, 1.0).sqrt() * scale, 0.0)


@in_single
def depth_of_phase(phase: Tensor, frequency_hz: float) -> Tensor:
    """``c phase / (4 pi f)`` in metres, in the shape of ``phase``."""
    (phase,) = reals("depth_of_phase", phase=phase)
    if len(values := check_frequencies(frequency_hz, "depth_of_phase")) != 1:
        raise UnitError(f"depth_of_phase: expected frequency_hz as one number, got {shown(frequency_hz)}.")
    (f,) = values
    return phase * (SPEED_OF_LIGHT / (2 * _TURN * f))


def unambiguous_range_m(frequencies_hz: Frequencies) -> float:
    """``c / (2 gcd)``: the depth after which all phases repeat. UnitError for frequencies that are not whole hertz."""
    values = check_frequencies(frequencies_hz, "unambiguous_range_m")
    if any(f != int(f) for f in values):
        raise UnitError(
            f"unambiguous_range_m: expected whole numbers of hertz, which have a common divisor, got {values}. Say "
            "the largest depth instead."
        )
    return SPEED_OF_LIGHT / (2 * math.gcd(*(int(f) for f in values)))


@in_single
def wrapped_difference(a: Tensor, b: Tensor) -> Tensor:
    """``a - b`` in radians, the short way round: in [-pi, pi), derivative one everywhere. Shapes broadcast."""
    a, b = going_together("wrapped_difference", a=a, b=b)
    difference = a - b
    turns = torch.floor((difference + math.pi) / _TURN)
    return difference - _TURN * turns


def phasor_loss(phasor: Tensor, target: Tensor, weight: Tensor | None = None) -> Tensor:
    """``|z - target|^2`` elementwise, real, or with the given weights: the loss of phases that knows no branch cut.

    Scale both to amplitude one (``z / amplitude``) for a loss on the phase alone, ``2 (1 - cos(difference))``.
    """
    phasor, target = complex_tensor("phasor_loss", phasor=phasor), complex_tensor("phasor_loss", target=target)
    check_broadcast("phasor_loss", phasor=phasor, target=target)
    difference = phasor - target
    loss = difference.real.square() + difference.imag.square()
    if weight is None:
        return loss
    weight = number_or_tensor(weight, "weight", "phasor_loss")
    if isinstance(weight, Tensor):
        check_broadcast("phasor_loss", phasor=phasor, weight=weight)
    return loss * weight


def shares_of_depth(frequencies_hz: Sequence[float], weights: Sequence[float] | None = None) -> list[float]:
    """How much the depth of each frequency counts in that of all, by least squares: ``w f^2`` over their sum."""
    given = [1.0] * len(frequencies_hz) if weights is None else weights
    # A phase of frequency f measures depth with the weight w / period^2.
    parts = [w * f**2 for w, f in zip(given, frequencies_hz, strict=True)]
    return [part / sum(parts) for part in parts]


@in_single
def unwrap_depth(
    phase: Tensor,
    frequencies_hz: Frequencies,
    *,
    max_depth_m: float | None = None,
    min_depth_m: float = 0.0,
    weights: Numbers | None = None,
) -> Tensor:
    """Depth (..., C, H, W) from phases (..., C, F, H, W) of F frequencies: the lattice of wraps, searched.

    For every number of turns of the highest frequency within [min_depth_m, max_depth_m] the other frequencies take
    their nearest number of turns, and the weighted least-squares depth with the least residual wins. ``max_depth_m``:
    None for one range after which everything repeats. ``weights``: one over the variance of each *phase*; equal by
    default. With noise around zero depth give a ``min_depth_m`` a little below zero.

    The whole turns are detached; the gradient is that of the least-squares depth in the phases. Memory does not grow
    with the number of candidates. Raises ShapeError for a wrong F, UnitError for an empty range, and for one over which
    the phases repeat.
    """
    me = "unwrap_depth"
    values = check_frequencies(frequencies_hz, me)
    (phase,) = reals(me, phase=phase)
    if phase.ndim < 4 or phase.shape[-3] != len(values):
        raise ShapeError(f"{me}: expected phases (..., C, {len(values)}, H, W), got {tuple(phase.shape)}.")
    least, most = check_depths(min_depth_m, max_depth_m, me)
    min_depth_m, longest = least, least + unambiguous_range_m(values) if most is None else most
    if not (math.isfinite(longest) and longest > min_depth_m):
        raise UnitError(f"{me}: expected min_depth_m < max_depth_m in metres, got {min_depth_m!r} and {longest!r}.")
    # a tenth more leaves room for noise at both ends
    if longest - min_depth_m > 1.1 * unambiguous_range_m(values):
        raise UnitError(
            f"{me}: expected max_depth_m - min_depth_m of at most {unambiguous_range_m(values):.4g} m, after which the "
            f"phases of {values} Hz repeat, got {longest - min_depth_m:.4g} m. Metres? Or add a frequency."
        )
    refuse_cut_off(weights, "weights", me)
    given = np.ones(len(values)) if weights is None else real_array(weights)
    if given is None or given.shape != (len(values),) or not (given > 0).all():
        raise UnitError(f"{me}: expected {len(values)} positive weights, got {shown(weights)}.")
    weight = given.tolist()

    turns = phase / _TURN
    periods = [SPEED_OF_LIGHT / (2 * f) for f in values]  # metres per turn
    share = shares_of_depth(values, weight)
    reference = min(range(len(values)), key=lambda i: periods[i])
    with torch.no_grad():
        _, whole = _search(turns, periods, share, weight, reference, (float(min_depth_m), longest))
    metres = turns.new_tensor([s * p for s, p in zip(share, periods, strict=True)]).reshape(-1, 1, 1)
    depth: Tensor = ((turns + whole) * metres).sum(-3)
    return depth


def check_depths(min_depth_m: Any, max_depth_m: Any, where: str) -> tuple[float, float | None]:
    """The ends of a range of depths, the far one of which may be None. UnitError for no numbers."""
    least, most = as_number(min_depth_m), None if max_depth_m is None else as_number(max_depth_m)
    if least is None or (most is None and max_depth_m is not None):
        got = f"{shown(min_depth_m)} and {shown(max_depth_m)}"
        raise UnitError(f"{where}: expected min_depth_m and max_depth_m as numbers of metres, got {got}.")
    return least, most


def _search(
    turns: Tensor,
    periods: list[float],
    share: list[float],
    weight: list[float],
    reference: int,
    limits: tuple[float, float],
) -> tuple[Tensor, Tensor]:
    """Least residual and the whole turns (..., F, H, W) that give it."""
    shape = (-1, 1, 1)
    period, part, importance = (turns.new_tensor(v).reshape(shape) for v in (periods, share, weight))
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
        residual = (((depths - depth.unsqueeze(-3)) / period).square() * importance).sum(-3)
        inside = (depth >= limits[0]) & (depth < limits[1])
        residual = torch.where(inside, residual, math.inf)
        # Rounding leaves residuals of 1e-14 that mean nothing; the nearer of two equal candidates stays.
        better = residual < best - 1e-12
        best = torch.where(better, residual, best)
        whole = torch.where(better.unsqueeze(-3), candidate, whole)
    return best, whole


# ------------------------------------------------------------------------------------------------------------- readings


_SMALL_PHASE = 0.2  # radians of noise, up to which a phase is right to first order


@dataclass(frozen=True, eq=False, repr=False)
class ItofReading(TensorRecord):
    """``phase`` (..., C, F, H, W) radians in [0, 2 pi), without what the calibration knows; ``amplitude`` and
    ``offset``, of one exposure, in the units of the frames, (..., C, F, H, W), the offset None for differences;
    ``depth_std_m`` the standard deviation of depth, ``depth_m`` the depth, both (..., C, H, W) in metres.

    ``depth_std_m`` is first order in the noise, averaged over it where a ``code`` has corners (2 N frames are decoded
    for it), infinite without modulated light, and None where nobody can know it: see `ItofNoise`. It is NaN in pixels
    that no light can give (more amplitude than twice the offset, by more than the noise): differences read as taps,
    an ``offset_e`` that is too small. It holds no wrong number of turns, no wiggling and no second path.
    """

    phase: Tensor
    amplitude: Tensor
    _: KW_ONLY
    offset: Tensor | None
    depth_std_m: Tensor | None
    depth_m: Tensor

    def __getattr__(self, name: str) -> Any:
        instead = " What it stood for: depth_std_m (metres), amplitude, or contrast (amplitude / offset)."
        hint = instead * (name == "confidence")
        raise AttributeError(f"'{type(self).__name__}' object has no attribute '{name}'.{hint}")

    @property
    def contrast(self) -> Tensor | None:
        """``amplitude / offset``, in the shape of both; zero without light, None for differences."""
        if self.offset is None:
            return None
        lit = ~(self.offset <= 0)
        return torch.where(lit, self.amplitude, 0.0) / torch.where(lit, self.offset, 1.0)


@dataclass(frozen=True, eq=False)
class ItofNoise:
    """What is known of the noise of frames, for `ItofReading.depth_std_m`.

    ``electrons_per_unit``: of the numbers of the frames. None: frames of floating numbers are electrons, as
    `PixelElectronics` gives them; whole numbers are those of a converter and ask for it (UnitError in `read_itof`).
    ``read_noise_e``: rms electrons of one tap in one exposure, converter included. Shot noise is that of the taps
    themselves; differences know their light no longer: ``offset_e``, mean electrons of A + B in *one* exposure of the N
    (all light, background and the dark electrons of both taps), a number above 0 or (..., C, F, H, W), of an intensity
    picture for instance. ``std_e`` replaces all of it: rms electrons of what a phase step has measured, a tap
    ("single") or a difference A - B ("two_tap" and "differential"), a number or (..., C, F, H, W). Arrays are taken as
    tensors. Raises UnitError.
    """

    _: KW_ONLY
    electrons_per_unit: float | None = None
    read_noise_e: float = 0.0
    offset_e: float | Tensor | None = None
    std_e: float | Tensor | None = None

    def __post_init__(self) -> None:
        me = "ItofNoise"
        if self.electrons_per_unit is not None:
            gain = check_number(self.electrons_per_unit, "electrons_per_unit", me, open_low=True)
            object.__setattr__(self, "electrons_per_unit", gain)
        object.__setattr__(self, "read_noise_e", check_number(self.read_noise_e, "read_noise_e", me))
        for name in ("offset_e", "std_e"):
            given = no_arrays(getattr(self, name), me)
            if given is not None and not isinstance(given, Tensor):
                # no light at all has no phase, and no noise no deviation
                given = check_number(given, name, me, open_low=True)
            elif given is not None and not holds(reals(me, None, **{name: given})[0] >= 0):
                raise UnitError(f"{me}: expected every {name} to be a number >= 0, got {shown(given)}.")
            object.__setattr__(self, name, given)


@in_single
def phase_noise_rad(
    amplitude: Tensor, offset: Tensor, num_taps: int, *, read_noise_e: float = 0.0, readout: Readout = "single"
) -> Tensor:
    """Standard deviation of the phase from amplitude and offset of an exposure, in electrons, shot and read noise.

    ``sqrt(2 (offset + k read^2) / N) / amplitude`` with k = 1 tap in a step, 2 for "two_tap" and "differential" (A and
    B are read apart), which is ``sqrt(2 B) / A`` of the totals without read noise: first order in the noise, right for
    deviations below about 0.2 rad. Dark electrons are part of the offset. Infinite at amplitude zero. With three
    single taps the variance also swings with the phase, ``(2 B - A cos 3 phi) / A^2``; this is its root mean square.
    """
    read = check_number(read_noise_e, "read_noise_e", "phase_noise_rad")
    amplitude, offset = going_together("phase_noise_rad", amplitude=amplitude, offset=offset)
    check_readout(readout, "phase_noise_rad")
    power = 2 * (offset + (1 if readout == "single" else 2) * read**2)
    return (power / check_count(num_taps, "num_taps", "phase_noise_rad")).sqrt() / amplitude


def decode_code(taps: Frames, code: CorrelationCode, *, num_phases: int = 1024, readout: Readout = "single") -> Tensor:
    """Phase (..., C, F, H, W) in [0, 2 pi) of frames of *any* code, by the closest shape of the N steps.

    The steps at length one, single taps without their mean, are compared with the code at ``num_phases`` phases
    (normalised cross-correlation, Gupta et al. 2018); the best of them, detached, is refined by one Gauss-Newton step
    on the code's slope, which carries the gradient. Needs no model of amplitude or background. A dark or flat pixel
    has phase zero. ``code``: that of one tap, or its `TwoTapCode`. Errors as `itof_depth.steps_of`; UnitError for a
    `TwoTapCode` of single taps.
    """
    code = one_tap(code, readout, me := "decode_code")
    phases = check_count(num_phases, "num_phases", me, most=MOST_MADE)
    return _by_shape(steps_of(taps, code.num_taps, readout, me), code, phases, readout)[0]


@without_autocast
def _by_shape(steps: Tensor, code: CorrelationCode, num_phases: int, readout: str) -> tuple[Tensor, Tensor]:
    """Phases (..., F, H, W) of steps (..., F, N, H, W), and their slopes ``d phi / d X_n`` (..., F, N, H, W)."""
    split = steps.movedim(-3, -1)
    # Differences have no unmodulated light in them, and two have nothing to spare.
    single = readout == "single"
    centred = split - split.mean(-1, keepdim=True) if single else split
    length = torch.linalg.vector_norm(centred, dim=-1, keepdim=True)
    faint = (1e-6 if single else 0.0) * split.abs().amax(-1, keepdim=True)
    there = ~(length <= faint)
    unit = torch.where(there, centred, 0.0) / torch.where(there, length, 1.0)
    x = torch.arange(num_phases, dtype=torch.float64) / num_phases
    table = _unit_shapes(code, x, single).to(unit)
    best = _best_match(unit, table)
    step = 0.5 / num_phases
    slope = ((_unit_shapes(code, x + step, single) - _unit_shapes(code, x - step, single)) / (2 * step)).to(unit)
    here, direction = table[best], slope[best]
    # Along the curve of shapes, the distance to the measured one in units of the curve's speed.
    speed = direction.square().sum(-1).clamp_min(1e-12)
    shift = ((unit - here) * direction).sum(-1) / speed
    turns = x.to(unit)[best] + shift.clamp(-2 / num_phases, 2 / num_phases)
    phase = below_a_turn((turns - torch.floor(turns)) * _TURN)
    slopes = _TURN * direction / (torch.where(there, length, 1.0) * speed.unsqueeze(-1))
    slopes = torch.where(there, slopes, math.inf)
    return torch.where(there.squeeze(-1), phase, 0.0), slopes.movedim(-1, -3)


def _unit_shapes(code: CorrelationCode, turns: Tensor, centred: bool) -> Tensor:
    """(P, N): the steps of a code at the given phases at length one, without their mean if `centred`."""
    shape = code.evaluate(turns).T
    shape = shape - shape.mean(-1, keepdim=True) if centred else shape
    unit: Tensor = shape / torch.linalg.vector_norm(shape, dim=-1, keepdim=True).clamp_min(1e-12)
    return unit


def _best_match(unit: Tensor, table: Tensor, chunk: int = 1 << 14) -> Tensor:
    """Index of the row of ``table`` (P, N) with the largest product for each of (..., N); memory chunk x P."""
    if unit.numel() == 0:
        return torch.zeros(unit.shape[:-1], dtype=torch.int64, device=unit.device)
    flat = unit.reshape(-1, unit.shape[-1])
    found = [(flat[i : i + chunk] @ table.T).argmax(-1) for i in range(0, flat.shape[0], chunk)]
    return torch.cat(found).reshape(unit.shape[:-1])


def one_tap(code: CorrelationCode, readout: str, where: str) -> CorrelationCode:
    """The code of one tap that frames of this readout are decoded by. UnitError for what is none."""
    if not isinstance(code, CorrelationCode):
        raise UnitError(f"{where}: expected a code such as hamiltonian_code(3), got {shown(code)}.")
    if isinstance(code, TwoTapCode) and readout == "single":
        raise ArgumentError(f"{where}: expected readout='two_tap' or 'differential' for a TwoTapCode, got 'single'.")
    return code.code if isinstance(code, TwoTapCode) else code


def read_itof(
    taps: Frames,
    frequencies_hz: Frequencies,
    num_taps: int,
    *,
    readout: Readout = "single",
    code: CorrelationCode | None = None,
    calibration: ItofCalibration | None = None,
    noise: ItofNoise | None = None,
    max_depth_m: float | None = None,
    min_depth_m: float = 0.0,
) -> ItofReading:
    """Everything a camera reports, from its frames. See `ItofReading` for shapes and units.

    ``taps`` and ``readout``: frames (..., C, F N, H, W) of taps, (..., C, F 2N, H, W) of pixels of two taps, or
    (..., C, F N, H, W) of their differences, with N = ``num_taps`` phase steps; raw whole numbers as tensors or
    arrays too. See `itof_depth.steps_of`. ``code``: decode by its shape (`decode_code`) instead of by the Fourier sum:
    needed for Hamiltonian and measured codes, removes the wiggling of square ones. ``calibration``: phase offset,
    direction of the steps and maps of pixels, which are taken off. ``noise``: see `ItofNoise`; by default shot noise
    of frames in electrons. One frequency: depth within ``c / (2 f)``; several: unwrapped, with equal weights.

    Raises ShapeError for other frames or maps, UnitError for unusable values.
    """
    me = "read_itof"
    values = check_frequencies(frequencies_hz, me)
    taps = as_frames(taps, me)
    steps = steps_of(taps, num_taps, readout, me)
    if steps.shape[-4] != len(values):
        raise ShapeError(
            f"{me}: expected {readout} frames of {len(values)} frequencies and {num_taps} phase steps, got "
            f"{steps.shape[-4]} frequencies in {tuple(taps.shape)}."
        )
    known = calibration or ItofCalibration()
    phasor = tap_phasor(taps, num_taps, readout)
    if code is None:
        phase, slopes = phase_of(phasor), _slopes(phasor, num_taps)
        phase = phase if known.direction == 1 else -phase
    else:
        gates = in_direction(one_tap(code, readout, me), known.direction)
        if gates.num_taps != num_taps:
            raise ShapeError(f"{me}: expected num_taps = {gates.num_taps} of the code, got {num_taps}.")
        phase, slopes = _by_shape(steps, gates, 1024, readout)
    offset = None if readout == "differential" else offset_of(taps, num_taps, readout)
    at_corners = None if code is None else functools.partial(_at_corners, steps, phase, gates, readout)
    phase = _without_offsets(phase, known, values)
    std = _depth_std(taps, steps, slopes, values, readout, noise, at_corners)
    if len(values) == 1:
        check_depths(min_depth_m, max_depth_m, me)
        depth = depth_of_phase(phase, values[0]).squeeze(-3)
    else:
        depth = unwrap_depth(phase, values, max_depth_m=max_depth_m, min_depth_m=min_depth_m)
    return ItofReading(phase, amplitude_of(phasor), offset=offset, depth_std_m=std, depth_m=depth)


def _without_offsets(phase: Tensor, calibration: ItofCalibration, frequencies: tuple[float, ...]) -> Tensor:
    """Phases (..., F, H, W) in [0, 2 pi) less what the calibration knows."""
    added = calibration.phases_rad(frequencies)
    if tuple(added.shape[1:]) not in ((1, 1), tuple(phase.shape[-2:])):
        raise ShapeError(
            f"read_itof: expected frames of {tuple(added.shape[1:])} pixels, as the maps of the calibration, got "
            f"{tuple(phase.shape[-2:])}."
        )
    # In [0, 2 pi) before the dtype of the frames rounds it.
    phase = phase - (added % _TURN).to(phase)
    return below_a_turn(phase - _TURN * torch.floor(phase / _TURN))


def _slopes(phasor: Tensor, num_taps: int) -> Tensor:
    """(..., F, N, H, W): ``d phi / d X_n = 2 sin(theta_n - phi) / (N a)`` of the Fourier sum; infinite in darkness."""
    angles = (_TURN * phase_steps(num_taps)).reshape(-1, 1, 1).to(phasor.real)
    real, imag = phasor.real.unsqueeze(-3), phasor.imag.unsqueeze(-3)
    amplitude = amplitude_of(phasor).unsqueeze(-3)
    there = ~(amplitude <= 0)
    scale = torch.where(there, amplitude, 1.0)
    # Twice over the amplitude: its square would underflow.
    slopes = (2 / num_taps) * (angles.sin() * (real / scale) - angles.cos() * (imag / scale)) / scale
    return torch.where(there, slopes, math.inf)


def _at_corners(
    steps: Tensor, phase: Tensor, code: CorrelationCode, readout: str, first: Tensor, variance: Tensor
) -> Tensor:
    """Variance of phases decoded by shape, where noise is small beside the phase: that of 2 N frames around.

    At a corner of a code the slope has two values, and frames on its inner side jump from one side to the other: the
    slope is averaged over the noise. sqrt(N) deviations in each step have the covariance of all of them together.
    """
    # sqrt has no slope at 0
    far = torch.where(variance > 0, (steps.shape[-3] * torch.where(variance > 0, variance, 1.0)).sqrt(), 0.0)
    found = []
    for row in torch.eye(steps.shape[-3], dtype=steps.dtype, device=steps.device):
        away = far * row.view(-1, 1, 1)
        for moved in (steps + away, steps - away):
            found.append(wrapped_difference(_by_shape(moved, code, 1024, readout)[0], phase))
    return torch.where(first < _SMALL_PHASE**2, torch.stack(found).var(0, correction=0), first)


def _depth_std(
    taps: Tensor,
    steps: Tensor,
    slopes: Tensor,
    values: tuple[float, ...],
    readout: str,
    noise: ItofNoise | None,
    at_corners: Callable[[Tensor, Tensor], Tensor] | None,
) -> Tensor | None:
    """(..., C, H, W) metres, or None where the noise cannot be known."""
    raw = not taps.is_floating_point()
    if noise is None and raw:
        return None  # nobody said how many electrons a number of the converter is
    known = noise or ItofNoise()
    if raw and known.electrons_per_unit is None:
        raise UnitError(
            f"read_itof: expected ItofNoise(electrons_per_unit=...) for frames of whole numbers ({taps.dtype}), which "
            "are those of a converter, got none. The gain of the camera in electrons per number; 1.0 if they are "
            "electrons."
        )
    gain = known.electrons_per_unit or 1.0
    offset: Tensor | None = None  # electrons of all light in a step; None where the deviations were given
    if readout == "differential" and known.offset_e is not None:
        offset = _of_frequencies(known.offset_e, steps)
    elif readout == "two_tap":
        offset = sums_of(taps, steps.shape[-3], "read_itof").clamp_min(0) * gain
    elif readout == "single":
        offset = steps.clamp_min(0) * gain
    read = (1 if readout == "single" else 2) * known.read_noise_e**2
    if known.std_e is not None:
        variance = _of_frequencies(known.std_e, steps).square()
    elif offset is None:
        return None
    else:
        variance = offset + read
    # The slopes of dark pixels are infinite: neither a product with zero nor a gradient may come of them.
    there = ~torch.isinf(slopes)
    power = ((torch.where(there, slopes, 0.0) / gain).square() * variance).sum(-3)
    if at_corners is not None:
        power = at_corners(power, variance / gain**2)
    metres = [SPEED_OF_LIGHT / (2 * _TURN * f) * s for f, s in zip(values, shares_of_depth(values), strict=True)]
    factor = torch.tensor(metres, dtype=torch.float64).reshape(-1, 1, 1).to(power)
    total = (power * factor.square()).sum(-3)
    std = torch.where(total > 0, torch.where(total > 0, total, 1.0).sqrt(), total)
    std = torch.where(there.all(-3).all(-3), std, math.inf)
    if offset is None:
        return std
    rounding = (gain if raw else 0.0) ** 2 / 12
    if readout == "single":
        offset = steps * gain  # signs and all
    elif readout == "two_tap":
        offset = sums_of(taps, steps.shape[-3], "read_itof") * gain
    lit = _can_be(steps * gain, offset, readout == "differential", read + rounding)
    if lit.numel() and not holds(lit.double().mean() >= 0.5):
        warnings.warn(
            f"read_itof: most of these {readout} frames have more amplitude than their light can have, and no "
            "depth_std_m (NaN). Differences of two taps are readout='differential', with offset_e of all their light; "
            "frames with read noise say so in ItofNoise.",
            PhysicsWarning,
            stacklevel=3,
        )
    return torch.where(lit.all(-3), std, math.nan)


def _can_be(steps: Tensor, offset: Tensor, from_picture: bool, read: float) -> Tensor:
    """(..., F, H, W) whether light can have given steps (..., F, N, H, W) in electrons: ``a <= 2 offset``.

    Of numbers X_n >= 0 the sum ``a = (2 / N) |sum_n X_n exp(2 pi i n / N)|`` is at most twice their mean, and the
    differences of two taps lie within their sums. What is above that by six deviations is no light.
    """
    number = steps.shape[-3]
    angles = (_TURN * phase_steps(number)).reshape(-1, 1, 1).to(steps)
    size = (2 / number) * torch.hypot((steps * angles.cos()).sum(-3), (steps * angles.sin()).sum(-3))
    mean = offset.mean(-3)
    # read noise of both sides, and the shot noise of differences beside a mean that does not know it
    spread = (6 / number * (read + (mean if from_picture else 0.0))) ** 0.5
    largest = steps.abs().amax(-3)
    return ~(size > 2 * mean + 6 * spread + 1e-5 * largest)


def _of_frequencies(given: float | Tensor, steps: Tensor) -> Tensor:
    """(..., F, 1, H, W) of a number or of (..., C, F, H, W). Raises ShapeError for other sizes."""
    like = steps.select(-3, 0)
    value = given.to(like) if isinstance(given, Tensor) else like.new_tensor(given)
    try:
        return value.broadcast_to(like.shape).unsqueeze(-3)
    except RuntimeError as error:
        got = f"expected a number or what broadcasts to {tuple(like.shape)}, got {tuple(value.shape)}"
        raise ShapeError(f"ItofNoise: {got}.") from error
