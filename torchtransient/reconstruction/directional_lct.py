"""The directional light-cone transform: albedo and normals of confocal captures (Young, Lindell, Girod, Taubman,
Wetzstein, "Non-line-of-sight surface reconstruction using the directional light-cone transform", CVPR 2020).

A hidden point of strength rho and normal n sends light by the cosine towards the wall point,

    H(tau) = int nu . w r^-p delta(tau - 2 r) dV,    nu = rho n,    w = (x' - x, y' - y, -z) / r .

In v and u that is the sum of three convolutions of the components of nu, the third multiplied by z, with the cone
times (x' - x), (y' - y) and -1. The regularised inverse, 3 x 3 for each frequency, has a closed form, since three
kernels make one number: nu_i = conj(a_i) H / (sum |a|^2 + noise).
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from torchtransient.axes import TimeAxis
from torchtransient.capture import Capture, Scan
from torchtransient.checks import finite
from torchtransient.errors import UnitError
from torchtransient.reconstruction.cone_operator import DEFAULT_SNR, FALL, ConeOperator
from torchtransient.reconstruction.planar_scan import PlanarScan
from torchtransient.reconstruction.transient_operator import reconstructed

DEFAULT_TAPER = 0.1


class DirectionalLCT(ConeOperator):
    """The light-cone transform of surfaces with normals, for confocal captures of a flat wall.

    ``operator(volume)``: vectors (..., 3, Z, Y, X), strength per m^3 times unit normal in world coordinates, to the
    light in each bin (..., T, Y, X), falling with the cosine at the surface and r^-4 (``target="diffuse"``) or r^-2
    ("retroreflective"); ``operator.adjoint``, ``operator.inverse`` and ``operator.reconstruct`` as of :class:`LCT`,
    from transients to such vectors. Their lengths are the albedo, their directions the normals, towards the wall.

    ``snr``, ``v_bins``: as of :class:`LCT`. The three components are regularised alike at the middle of the volume's
    depth; where nothing is measured, normals are noise. Of all
    vectors that explain the light these are the shortest, which lean towards the wall: a plate tilted by 17 degrees
    comes out at 13, one by 34 at 21.

    ``taper``: share of each side of the scan over which the inverse fades light out towards the border (0 to 0.5, 0:
    not at all). Light that ends at the border is otherwise explained by vectors that point across it: a bright rim, in
    measured captures as bright as what is inside. ``forward`` and ``adjoint`` do not fade.

    Not supported: what :class:`LCT` does not; the squared cosine of confocal light, for which the linear one stands.
    Raises as :class:`LCT`.
    """

    moments = ((0, 1), (1, 0), (0, 0))
    frame: Tensor
    relative_depth: Tensor
    fading: Tensor

    def __init__(
        self,
        scan: Scan | PlanarScan,
        *,
        time_axis: TimeAxis,
        target: str = "diffuse",
        snr: float = DEFAULT_SNR,
        v_bins: int | None = None,
        taper: float = DEFAULT_TAPER,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        self.taper = finite("DirectionalLCT: taper", taper)
        if not 0 <= self.taper <= 0.5:
            raise UnitError(f"DirectionalLCT: expected taper as a share from 0 to 0.5, got {self.taper:g}.")
        super().__init__(scan, time_axis=time_axis, dtype=dtype, target=target, snr=snr, v_bins=v_bins)
        self.volume_shape = (3, *self.data_shape)
        self.scales = (1.0, 1.0, float(self.depths.mean()))

    def fall(self) -> int:
        """One power more than the light has: w holds 1 / r."""
        return FALL[self.target] + 1

    def tables(self) -> dict[str, Tensor]:
        """Those of the base; ``frame`` (3, 3): world to wall coordinates, ``relative_depth`` (Z,): over the middle;
        ``fading`` (Y, X): of the light, towards the border.
        """
        frame = torch.stack([self.grid.along_x, self.grid.along_y, -self.grid.normal])
        along_y, along_x = (_fading(n, self.taper) for n in self.grid.size)
        return {
            **super().tables(), "frame": frame, "relative_depth": self.depths / self.depths.mean(),
            "fading": along_y[:, None] * along_x,
        }  # fmt: skip

    def _back(self, data: Tensor, *, inverse: bool) -> Tensor:
        return super()._back(data * self.fading if inverse else data, inverse=inverse)

    def _model(self, volume: Tensor, *, inverse: bool) -> Tensor:
        data = super()._model(volume, inverse=inverse)
        return data * self.fading if inverse else data

    def components(self, volume: Tensor, matrix: str) -> list[Tensor]:
        x, y, towards = torch.einsum("ij,jzyx->izyx", self.frame, volume)
        parts = (x, y, towards * self._weight(matrix))
        return [self._resampled(part, matrix, transposed=False, to_v=True) for part in parts]

    def volume_of(self, components: list[Tensor], matrix: str) -> Tensor:
        x, y, towards = (self._resampled(part, matrix, transposed=True, to_v=False) for part in components)
        return torch.einsum("ij,izyx->jzyx", self.frame, torch.stack([x, y, towards * self._weight(matrix)]))

    def _weight(self, matrix: str) -> Tensor:
        weight = self.relative_depth[:, None, None]
        return weight if matrix == "volume" else 1 / weight


def _fading(points: int, share: float) -> Tensor:
    """(points,) float64: a squared sine, zero at the outer edges of the outermost cells, one from ``share`` on."""
    place = torch.arange(points, dtype=torch.float64, device="cpu") + 0.5
    place = torch.minimum(place, points - place)
    return torch.sin((place / max(share * points, 0.5)).clamp_max(1.0) * (math.pi / 2)) ** 2


def directional_lct(capture: Capture, **options: Any) -> Tensor:
    """:meth:`DirectionalLCT.reconstruct` of a capture: vectors (C, 3, Z, Y, X), on the device of its transient.

    ``options``: of :class:`DirectionalLCT`. Raises as it does.
    """
    return reconstructed(capture, DirectionalLCT, who="directional_lct", **options)
