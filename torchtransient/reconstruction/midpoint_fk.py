"""f-k migration of captures that are not confocal, by midpoint and normal moveout (Lindell, Wetzstein, O'Toole,
"Wave-based non-line-of-sight imaging using fast f-k migration", SIGGRAPH 2019; the approximation is seismology's).

Light of a spot and a sensor point with the distance d between them comes about as that of a confocal scan at their
middle, only later: tau^2 = tau_0^2 + d^2. That is exact for what lies straight behind the middle, or lies flat.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from torchtransient.axes import TimeAxis
from torchtransient.capture import Capture, Scan
from torchtransient.errors import ShapeError
from torchtransient.reconstruction.capture_checks import (
    check_from_zero,
    checked_axis,
    checked_scan,
    refuse_legs,
    refuse_pairs,
)
from torchtransient.reconstruction.capture_roots import stabilized_root
from torchtransient.reconstruction.confocal_operator import chunk_rows
from torchtransient.reconstruction.fk import FK
from torchtransient.reconstruction.linear import each
from torchtransient.reconstruction.planar_scan import OFF_GRID, PlanarScan
from torchtransient.reconstruction.transient_operator import TransientOperator, reconstructed
from torchtransient.reconstruction.voxels import VoxelGrid


class Midpoints(TransientOperator):
    """Confocal light at midpoints, and what pairs of spot and sensor point measure of it.

    ``operator(confocal)``: (..., T, 2 Y, 2 X) on a grid of half the sensors' pitch (:attr:`wall`) to the scan's
    (..., T, *scan.shape); ``operator.adjoint``: its adjoint, the mean over the pairs of each midpoint, moved to the
    time of a confocal pair by linear interpolation between bins, zero before and behind the record. Midpoints are
    rounded to the grid; those of one spot stand on it. Midpoints that no pair has are dark.

    Raises ShapeError for confocal scans, grids that are not regular or not flat, spots off their plane or beside the
    sensors' rectangle, and scans that count legs; UnitError for times before zero.
    """

    place: Tensor
    distance_squared: Tensor
    share: Tensor
    times: Tensor

    def __init__(self, scan: Scan, *, time_axis: TimeAxis, dtype: torch.dtype = torch.float32) -> None:
        sensors = _sensors(scan, time_axis, "MidpointFK")
        super().__init__(scan, time_axis=time_axis, dtype=dtype)
        rows, columns = sensors.size
        spots, points = (sensors.local(p).reshape(-1, 3) for p in (scan.laser_points, scan.sensor_points))
        pitch = torch.tensor([sensors.pitch[1], sensors.pitch[0], 1.0], dtype=torch.float64, device="cpu")
        extent = torch.tensor([columns - 1, rows - 1, 0], dtype=torch.float64, device="cpu")
        off = (spots / pitch - (spots / pitch).clamp_min(0).minimum(extent)).abs()
        if float(off[:, 2].max()) > OFF_GRID * min(sensors.pitch) or float(off[:, :2].max()) > 0.5 + OFF_GRID:
            raise ShapeError(
                f"MidpointFK: expected spots in the plane of the sensor points and within their rectangle, got some "
                f"{float(off.max()):.3g} off it, in pitches along the wall and metres across. Use Backprojection."
            )
        # In steps of half the pitch from the first sensor point; (M, N, 2) of spots and sensor points.
        middles = ((spots[:, None] + points) / pitch)[..., :2]
        phase = middles[0, 0] - middles[0, 0].round()
        index = (middles - phase).round().to(torch.int64)
        size = (2 * rows, 2 * columns)
        index = torch.stack([index[..., 0].clamp(0, size[1] - 1), index[..., 1].clamp(0, size[0] - 1)], -1)
        step = (sensors.pitch[0] / 2, sensors.pitch[1] / 2)
        first = (
            sensors.first + float(phase[0]) * step[1] * sensors.along_x + float(phase[1]) * step[0] * sensors.along_y
        )
        self.wall = PlanarScan(
            size, step, first, along_x=sensors.along_x, along_y=sensors.along_y, normal=sensors.normal
        )
        self.grid = VoxelGrid.of_wall(self.wall, time_axis.centers_opl / 2)
        self._place = (index[..., 1] * size[1] + index[..., 0]).reshape(-1)
        self._distance_squared = (spots[:, None] - points).square().sum(-1).reshape(-1)
        self.data_shape, self.volume_shape = (time_axis.num_bins, *scan.shape), (time_axis.num_bins, *size)
        self._set_tables()

    def tables(self) -> dict[str, Tensor]:
        """Of each pair its ``place`` on the grid and ``distance_squared``, m^2; the ``share`` of a pair in the light of
        each place; ``times`` (T,) of the bins.
        """
        pairs = torch.bincount(self._place, minlength=math.prod(self.wall.size)).to(torch.float64)
        return {
            "place": self._place,
            "distance_squared": self._distance_squared,
            "share": 1 / pairs.clamp_min(1),
            "times": self.axis.centers_opl,
        }

    def map_(self, x: Tensor) -> Tensor:
        return each(self._spread, x, 3)

    def adjoint_(self, y: Tensor) -> Tensor:
        return each(self._gather, y, len(self.data_shape))

    def _spread(self, confocal: Tensor) -> Tensor:
        bins = self.axis.num_bins
        of_place = (confocal.reshape(bins, -1) * self.share).T.contiguous()
        out = confocal.new_zeros(len(self.place), bins + 3)
        for first, last, low, high_share in self._pieces():
            light = of_place.index_select(0, self.place[first:last])
            late = light * high_share
            out[first:last].scatter_add_(1, low, light - late)
            out[first:last].scatter_add_(1, low + 1, late)
        return out[:, 1 : bins + 1].T.reshape(self.data_shape)

    def _gather(self, measured: Tensor) -> Tensor:
        bins = self.axis.num_bins
        rows = torch.nn.functional.pad(measured.reshape(bins, -1).T, (1, 2))
        out = measured.new_zeros(math.prod(self.wall.size), bins)
        for first, last, low, high_share in self._pieces():
            piece = rows[first:last]
            light = torch.gather(piece, 1, low)
            light = light + high_share * (torch.gather(piece, 1, low + 1) - light)
            out.index_add_(0, self.place[first:last], light)
        return (out * self.share[:, None]).T.reshape(self.volume_shape)

    def _pieces(self) -> Any:
        """Pairs ``first`` to ``last``, the bin (pairs, T) before the moment that light of each confocal time is from,
        counted from a bin of zeros before the record, and the share of the bin after it. What is from behind the record
        is from the first of two bins of zeros there.
        """
        width, start, bins = self.axis.bin_width_opl, self.axis.start_opl, self.axis.num_bins
        step = chunk_rows(bins, self.times.device)
        for first in range(0, len(self.place), step):
            last = min(first + step, len(self.place))
            later = torch.sqrt(self.times.square() + self.distance_squared[first:last, None])
            at = ((later - start) / width + 0.5).clamp_(0, bins + 1)
            low = at.floor()
            yield first, last, low.to(torch.int64), at - low


class MidpointFK(TransientOperator):
    """f-k migration for single and exhaustive captures of a flat wall, by way of their midpoints.

    ``operator(field)``: complex (..., Z, 2 Y, 2 X) on a grid of half the sensors' pitch to the wavefield of each pair,
    (..., T, *scan.shape); ``operator.adjoint``: the migration; ``operator.reconstruct(transient)``: from measured light
    to the squared field. Settings as of :class:`FK`. An approximation: a letter that faces the wall comes out of a
    capture by one laser with a correlation of 0.8, of 4 x 4 lasers 0.9, and tilted ones worse. One laser sees half of
    the wall's width. Filtered backprojection and phasor fields are better, and take longer.

    Raises as :class:`Midpoints` and :class:`FK`.
    """

    real_volume = False
    grid: VoxelGrid

    def __init__(
        self,
        scan: Scan,
        *,
        time_axis: TimeAxis,
        target: str = "diffuse",
        floor: float = 0.0,
        taps: int = 4,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        super().__init__(checked_scan(scan, "MidpointFK"), time_axis=time_axis, dtype=dtype)
        self.midpoints = Midpoints(scan, time_axis=time_axis, dtype=dtype)
        self.fk = FK(self.midpoints.wall, time_axis=time_axis, target=target, floor=floor, taps=taps, dtype=dtype)
        self.grid = self.fk.grid
        self.volume_shape, self.data_shape = self.fk.volume_shape, self.midpoints.data_shape

    @property
    def depths(self) -> Tensor:
        """(Z,) float64: distances of the planes from the wall, metres."""
        return self.grid.depths

    def map_(self, x: Tensor) -> Tensor:
        return self.midpoints.map_(self.fk.map_(x))

    def adjoint_(self, y: Tensor) -> Tensor:
        return self.fk.adjoint_(self.midpoints.adjoint_(y))

    def reconstruct(self, transient: Tensor | Capture) -> Tensor:
        """The squared modulus of the migrated field, (..., Z, 2 Y, 2 X) of (..., T, *scan.shape) or of a capture's.

        Differentiable; with ``floor=0`` empty bins get no gradient. Raises ShapeError, DeviceError.
        """
        data = self.transients(transient)
        return self.fk.picture(self.midpoints.adjoint(stabilized_root(data, self.fk.floor)))


def midpoint_fk(capture: Capture, **options: Any) -> Tensor:
    """:meth:`MidpointFK.reconstruct` of a capture: the volume (C, Z, 2 Y, 2 X), on the device of its transient.

    ``options``: of :class:`MidpointFK`. Raises as it does.
    """
    return reconstructed(capture, MidpointFK, who="midpoint_fk", **options)


def _sensors(scan: Scan, time_axis: TimeAxis, who: str) -> PlanarScan:
    """The sensors' grid of a scan. Raises ShapeError, UnitError."""
    if checked_scan(scan, who).kind == "confocal":
        raise ShapeError(f"{who}: expected a single or exhaustive scan, got a confocal one. Use FK.")
    refuse_pairs(scan, who)
    refuse_legs(scan, who)
    check_from_zero(checked_axis(time_axis, who), who)
    return PlanarScan.of_scan(scan, who)
