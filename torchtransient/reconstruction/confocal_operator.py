"""What operators of confocal captures on a flat, regular grid share: a plane of voxels for each bin; inverses."""

from __future__ import annotations

import copy

import torch
from torch import Tensor

from torchtransient.axes import TimeAxis
from torchtransient.capture import Scan
from torchtransient.errors import ShapeError
from torchtransient.reconstruction.capture_checks import check_from_zero, checked_axis, confocal_wall
from torchtransient.reconstruction.linear import LinearOperator
from torchtransient.reconstruction.planar_scan import PlanarScan
from torchtransient.reconstruction.transient_operator import TransientOperator
from torchtransient.reconstruction.voxels import VoxelGrid

LEAST_BINS = 4
# Complex numbers that are worked on at once: a piece that the caches of a CPU hold, and one that fills a GPU.
CPU_CHUNK, GPU_CHUNK = 1 << 17, 1 << 24


def chunk_rows(elements: int, device: torch.device) -> int:
    """How many rows of ``elements`` complex numbers to work on at once."""
    return max(1, (CPU_CHUNK if device.type == "cpu" else GPU_CHUNK) // max(1, elements))


class ConfocalOperator(TransientOperator):
    """A linear operator between a volume (..., Z, Y, X) before a flat wall and confocal transients (..., T, Y, X).

    ``scan``: a :class:`PlanarScan`, or a confocal :class:`Scan` on a regular grid of a flat wall that counts lengths
    from the spot to the sensor point (``first_and_last_leg=False``). ``time_axis``: of the transients. Voxels stand
    behind the points of the wall (:attr:`wall`) at :attr:`depths`, one for each bin: half its optical path length. Time
    axes start at zero or later, unless a class says :attr:`early`.

    Raises ShapeError for other scans and axes, UnitError for time axes that begin before zero and for a
    dtype other than float32 and float64.
    """

    grid: VoxelGrid
    # Whether bins before time zero are taken: they are where no voxel is.
    early = False

    def __init__(self, scan: Scan | PlanarScan, *, time_axis: TimeAxis, dtype: torch.dtype) -> None:
        who = type(self).__name__
        confocal_wall(scan, who)
        bins = checked_axis(time_axis, who).num_bins
        if bins < LEAST_BINS:
            raise ShapeError(f"{who}: expected a time axis of {LEAST_BINS} bins at least, got {bins}.")
        if not self.early:
            check_from_zero(time_axis, who)
        super().__init__(scan, time_axis=time_axis, dtype=dtype)
        self.wall = confocal_wall(self.scan, who)
        self.grid = VoxelGrid.of_wall(self.wall, time_axis.centers_opl / 2)
        self.data_shape = (bins, *self.wall.size)
        self.volume_shape = self.data_shape

    @property
    def depths(self) -> Tensor:
        """(Z,) float64: distances of the planes from the wall, metres. Half bins count: half the middle of each bin."""
        return self.grid.depths

    def _measured(self) -> PlanarScan:
        return self.wall

    def _takes(self, scan: Scan) -> bool:
        return scan is self.scan or self.wall.matches(confocal_wall(scan, type(self).__name__))


class InverseOperator(LinearOperator):
    """A regularised inverse of an operator, itself a linear operator: from its data to its volume, whose
    ``points``, ``depths`` and ``grid`` it has. It shares the operator's tables until one of them is moved or converted,
    which leaves the other as it was.
    """

    def __init__(self, operator: ConfocalOperator) -> None:
        super().__init__()
        # Modules that share tables but not the lists of them.
        self.operator = copy.copy(operator)
        for name in ("_buffers", "_parameters", "_modules"):
            setattr(self.operator, name, dict(getattr(operator, name)))
        self.volume_shape, self.data_shape = operator.data_shape, operator.volume_shape
        self.dtype = operator.dtype
        self.volume_name, self.data_name = "transient", operator.volume_name

    @property
    def axis(self) -> TimeAxis:
        """Of the transients."""
        return self.operator.axis

    @property
    def grid(self) -> VoxelGrid:
        """The voxels that it finds values of."""
        return self.operator.grid

    @property
    def points(self) -> Tensor:
        """(Z, Y, X, 3) float64 on the CPU: these voxels in world coordinates, metres."""
        return self.operator.points

    @property
    def depths(self) -> Tensor:
        """(Z,) float64: distances of their planes from the wall, metres."""
        return self.operator.depths

    def extra_repr(self) -> str:
        taken, found = (" x ".join(map(str, shape)) for shape in (self.volume_shape, self.data_shape))
        return f"{self.volume_name} of {taken} to {self.data_name} of {found}"
