"""Readings of indirect time-of-flight cameras from their frames: phase, amplitude, depth, and its standard deviation.

A phase is read off the steps X_n of a pixel, so that to first order its noise is ``d phi = sum_n g_n dX_n``: of the
Fourier sum, ``g_n = 2 sin(theta_n - phi) / (N a)`` with the amplitude a, and

    Var phi = sum_n g_n^2 Var X_n = 2 (offset + k read^2) / (N a^2)        (`phase_noise_rad`)

of shot and read noise, with k = 1 tap or, in two-tap pixels, 2 in a step, and the offset of all light, dark electrons
too, that falls into a step: the difference of two taps cancels the offset and keeps its noise. N = 3 single taps swing
about it with ``cos 3 phi``.

Sources: Lange & Seitz (2001); Frank et al., "Theoretical and experimental error analysis of continuous-wave
time-of-flight range cameras" (Opt. Eng. 2009); Gupta et al. (ACM TOG 2018) for the decoding of general codes.
"""

from __future__ import annotations

import functools
import math
import warnings
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass

import torch
from torch import Tensor

from torchtransient.checks import shown
from torchtransient.errors import ArgumentError, PhysicsWarning, ShapeError, UnitError
from torchtransient.floating import holds, in_single, without_autocast
from torchtransient.sensing.checks import check_choice, check_count, check_number, no_arrays
from torchtransient.sensing.itof.codes import CorrelationCode, TwoTapCode, in_direction, phase_steps
from torchtransient.sensing.itof.correlation import Frequencies, ItofCalibration, check_frequencies, fitting_pixels
from torchtransient.sensing.itof.depth import (
    Frames,
    Readout,
    amplitude_of,
    as_frames,
    below_a_turn,
    depth_of_phase,
    offset_of,
    phase_of,
    shares_of_depth,
    steps_of,
    sums_of,
    tap_phasor,
    unwrap_depth,
    wrapped_difference,
)
from torchtransient.tensor_record import TensorRecord
from torchtransient.units import SPEED_OF_LIGHT

_TURN = 2 * math.pi
_PHASES = 1024  # of the table that shapes are compared with
_CHUNK = 1 << 14  # pixels that are compared at once
_SMALL_PHASE = 0.2  # radians of noise, up to which a phase is right to first order


@dataclass(frozen=True, eq=False, repr=False)
class ItofReading(TensorRecord):
    """Phase, amplitude and depth that a camera reports of its frames.

    The standard deviation of depth is first order in the noise, averaged over it where a ``code`` has corners (2 N
    frames are decoded for it). It does not cover a wrong number of turns, wiggling or a second path. It is NaN in
    pixels that no light can give (more amplitude than twice the offset, by more than the noise): differences read as
    taps, an ``offset_e`` that is too small.

    Attributes:
        phase: (..., C, F, H, W) radians in [0, 2 pi), without what the calibration knows.
        amplitude: amplitude of one exposure, in the units of the frames, (..., C, F, H, W).
        offset: offset of one exposure, in the same units and shape; None for differences.
        depth_std_m: standard deviation of depth, (..., C, H, W) metres; infinite without modulated light, None if
            unknown, see `ItofNoise`.
        depth_m: depth, (..., C, H, W) metres.
    """

    phase: Tensor
    amplitude: Tensor
    _: KW_ONLY
    offset: Tensor | None
    depth_std_m: Tensor | None
    depth_m: Tensor

    @property
    def contrast(self) -> Tensor | None:
        """Amplitude over offset, in the shape of both; zero without light, None for differences."""
        if self.offset is None:
            return None
        lit = ~(self.offset <= 0)
        return torch.where(lit, self.amplitude, 0.0) / torch.where(lit, self.offset, 1.0)


@dataclass(frozen=True, eq=False)
class ItofNoise:
    """Noise of frames, for `ItofReading.depth_std_m`.

    Shot noise is that of the taps themselves; differences no longer contain the total light, and need ``offset_e``.
    Arrays are taken as tensors.

    Attributes:
        electrons_per_unit: electrons for each unit of the frames. None: frames of floating numbers are electrons, as
            `PixelElectronics` gives them; whole numbers are those of a converter and need this factor (UnitError in
            `read_itof` without it).
        read_noise_e: rms read noise in electrons of one tap in one exposure, converter included.
        offset_e: mean electrons of A + B in *one* exposure of the N (all light, background and the dark electrons of
            both taps), a number above 0 or (..., C, F, H, W), of an intensity picture for instance.
        std_e: rms noise in electrons of a measured phase step, in place of all of the above: a tap ("single") or a
            difference A - B ("two_tap" and "differential"), a number or (..., C, F, H, W).

    Raises:
        UnitError: for numbers out of range.
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
            given = no_arrays(getattr(self, name))
            if isinstance(given, Tensor):
                if not holds(given >= 0):
                    raise UnitError(f"{me}: expected every {name} to be a number >= 0, got {shown(given)}.")
            elif given is not None:
                # no light at all has no phase, and no noise no deviation
                given = check_number(given, name, me, open_low=True)
            object.__setattr__(self, name, given)


@in_single
def phase_noise_rad(
    amplitude: Tensor | float,
    offset: Tensor | float,
    num_taps: int,
    *,
    read_noise_e: float = 0.0,
    readout: Readout = "single",
) -> Tensor:
    """Standard deviation of the phase from amplitude and offset of an exposure, by shot and read noise.

    ``sqrt(2 (offset + k read^2) / N) / amplitude`` with k = 1 tap in a step, 2 for "two_tap" and "differential" (A and
    B are read apart), which is ``sqrt(2 B) / A`` of the totals without read noise: first order in the noise, right for
    deviations below about 0.2 rad. With three single taps the variance also swings with the phase, ``(2 B - A cos 3
    phi) / A^2``; this is its root mean square.

    Args:
        amplitude: electrons of an exposure, a number or any shape; infinite deviation at zero.
        offset: electrons of an exposure, dark ones too; shapes broadcast.
        num_taps: number of phase steps N.
        read_noise_e: rms read noise in electrons of one tap in one exposure.
        readout: "single", "two_tap" or "differential".

    Returns:
        Radians.
    """
    read = check_number(read_noise_e, "read_noise_e", "phase_noise_rad")
    check_choice(readout, Readout, "readout", "phase_noise_rad")
    power = 2 * (torch.as_tensor(offset) + (1 if readout == "single" else 2) * read**2)
    return (power / check_count(num_taps, "num_taps", "phase_noise_rad")).sqrt() / amplitude


def decode_code(taps: Frames, code: CorrelationCode, *, readout: Readout = "single") -> Tensor:
    """Decode frames of *any* code by the closest shape of the N steps.

    The steps at length one, single taps without their mean, are compared with the code at 1024 phases
    (normalised cross-correlation, Gupta et al. 2018); the best of them, detached, is refined by one Gauss-Newton step
    on the code's slope, which carries the gradient. Needs no model of amplitude or background. A dark or flat pixel has
    phase zero.

    Args:
        taps: frames of a camera, see `read_itof`.
        code: code of one tap, or its `TwoTapCode`.
        readout: "single", "two_tap" or "differential".

    Returns:
        Phase (..., C, F, H, W) in [0, 2 pi).

    Raises:
        ShapeError: for another number of frames.
        ArgumentError: for a `TwoTapCode` of single taps.
    """
    code = one_tap(code, readout, me := "decode_code")
    return _by_shape(steps_of(taps, code.num_taps, readout, me), code, readout)[0]


@without_autocast
def _by_shape(steps: Tensor, code: CorrelationCode, readout: str) -> tuple[Tensor, Tensor]:
    """Return phases (..., F, H, W) of steps (..., F, N, H, W), and their slopes ``d phi / d X_n`` (..., F, N, H, W)."""
    split = steps.movedim(-3, -1)
    # Differences have no unmodulated light in them, and two have nothing to spare.
    single = readout == "single"
    centred = split - split.mean(-1, keepdim=True) if single else split
    length = torch.linalg.vector_norm(centred, dim=-1, keepdim=True)
    faint = (1e-6 if single else 0.0) * split.abs().amax(-1, keepdim=True)
    there = ~(length <= faint)
    unit = torch.where(there, centred, 0.0) / torch.where(there, length, 1.0)
    x = torch.arange(_PHASES, dtype=torch.float64) / _PHASES
    table = _unit_shapes(code, x, single).to(unit)
    best = _best_match(unit, table)
    step = 0.5 / _PHASES
    slope = ((_unit_shapes(code, x + step, single) - _unit_shapes(code, x - step, single)) / (2 * step)).to(unit)
    here, direction = table[best], slope[best]
    # Along the curve of shapes, the distance to the measured one in units of the curve's speed.
    speed = direction.square().sum(-1).clamp_min(1e-12)
    shift = ((unit - here) * direction).sum(-1) / speed
    turns = x.to(unit)[best] + shift.clamp(-2 / _PHASES, 2 / _PHASES)
    phase = below_a_turn((turns - torch.floor(turns)) * _TURN)
    slopes = _TURN * direction / (torch.where(there, length, 1.0) * speed.unsqueeze(-1))
    slopes = torch.where(there, slopes, math.inf)
    return torch.where(there.squeeze(-1), phase, 0.0), slopes.movedim(-1, -3)


def _unit_shapes(code: CorrelationCode, turns: Tensor, centred: bool) -> Tensor:
    """Steps of a code at the given phases at length one, (P, N), without their mean if `centred`."""
    shape = code.evaluate(turns).T
    shape = shape - shape.mean(-1, keepdim=True) if centred else shape
    unit: Tensor = shape / torch.linalg.vector_norm(shape, dim=-1, keepdim=True).clamp_min(1e-12)
    return unit


def _best_match(unit: Tensor, table: Tensor) -> Tensor:
    """Index of the row of ``table`` (P, N) with the largest product for each of (..., N)."""
    flat = unit.reshape(-1, unit.shape[-1])
    found = [(part @ table.T).argmax(-1) for part in flat.split(_CHUNK)]  # type: ignore[no-untyped-call]
    return torch.cat(found).reshape(unit.shape[:-1])


def one_tap(code: CorrelationCode, readout: str, where: str) -> CorrelationCode:
    """Return the code of one tap that frames of a readout are decoded by.

    Args:
        code: a code.
        readout: name of the readout.
        where: name of the caller, for errors.

    Raises:
        ArgumentError: for a `TwoTapCode` of single taps.
    """
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
    """Read phase, amplitude, depth and its deviation from the frames of a camera.

    Args:
        taps: frames (..., C, F N, H, W) of taps or of exposures of one tap, (..., C, F 2N, H, W) of pixels of two taps,
            A and B in turn, or (..., C, F N, H, W) of their differences; raw whole numbers as tensors or arrays too.
        frequencies_hz: F modulation frequencies in hertz. Depth of one is within ``c / (2 f)``; of several unwrapped,
            with equal weights.
        num_taps: number of phase steps N.
        readout: "single", "two_tap" or "differential".
        code: decode by its shape (`decode_code`) instead of by the Fourier sum: needed for Hamiltonian and measured
            codes, removes the wiggling of square ones.
        calibration: phase offset, direction of the steps and maps of pixels, which are taken off.
        noise: noise of the frames, by default shot noise of frames in electrons.
        max_depth_m: largest depth of several frequencies in metres.
        min_depth_m: least depth in metres.

    Returns:
        The reading.

    Raises:
        ShapeError: for other frames or maps.
        UnitError: for numbers out of range.
    """
    me = "read_itof"
    values = check_frequencies(frequencies_hz, me)
    taps = as_frames(taps)
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
        phase, slopes = _by_shape(steps, gates, readout)
    offset = None if readout == "differential" else offset_of(taps, num_taps, readout)
    at_corners = None if code is None else functools.partial(_at_corners, steps, phase, gates, readout)
    phase = _without_offsets(phase, known, values)
    std = _depth_std(taps, steps, slopes, values, readout, noise, at_corners)
    if len(values) == 1:
        depth = depth_of_phase(phase, values[0]).squeeze(-3)
    else:
        depth = unwrap_depth(phase, values, max_depth_m=max_depth_m, min_depth_m=min_depth_m)
    return ItofReading(phase, amplitude_of(phasor), offset=offset, depth_std_m=std, depth_m=depth)


def _without_offsets(phase: Tensor, calibration: ItofCalibration, frequencies: tuple[float, ...]) -> Tensor:
    """Take the phases of a calibration off phases (..., F, H, W), in [0, 2 pi)."""
    added = fitting_pixels(calibration.phases_rad(frequencies), phase, "read_itof")
    # In [0, 2 pi) before the dtype of the frames rounds it.
    phase = phase - (added % _TURN).to(phase)
    return below_a_turn(phase - _TURN * torch.floor(phase / _TURN))


def _slopes(phasor: Tensor, num_taps: int) -> Tensor:
    """Slopes ``d phi / d X_n`` of the Fourier sum, (..., F, N, H, W): ``2 sin(theta_n - phi) / (N a)``.

    Infinite in darkness.
    """
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
            found.append(wrapped_difference(_by_shape(moved, code, readout)[0], phase))
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
    """Standard deviation of depth, (..., C, H, W) metres, or None where the noise is unknown."""
    raw = not taps.is_floating_point()
    if noise is None and raw:
        return None  # electrons of a number of the converter are unknown
    known = noise or ItofNoise()
    if raw and known.electrons_per_unit is None:
        raise UnitError(
            f"read_itof: expected ItofNoise(electrons_per_unit=...) for frames of whole numbers ({taps.dtype}), which "
            "are those of a converter, got none. The gain of the camera in electrons per number; 1.0 if they are "
            "electrons."
        )
    gain = known.electrons_per_unit or 1.0
    offset: Tensor | None = None  # electrons of all light in a step; None where the deviations were given
    if readout != "differential":
        offset = (sums_of(taps, steps.shape[-3], "read_itof") if readout == "two_tap" else steps) * gain
    elif known.offset_e is not None:
        offset = _of_frequencies(known.offset_e, steps)
    read = (1 if readout == "single" else 2) * known.read_noise_e**2
    if known.std_e is not None:
        variance = _of_frequencies(known.std_e, steps).square()
    elif offset is None:
        return None
    else:
        variance = offset.clamp_min(0) + read
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
    """Mask (..., F, H, W) of steps (..., F, N, H, W) in electrons that light can give: ``a <= 2 offset``.

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
    """(..., F, 1, H, W) of a number or of (..., C, F, H, W)."""
    like = steps.select(-3, 0)
    return torch.as_tensor(given, dtype=torch.float64).to(like).broadcast_to(like.shape).unsqueeze(-3)
