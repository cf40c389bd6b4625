"""How often carriers fire a detector that is armed: after a detection it is armed again just when carriers come.

A carrier that is trapped is set free after an exponential time, whatever the detector does: it fires it when it is
armed and is lost when it is dead. What is followed are factorial moments of the numbers of trapped carriers, in bins
and over armed detectors: F of none (the chance to be armed), F_k of one of kind k, F_kl of ordered pairs. All of them
obey the renewal equation of the detector, with carriers set free as a loss,

    dF_S/dt = -(n + H_S + sum 1/tau) F_S + [what came back from detections one dead time ago],

H_S being the rate of all other carriers. Detections leave S as it is (thinned by those set free during the dead time)
or put a new carrier to what lacks it. The rate that fires an armed detector, H of none, is sum F_k / (tau_k F): with
it the balance of a detector that knows phases only has the mean of the one that knows its carriers. Pairs are followed
too; of triples the rate of others is H_k + H_l - H, which is right where carriers are independent (as many of them are)
and where detections have at most two between them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from torchtransient.sensing.correlated_noise.trapped_ring import trapped_lines
from torchtransient.sensing.dead_time.dead_time_cycle import (
    PHOTONS,
    BlockWalk,
    armed_of_pieces,
    row_levels,
    whole_and_part,
)
from torchtransient.sensing.dead_time.dead_time_walk import degree_of, response_series
from torchtransient.sensing.dead_time.free_running_state import DARK, per_period, rows_by_contrast
from torchtransient.sensing.dead_time.renewal_chain import BinResponse, RenewalChain, bin_response
from torchtransient.sensing.dead_time.stationary_phases import stationary_phases

_LEFT = 1e-5  # generations end: some ten times the error of counts that is left
_SERIES = 2.0  # photons of a piece, up to which powers of them add up to all digits that count
_AT_ONCE = 1 << 15  # pieces: as many as stay in the cache
_EXPONENT = 500.0  # of a stretch, inside float64


class Train(Protocol):
    """A detector whose detections are on straight lines, in pieces of bins."""

    def bare(self, rate: Tensor) -> tuple[Tensor, Tensor]:
        """Rates (R, N) -> (pieces that it is armed in each (R, N), lines of detections (R, 2, N))."""
        ...

    def trapped(self, rate: Tensor, lost: Tensor, back: Tensor, source: Tensor) -> tuple[Tensor, Tensor]:
        """The same of what is also lost at the rate `lost` (R, 1), comes back by the share `back` (R, 1) of detections
        and is put by the lines `source` (R, 2, N)."""
        ...


def _response(loss: Tensor, part: Tensor, largest: float) -> BinResponse:
    """`bin_response`; of few photons one matrix times their powers, in a quarter of the time."""
    if largest > _SERIES or part.requires_grad:
        return bin_response(loss, part, largest)
    series = response_series(float(part), degree_of(largest))[0].to(loss.device)
    order = [2, 3, 0, 1, 4]  # younger lines first
    kept, hit, slope = series[:, order].unbind(0)
    waited = torch.nn.functional.pad(hit[:, 1:], (0, 1))
    powers = [torch.ones_like(loss), loss]
    for _ in range(series.shape[-1] - 2):
        powers.append(powers[-1] * loss)
    rows = torch.cat([kept, waited, slope])
    found = torch.mm(rows, torch.stack(powers).flatten(1)).view(15, *loss.shape)
    kept, waited, slope = (v.movedim(0, 1) for v in torch.split(found, 5))
    return BinResponse(
        kept[:, :4], waited[:, :4], waited[:, :4], slope[:, :4], kept[:, 4], slope[:, 4], waited[:, 4], kept[:, 4]
    )


@dataclass(frozen=True)
class CycleTrain:
    """Armed at the start of a cycle, without carriers of this cycle."""

    whole: int
    part: Tensor
    largest: float  # rates, but for those lost

    def bare(self, rate: Tensor) -> tuple[Tensor, Tensor]:
        return self._walk(rate, rate, None, None, self.largest)

    def trapped(self, rate: Tensor, lost: Tensor, back: Tensor, source: Tensor) -> tuple[Tensor, Tensor]:
        return self._walk(rate, rate + lost, back.unsqueeze(-1), source, self.largest + float(lost.detach().amax()))

    def _walk(
        self, rate: Tensor, loss: Tensor, back: Tensor | None, source: Tensor | None, largest: float
    ) -> tuple[Tensor, Tensor]:
        pieces = rate.shape[-1]
        bins = _response(loss, self.part, largest)
        kept = None if source is None else rate / loss
        start = torch.ones_like(rate[:, :1]) if source is None else torch.zeros_like(rate[:, :1])
        walk, put = BlockWalk(pieces, self.whole, 1), None
        if source is not None:
            put = torch.cat([torch.nn.functional.pad(source, (self.whole + k, 0))[..., :pieces] for k in (0, 1)], 1)
        stretch = max(1, math.floor(_EXPONENT / max(largest, 1e-3)))
        found: list[tuple[Tensor, Tensor, Tensor]] = []
        # split, since derivatives of slices are as large as what they are taken from
        needed = (bins.kept, bins.waited, bins.hit_slope, bins.wait, bins.slope, rate, loss)
        columns = [torch.split(value, self.whole, -1) for value in needed]
        none: list[Tensor | None] = [None] * len(columns[0])
        sources = none if put is None else torch.split(put, self.whole, -1)
        shares = none if kept is None else torch.split(kept, self.whole, -1)
        for own, put_here, share in zip(zip(*columns, strict=True), sources, shares, strict=True):
            kept_, waited_, slope_, wait, fire_slope, light, lost = own
            inflow = walk.inflow(light.shape[-1])
            if put_here is not None and back is not None and inflow is not None:
                inflow = inflow * back + put_here
            joined = None if inflow is None else (kept_ * inflow).sum(1)
            armed, start = armed_of_pieces(start, lost, joined, stretch)
            waited, slope = armed * wait, armed * fire_slope
            if inflow is not None:
                waited = waited + (waited_ * inflow).sum(1)
                slope = slope + (slope_ * inflow).sum(1)
            count = light * waited
            slope = slope if share is None else slope * share
            walk.keep(count, slope)
            found.append((waited, count, slope))
        waited, count, slope = (torch.cat(c, -1) for c in zip(*found, strict=True))
        return waited, torch.stack([count, slope], 1)


@dataclass(frozen=True)
class RingTrain:
    """A detector that runs free, in its stationary state."""

    whole: int
    part: Tensor

    def bare(self, rate: Tensor) -> tuple[Tensor, Tensor]:
        chain = RenewalChain(rate, self.whole, self.part)
        lines = per_period(chain, stationary_phases(rate, self.part, self.whole))
        back = chain.inflow(lines)
        waited = chain.at_start(back) * chain.response.wait + (chain.response.waited * back).sum(1)
        return waited, lines.view(rate.shape[0], 2, -1)

    def trapped(self, rate: Tensor, lost: Tensor, back: Tensor, source: Tensor) -> tuple[Tensor, Tensor]:
        loss = rate + lost
        kept = rate / loss
        lines = trapped_lines(loss, kept * back, source.flatten(1), self.part, self.whole).view_as(source)
        return lines[:, 0] / loss, lines * kept.unsqueeze(1)


def _ratio(part: Tensor, whole: Tensor) -> Tensor:
    """part / whole, at least 0, and 0 where nothing is."""
    some = whole > 1e-200
    return torch.where(some, part / torch.where(some, whole, torch.ones_like(whole)), 0.0).clamp_min(0)


def armed_hazard(
    train: Train,
    photons: Callable[[Tensor], Tensor] | None,
    first: Tensor,
    gate: Tensor | None,
    seen: Tensor,
    tau: Tensor,
    dead: Tensor,
) -> tuple[Tensor, Tensor]:
    """(Rate of carriers that fire an armed detector (P, N), pieces of time that it is armed (P, N)), per piece.

    `first` (P, N): photons; `photons`: all else that fires it, from the detections of the round before; None: these.
    `gate` (N,): share of carriers that are seen. `seen`, `tau` (K,): carriers of a detection and their mean delays
    beyond the dead time `dead`, in pieces.
    """
    kinds, (pixels, pieces) = tau.shape[0], first.shape
    one, stay = (1 / tau).view(1, kinds, 1), torch.exp(-dead / tau).view(1, kinds, 1)
    p = seen.view(1, kinds, 1)
    # of pairs: lost, come back, and the chance that one detection leaves both
    pair_lost = (one.unsqueeze(2) + one.unsqueeze(1)).expand(pixels, -1, -1, -1)
    pair_stay = (stay.unsqueeze(2) * stay.unsqueeze(1)).expand(pixels, -1, -1, -1)
    other = 1 - torch.eye(kinds, dtype=p.dtype, device=p.device).view(1, kinds, kinds, 1)
    pair_new = p.unsqueeze(2) * p.unsqueeze(1) * other

    def level(
        rate: Tensor, lost: Tensor, back: Tensor, source: Tensor, shape: tuple[int, ...]
    ) -> tuple[Tensor, Tensor]:
        waited, lines = train.trapped(
            rate.reshape(-1, pieces), lost.reshape(-1, 1), back.reshape(-1, 1), source.reshape(-1, 2, pieces)
        )
        return waited.view(*shape, pieces), lines.view(*shape, 2, pieces)

    alone = first
    hazard = torch.zeros_like(first)  # given none,
    given = first.new_zeros(pixels, kinds, pieces)  # given one of each kind
    waited = torch.zeros_like(first)
    number = _rounds(seen)
    for k in range(number):
        waited, bare = train.bare(alone + hazard)
        own = alone.unsqueeze(1) + given
        singles, lines = level(
            own, one.expand(pixels, -1, -1), stay.expand(pixels, -1, -1), p.unsqueeze(-1) * bare.unsqueeze(1),
            (pixels, kinds),
        )  # fmt: skip
        if k and (number - k) % 2 == 0:  # what pairs do comes with p^2
            more = (given.unsqueeze(2) + given.unsqueeze(1) - hazard[:, None, None]).clamp_min(0)
            put = p.view(1, kinds, 1, 1, 1) * (stay.view(1, 1, kinds, 1, 1) * lines.unsqueeze(1))
            source = put + put.transpose(1, 2) + pair_new.unsqueeze(-1) * bare[:, None, None]
            pairs, _ = level(alone[:, None, None] + more, pair_lost, pair_stay, source, (pixels, kinds, kinds))
            given = _ratio((pairs * one.unsqueeze(1)).sum(2), singles)
        hazard = _ratio((singles * one).sum(1), waited)
        if gate is not None:
            given, hazard = given * gate, hazard * gate
        if photons is not None:
            alone = photons(bare[:, 0])
    return hazard, waited


def _rounds(seen: Tensor) -> int:
    most = float(seen.detach().sum())
    return max(2, math.ceil(math.log(_LEFT) / math.log(most))) if most > _LEFT else 1


def _coarser(hazard: Tensor, waited: Tensor, pieces: int) -> Tensor:
    """Per piece while armed -> per `pieces` of them while armed."""
    shape = (hazard.shape[0], -1, pieces)
    return pieces * _ratio((hazard * waited).view(shape).sum(-1), waited.view(shape).sum(-1))


def _finer(value: Tensor, pieces: int) -> Tensor:
    return (value / pieces).repeat_interleave(pieces, -1)


def of_cycles(
    rate: Tensor,
    dead_bins: Tensor,
    gate: Tensor | None,
    seen: Tensor,
    tau: Tensor,
    earlier: Callable[[Tensor, Tensor | slice], Tensor],
    steps: int = 1,
) -> Tensor:
    """Carriers set free per cycle while a detector is armed, (P, steps T): in `steps` (2^k) equal parts of bins.

    The detector is armed at the start of cycles. `rate` (P, T) photons; `gate` (T,) multiplies them and carriers;
    `earlier(detections, rows)`: carriers of other cycles. `tau` (K,) in bins.
    """
    size = rate.shape[-1]
    least = max(steps, 1 if float(dead_bins) >= 1 - 1e-9 else 2)
    level, present, hidden = row_levels(rate + (seen / tau).sum(), least)

    def solved(rows: Tensor, at: Tensor | slice, pieces: int) -> Tensor:
        def photons(detected: Tensor) -> Tensor:
            free = earlier(detected.view(rows.shape[0], size, pieces).sum(-1), at)
            last.append(free)
            return _finer(rows + free if gate is None else (rows + free) * gate, pieces)

        last: list[Tensor] = []
        train = CycleTrain(*whole_and_part(dead_bins * pieces), 2 * PHOTONS)
        opened = None if gate is None else gate.repeat_interleave(pieces, -1)
        first = _finer(rows if gate is None else rows * gate, pieces)
        hazard, waited = armed_hazard(train, photons, first, opened, seen, tau * pieces, dead_bins * pieces)
        own = _coarser(hazard, waited, pieces // steps)
        if gate is not None:
            own = _ratio(own, gate.repeat_interleave(steps, -1).expand_as(own))
        return own + _finer(last[-1], steps)

    def chunks(rows: Tensor, at: Tensor, pieces: int) -> Tensor:
        few = max(1, _AT_ONCE // (size * pieces))
        parts = [solved(r, i, pieces) for r, i in zip(torch.split(rows, few), torch.split(at, few), strict=True)]
        return torch.cat(parts) if len(parts) > 1 else parts[0]

    if len(present) == 1:
        return chunks(rate, torch.arange(rate.shape[0], device=rate.device), least << present[0])
    found = rate.new_zeros(rate.shape[0], steps * size)
    for k in present:
        if hidden:
            here = (level == k).unsqueeze(-1)
            own = solved(torch.where(here, rate, 0.0), slice(None), least << k)
            found = found + torch.where(here, own, 0.0)
        else:
            rows = (level == k).nonzero().squeeze(-1)
            found = found.index_copy(0, rows, chunks(rate[rows], rows, least << k))
    return found


def of_free_running(rate: Tensor, dead_bins: Tensor, seen: Tensor, tau: Tensor, steps: int = 1) -> Tensor:
    """The same of a detector that runs free, for rates (P, T) per period; 0 in the dark."""
    dark = rate.sum(-1, keepdim=True) < DARK
    safe = torch.where(dark, 0.1, rate)
    found = rate.new_zeros(rate.shape[0], steps * rate.shape[-1])
    for rows, cut in rows_by_contrast(safe):
        pieces = max(cut, steps)
        fine = _finer(safe if rows is None else safe[rows], pieces)
        train = RingTrain(*whole_and_part(dead_bins * pieces))
        hazard, waited = armed_hazard(train, None, fine, None, seen, tau * pieces, dead_bins * pieces)
        own = _coarser(hazard, waited, pieces // steps)
        found = own if rows is None else found.index_copy(0, rows, own)
    return torch.where(dark, 0.0, found)
