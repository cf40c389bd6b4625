"""From the taps of an indirect time-of-flight camera to phase, amplitude, depth and confidence.

With taps ``I_n = (B + A cos(phi - 2 pi n / N)) / N`` the sum ``(2 / N) sum_n I_n exp(2 pi i n / N)`` is the *tap
phasor* ``(A / N) exp(i phi)`` (its phase is minus that of a phasor image, whose exponent is negative). Depth is half
the way there and back: ``d = c phi / (4 pi f)``, unique up to ``c / (2 f)``.

Gradients: a phase jumps by a turn at the end of its range, so that a loss on it (or on depth) pulls pixels near the
jump the long way round. `phasor_loss` compares phasors and has no jump; `wrapped_difference` gives the short way. A
pixel without modulated light has phase and derivative zero.

Sources: Lange & Seitz (2001); Payne, Dorrington & Cree, "Illumination waveform optimization for time-of-flight range
imaging cameras" (SPIE 2011); Jongenelen et al., "Analysis of errors in ToF range imaging with dual-frequency
modulation" (IEEE TIM 2011); Gupta et al. (ACM TOG 2018) for the decoding of general codes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchtransient.errors import ShapeError, UnitError
from torchtransient.sensing.itof import check_frequencies
from torchtransient.sensing.itof_codes import CorrelationCode
from torchtransient.sensing.layout import check_number, without_autocast
from torchtransient.tensor_record import TensorRecord
from torchtransient.units import SPEED_OF_LIGHT

_TURN = 2 * math.pi


@dataclass(frozen=True, eq=False, repr=False)
class ItofReading(TensorRecord):
    """``phase`` (..., C, F, H, W) radians in [0, 2 pi); ``amplitude`` and ``offset`` in electrons per tap and
    ``confidence`` = amplitude / offset, all (..., C, F, H, W); ``depth_m`` (..., C, H, W) metres from the camera."""

    phase: Tensor
    amplitude: Tensor
    offset: Tensor
    confidence: Tensor
    depth_m: Tensor


@without_autocast
def tap_phasor(taps: Tensor, num_taps: int) -> Tensor:
    """(..., C, F, H, W) complex: ``(2 / N) sum_n taps_n exp(2 pi i n / N)`` of taps (..., C, F N, H, W).

    Taps at equal shifts of one function (sine, square). Harmonics ``m N +- 1`` of it alias into the result (wiggling).
    Half precision becomes complex64. Raises ShapeError when the tap dimension is no multiple of ``num_taps``.
    """
    split = _split(taps, num_taps, "tap_phasor")
    if split.dtype in (torch.float16, torch.bfloat16):
        split = split.float()  # bfloat16 has no complex numbers
    # The mean has no part in the sum; without it, equal taps give exactly zero and float32 keeps its digits.
    split = split - split.mean(-3, keepdim=True)
    angles = _TURN * torch.arange(num_taps, dtype=torch.float64) / num_taps
    weight = (2 / num_taps) * torch.exp(1j * angles)
    real = torch.einsum("...fnhw,n->...fhw", split, weight.real.to(split))
    imag = torch.einsum("...fnhw,n->...fhw", split, weight.imag.to(split))
    return torch.complex(real, imag)


def offset_of(taps: Tensor, num_taps: int) -> Tensor:
    """(..., C, F, H, W): mean of the taps, a pixel's unmodulated level. Errors as `tap_phasor`."""
    return _split(taps, num_taps, "offset_of").mean(-3)


def phase_of(phasor: Tensor) -> Tensor:
    """Angle of a complex tensor in [0, 2 pi), in its shape; zero, with derivative zero, where it is zero."""
    real, imag = phasor.real, phasor.imag
    # At scale one the squares in the derivative of atan2 cannot underflow; the angle does not depend on it.
    largest = torch.maximum(real.abs(), imag.abs()).detach()
    there = ~(largest <= torch.finfo(real.dtype).tiny)  # NaN is not darkness
    scale = torch.where(there, largest, 1.0)
    angle = torch.atan2(torch.where(there, imag, 0.0) / scale, torch.where(there, real, 1.0) / scale)
    wrapped = angle + torch.where(angle.detach() < 0, _TURN, 0.0)
    # The sum of a tiny negative angle and a turn rounds to the turn itself.
    return torch.where(wrapped.detach() >= _TURN, wrapped - _TURN, wrapped)


def amplitude_of(phasor: Tensor) -> Tensor:
    """Modulus of a complex tensor, in its shape; derivative zero where it is zero."""
    real, imag = phasor.real, phasor.imag
    largest = torch.maximum(real.abs(), imag.abs()).detach()
    there = ~(largest <= torch.finfo(real.dtype).tiny)  # NaN is not darkness
    scale = torch.where(there, largest, 1.0)
    square = (real / scale).square() + (imag / scale).square()
    return torch.where(there, torch.where(there, square, 1.0).sqrt() * scale, 0.0)


def depth_of_phase(phase: Tensor, frequency_hz: float) -> Tensor:
    """``c phase / (4 pi f)`` in metres, in the shape of ``phase``."""
    (f,) = check_frequencies(frequency_hz, "depth_of_phase")
    return phase * (SPEED_OF_LIGHT / (2 * _TURN * f))


def unambiguous_range_m(frequencies_hz: float | Sequence[float]) -> float:
    """``c / (2 gcd)``: the depth after which all phases repeat. UnitError for frequencies that are not whole hertz."""
    values = check_frequencies(frequencies_hz, "unambiguous_range_m")
    if any(f != int(f) for f in values):
        raise UnitError(
            f"unambiguous_range_m: expected whole numbers of hertz, which have a common divisor, got {values}. Say "
            "the largest depth instead."
        )
    return SPEED_OF_LIGHT / (2 * math.gcd(*(int(f) for f in values)))


def wrapped_difference(a: Tensor, b: Tensor) -> Tensor:
    """``a - b`` in radians, the short way round: in [-pi, pi), derivative one everywhere. Shapes broadcast."""
    difference = a - b
    turns = torch.floor((difference.detach() + math.pi) / _TURN)
    return difference - _TURN * turns


def phasor_loss(phasor: Tensor, target: Tensor, weight: Tensor | None = None) -> Tensor:
    """``|z - target|^2`` elementwise, real, or with the given weights: the loss of phases that knows no branch cut.

    Scale both to amplitude one (``z / amplitude``) for a loss on the phase alone, ``2 (1 - cos(difference))``.
    """
    difference = phasor - target
    loss = difference.real.square() + difference.imag.square()
    return loss if weight is None else loss * weight


def phase_noise_rad(amplitude: Tensor, offset: Tensor, num_taps: int, read_noise_e: float = 0.0) -> Tensor:
    """Standard deviation of the phase from amplitude and offset per tap, in electrons, shot and read noise.

    ``sqrt(2 (offset + read^2) / N) / amplitude``, which is ``sqrt(2 B) / A`` of the totals without read noise: first
    order in the noise, right for deviations below about 0.2 rad. Infinite at amplitude zero. With three taps the
    variance also swings with the phase, ``(2 B - A cos 3 phi) / A^2``; this is its root mean square.
    """
    check_number(read_noise_e, "read_noise_e", "phase_noise_rad")
    return (2 * (offset + read_noise_e**2) / num_taps).sqrt() / amplitude


def unwrap_depth(
    phase: Tensor,
    frequencies_hz: Sequence[float],
    *,
    max_depth_m: float | None = None,
    min_depth_m: float = 0.0,
    weights: Sequence[float] | None = None,
) -> Tensor:
    """Depth (..., C, H, W) from phases (..., C, F, H, W) of F frequencies: the lattice of wraps, searched.

    For every number of turns of the highest frequency within [min_depth_m, max_depth_m] the other frequencies take
    their nearest number of turns, and the weighted least-squares depth with the least residual wins. ``max_depth_m``:
    None for one range after which everything repeats. ``weights``: one over the variance of each *phase*; equal by
    default. With noise around zero depth give a ``min_depth_m`` a little below zero.

    The whole turns are detached; the gradient is that of the least-squares depth in the phases. Memory does not grow
    with the number of candidates. Raises ShapeError for a wrong F, UnitError for an empty range.
    """
    me = "unwrap_depth"
    values = check_frequencies(frequencies_hz, me)
    if phase.ndim < 4 or phase.shape[-3] != len(values):
        raise ShapeError(f"{me}: expected phases (..., C, {len(values)}, H, W), got {tuple(phase.shape)}.")
    longest = float(min_depth_m + unambiguous_range_m(values) if max_depth_m is None else max_depth_m)
    if not (math.isfinite(longest) and longest > min_depth_m):
        raise UnitError(f"{me}: expected min_depth_m < max_depth_m in metres, got {min_depth_m!r} and {longest!r}.")
    weight = [1.0] * len(values) if weights is None else [float(w) for w in weights]
    if len(weight) != len(values) or not all(w > 0 for w in weight):
        raise UnitError(f"{me}: expected {len(values)} positive weights, got {weights!r}.")

    turns = phase / _TURN
    periods = [SPEED_OF_LIGHT / (2 * f) for f in values]  # metres per turn
    # A phase of frequency f measures depth with the weight w / period^2.
    share = [w / p**2 for w, p in zip(weight, periods, strict=True)]
    share = [s / sum(share) for s in share]
    reference = min(range(len(values)), key=lambda i: periods[i])
    best, whole = _search(turns.detach(), periods, share, weight, reference, (float(min_depth_m), longest))
    del best
    metres = turns.new_tensor([s * p for s, p in zip(share, periods, strict=True)]).reshape(-1, 1, 1)
    depth: Tensor = ((turns + whole) * metres).sum(-3)
    return depth


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


@without_autocast
def decode_code(taps: Tensor, code: CorrelationCode, num_phases: int = 1024) -> Tensor:
    """Phase (..., C, F, H, W) in radians of taps of *any* code, by the closest shape of the N taps.

    The taps without their mean and at length one are compared with the code at ``num_phases`` phases (zero-mean
    normalised cross-correlation, Gupta et al. 2018); the best of them, detached, is refined by one Gauss-Newton step
    on the code's slope, which carries the gradient. Needs no model of amplitude or background. A dark or flat pixel
    has phase zero. Raises ShapeError when the tap dimension is no multiple of the code's taps.
    """
    split = _split(taps, code.num_taps, "decode_code").movedim(-3, -1)
    centred = split - split.mean(-1, keepdim=True)
    length = torch.linalg.vector_norm(centred, dim=-1, keepdim=True)
    there = ~(length <= 1e-6 * split.abs().amax(-1, keepdim=True).clamp_min(torch.finfo(split.dtype).tiny))
    unit = torch.where(there, centred, 0.0) / torch.where(there, length, 1.0)
    x = torch.arange(num_phases, dtype=torch.float64) / num_phases
    table = _unit_shapes(code, x).to(unit)
    best = _best_match(unit.detach(), table)
    step = 0.5 / num_phases
    slope = ((_unit_shapes(code, x + step) - _unit_shapes(code, x - step)) / (2 * step)).to(unit)
    here, direction = table[best], slope[best]
    # Along the curve of shapes, the distance to the measured one in units of the curve's speed.
    speed = direction.square().sum(-1).clamp_min(1e-12)
    shift = ((unit - here) * direction).sum(-1) / speed
    turns = x.to(unit)[best] + shift.clamp(-2 / num_phases, 2 / num_phases)
    phase = (turns - torch.floor(turns.detach())) * _TURN
    return torch.where(there.squeeze(-1), phase, 0.0)


def _unit_shapes(code: CorrelationCode, turns: Tensor) -> Tensor:
    """(P, N): the taps of a code at the given phases without their mean and at length one."""
    shape = code.evaluate(turns).T
    shape = shape - shape.mean(-1, keepdim=True)
    unit: Tensor = shape / torch.linalg.vector_norm(shape, dim=-1, keepdim=True).clamp_min(1e-12)
    return unit


def _best_match(unit: Tensor, table: Tensor, chunk: int = 1 << 14) -> Tensor:
    """Index of the row of ``table`` (P, N) with the largest product for each of (..., N); memory chunk x P."""
    if unit.numel() == 0:
        return torch.zeros(unit.shape[:-1], dtype=torch.int64, device=unit.device)
    flat = unit.reshape(-1, unit.shape[-1])
    found = [(flat[i : i + chunk] @ table.T).argmax(-1) for i in range(0, flat.shape[0], chunk)]
    return torch.cat(found).reshape(unit.shape[:-1])


def read_itof(
    taps: Tensor,
    frequencies_hz: float | Sequence[float],
    num_taps: int,
    *,
    code: CorrelationCode | None = None,
    max_depth_m: float | None = None,
    min_depth_m: float = 0.0,
) -> ItofReading:
    """Everything a camera reports, from taps (..., C, F N, H, W). See `ItofReading` for shapes and units.

    ``code``: decode by its shape (`decode_code`) instead of by the Fourier sum: needed for Hamiltonian and measured
    codes, removes the wiggling of square ones. One frequency: depth within ``c / (2 f)``; several: unwrapped, with
    weights by amplitude left out. Confidence is zero where there is no light.
    """
    values = check_frequencies(frequencies_hz, "read_itof")
    if taps.shape[-3] != len(values) * num_taps:
        raise ShapeError(
            f"read_itof: expected taps (..., C, {len(values)} x {num_taps}, H, W), got {tuple(taps.shape)}."
        )
    phasor, offset = tap_phasor(taps, num_taps), offset_of(taps, num_taps)
    phase = phase_of(phasor) if code is None else decode_code(taps, code)
    amplitude = amplitude_of(phasor)
    lit = ~(offset <= 0)
    confidence = torch.where(lit, amplitude, 0.0) / torch.where(lit, offset, 1.0)
    if len(values) == 1:
        depth = depth_of_phase(phase, values[0]).squeeze(-3)
    else:
        depth = unwrap_depth(phase, values, max_depth_m=max_depth_m, min_depth_m=min_depth_m)
    return ItofReading(phase, amplitude, offset, confidence, depth)


def _split(taps: Tensor, num_taps: int, where: str) -> Tensor:
    """(..., C, F, N, H, W) of taps (..., C, F N, H, W)."""
    if taps.ndim < 4 or num_taps < 3 or taps.shape[-3] % num_taps or not taps.shape[-3]:
        raise ShapeError(
            f"{where}: expected taps (..., C, F x N, H, W) with N = {num_taps} >= 3, got {tuple(taps.shape)}."
        )
    return taps.reshape(*taps.shape[:-3], taps.shape[-3] // num_taps, num_taps, *taps.shape[-2:])
