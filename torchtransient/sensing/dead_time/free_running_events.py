"""Trains of a free-running detector, detection by detection, many pixels side by side.

Exact where counts are few, or where the phase of detections is remembered for so long that no limit theorem holds: one
wait of an exponential clock in units of flux for every detection. The cost grows with the number of detections.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchtransient.sensing.dead_time.free_running_state import FreeRunningState

_TRIES = 64  # for a place in the piece that holds the detection just one dead time ago
_LATER = 32  # detections between looks at which pixels are done


def begin_places(state: FreeRunningState, part: Tensor, generator: torch.Generator | None) -> Tensor:
    """When each detector (P,) is armed for the first time, in pieces after the start: 0, or up to a dead time later.

    `state`: the stationary one of pieces (P, N), whose dead time is `state.whole` of them and a `part` of one.
    """
    count = state.detected
    pixels, size = count.shape
    dead = state.whole + part
    index = torch.arange(size, dtype=torch.float64, device=count.device)
    # earlier periods in which a detection of this piece would still be felt, the piece where it only may be included
    rounds = torch.ceil((index + 1 + dead) / size - 1e-12) - 1
    weights = (count * rounds).cumsum(-1)

    def uniform() -> Tensor:
        return torch.rand(pixels, 1, dtype=torch.float64, device=count.device, generator=generator)

    armed = state.armed[:, :1]
    start = torch.zeros_like(armed)
    left = (uniform() >= armed) & (weights[:, -1:] > 0)
    share = state.late / count  # NaN of pieces that nothing is drawn from
    for _ in range(_TRIES):
        if not bool(left.any()):
            break
        piece = torch.searchsorted(weights, uniform() * weights[:, -1:], right=True).clamp_max(size - 1)
        # in the last `part` of the piece with the chance of the line, evenly inside either stretch
        at_end = uniform() < share.gather(1, piece)
        inside = torch.where(at_end, 1 - part * uniform(), (1 - part) * uniform())
        before = torch.floor(uniform() * rounds[piece]) + 1
        free = piece + inside - before * size + dead
        start = torch.where(left & (free > 0), free, start)
        left = left & (free <= 0)
    return start


def event_counts(
    rate: Tensor, dead: Tensor, start: Tensor, periods: int, generator: torch.Generator | None
) -> Tensor:
    """Counts (P, T) over `periods` periods for rates (P, T) per period, float64, above 0 in all.

    `dead`: in bins. `start` (P, 1): when detectors are armed for the first time, in bins. Detections are spread by the
    light inside a bin, which is constant there.
    """
    pixels, bins = rate.shape
    counts = torch.zeros_like(rate)
    flux = torch.cat([torch.zeros_like(rate[:, :1]), rate.cumsum(-1)], -1)
    rounds, rest = divmod(float(dead), bins)
    rows = torch.arange(pixels, device=rate.device)
    period = torch.floor(start / bins)
    place = start - period * bins
    hits = counts
    while rows.numel():
        total, upto = flux[:, -1:], flux[:, 1:].contiguous()
        for _ in range(_LATER):
            k = place.long().clamp_max_(bins - 1)
            target = flux.gather(1, k).addcmul_(rate.gather(1, k), place - k)
            target += torch.empty_like(target).exponential_(generator=generator)
            over = torch.floor(target / total)
            target.addcmul_(over, total, value=-1)
            period += over
            k = torch.searchsorted(upto, target, right=True).clamp_max_(bins - 1)
            hits.scatter_add_(1, k, (period < periods).to(hits.dtype))
            inside = (target - flux.gather(1, k)) / rate.gather(1, k)
            place = inside.nan_to_num_(0.0, 0.0, 0.0).clamp_(0, 1) + k + rest
            over = (place >= bins).to(place.dtype)
            place.sub_(over, alpha=bins)
            period += over + rounds
        going = (period < periods).squeeze(-1)
        if hits is not counts:
            counts[rows] = hits
        if not bool(going.all()):
            rows, rate, flux = rows[going], rate[going], flux[going]
            place, period = place[going], period[going]
            hits = counts[rows]
    return counts
