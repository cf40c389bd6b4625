"""Impulse responses applied along time: of instruments (IRF), and pulses as films apply them while rendering.

The shapes are in `responses`. Rendering with a pulse spreads every arrival from where it is; afterwards only its bin
is known, and light is taken to be spread evenly over a bin. The two agree up to the square of the bin's width over that
of the pulse.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchtransient.axes import TimeAxis
from torchtransient.errors import ShapeError, UnitError
from torchtransient.floating import without_autocast
from torchtransient.pulses import Pulse, cumulative_of_sum
from torchtransient.sensing.checks import bins_from
from torchtransient.sensing.responses import Response, WithinBin, kernel_of
from torchtransient.sensing.sensor import Sensor
from torchtransient.sensing.time_convolution import Boundary, convolve_time, filter_rows


class ImpulseResponse(Sensor):
    """Convolve light (..., C, T, H, W) with a response along time: its shape before it is detected.

    For the laser's pulse and the optics. `DetectionJitter`, behind the detector, is for the jitter of the detector and
    its timing, which moves single detections. Constant light, ambient and dark counts, comes after this too:
    `PhotonBudget` adds it. With boundary "zero" light that leaves the window is lost and nothing comes in, so that
    constant light would starve at its edges; `Compose` refuses that order. Sums over time are conserved with
    "periodic", and with "zero" as far as light stays in the window.

    Args:
        response: shape of the delays.
        axis: axis of the light, or
        bin_width_s: its bin width in seconds.
        boundary: treatment of the window's ends, "zero" or "periodic", see `convolve_time`.
        within_bin: place of light in its bin, "uniform" or "center", see `Response.kernel`.

    Raises:
        UnitError: for widths out of range.
    """

    gives = "the same"

    def __init__(
        self,
        response: Response,
        axis: TimeAxis | None = None,
        *,
        bin_width_s: float | None = None,
        boundary: Boundary = "zero",
        within_bin: WithinBin = "uniform",
    ) -> None:
        super().__init__()
        self.response = response
        self.bin_width_s, self.num_bins = bins_from(axis, bin_width_s, "ImpulseResponse")
        self.boundary: Boundary = boundary
        self.within_bin: WithinBin = within_bin

    def expected(self, x: Tensor) -> Tensor:
        first, kernel = kernel_of(self.response, self.bin_width_s, self.within_bin)
        return convolve_time(x, kernel, first, boundary=self.boundary)


# --------------------------------------------------------------------------------------------------------------- pulses


# Longer kernels are applied by a Fourier transform in double precision, whose rounding stays 1e-12 below the largest
# bin where one in single precision would drown the late ones.
_DIRECT_TAPS = 192
_NODES_PER_BIN = 64
_NODES = 4096


def pulse_kernel(bin_width_opl: float, *pulses: Pulse) -> tuple[int, Tensor]:
    """Share of the light of one bin that pulses bring into each bin.

    Args:
        bin_width_opl: bin width in metres.
        pulses: one or more pulses, convolved with one another.

    Returns:
        First lag in bins, and shares (K,) float64 of the lags from there on, summing to one.

    Raises:
        UnitError: without a pulse.
    """
    if not pulses:
        raise UnitError("pulse_kernel: expected at least one pulse, got none.")
    # Light of a bin lies anywhere between its edges: one more delay, uniform over the width.
    spread = [*pulses, Pulse.rectangular(bin_width_opl, center_opl=bin_width_opl / 2)]
    bins = sum(p.support_opl[1] - p.support_opl[0] for p in spread) / bin_width_opl
    per_bin = max(_NODES_PER_BIN, 2 ** math.ceil(math.log2(_NODES / bins)))
    start, values = cumulative_of_sum(spread, bin_width_opl / per_bin)
    first = math.floor(start / per_bin)
    last = math.ceil((start + values.size - 1) / per_bin)
    padded = torch.ones((last - first) * per_bin + 1, dtype=torch.float64)
    offset = start - first * per_bin
    padded[:offset] = 0
    padded[offset : offset + values.size] = torch.from_numpy(values)
    return first, torch.diff(padded[::per_bin])


def axis_with_margin(axis: TimeAxis, *pulses: Pulse) -> TimeAxis:
    """Add the bins around an axis whose light pulses bring into it: render on the result, then keep ``axis``.

    Args:
        axis: wanted axis.
        pulses: one or more pulses.

    Returns:
        A longer axis of the same bins.
    """
    first, kernel = pulse_kernel(axis.bin_width_opl, *pulses)
    before, after = max(first + kernel.numel() - 1, 0), max(-first, 0)
    start = axis.start_opl - before * axis.bin_width_opl
    return TimeAxis(start, axis.bin_width_opl, axis.num_bins + before + after)


def apply_pulse(transient: Tensor, axis: TimeAxis, *pulses: Pulse, keep: TimeAxis | None = None) -> Tensor:
    """Convolve a transient with pulses along time.

    Light that is spread beyond the axis is lost. To miss nothing, render on ``axis_with_margin(wanted, *pulses)`` and
    keep ``wanted``. Differentiable in ``transient``, in both modes and twice.

    Args:
        transient: (..., T, H, W), radiance integrated over each bin of ``axis``.
        axis: time axis of the transient.
        pulses: one or more pulses.
        keep: axis made of bins of ``axis``, those to return.

    Returns:
        (..., T or bins of ``keep``, H, W), in dtype and device of ``transient``.

    Raises:
        ShapeError: if T is not that of ``axis``, or ``keep`` does not consist of its bins.
        UnitError: without a pulse, or for whole numbers.
    """
    if transient.ndim < 3 or transient.shape[-3] != axis.num_bins:
        raise ShapeError(
            f"apply_pulse: expected (..., T, H, W) with T = {axis.num_bins}, got {tuple(transient.shape)}."
        )
    if not transient.is_floating_point():
        raise UnitError(f"apply_pulse: expected a floating-point transient, got {transient.dtype}.")
    skip, count = (0, axis.num_bins) if keep is None else _bins_of(axis, keep)
    first, kernel = pulse_kernel(axis.bin_width_opl, *pulses)
    rows = transient.movedim(-3, -1)
    # Row b of the result is the sum of kernel[k] row[b - first - k].
    spread = _convolve_rows(rows, kernel.to(transient.device))
    begin = skip - first
    result = spread[..., max(begin, 0) : max(begin + count, 0)]
    missing_before = min(max(-begin, 0), count)
    result = torch.nn.functional.pad(result, (missing_before, count - missing_before - result.shape[-1]))
    return result.movedim(-1, -3)


@without_autocast
def _convolve_rows(rows: Tensor, kernel: Tensor) -> Tensor:
    """Full convolution along the last dimension: T + K - 1 entries."""
    length = rows.shape[-1] + kernel.numel() - 1
    if min(kernel.numel(), rows.shape[-1]) > _DIRECT_TAPS:
        transfer = torch.fft.rfft(kernel, n=length)
        return filter_rows(rows.double(), transfer, length, 0, length).to(rows.dtype)
    flat = rows.reshape(-1, 1, rows.shape[-1])
    weights = kernel.flip(0).to(rows.dtype).view(1, 1, -1)
    spread: Tensor = torch.nn.functional.conv1d(flat, weights, padding=kernel.numel() - 1)
    return spread.view(*rows.shape[:-1], length)


def _bins_of(axis: TimeAxis, keep: TimeAxis) -> tuple[int, int]:
    """(first bin, number of bins) of ``keep`` in ``axis``."""
    offset = (keep.start_opl - axis.start_opl) / axis.bin_width_opl
    same_width = math.isclose(keep.bin_width_opl, axis.bin_width_opl, rel_tol=1e-9)
    whole = abs(offset - round(offset)) < 1e-6 * max(1.0, abs(offset))
    if not same_width or not whole or round(offset) < 0 or round(offset) + keep.num_bins > axis.num_bins:
        raise ShapeError(f"apply_pulse: expected `keep` to consist of bins of {axis}, got {keep}.")
    return round(offset), keep.num_bins
