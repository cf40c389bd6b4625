"""The stationary state of a free-running detector: detected, armed and dead, bin by bin."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from torchtransient.errors import TorchTransientError
from torchtransient.sensing.dead_time.dead_time_cycle import whole_and_part
from torchtransient.sensing.dead_time.renewal_chain import RenewalChain
from torchtransient.sensing.dead_time.stationary_phases import stationary_phases

DARK = 1e-12  # photons per period; below, detections equal photons
_BELOW_ZERO = 1e-5  # of the largest bin: counts as far below zero show bins too wide for what is in them
_SETTLED = 1e-2  # of all counts: change from pieces twice as wide, some ten times the error that is left
_FINEST = 32
_CONTRAST = 9.0  # photons by which light changes from piece to piece
# Of all detections: share that ends being dead in light that asks for finer pieces. With less of them errors of counts
# in whole bins are below 2e-3 (total variation), and finer pieces cost ten times as much.
_BRIGHT = 0.07


@dataclass(frozen=True)
class FreeRunningState:
    """Rows (P, T), per period, float64, differentiable."""

    detected: Tensor
    armed: Tensor  # probability at the start of the bin
    late: Tensor  # of `detected`: those that are armed again in bin i + `whole` + 1; the others in i + `whole`
    whole: int


def stationary_state(rate: Tensor, dead_bins: Tensor) -> FreeRunningState:
    """For rates (P, T) per bin and period and a scalar dead time in bins, float64.

    Detections that end being dead in light that changes by many photons a bin follow no straight lines: bins of such
    pixels are cut. Where many photons in a bin meet a dead time that locks the phase, all detections crowd at an edge
    of a bin; the straight lines of `renewal_chain` then go below zero. Such pixels are solved again with their bins cut
    in 2, 4, ..., until counts settle. Raises TorchTransientError when they do not with 32 pieces.
    """
    # a dark pixel has no phases; its limit is one photon, at most, per many periods
    dark = rate.sum(-1, keepdim=True) < DARK
    safe = torch.where(dark, 0.1, rate)
    state = _settled(safe, dead_bins, 1)
    inside = _armed_in_the_light(safe, state).nonzero().flatten()
    for rows, pieces in rows_by_contrast(safe[inside]):
        if pieces > 1:
            rows = inside if rows is None else inside[rows]
            state = _placed(state, _settled(safe[rows], dead_bins, pieces), rows)
    detected = torch.where(dark, rate, state.detected.clamp_min(0))
    late = torch.where(dark, torch.zeros_like(rate), torch.minimum(state.late.clamp_min(0), detected))
    armed = torch.where(dark, torch.ones_like(rate), state.armed.clamp(0, 1))
    return FreeRunningState(detected, armed, late, state.whole)


def _armed_in_the_light(rate: Tensor, state: FreeRunningState) -> Tensor:
    """(P,) whether a share of detections ends being dead in bins far brighter than the darkest."""
    detected, late = state.detected, state.late
    armed_anew = (detected - late).roll(state.whole, -1) + late.roll(state.whole + 1, -1)
    bright = rate - rate.amin(-1, keepdim=True) > _CONTRAST
    return torch.where(bright, armed_anew, 0.0).sum(-1) > _BRIGHT * detected.sum(-1)


def rows_by_contrast(rate: Tensor) -> Iterator[tuple[Tensor | None, int]]:
    """(indices of rows, None for all; pieces of their bins), so that light changes by few photons a piece.

    What all bins have in common is left out: constant light is exact in bins of any width.
    """
    peak = torch.nan_to_num(rate.amax(-1) - rate.amin(-1)) / _CONTRAST
    level = torch.ceil(torch.log2(peak.clamp(1, _FINEST / 2)) - 1e-9).long()
    for k in range(int(_FINEST).bit_length()):
        rows = (level == k).nonzero().flatten()
        if rows.numel():
            yield (None if rows.numel() == rate.shape[0] else rows), 1 << k


def _placed(whole: FreeRunningState, part: FreeRunningState, rows: Tensor) -> FreeRunningState:
    """`whole` with `part` in these rows."""
    return FreeRunningState(
        whole.detected.index_copy(0, rows, part.detected),
        whole.armed.index_copy(0, rows, part.armed),
        whole.late.index_copy(0, rows, part.late),
        whole.whole,
    )


def _settled(safe: Tensor, dead_bins: Tensor, pieces: int) -> FreeRunningState:
    """Of rows above 0, bins cut in `pieces` or as many more as they need."""
    state = _solved(safe, dead_bins, pieces)
    low, high = state.detected.aminmax(dim=-1)
    rows = (~(low >= -_BELOW_ZERO * high)).nonzero().flatten()
    while rows.numel():
        before = state.detected[rows]
        pieces *= 2
        if pieces > _FINEST:
            raise TorchTransientError(
                f"stationary_state: expected counts that settle when bins are cut, got {rows.numel()} pixels that do "
                f"not with bins cut in {_FINEST}. The dead time locks the phase more narrowly than that; use narrower "
                "bins, or less light in a bin."
            )
        finer = _solved(safe[rows], dead_bins, pieces)
        state = _placed(state, finer, rows)
        now = finer.detected
        low, high = now.aminmax(dim=-1)
        settled = (now - before).abs().sum(-1) <= _SETTLED * now.sum(-1)
        rows = rows[~(settled & (low >= -_BELOW_ZERO * high))]
    return state


def per_period(chain: RenewalChain, lines: Tensor) -> Tensor:
    """Stationary lines whose counts sum to 1 -> detections per period."""
    # from one detection to the next a detector is dead, then armed
    return lines * (chain.bins / (chain.whole + chain.part + chain.waiting(lines)))


def late_lines(lines: Tensor, part: Tensor) -> Tensor:
    """Of detections on lines (P, 2 T): those that are armed again after one bin more than the whole dead time."""
    bins = lines.shape[-1] // 2
    return part * lines[:, :bins] + math.sqrt(3.0) * (1 - part) * part * lines[:, bins:]


def within_limits(chain: RenewalChain, lines: Tensor) -> FreeRunningState:
    """Of lines (P, 2 N), which may dip below zero where detections crowd at an edge: what can be drawn from."""
    count = lines[:, : chain.bins].clamp_min(0)
    late = torch.minimum(late_lines(lines, chain.part).clamp_min(0), count)
    armed = chain.at_start(chain.inflow(lines)).clamp(0, 1)
    return FreeRunningState(count, armed, late, chain.whole)


def _solved(rate: Tensor, dead_bins: Tensor, pieces: int) -> FreeRunningState:
    """With every bin cut in `pieces` of equal rate, and put together again."""
    pixels, bins = rate.shape
    fine = (rate / pieces).repeat_interleave(pieces, -1) if pieces > 1 else rate
    whole, part = whole_and_part(dead_bins * pieces)
    part = part.to(rate.device)
    chain = RenewalChain(fine, whole, part)
    lines = per_period(chain, stationary_phases(fine, part, whole))
    count, slope = lines.view(pixels, 2, bins, pieces).unbind(1)
    armed = chain.at_start(chain.inflow(lines)).view(pixels, bins, pieces)[..., 0]
    first = 1 - part
    soon = first * count - math.sqrt(3.0) * first * part * slope  # detected in the first 1 - part of a piece
    place = torch.arange(pieces, device=rate.device) + whole % pieces
    late = (soon * (place >= pieces) + (count - soon) * (place + 1 >= pieces)).sum(-1)
    return FreeRunningState(count.sum(-1), armed, late, whole // pieces)
