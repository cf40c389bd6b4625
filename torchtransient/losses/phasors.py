"""Losses of phasors: the oscillations that a band of frequencies makes of a transient, compared without a branch cut.

The phasor of a record is the sum of its bins times `exp(-2 pi i nu (opl - start))`, `nu` in cycles per metre of optical
path and `opl` at the middle of the bin. A delay by `d` turns it by `2 pi nu d`. Squares of differences of phasors
see `2 - 2 cos` of that angle, which is smooth where the angle itself jumps by a whole turn. Frequencies that are low
against one over the delay see it from afar; high ones resolve it and repeat.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from torchtransient.axes import FrequencyAxis, TimeAxis
from torchtransient.checks import flag, shown
from torchtransient.errors import ArgumentError, ShapeError, UnitError
from torchtransient.losses.comparison import (
    Reduction,
    check_dense,
    check_level,
    check_mask,
    check_option,
    check_pair,
    check_reduction,
    counted,
    item_scale,
    reduce,
    squared_modulus,
    working_dtype,
)
from torchtransient.losses.layouts import bins_dim, check_held, item_dims
from torchtransient.losses.results import PHASOR, TRANSIENT, Phasors, Transient, reads

# The phasors of dark pixels are noise: relative to the mean modulus of an item, below what has a phase.
_PHASE_FLOOR = 1e-3
# The highest frequency of a discrete transform is half of one over the bin, however that was computed.
_ROUNDING = 1e-9


@reads(transient=TRANSIENT)
def transient_phasors(
    transient: Transient,
    axis: TimeAxis | None = None,
    frequencies: FrequencyAxis | None = None,
    *,
    dim: int | None = None,
) -> Tensor:
    """Phasors (..., C, F, Y, X), complex, of transients (..., C, T, Y, X): a dense transform to F frequencies.

    `dim`: where time is, and frequency then (`losses.layouts`). As from a renderer with
    `frequencies=`, but for the bins: those count as at their middles, which lacks a factor `sinc(nu bin_width_opl)`.
    Phases are computed in double precision. Raises ShapeError where T is not that of the axis; UnitError for
    wavelengths below two bins, whose phasors are those of longer ones. Two bins, the last frequency of a discrete
    transform, are taken: the phasor there does not know the sign of a delay.
    """
    return _phasors(transient, axis, frequencies, dim, "transient_phasors")


def _phasors(
    given: object, time_axis: TimeAxis | None, band: FrequencyAxis | None, dim: int | None, where: str
) -> Tensor:
    axis, frequencies = _check_axes(time_axis, band, where)
    (transient,) = check_dense((given,), where)
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
    # A product of complex numbers, twice the work: autocast narrows a product of real ones, and its derivative wherever
    # the backward pass runs, and leaves complex ones alone.
    table = torch.polar(torch.ones_like(angle), angle).to(transient.device, torch.promote_types(dtype, torch.complex64))
    record = transient.to(dtype).reshape(*lead, bins, math.prod(trail)).to(table.dtype)
    return (table @ record).reshape(*lead, frequencies.num_frequencies, *trail)


def _check_axes(
    axis: TimeAxis | None, frequencies: FrequencyAxis | None, where: str
) -> tuple[TimeAxis, FrequencyAxis]:
    """Raises UnitError for no axes, and for frequencies that bins cannot tell from lower ones."""
    if not isinstance(axis, TimeAxis) or not isinstance(frequencies, FrequencyAxis):
        raise ArgumentError(
            f"{where}: expected a TimeAxis and a FrequencyAxis, got {type(axis).__name__} and "
            f"{type(frequencies).__name__}. Results that have an axis need no other."
        )
    highest, most = max(abs(f) for f in frequencies.frequencies), 0.5 / axis.bin_width_opl
    if highest > most * (1 + _ROUNDING):
        raise UnitError(
            f"{where}: expected a wavelength of two bins at least, frequencies of {most:.4g} per metre at most, got "
            f"{highest:.4g}. Take narrower bins or lower frequencies; in hertz with FrequencyAxis.from_hertz."
        )
    return axis, frequencies


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
    """`|P - Q|^2` of each element of two complex tensors, such as phasors (..., C, F, Y, X). Symmetric.

    `phase_only`: of `P / sqrt(|P|^2 + floor^2)` and Q likewise, each between 0 and 1, so that brightness has no part:
    `2 - 2 cos` of the angle between them where both are bright, 1 where one is dark. `floor`, in the unit of the
    phasors, says what is dark and bounds the gradient by 4/floor; None: 1e-3 of the mean modulus of each item of each;
    `dim`, where frequency is, then says what is an item (`losses.layouts`). Raises ShapeError for two shapes, UnitError
    for real numbers.
    """
    return _phasor_loss(input, target, (phase_only, floor, dim), mask, reduction, "phasor_loss")


def _phasor_loss(
    ours: object,
    theirs: object,
    phases: tuple[bool, Tensor | float | None, int | None],
    mask: Tensor | None,
    reduction: Reduction,
    where: str,
) -> Tensor:
    phase_only, floor, dim = phases
    flag(f"{where}: phase_only", phase_only)
    check_held(reduction, dim, where)
    check_option("floor", floor, where)
    input, target = check_pair(ours, theirs, where, complex_too=True)
    if not input.is_complex():
        raise UnitError(f"{where}: expected complex phasors, got {input.dtype}. See transient_phasor_loss.")
    mask = check_mask(mask, input, where)
    input, target = counted(input, mask), counted(target, mask)
    if phase_only:
        if floor is None:
            item = item_dims(input, dim, where, " or floor=")
            scale, other = (_PHASE_FLOOR * item_scale(*x, item, mask) for x in ((input, target), (target, input)))
        else:
            scale = other = check_level("floor", floor, input, where)
        input, target = _phase(input, scale), _phase(target, other)
    return reduce(squared_modulus(input - target), reduction, where, mask)


def _phase(phasor: Tensor, floor: Tensor) -> Tensor:
    """`P / sqrt(|P|^2 + floor^2)`, by numbers near one: squares of bright phasors exceed single precision."""
    size = torch.maximum(phasor.detach().abs(), floor)
    scaled = phasor / size
    return scaled / (squared_modulus(scaled) + (floor / size) ** 2).sqrt()


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
    """`phasor_loss` of the phasors of two transients (..., C, T, Y, X), for each pixel and frequency.

    Parseval: over all frequencies of a discrete transform its mean is that of the squared difference times T; over a
    band it forgets what the band does not see. `mask` (..., C, T, Y, X): bins that do not count are empty in both,
    pixels of which none does are left out. `reduction="none"`: (..., C, F, Y, X). Errors as those of
    `transient_phasors` and `phasor_loss`. `dim`: where time is (`losses.layouts`).
    """
    where = "transient_phasor_loss"
    check_reduction(reduction, where)
    input, target = check_pair(input, target, where)
    dim = bins_dim(input, dim, where)
    mask = check_mask(mask, input, where)
    ours, theirs = (_phasors(counted(x, mask), axis, frequencies, dim, where) for x in (input, target))
    pixels = None if mask is None else mask.any(dim, keepdim=True)
    return _phasor_loss(ours, theirs, (phase_only, floor, dim), pixels, reduction, where)


class PhasorLoss(nn.Module):
    """`phasor_loss(input, target)` with its options held."""

    def __init__(
        self,
        *,
        phase_only: bool = False,
        floor: float | None = None,
        dim: int | None = None,
        reduction: Reduction = "mean",
    ) -> None:
        super().__init__()
        check_held(reduction, dim, "PhasorLoss")
        flag("PhasorLoss: phase_only", phase_only)
        check_option("floor", floor, "PhasorLoss")
        self.phase_only, self.floor, self.dim, self.reduction = phase_only, floor, dim, reduction

    def forward(self, input: Phasors, target: Phasors, mask: Tensor | None = None) -> Tensor:
        return phasor_loss(
            input,
            target,
            phase_only=self.phase_only,
            floor=self.floor,
            dim=self.dim,
            mask=mask,
            reduction=self.reduction,
        )


class TransientPhasorLoss(nn.Module):
    """`transient_phasor_loss(input, target, axis, frequencies)` with its axes and options held."""

    def __init__(
        self,
        axis: TimeAxis | None = None,
        frequencies: FrequencyAxis | None = None,
        *,
        phase_only: bool = False,
        floor: float | None = None,
        dim: int | None = None,
        reduction: Reduction = "mean",
    ) -> None:
        super().__init__()
        check_held(reduction, dim, "TransientPhasorLoss")
        if axis is not None:
            _check_axes(axis, frequencies, "TransientPhasorLoss")
        elif not isinstance(frequencies, FrequencyAxis):
            raise UnitError(f"TransientPhasorLoss: expected frequencies, a FrequencyAxis, got {shown(frequencies)}.")
        flag("TransientPhasorLoss: phase_only", phase_only)
        check_option("floor", floor, "TransientPhasorLoss")
        self.axis, self.frequencies = axis, frequencies
        self.phase_only, self.floor, self.dim, self.reduction = phase_only, floor, dim, reduction

    def forward(self, input: Transient, target: Transient, mask: Tensor | None = None) -> Tensor:
        return transient_phasor_loss(
            input,
            target,
            axis=self.axis,
            frequencies=self.frequencies,
            phase_only=self.phase_only,
            floor=self.floor,
            dim=self.dim,
            mask=mask,
            reduction=self.reduction,
        )
