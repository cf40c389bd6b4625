"""Losses of phasors: the amplitudes of a band of frequencies of a transient, compared without a branch cut.

The phasor of a record is the sum of its bins times `exp(-2 pi i nu (opl - start))`, with `nu` in cycles per metre of
optical path and `opl` at the middle of the bin. A delay by `d` turns it by `2 pi nu d`; squared differences of phasors
are `2 - 2 cos` of that angle, which is smooth where the angle jumps. Frequencies that are low against one over the
delay have a slope from afar, high ones resolve it and repeat.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchtransient.axes import FrequencyAxis, TimeAxis
from torchtransient.errors import ArgumentError, ShapeError, UnitError
from torchtransient.losses.checks import (
    Reduction,
    check_dense,
    check_level,
    item_scale,
    masked_pair,
    reduce,
    squared_modulus,
    working_dtype,
)
from torchtransient.losses.layouts import bins_dim, item_dims
from torchtransient.losses.loss_module import LossModule
from torchtransient.losses.results import PHASOR, TRANSIENT, Phasors, Transient, reads

# Relative to the mean modulus of an item: phasors below are noise and have no phase.
_PHASE_FLOOR = 1e-3
# The highest frequency of a discrete transform, half of one over the bin, is taken however it was computed.
_ROUNDING = 1e-9


@reads(transient=TRANSIENT)
def transient_phasors(
    transient: Transient,
    axis: TimeAxis | None = None,
    frequencies: FrequencyAxis | None = None,
    *,
    dim: int | None = None,
) -> Tensor:
    """Transform transients to phasors at F frequencies.

    As from a renderer with `frequencies=`, but for a factor `sinc(nu bin_width_opl)`, since light counts as at the
    middle of its bin. Phases are computed in double precision.

    Args:
        transient: transient (..., C, T, Y, X), or another layout with `dim`.
        axis: time axis of T bins; None: that of a result.
        frequencies: F frequencies, wavelengths of two bins or more. At two bins the phasor is blind to the sign of a
            delay.
        dim: dimension of time (`losses.layouts`).

    Returns:
        Complex phasors (..., C, F, Y, X).

    Raises:
        ShapeError: if T is not the number of bins of the axis, or without `dim` where the shape is ambiguous.
        UnitError: for wavelengths below two bins, which alias.
    """
    where = "transient_phasors"
    axis, frequencies = _check_axes(axis, frequencies, where)
    (transient,) = check_dense((transient,), where)
    place = bins_dim(transient, dim, where) + transient.ndim
    lead, bins, trail = transient.shape[:place], transient.shape[place], transient.shape[place + 1 :]
    if bins != axis.num_bins:
        raise ShapeError(
            f"{where}: expected T = {axis.num_bins} bins in dimension {place - transient.ndim}, got {bins}. Say with "
            "dim= where time is elsewhere."
        )
    dtype = working_dtype((transient,), where)
    turns = torch.outer(frequencies.per_metre, axis.centers_opl - frequencies.start_opl)
    angle = -2 * math.pi * (turns - turns.round())
    # A product of complex numbers, twice the work: autocast narrows products of real ones, in the backward pass too.
    table = torch.polar(torch.ones_like(angle), angle).to(transient.device, torch.promote_types(dtype, torch.complex64))
    record = transient.to(dtype).reshape(*lead, bins, math.prod(trail)).to(table.dtype)
    return (table @ record).reshape(*lead, frequencies.num_frequencies, *trail)


@reads(input=PHASOR, target=PHASOR)
def phasor_loss(
    input: Phasors,
    target: Phasors,
    *,
    phase_only: bool = False,
    floor: Tensor | float | None = None,
    dim: int | None = None,
    mask: Tensor | None = None,
    reduction: Reduction = "mean",
) -> Tensor:
    """Compute the squared difference of phasors, `|P - Q|^2`. Symmetric.

    Args:
        input: complex phasors P (..., C, F, Y, X), or any shape.
        target: phasors Q of the same shape.
        phase_only: compare `P / sqrt(|P|^2 + floor^2)`, so that brightness has no part: `2 - 2 cos` of the angle
            between two bright phasors, 1 where one is dark.
        floor: modulus below which phasors are dark, above zero; bounds the gradient by 4/floor. None: 1e-3 of the mean
            modulus of each item of each.
        dim: dimension of frequency, which says what an item is (`losses.layouts`).
        mask: elements that count.
        reduction: "mean" over elements that count, "sum", or "none".

    Returns:
        Unit of the phasors, squared (`phase_only`: none); scalar, or the shape of the input for "none".

    Raises:
        UnitError: for real tensors, and a floor that is not above zero.
        ShapeError: for two shapes, or without `dim` and `floor` where the shape is ambiguous.
    """
    where = "phasor_loss"
    input, target, mask = masked_pair(input, target, mask, where, complex_too=True)
    if not input.is_complex():
        raise UnitError(f"{where}: expected complex phasors, got {input.dtype}. See transient_phasor_loss.")
    if phase_only:
        if floor is None:
            item = item_dims(input, dim, where, " or floor=")
            scale, other = (_PHASE_FLOOR * item_scale(*x, item, mask) for x in ((input, target), (target, input)))
        else:
            scale = other = check_level("floor", floor, input, where)
        input, target = _phase(input, scale), _phase(target, other)
    return reduce(squared_modulus(input - target), reduction, where, mask)


class PhasorLoss(LossModule, function=phasor_loss):
    """`phasor_loss` with its options held."""


@reads(input=TRANSIENT, target=TRANSIENT)
def transient_phasor_loss(
    input: Transient,
    target: Transient,
    *,
    axis: TimeAxis | None = None,
    frequencies: FrequencyAxis | None = None,
    phase_only: bool = False,
    floor: Tensor | float | None = None,
    dim: int | None = None,
    mask: Tensor | None = None,
    reduction: Reduction = "mean",
) -> Tensor:
    """Compute `phasor_loss` of the phasors of two transients, for each pixel and frequency. Symmetric.

    Parseval: over all frequencies of a discrete transform its mean is that of the squared difference times T; a band
    compares only its part.

    Args:
        input: transient (..., C, T, Y, X), or another layout with `dim`.
        target: transient of the same shape.
        axis: time axis of T bins; None: that of a result.
        frequencies: F frequencies, wavelengths of two bins or more, see `transient_phasors`.
        phase_only: compare phases regardless of brightness, see `phasor_loss`.
        floor: modulus below which phasors are dark, above zero, see `phasor_loss`.
        dim: dimension of time (`losses.layouts`).
        mask: bins that count, (..., C, T, Y, X); the others are empty in both, and pixels without any are left out.
        reduction: "mean" over pixels that count, "sum", or "none".

    Returns:
        Scalar, or (..., C, F, Y, X) for "none".

    Raises:
        ShapeError, UnitError: as `transient_phasors` and `phasor_loss`.
    """
    where = "transient_phasor_loss"
    input, target, mask = masked_pair(input, target, mask, where)
    dim = bins_dim(input, dim, where)
    ours, theirs = (transient_phasors(x, axis, frequencies, dim=dim) for x in (input, target))
    pixels = None if mask is None else mask.any(dim, keepdim=True)
    return phasor_loss(ours, theirs, phase_only=phase_only, floor=floor, dim=dim, mask=pixels, reduction=reduction)


class TransientPhasorLoss(LossModule, function=transient_phasor_loss, by_place=("axis", "frequencies")):
    """`transient_phasor_loss` with its axes and options held."""


def _check_axes(axis: TimeAxis | None, frequencies: FrequencyAxis | None, where: str) -> tuple[TimeAxis, FrequencyAxis]:
    """Return the axes. Raises ArgumentError if one is missing, UnitError for frequencies that alias."""
    if axis is None or frequencies is None:
        raise ArgumentError(f"{where}: expected a TimeAxis (or results that have one) and a FrequencyAxis, got None.")
    highest, most = max(abs(f) for f in frequencies.frequencies), 0.5 / axis.bin_width_opl
    if highest > most * (1 + _ROUNDING):
        raise UnitError(
            f"{where}: expected a wavelength of two bins at least, frequencies of {most:.4g} per metre at most, got "
            f"{highest:.4g}. Take narrower bins or lower frequencies; in hertz with FrequencyAxis.from_hertz."
        )
    return axis, frequencies


def _phase(phasor: Tensor, floor: Tensor) -> Tensor:
    """`P / sqrt(|P|^2 + floor^2)`, by numbers near one, since squares of bright phasors overflow."""
    size = torch.maximum(phasor.detach().abs(), floor)
    scaled = phasor / size
    return scaled / (squared_modulus(scaled) + (floor / size) ** 2).sqrt()
