"""The renewal chain in constant light, diagonal in the frequencies of the period: a preconditioner for other light."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchtransient.sensing.dead_time.renewal_chain import bin_response


class ConstantLight:
    """Inverse of 1 - F + 1/T (sum of counts), F the step of the chain at one rate per pixel; lines (P, 2 T).

    In bright light phases turn almost rigidly with every detection, and 1 - F is nearly singular for patterns that the
    dead time maps on themselves. Where they are and how fast they fade depends on dead time and mean wait alone.
    """

    def __init__(self, mean_wait: Tensor, bins: int, whole: int, part: Tensor, kept: Tensor | None = None) -> None:
        """`mean_wait`: (P, 1), in bins. `kept` (P, 1): the share below 1 of what detections leave, then of 1 - kept F.
        """
        self.bins = bins
        bin_ = bin_response(1 / mean_wait, part)
        turn = -2j * math.pi / bins * torch.arange(bins // 2 + 1, device=mean_wait.device, dtype=torch.float64)
        shifts = torch.exp(turn * (whole % bins)), torch.exp(turn * ((whole + 1) % bins))

        def moved(inflow: Tensor) -> Tensor:
            """(P, 2, K): response to constants and slopes."""
            return inflow[:, :2] * shifts[0] + inflow[:, 2:] * shifts[1]

        late = torch.exp(turn) / (1 - bin_.decay * torch.exp(turn))
        armed = late.unsqueeze(1) * moved(bin_.kept)
        count = -(moved(bin_.hit) + bin_.fire.unsqueeze(1) * armed)
        slope = -(moved(bin_.hit_slope) + bin_.slope.unsqueeze(1) * armed)
        if kept is not None:
            count, slope = count * kept.unsqueeze(-1), slope * kept.unsqueeze(-1)
        a, b, c, d = count[:, 0] + 1, count[:, 1], slope[:, 0], slope[:, 1] + 1
        if kept is None:
            # detections are conserved: the mean of the counts is left to the rank-one term
            a[:, 0], b[:, 0] = 1, 0
        determinant = a * d - b * c
        self.inverse = torch.stack([d, -b, -c, a], 1) / determinant.unsqueeze(1)

    def solve(self, lines: Tensor) -> Tensor:
        return self._apply(lines, self.inverse)

    def solve_transposed(self, lines: Tensor) -> Tensor:
        return self._apply(lines, self.inverse[:, [0, 2, 1, 3]].conj())

    def _apply(self, lines: Tensor, m: Tensor) -> Tensor:
        count, slope = torch.fft.rfft(lines.view(-1, 2, self.bins)).unbind(1)
        found = torch.stack([m[:, 0] * count + m[:, 1] * slope, m[:, 2] * count + m[:, 3] * slope], 1)
        solved: Tensor = torch.fft.irfft(found, n=self.bins).reshape(-1, 2 * self.bins)
        return solved
