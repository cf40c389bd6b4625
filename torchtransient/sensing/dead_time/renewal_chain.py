"""The Markov chain of detection phases under a non-paralyzable dead time.

In every bin the density of detections is a straight line, kept by two coefficients (of 1 and of sqrt(3) (2 y - 1), y
from 0 to 1 across the bin). Dead time moves the lines, also by fractions of a bin; what they become while armed
detectors decay is integrated exactly and put on a straight line again, with count and mean place kept. Constant light,
and a dead time of whole periods in any light, are solved exactly, other light to third order in the width of bins.

One step is a shift followed by a decaying sum round the period: O(T) in time and memory, never the matrix of a pixel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchtransient.sensing.numerics.exponential_moments import moments

# exp(+-x) of the running sums stays inside float64 below this flux; beyond, sums are made in blocks
_SAFE_EXPONENT = 600.0
_ROOT = math.sqrt(3.0)


@dataclass(frozen=True)
class BinResponse:
    """What a bin of constant rate does to the detectors that come back in it and to those armed at its start.

    Inflow has four parts, dimension 1 of (P, 4, T): constant and slope of the line from `whole` bins ago, then of that
    from one bin earlier.
    """

    kept: Tensor  # inflow still armed at the end of the bin
    waited: Tensor  # bins that the inflow waits, armed, in this bin
    hit: Tensor  # inflow detected in this bin
    hit_slope: Tensor  # slope coefficient of these detections
    fire: Tensor  # (P, T), of those armed at the start: detected,
    slope: Tensor  # slope coefficient of these detections,
    wait: Tensor  # bins waited,
    decay: Tensor  # still armed at the end


def bin_response(rate: Tensor, part: Tensor, largest: float | None = None) -> BinResponse:
    """For rates (P, T) per bin and the fraction of a bin in the dead time, float64, differentiable in both.

    `largest`: a bound of the rates, where it is known.
    """
    first = 1 - part  # inflow of the younger line lasts from `part` to the end of the bin, `first` long

    def parts(near: tuple[Tensor, Tensor], whole: tuple[Tensor, Tensor]) -> Tensor:
        """From integrals of g(z) and z g(z), z the time to the end of the bin, up to `first` and over all of it."""
        rest = whole[0] - near[0], whole[1] - near[1]
        young = (2 * first - 1) * near[0] - 2 * near[1]
        old = (2 * first + 1) * rest[0] - 2 * rest[1]
        return torch.stack([near[0], _ROOT * young, rest[0], _ROOT * old], 1)

    near, over = moments(rate * first, largest), moments(rate, largest)
    kept = parts((first * near.decay[0], first**2 * near.decay[1]), over.decay)
    waited = parts((first**2 * near.hit[0], first**3 * near.hit[1]), over.hit)
    one = torch.ones(1, 1, dtype=rate.dtype, device=rate.device)
    count = parts((first * one, first**2 * one / 2), (one, one / 2))
    place = parts((first**2 * one / 2, first**3 * one / 3), (one / 2, one / 3))
    wait, decay = over.decay[0], torch.exp(-rate)
    return BinResponse(
        kept=kept,
        waited=waited,
        hit=rate.unsqueeze(1) * waited,
        # 2 y - 1 of a detection: by parts, from where the inflow is, how long it waits and what is left
        hit_slope=_ROOT * (count - 2 * place + 2 * waited - kept),
        fire=-torch.expm1(-rate),
        slope=_ROOT * (2 * wait - 1 - decay),
        wait=wait,
        decay=decay,
    )


class RenewalChain:
    """One step of the chain and its transpose, for rates (P, T) per period, float64, on lines (P, 2 T)."""

    def __init__(self, rate: Tensor, whole: int, part: Tensor) -> None:
        self.bins = rate.shape[-1]
        self.response = bin_response(rate, part)
        total = rate.sum(-1, keepdim=True)
        # a detector that waits for a whole period without a detection: the sum over all periods is 1/(1 - exp(-total))
        self.rounds = 1 / -torch.expm1(-total)
        self.rate, self.whole, self.part = rate, whole, part
        before = rate.cumsum(-1) - rate
        self.reached = torch.exp(-before)
        self.blocks = self._blocks(before)

    def _blocks(self, before: Tensor) -> list[tuple[int, int, Tensor, Tensor]]:
        """(begin, end, exp(-flux since begin), exp(+the same)) for stretches short enough for float64."""
        begin, blocks = 0, []
        while begin < self.bins:
            flux = before[:, begin:] - before[:, begin : begin + 1]
            inside = int((flux.amax(0) <= _SAFE_EXPONENT).sum())
            end = begin + max(1, inside)
            part = flux[:, : end - begin]
            blocks.append((begin, end, torch.exp(-part), torch.exp(part)))
            begin = end
        return blocks

    def armed(self, rearmed: Tensor) -> Tensor:
        """Armed at the start of bins, from those that join there: A[k] = A[k-1] exp(-rate[k-1]) + rearmed[k]."""
        parts, carry = [], torch.zeros_like(rearmed[:, :1])
        for begin, end, falling, rising in self.blocks:
            piece = falling * (carry + (rearmed[:, begin:end] * rising).cumsum(-1))
            parts.append(piece)
            carry = piece[:, -1:] * self.response.decay[:, end - 1 : end]
        # what is left at the end of the period starts the next one, and the one after, ...
        return torch.cat(parts, -1) + carry * self.rounds * self.reached

    def armed_transposed(self, weights: Tensor) -> Tensor:
        """The transpose of `armed`."""
        carry = (weights * self.reached).sum(-1, keepdim=True) * self.rounds
        parts = []
        # the last bin hands `carry` on through its own decay
        carry = carry * self.response.decay[:, -1:]
        for begin, end, falling, rising in reversed(self.blocks):
            inner = (weights[:, begin:end] * falling).flip(-1).cumsum(-1).flip(-1)
            piece = rising * (inner + carry * falling[:, -1:])
            parts.append(piece)
            if begin > 0:
                carry = piece[:, :1] * self.response.decay[:, begin - 1 : begin]
        return torch.cat(parts[::-1], -1)

    def inflow(self, lines: Tensor) -> Tensor:
        """The four parts (P, 4, T) of what comes back in every bin."""
        pair = lines.view(-1, 2, self.bins)
        return torch.cat([pair.roll(self.whole, -1), pair.roll(self.whole + 1, -1)], 1)

    def at_start(self, inflow: Tensor) -> Tensor:
        """Armed at the start of every bin (P, T)."""
        return self.armed((self.response.kept * inflow).sum(1).roll(1, -1))

    def step(self, lines: Tensor) -> Tensor:
        """Lines of the next detection."""
        back, bins = self.inflow(lines), self.response
        armed = self.at_start(back)
        count = armed * bins.fire + (bins.hit * back).sum(1)
        slope = armed * bins.slope + (bins.hit_slope * back).sum(1)
        return torch.cat([count, slope], -1)

    def transposed(self, weights: Tensor) -> Tensor:
        count, slope = weights.view(-1, 2, self.bins).unbind(1)
        bins = self.response
        kept = self.armed_transposed(bins.fire * count + bins.slope * slope).roll(-1, -1)
        back = bins.kept * kept.unsqueeze(1) + bins.hit * count.unsqueeze(1) + bins.hit_slope * slope.unsqueeze(1)
        pair = back[:, :2].roll(-self.whole, -1) + back[:, 2:].roll(-self.whole - 1, -1)
        return pair.reshape(-1, 2 * self.bins)

    def waiting(self, lines: Tensor) -> Tensor:
        """Bins that detectors wait, armed, until they detect, summed over the period: (P, 1)."""
        back = self.inflow(lines)
        spent = self.at_start(back) * self.response.wait + (self.response.waited * back).sum(1)
        return spent.sum(-1, keepdim=True)
