"""f-k migration of captures that are not confocal, by midpoint and normal moveout (Lindell, Wetzstein, O'Toole,
"Wave-based non-line-of-sight imaging using fast f-k migration", SIGGRAPH 2019; the approximation is seismology's).

Light of a spot and a sensor point with the distance d between them comes about as that of a confocal scan at their
middle, only later: tau^2 = tau_0^2 + d^2. That is exact for what lies straight behind the middle, or lies flat.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Self

import torch
from torch import Tensor

from torchtransient.axes import TimeAxis
from torchtransient.capture import Capture, Scan
from torchtransient.errors import ShapeError, UnitError
from torchtransient.quantities import shown
from torchtransient.reconstruction.capture_roots import stabilised_root
from torchtransient.reconstruction.confocal_operator import (
    check_capture,
    checked_precision,
    chunk_rows,
    precision_of,
)
from torchtransient.reconstruction.fk import FK
from torchtransient.reconstruction.linear import LinearOperator, each
from torchtransient.reconstruction.planar_scan import OFF_GRID, PlanarScan


class Midpoints(LinearOperator):
    """Confocal light at midpoints, and what pairs of spot and sensor point measure of it.

    ``operator(confocal)``: (..., T, 2 Y, 2 X) on a grid of half the sensors' pitch (:attr:`grid`) to the scan's
    (..., T, *scan.shape); ``operator.adjoint``: its adjoint, the mean over the pairs of each midpoint, moved to the
    time of a confocal pair by linear interpolation. Midpoints are rounded to the grid; those of one spot stand on it.
    Midpoints that no pair has are dark.

    Raises ShapeError for confocal scans, grids that are not regular or not flat, spots off their plane or beside the
    sensors' rectangle, and scans that count legs; UnitError for times before zero.
    """

    place: Tensor
    distance_squared: Tensor
    share: Tensor
    times: Tensor

    def __init__(self, scan: Scan, *, time_axis: TimeAxis, dtype: torch.dtype = torch.float32) -> None:
        super().__init__()
        sensors = _checked(scan, time_axis)
        self.axis, self.dtype = time_axis, checked_precision(dtype, "MidpointFK")
        rows, columns = sensors.size
        spots, points = (sensors.local(p).reshape(-1, 3) for p in (scan.laser_points, scan.sensor_points))
        pitch = torch.tensor([sensors.pitch[1], sensors.pitch[0], 1.0], dtype=torch.float64)
        extent = torch.tensor([columns - 1, rows - 1, 0], dtype=torch.float64)
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
        self.grid = PlanarScan(size, step, first, sensors.along_x, sensors.along_y, sensors.normal)
        self._place = (index[..., 1] * size[1] + index[..., 0]).reshape(-1)
        self._distance_squared = (spots[:, None] - points).square().sum(-1).reshape(-1)
        self.data_shape, self.volume_shape = (time_axis.num_bins, *scan.shape), (time_axis.num_bins, *size)
        self._set_tables("cpu")

    def _set_tables(self, device: torch.device | str) -> None:
        pairs = torch.bincount(self._place, minlength=math.prod(self.grid.size)).to(torch.float64)
        tables = {
            "distance_squared": self._distance_squared,
            "share": 1 / pairs.clamp_min(1),
            "times": self.axis.centers_opl,
        }
        for name, table in tables.items():
            self.register_buffer(name, table.to(device, self.dtype), persistent=False)
        self.register_buffer("place", self._place.to(device), persistent=False)

    def _apply(self, fn: Callable[..., Any], recurse: bool = True) -> Self:
        super()._apply(fn, recurse)  # type: ignore[no-untyped-call]
        if self.times.dtype != self.dtype:
            self.dtype = checked_precision(self.times.dtype, "MidpointFK")
            self._set_tables(self.times.device)
        return self

    def map_(self, x: Tensor) -> Tensor:
        return each(self._spread, x, 3)

    def adjoint_(self, y: Tensor) -> Tensor:
        return each(self._gather, y, len(self.data_shape))

    def _spread(self, confocal: Tensor) -> Tensor:
        bins = self.axis.num_bins
        of_place = (confocal.reshape(bins, -1) * self.share).T.contiguous()
        out = confocal.new_zeros(len(self.place), bins + 2)
        for first, last, low, high_share in self._pieces():
            light = of_place.index_select(0, self.place[first:last])
            late = light * high_share
            out[first:last].scatter_add_(1, low, light - late)
            out[first:last].scatter_add_(1, low + 1, late)
        return out[:, 1:-1].T.reshape(self.data_shape)

    def _gather(self, measured: Tensor) -> Tensor:
        bins = self.axis.num_bins
        rows = torch.nn.functional.pad(measured.reshape(bins, -1).T, (1, 1))
        out = measured.new_zeros(math.prod(self.grid.size), bins)
        for first, last, low, high_share in self._pieces():
            piece = rows[first:last]
            light = torch.gather(piece, 1, low)
            light = light + high_share * (torch.gather(piece, 1, low + 1) - light)
            out.index_add_(0, self.place[first:last], light)
        return (out * self.share[:, None]).T.reshape(self.volume_shape)

    def _pieces(self) -> Any:
        """Pairs ``first`` to ``last``, the bin (pairs, T) before the moment that light of each confocal time is from,
        counted from a bin of zeros before the record, and the share of the bin after it.
        """
        width, start, bins = self.axis.bin_width_opl, self.axis.start_opl, self.axis.num_bins
        step = chunk_rows(bins, self.times.device)
        for first in range(0, len(self.place), step):
            last = min(first + step, len(self.place))
            later = torch.sqrt(self.times.square() + self.distance_squared[first:last, None])
            at = ((later - start) / width + 0.5).clamp_(0, bins)
            low = at.floor()
            yield first, last, low.to(torch.int64), at - low


class MidpointFK(LinearOperator):
    """f-k migration for single and exhaustive captures of a flat wall, by way of their midpoints.

    ``operator(field)``: complex (..., Z, 2 Y, 2 X) on a grid of half the sensors' pitch to the wavefield of each pair,
    (..., T, *scan.shape); ``operator.adjoint``: the migration; ``operator.reconstruct(transient)``: from measured light
    to the squared field. Settings as of :class:`FK`. An approximation: a letter that faces the wall comes out of a
    capture by one laser with a correlation of 0.8, of 4 x 4 lasers 0.9, and tilted ones worse. One laser sees half of
    the wall's width. Filtered backprojection and phasor fields are better, and take longer.

    Raises as :class:`Midpoints` and :class:`FK`.
    """

    real_volume = False

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
        super().__init__()
        self.midpoints = Midpoints(scan, time_axis=time_axis, dtype=dtype)
        self.fk = FK(self.midpoints.grid, time_axis=time_axis, target=target, floor=floor, taps=taps, dtype=dtype)
        self.scan, self.axis, self.dtype = scan, time_axis, dtype
        self.volume_shape, self.data_shape = self.fk.volume_shape, self.midpoints.data_shape

    def _apply(self, fn: Callable[..., Any], recurse: bool = True) -> Self:
        super()._apply(fn, recurse)  # type: ignore[no-untyped-call]
        self.dtype = self.fk.dtype
        return self

    @property
    def depths(self) -> Tensor:
        """(Z,) float64: distances of the planes from the wall, metres."""
        return self.fk.depths

    def points(self) -> Tensor:
        """(Z, 2 Y, 2 X, 3) float64: the voxels in world coordinates, metres."""
        return self.fk.points()

    def map_(self, x: Tensor) -> Tensor:
        return self.midpoints.map_(self.fk.map_(x))

    def adjoint_(self, y: Tensor) -> Tensor:
        return self.fk.adjoint_(self.midpoints.adjoint_(y))

    def reconstruct(self, transient: Tensor | Capture) -> Tensor:
        """The squared modulus of the migrated field, (..., Z, 2 Y, 2 X) of (..., T, *scan.shape) or of a capture's.

        Differentiable; with ``floor=0`` empty bins get no gradient. Raises ShapeError, DeviceError.
        """
        data = transient
        if isinstance(data, Capture):
            if data.transient is None or data.axis != self.axis or data.scan != self.scan or data.polarized:
                raise ShapeError(
                    f"MidpointFK: expected a capture of intensities by {self.scan!r} with {self.axis}, got one by "
                    f"{data.scan!r} with {data.axis}. Make an operator for it."
                )
            data = data.transient
        data = self._taken("transient", data, self.data_shape, real=True)
        psi = self.midpoints.adjoint(stabilised_root(data, self.fk.floor))
        if self.fk.target == "diffuse":
            psi = psi * self.depths.to(psi)[:, None, None]
        field = self.fk.adjoint(psi)
        return field.real.square() + field.imag.square()


def midpoint_fk(capture: Capture, **options: Any) -> Tensor:
    """:meth:`MidpointFK.reconstruct` of a capture: the volume (C, Z, 2 Y, 2 X), on the device of its transient.

    ``options``: of :class:`MidpointFK`. Raises as it does.
    """
    transient, axis = check_capture(capture, "midpoint_fk")
    options.setdefault("dtype", precision_of(capture))
    operator: MidpointFK = MidpointFK(capture.scan, time_axis=axis, **options).to(transient.device)
    return operator.reconstruct(capture)


def _checked(scan: Scan, time_axis: TimeAxis) -> PlanarScan:
    """The sensors' grid of a scan. Raises ShapeError, UnitError."""
    if not isinstance(scan, Scan):
        raise ShapeError(f"MidpointFK: expected a tt.nlos.Scan, got {shown(scan)}.")
    if not isinstance(time_axis, TimeAxis):
        raise ShapeError(f"MidpointFK: expected time_axis as a tt.TimeAxis, got {shown(time_axis)}.")
    if scan.kind == "confocal":
        raise ShapeError("MidpointFK: expected a single or exhaustive scan, got a confocal one. Use FK.")
    if scan.first_and_last_leg:
        raise ShapeError(
            "MidpointFK: expected lengths from the spot to the sensor point, got a scan that counts the first and last "
            "leg too. Take the capture that subtract_legs(capture) gives, with its scan and axis."
        )
    if time_axis.start_opl < 0:
        raise UnitError(f"MidpointFK: expected a time axis from zero on, got {time_axis}. Crop the capture.")
    return PlanarScan.of_scan(scan, "MidpointFK")
