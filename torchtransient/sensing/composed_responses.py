"""Responses made of others: measured histograms, and independent delays one after another."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor, nn

from torchtransient.errors import ShapeError, UnitError
from torchtransient.sensing.checks import check_choice, check_seconds, reals
from torchtransient.sensing.responses import (
    CLOSED_BINS,
    Core,
    GaussianResponse,
    Response,
    TailedResponse,
    WithinBin,
    above_floor,
    counts_before,
    integrated_counts,
    kernel_of,
)
from torchtransient.sensing.time_convolution import filter_rows

Align = Literal["center_of_mass", "start"]

_TABLE = 2000  # bins of a response without a closed form
_FINE = 9  # grid points in a bin, odd


class MeasuredResponse(Response):
    """Measured histogram as a response, resampled by integrating.

    Args:
        counts: (T,), T >= 2, finite, >= 0.
        bin_width_s: bin width in seconds.
        delay_s: delay in seconds.
        align: "center_of_mass" puts the mean delay at `delay_s` (the highest bin would shift an asymmetric response by
            about its tail); "start" the start of the first bin.
        floor: background taken off every bin: True for the median of all bins, False for nothing, or a number of
            counts. The rest is normalised to 1.
        learnable: learn the delay and the shape (as logits).

    Raises:
        ShapeError: for other shapes.
        UnitError: for counts without a peak above their median.
    """

    shares: Tensor

    share_logits: Tensor

    def __init__(
        self,
        counts: Tensor,
        bin_width_s: float,
        delay_s: float = 0.0,
        *,
        align: Align = "center_of_mass",
        floor: float | bool = True,
        learnable: bool = False,
    ) -> None:
        super().__init__(delay_s, learnable)
        check_choice(align, Align, "align", "MeasuredResponse")
        self.bin_width_s = check_seconds(bin_width_s, "bin_width_s", "MeasuredResponse", open_low=True)
        values = reals("MeasuredResponse", torch.float64, counts=counts)[0].detach().double()
        if values.ndim != 1 or values.numel() < 2:
            raise ShapeError(f"MeasuredResponse: expected counts (T,) with T >= 2, got {tuple(values.shape)}.")
        if not bool(torch.isfinite(values).all()) or not bool((values.amax() > values.median()) & (values >= 0).all()):
            raise UnitError("MeasuredResponse: expected finite counts >= 0 with a peak above their median.")
        shares = above_floor(values, floor, "MeasuredResponse")
        self.align: Align = align
        if self.learnable:
            # a bin without light starts at e^-30 of the whole, so that it can be learnt at all
            self.register_parameter("share_logits", nn.Parameter(shares.clamp_min(1e-13).log()))
        else:
            self.register_buffer("shares", shares)

    def _shares(self) -> Tensor:
        if self.learnable:
            logits: Tensor = self.share_logits
            return logits.double().softmax(0)
        return self.shares.double()

    def _start_s(self, shares: Tensor) -> Tensor:
        if self.align == "start":
            return self.delay_s
        middles = (torch.arange(shares.numel(), dtype=torch.float64, device=shares.device) + 0.5) * self.bin_width_s
        return self.delay_s - (shares * middles).sum()

    def cdf(self, time_s: Tensor) -> Tensor:
        shares = self._shares()
        return counts_before(shares, self.bin_width_s, time_s, self._start_s(shares))

    def integrals(self, time_s: Tensor) -> tuple[Tensor, Tensor]:
        shares = self._shares()
        start = self._start_s(shares)
        end = start + shares.numel() * self.bin_width_s
        # seen from its end, the response runs the other way
        above = integrated_counts(shares.flip(0), self.bin_width_s, end - time_s)
        return integrated_counts(shares, self.bin_width_s, time_s, start), above

    def support_s(self) -> tuple[float, float]:
        shares = self._shares()
        start = float(self._start_s(shares).detach())
        kept = torch.nonzero(shares > 1e-12).flatten()
        return start + int(kept[0]) * self.bin_width_s, start + (int(kept[-1]) + 1) * self.bin_width_s


class ComposedResponse(Response):
    """Independent delays one after another: laser pulse, detector jitter, timing electronics. Variances add.

    Normal ones, with at most one `TailedResponse` among them, have a closed form. Others are convolved on a grid finer
    than the bins, and gathered into bins at the end. The grid, nine points in a bin, keeps the mean and adds a variance
    of (bin width/9)^2/6 for each; with `within_bin="center"` half of that.

    Args:
        responses: one or more responses, whose delays add up.
    """

    def __init__(self, responses: Sequence[Response]) -> None:
        super().__init__(0.0, learnable=False)
        self.responses = nn.ModuleList(responses)

    def _closed(self) -> tuple[GaussianResponse | TailedResponse, Core] | None:
        """Return the tailed response, or a normal one, and the core of all together; None if there are other parts."""
        parts = [r for r in self.responses if isinstance(r, (GaussianResponse, TailedResponse))]
        tailed = [r for r in parts if isinstance(r, TailedResponse)]
        if len(tailed) > 1 or len(parts) < len(self.responses):
            return None
        delay = torch.stack([r.delay_s for r in parts]).sum()
        sigma = torch.stack([r.sigma_s for r in parts]).square().sum().sqrt()
        return (tailed or parts)[0], (delay, sigma)

    def cdf(self, time_s: Tensor) -> Tensor:
        """Without a closed form: from a histogram of 2000 bins, 1e-6 off where the parts are of one size."""
        if len(self.responses) == 1:
            return self.responses[0].cdf(time_s)  # type: ignore[operator, no-any-return]
        if (closed := self._closed()) is not None:
            return closed[0].cdf(time_s, closed[1])
        shares, width_s, start_s = self._table()
        return counts_before(shares, width_s, time_s, start_s)

    def survival(self, time_s: Tensor) -> Tensor:
        if len(self.responses) == 1:
            return self.responses[0].survival(time_s)  # type: ignore[operator, no-any-return]
        if (closed := self._closed()) is not None:
            return closed[0].survival(time_s, closed[1])
        shares, width_s, start_s = self._table()
        # seen from its end, the response runs the other way
        return counts_before(shares.flip(0), width_s, -time_s, -(start_s + shares.numel() * width_s))

    def _table(self) -> tuple[Tensor, float, float]:
        """Return shares (K,) in bins of a width that suits the response, the width, and the start of the first."""
        low, high = self.support_s()
        width_s = (high - low) / _TABLE
        first, shares = self.kernel(width_s)
        return shares, width_s, (first - 0.5) * width_s

    def integrals(self, time_s: Tensor) -> tuple[Tensor, Tensor] | None:
        closed = self._closed()
        return None if closed is None else closed[0].integrals(time_s, closed[1])

    def support_s(self) -> tuple[float, float]:
        # the sum of all supports holds all of it, and more
        ends = [r.support_s() for r in self.responses]  # type: ignore[operator]
        return sum(low for low, _ in ends), sum(high for _, high in ends)

    def kernel(self, bin_width_s: float, within_bin: WithinBin = "uniform") -> tuple[int, Tensor]:
        check_choice(within_bin, WithinBin, "within_bin", "ComposedResponse")
        if len(self.responses) == 1:
            return kernel_of(self.responses[0], bin_width_s, within_bin)  # type: ignore[arg-type]
        if within_bin == "uniform" and self._closed() is not None:
            first, last = self._lags(bin_width_s)
            if last - first <= CLOSED_BINS:
                return super().kernel(bin_width_s)
        fine = _FINE
        parts = [kernel_of(r, bin_width_s / fine, within_bin) for r in self.responses]  # type: ignore[arg-type]
        first = sum(begin for begin, _ in parts)
        total = functools.reduce(_full_convolution, [weights for _, weights in parts])
        # a fine lag goes to the bin round(lag/fine), or, where light is spread evenly, to two bins by linear shares,
        # which are `fine` such roundings from all places of a bin
        places = [(fine - 1) // 2] if within_bin == "center" else range(fine)
        coarse = first // fine
        tops = [_gathered(total, first + place - coarse * fine, fine, len(total) // fine + 3) for place in places]
        shares = torch.stack(tops).mean(0)
        return coarse, shares / shares.sum()


def _gathered(fine_shares: Tensor, before: int, fine: int, bins: int) -> Tensor:
    """Sums over `fine` neighbours each, the first entry standing `before` entries into the first of `bins` sums."""
    padded = torch.nn.functional.pad(fine_shares, (before, bins * fine - before - fine_shares.numel()))
    return padded.view(bins, fine).sum(1)


def _full_convolution(a: Tensor, b: Tensor) -> Tensor:
    length = a.numel() + b.numel() - 1
    return filter_rows(a, torch.fft.rfft(b, n=length), length, 0, length)
