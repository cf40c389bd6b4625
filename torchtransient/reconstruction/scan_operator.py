"""What operators of any scan share: volumes of points that the caller chooses."""

from __future__ import annotations

import torch
from torch import Tensor

from torchtransient.axes import TimeAxis
from torchtransient.capture import Scan
from torchtransient.reconstruction.capture_checks import checked_points, checked_scan
from torchtransient.reconstruction.proportions import check_reach
from torchtransient.reconstruction.transient_operator import TransientOperator
from torchtransient.reconstruction.voxels import VoxelGrid


class ScanOperator(TransientOperator):
    """A linear operator between values at hidden points and transients (..., T, *scan.shape) of a scan of any kind.

    ``points``: a :class:`VoxelGrid`, or points (..., 3) in world coordinates, metres; volumes have their leading
    dimensions. ``time_axis``: of the transients, counted as the scan's ``first_and_last_leg`` says. Points that carry
    gradients are taken as they are, detached: operators are differentiable by volumes and transients alone.

    Raises ShapeError for what is no scan, axis or points, UnitError for points that are not finite and for a dtype
    other than float32 and float64.
    """

    scan: Scan

    def __init__(self, scan: Scan, points: VoxelGrid | Tensor, *, time_axis: TimeAxis, dtype: torch.dtype) -> None:
        who = type(self).__name__
        super().__init__(checked_scan(scan, who), time_axis=time_axis, dtype=dtype)
        self.grid = points if isinstance(points, VoxelGrid) else None
        self._points = None if isinstance(points, VoxelGrid) else checked_points(points, who)
        check_reach(scan, points if self._points is None else self._points, time_axis, who)
        self.volume_shape = tuple(self.points.shape[:-1])
        self.data_shape = (time_axis.num_bins, *scan.shape)

    @property
    def points(self) -> Tensor:
        """(..., 3) float64 on the CPU: the hidden points in world coordinates, metres."""
        return super().points if self._points is None else self._points
