"""The light cone in the coordinates v = r^2 and u = z^2, where it is one convolution (O'Toole, Lindell, Wetzstein,
"Confocal non-line-of-sight imaging based on the light-cone transform", Nature 555, 2018).

Light of hidden points of strength rho per m^3 arrives as H(tau) = int rho r^-p delta(tau - 2 r) dV, p = 4 of diffuse
and 2 of retroreflective points. With v = (tau / 2)^2,

    H dtau = r^-p dv int rho / (2 sqrt u) delta(v - u - x^2 - y^2) du dx dy .

The bins of time and depth are resampled to equal bins of v and u by overlaps of intervals, which lose no light. Per
frequency w of v, the kernel is exp(-i w x^2) exp(-i w y^2): a product of two small tables.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchtransient.axes import TimeAxis, fast_length
from torchtransient.errors import ShapeError
from torchtransient.reconstruction.confocal_operator import chunk_rows
from torchtransient.reconstruction.planar_scan import PlanarScan

# Longest padded axis of v over the axis itself: what a cone reaches far behind the record costs memory and time.
LONGEST = 8


@dataclass(frozen=True)
class ConeGrid:
    """Equal bins of v between the ends of a time axis. ``edges`` (V + 1,) of v, ``radii`` (T + 1,) half the edges of
    the time axis, metres; ``padded``: length of the transforms along v, so that no cone comes round.
    """

    edges: Tensor
    radii: Tensor
    padded: int

    @staticmethod
    def of(axis: TimeAxis, grid: PlanarScan, v_bins: int, who: str) -> ConeGrid:
        """Of an axis from zero on. Raises ShapeError where the cone is far longer than the record."""
        radii = axis.edges_opl / 2
        near, far = float(radii[0]) ** 2, float(radii[-1]) ** 2
        edges = torch.linspace(near, far, v_bins + 1, dtype=torch.float64, device="cpu")
        length = float(edges[-1] - edges[0])
        reach = sum((n * pitch) ** 2 for n, pitch in zip(grid.size, grid.pitch, strict=True))
        needed = v_bins * (1 + reach / length)
        if needed > LONGEST * v_bins:
            raise ShapeError(
                f"{who}: expected a record that is not short beside the wall, got one of {length:.3g} m^2 in squared "
                f"distance with a scan whose diagonal squared is {reach:.3g} m^2. Let the time axis end later, or crop "
                "the scan."
            )
        return ConeGrid(edges, radii, fast_length(max(2 * v_bins, math.ceil(needed)), multiple=2))

    @property
    def width(self) -> float:
        """Width of a bin of v, m^2."""
        return float(self.edges[-1] - self.edges[0]) / (len(self.edges) - 1)

    def overlaps(self, of_depth: bool) -> tuple[Tensor, Tensor, Tensor]:
        """(index of v, index of time, overlap) of all bins that overlap; lengths in v, m^2, or in r, metres."""
        squares = self.radii**2
        # Both partitions together cut the axis into intervals, each of which lies in one bin of either.
        cuts = torch.cat([squares, self.edges[1:-1]]).sort().values
        middles = (cuts[1:] + cuts[:-1]) / 2
        v = (torch.bucketize(middles, self.edges, right=True) - 1).clamp(0, len(self.edges) - 2)
        t = (torch.bucketize(middles, squares, right=True) - 1).clamp(0, len(squares) - 2)
        size = (cuts.sqrt() if of_depth else cuts).diff()
        kept = size > 0
        return v[kept], t[kept], size[kept]

    def window(self) -> Tensor:
        """What the frequencies of v are multiplied by, (V' / 2 + 1,): a mean of neighbours, (1, 4, 6, 4, 1) / 16.

        A cone that is band-limited alone rings as far as the record is long, and the r^-4 of early bins makes more of
        that than there is light.
        """
        turn = math.pi / (self.padded // 2) * torch.arange(self.padded // 2 + 1, dtype=torch.float64, device="cpu")
        return ((1 + turn.cos()) / 2) ** 2

    def kernel_tables(self, count: int, pitch: float, moment: int = 0, *, windowed: bool = False) -> Tensor:
        """Transform (V' / 2 + 1, 2 count, 2) along one side of the wall of q^moment exp(-i w q^2) for every frequency
        w of v, real and imaginary; ``windowed``: times :meth:`window`.
        """
        w = torch.arange(self.padded // 2 + 1, dtype=torch.float64, device="cpu")
        w = w * (2 * math.pi / (self.padded * self.width))
        turns = -w[:, None] * offset_powers(count, pitch, 2)
        size = offset_powers(count, pitch, moment) * (self.window()[:, None] if windowed else torch.ones_like(turns))
        return torch.view_as_real(torch.fft.fft(torch.polar(torch.ones_like(turns), turns) * size))


def offset_powers(count: int, pitch: float, moment: int) -> Tensor:
    """q^moment (2 count,) float64 of the offsets q along one side of the wall, in the order of transforms. The farthest
    one stands for both signs: its odd powers are zero.
    """
    q = torch.fft.fftfreq(2 * count, 1 / (2 * count), dtype=torch.float64, device="cpu") * pitch
    powers: Tensor = q**moment
    if moment % 2:
        powers[count] = 0
    return powers


@dataclass(frozen=True)
class Resampling:
    """A sparse matrix as (row, column, value) of its entries."""

    rows: Tensor
    columns: Tensor
    values: Tensor

    def apply(self, x: Tensor, count: int, *, transposed: bool = False) -> Tensor:
        """The matrix, or its transpose, times x (T, N): (count, N)."""
        rows, columns = (self.columns, self.rows) if transposed else (self.rows, self.columns)
        out = x.new_zeros(count, x.shape[1])
        # In pieces of N, so that the products stay small.
        step = max(1, 4 * chunk_rows(len(rows), x.device))
        for first in range(0, x.shape[1], step):
            part = x[:, first : first + step]
            products = part.index_select(0, columns).mul_(self.values[:, None])
            out[:, first : first + step].index_add_(0, rows, products)
        return out
