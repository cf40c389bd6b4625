"""Histograms that a pixel can afford: equi-depth boundaries and coded projections instead of all bins."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchtransient.checks import MOST_MADE
from torchtransient.errors import ShapeError, UnitError
from torchtransient.floating import in_single, product
from torchtransient.sensing.checks import TIME, check_bins, check_count, check_transient, reals
from torchtransient.sensing.parameters import keep_number
from torchtransient.sensing.sensor import Sensor


@in_single
def equi_depth_edges(counts: Tensor, depth: int) -> Tensor:
    """Positions between which every pixel has equal shares of its counts.

    The quantiles 1/depth, 2/depth, ... of each histogram, a bin's counts being spread evenly over it; differentiable in
    `counts` where the bin of a quantile has any. Source: Ingle and Maier, Count-free single-photon 3D imaging with race
    logic, TPAMI 2023 (their circuits track these edges).

    Args:
        counts: (..., C, T, H, W), >= 0.
        depth: number of shares, 2 and more.

    Returns:
        (..., C, depth - 1, H, W), in bins; quantiles of even light for a pixel without counts.

    Raises:
        UnitError: for negative counts.
    """
    check_bins(counts, "equi_depth_edges")
    parts = check_count(depth, "depth", "equi_depth_edges", low=2)
    if bool((counts < 0).any()):
        raise UnitError("equi_depth_edges: expected counts >= 0, got negative ones.")
    h = counts.to(torch.float64)
    bins = h.shape[TIME]
    empty = h.sum(TIME, keepdim=True) == 0
    h = torch.where(empty, torch.ones_like(h), h)
    cumulative = h.cumsum(TIME)
    total = cumulative.narrow(TIME, bins - 1, 1)
    goals = torch.arange(1, parts, dtype=torch.float64, device=h.device).view(-1, 1, 1) / parts * total
    # rows of time last, as searchsorted wants them
    rows, wanted = cumulative.movedim(TIME, -1).contiguous(), goals.movedim(TIME, -1).contiguous()
    index = torch.searchsorted(rows, wanted).clamp_max(bins - 1)
    inside = torch.gather(h.movedim(TIME, -1), -1, index)
    above = torch.gather(rows, -1, index)
    edges = index + 1 - (above - wanted) / inside
    return edges.movedim(-1, TIME).to(counts.dtype)


class EquiDepthHistogram(Sensor):
    """Counts (..., C, T, H, W) to equi-depth boundaries (..., C, depth - 1, H, W) in bins; see `equi_depth_edges`.

    Args:
        depth: number of shares, 2 and more.
    """

    def __init__(self, depth: int) -> None:
        super().__init__()
        self.depth = check_count(depth, "depth", "EquiDepthHistogram", low=2)

    def expected(self, x: Tensor) -> Tensor:
        return equi_depth_edges(x, self.depth)


def fourier_codes(num_bins: int, num_codes: int) -> Tensor:
    """Cosines and sines of the lowest frequencies over the window, rows of unit length.

    Rows 0, 1 are one turn, 2, 3 two turns, and so on (truncated Fourier of Gutierrez-Barragan et al., Compressive
    single-photon 3D cameras, CVPR 2022). The constant is left out: it does not see time.

    Args:
        num_bins: number of bins T.
        num_codes: number of codes K, at most T - 1.

    Returns:
        (K, T) float64.

    Raises:
        ShapeError: for more codes.
    """
    bins = check_count(num_bins, "num_bins", "fourier_codes", most=MOST_MADE)
    codes = check_count(num_codes, "num_codes", "fourier_codes")
    if codes > bins - 1:
        raise ShapeError(f"fourier_codes: expected at most {bins - 1} codes for {bins} bins, got {codes}.")
    t = (torch.arange(bins, dtype=torch.float64) + 0.5) / bins
    rows = []
    for k in range(codes):
        turns = 2 * math.pi * (k // 2 + 1) * t
        rows.append(torch.cos(turns) if k % 2 == 0 else torch.sin(turns))
    table = torch.stack(rows)
    lengths: Tensor = table.norm(dim=1, keepdim=True)
    return table / lengths


class CodedHistogram(Sensor):
    """Coded sums (..., C, K, H, W) of a histogram (..., C, T, H, W): y = codes h, built up on the fly in a pixel.

    Linear: shot noise belongs before it.

    Args:
        codes: codes (K, T), any real numbers.
        learnable: make the codes a parameter.

    Raises:
        ShapeError: for other shapes.
        UnitError: for codes that are not finite.
    """

    codes: Tensor

    def __init__(self, codes: Tensor, *, learnable: bool = False) -> None:
        super().__init__()
        if codes.ndim != 2:
            raise ShapeError(f"CodedHistogram: expected codes (K, T), got {tuple(codes.shape)}.")
        values = reals("CodedHistogram", torch.float64, codes=codes)[0].detach().double().clone()
        if not bool(torch.isfinite(values).all()):
            raise UnitError("CodedHistogram: expected finite codes.")
        keep_number(self, "codes", values, learnable)

    def expected(self, x: Tensor) -> Tensor:
        check_transient(x, "CodedHistogram")
        if x.shape[TIME] != self.codes.shape[1]:
            raise ShapeError(f"CodedHistogram: expected T = {self.codes.shape[1]} as in codes, got {x.shape[TIME]}.")
        sums = product(self.codes.to(x.dtype), x.flatten(-2))
        return sums.reshape(*sums.shape[:-1], *x.shape[-2:])
