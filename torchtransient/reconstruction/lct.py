"""The light-cone transform of confocal captures; see `light_cone` for the formulas."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchtransient.axes import TimeAxis
from torchtransient.capture import Capture, Scan
from torchtransient.reconstruction.cone_operator import DEFAULT_SNR, ConeOperator
from torchtransient.reconstruction.planar_scan import PlanarScan
from torchtransient.reconstruction.transient_operator import reconstructed


class LCT(ConeOperator):
    """The light-cone transform, for confocal captures of a flat wall.

    ``operator(volume)``: strengths (..., Z, Y, X) of hidden points per m^3, light falling with the fourth power of the
    distance (``target="diffuse"``) or the second ("retroreflective"), to their light in each bin (..., T, Y, X);
    ``operator.adjoint``: its adjoint; ``operator.inverse``: the Wiener inverse, a linear operator itself;
    ``operator.reconstruct(transient)``: that of a capture, in the units of the volume.

    ``snr``: ratio of signal to noise power at the mean power of the kernel, without a unit; larger is sharper and
    noisier. ``v_bins``: bins of squared distance, as many as there are bins of time unless given. They are equal, and
    coarse in depth near the wall: v_max / (2 z v_bins). Results of the inverse go below zero; clamp them for display
    only. The kernel is band-limited: sharp volumes ring by some percent.

    Not supported: scans that are not confocal, curved walls, cosines of wall and hidden surfaces, hiding of points by
    others. Raises ShapeError for scans that it cannot take and for records that are far shorter than the wall is wide,
    UnitError for time axes that begin before zero and for an ``snr`` beyond 1e-20 to 1e20, SceneError for an unknown
    target.
    """

    moments = ((0, 0),)

    def __init__(
        self,
        scan: Scan | PlanarScan,
        *,
        time_axis: TimeAxis,
        target: str = "diffuse",
        snr: float = DEFAULT_SNR,
        v_bins: int | None = None,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        super().__init__(scan, time_axis=time_axis, dtype=dtype, target=target, snr=snr, v_bins=v_bins)

    def components(self, volume: Tensor, matrix: str) -> list[Tensor]:
        return [self._resampled(volume, matrix, transposed=False, to_v=True)]

    def volume_of(self, components: list[Tensor], matrix: str) -> Tensor:
        return self._resampled(components[0], matrix, transposed=True, to_v=False)


def lct(capture: Capture, **options: Any) -> Tensor:
    """:meth:`LCT.reconstruct` of a capture: the volume (C, Z, Y, X), on the device of its transient.

    ``options``: of :class:`LCT`. Raises as it does.
    """
    return reconstructed(capture, LCT, who="lct", **options)
