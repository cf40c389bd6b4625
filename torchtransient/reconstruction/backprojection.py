"""Backprojection: every voxel takes the light that each pair of laser spot and sensor point saw at its distance."""

from __future__ import annotations

import torch
from torch import Tensor

from torchtransient.axes import TimeAxis
from torchtransient.capture import Capture, Scan
from torchtransient.reconstruction.ellipsoids import EllipsoidOperator
from torchtransient.reconstruction.transient_operator import reconstructed
from torchtransient.reconstruction.voxels import VoxelGrid


def backproject(capture: Capture, points: VoxelGrid | Tensor, *, falloff: float = 0.0) -> Tensor:
    """:meth:`Backprojection.reconstruct` of a capture by its own scan and axis: (..., C, *volume), on the device of its
    transient. Raises as the class.
    """
    return reconstructed(capture, Backprojection, points, who="backproject", falloff=falloff)


class Backprojection(EllipsoidOperator):
    """Volume (..., *points) to transients (..., T, *scan.shape); the adjoint is backprojection (Velten et al. 2012).

    ``forward`` puts the value of a voxel at the length laser spot - voxel - sensor point of every pair, shared linearly
    between the two bins whose centres are next to it, so that their sum is the value: the transient of isotropic points
    that hide nothing. ``adjoint`` reads the transients there by linear interpolation and adds up. What falls outside of
    the record counts as zero. Scans of any kind are taken: confocal, single, exhaustive and pairs, grids and lists of
    points, flat and curved walls, with or without first and last legs, in single and double precision.

    ``points``: a :class:`VoxelGrid` or any points (..., 3). ``falloff``: p of a factor (r_laser r_sensor)^-p in both: 0
    leaves distances alone, 2 is the falloff of small diffuse patches, 1 that of retroreflectors in confocal scans; -2
    makes ``adjoint`` compensate for it. Distances below half a bin count as half a bin there. Cosines of wall and
    surface are not part of it.

    Time grows with pairs times voxels (some 4 ns each on a core); memory beyond operands with neither. Raises
    ShapeError and UnitError.
    """

    def __init__(
        self,
        scan: Scan,
        points: VoxelGrid | Tensor,
        *,
        time_axis: TimeAxis,
        falloff: float = 0.0,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        super().__init__(scan, points, time_axis=time_axis, falloff=falloff, dtype=dtype)

    def reconstruct(self, transient: Tensor | Capture) -> Tensor:
        """``adjoint`` of a transient (..., T, *scan.shape) or a capture: (..., *volume). Raises ShapeError."""
        return self.adjoint(self.transients(transient))

    def map_(self, x: Tensor) -> Tensor:
        if x.is_complex():
            return torch.complex(self.map_(x.real), self.map_(x.imag))
        lead = x.shape[: x.ndim - len(self.volume_shape)]
        out = x.new_empty(*lead, *self.data_shape)
        split = self.split(out)
        for group, rows in self.splat(x.reshape(-1, self.voxels.shape[1])):
            self.put_rows(split, group, rows)
        return out

    def adjoint_(self, y: Tensor) -> Tensor:
        if y.is_complex():
            return torch.complex(self.adjoint_(y.real), self.adjoint_(y.imag))
        split = self.split(y)
        found = self.gather(lambda group: self.rows_of(split, group), len(split))
        lead = y.shape[: y.ndim - len(self.data_shape)]
        volume: Tensor = found.reshape(*lead, *self.volume_shape)
        return volume
