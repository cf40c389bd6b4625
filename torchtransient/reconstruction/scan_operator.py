"""What operators of any scan share: which points stand where, captures as data, tables in the right precision."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Self

import torch
from torch import Tensor

from torchtransient.axes import TimeAxis
from torchtransient.capture import Capture, Scan
from torchtransient.errors import ShapeError, UnitError
from torchtransient.quantities import shown
from torchtransient.reconstruction.linear import LinearOperator
from torchtransient.reconstruction.voxels import VoxelGrid

PRECISIONS = (torch.float32, torch.float64)


class ScanOperator(LinearOperator):
    """A linear operator between values at hidden points and transients (..., T, *scan.shape) of a scan of any kind.

    ``points``: a :class:`VoxelGrid`, or points (..., 3) in world coordinates, metres; volumes have their leading
    dimensions. ``time_axis``: of the transients, counted as the scan's ``first_and_last_leg`` says. Tables are built in
    double precision and kept in ``dtype``; ``operator.double()`` builds them anew. Points that carry gradients are
    taken as they are, detached: operators are differentiable by volumes and transients alone.

    Raises ShapeError for what is no scan, axis or points, UnitError for points that are not finite and for a dtype
    other than float32 and float64.
    """

    def __init__(self, scan: Scan, points: VoxelGrid | Tensor, time_axis: TimeAxis, dtype: torch.dtype) -> None:
        super().__init__()
        who = type(self).__name__
        if not isinstance(scan, Scan):
            raise ShapeError(f"{who}: expected a tt.nlos.Scan, got {shown(scan)}.")
        if not isinstance(time_axis, TimeAxis):
            raise ShapeError(f"{who}: expected time_axis as a tt.TimeAxis, got {shown(time_axis)}.")
        self.scan, self.axis, self.dtype = scan, time_axis, _precision(dtype, who)
        self.grid = points if isinstance(points, VoxelGrid) else None
        self.points = points.points if isinstance(points, VoxelGrid) else _points(points, who)
        self.volume_shape = tuple(self.points.shape[:-1])
        self.data_shape = (time_axis.num_bins, *scan.shape)

    def tables(self) -> dict[str, Tensor]:
        """The tables of the operator on the CPU, float64 or whole numbers; complex ones as pairs of reals."""
        raise NotImplementedError

    def _set_tables(self, device: torch.device | str = "cpu") -> None:
        for name, table in self.tables().items():
            kept = table.to(device, self.dtype if table.is_floating_point() else None)
            # Not part of the state: the arguments make them.
            self.register_buffer(name, kept, persistent=False)

    def _apply(self, fn: Callable[..., Any], recurse: bool = True) -> Self:
        """Moves and conversions of a module. Another precision makes new tables, since converted ones have the digits
        of the old.
        """
        super()._apply(fn, recurse)  # type: ignore[no-untyped-call]
        dtypes = {buffer.dtype for buffer in self.buffers() if buffer.is_floating_point()}
        if len(dtypes) == 1 and (dtype := dtypes.pop()) != self.dtype:
            device = self.device
            try:
                self.dtype = _precision(dtype, type(self).__name__)
            finally:
                self._set_tables(device or "cpu")
        return self

    def transients(self, data: Tensor | Capture) -> Tensor:
        """The transient (..., T, *scan.shape) of a tensor or a capture, in the operator's precision.

        Raises ShapeError for a capture of another scan or axis, of polarized light, or without a transient.
        """
        who = type(self).__name__
        if not isinstance(data, Capture):
            return self._taken("transient", data, self.data_shape, real=True)
        if data.transient is None:
            raise ShapeError(f"{who}: expected a capture with a transient, got phasors alone.")
        if data.polarized:
            raise ShapeError(f"{who}: expected a capture of intensities, got Stokes components. Give its transient[0].")
        if data.axis != self.axis:
            raise ShapeError(f"{who}: expected a capture with {self.axis}, as the operator has, got {data.axis}.")
        if data.scan is not self.scan and not _same_points(data.scan, self.scan):
            raise ShapeError(
                f"{who}: expected a capture of the operator's own scan, {self.scan!r}, got one of {data.scan!r} with "
                "other points or legs. Make an operator for it."
            )
        return self._taken("transient", data.transient, self.data_shape, real=True)

    def extra_repr(self) -> str:
        volume = " x ".join(map(str, self.volume_shape))
        return f"{volume} voxels, {self.scan!r}, {self.axis}, {str(self.dtype).removeprefix('torch.')}"


def checked_capture(capture: Capture, who: str) -> tuple[TimeAxis, torch.dtype]:
    """Axis of a capture's transient and the precision to work in. Raises ShapeError for what is none, or has none."""
    if not isinstance(capture, Capture):
        raise ShapeError(f"{who}: expected a tt.nlos.Capture, got {shown(capture)}. Tensors go to an operator.")
    if capture.transient is None or capture.axis is None:
        raise ShapeError(f"{who}: expected a capture with a transient, got phasors alone.")
    return capture.axis, torch.float64 if capture.transient.dtype == torch.float64 else torch.float32


def _same_points(a: Scan, b: Scan) -> bool:
    """Whether two scans measure the same: kind, points and, where they count, legs."""
    if (a.kind, a.shape, a.first_and_last_leg) != (b.kind, b.shape, b.first_and_last_leg):
        return False
    names = ["sensor_points", "laser_points"] + ["sensor_origin", "laser_origin"] * a.first_and_last_leg
    return all(torch.equal(getattr(a, name).detach().cpu(), getattr(b, name).detach().cpu()) for name in names)


def _points(points: Any, who: str) -> Tensor:
    if not isinstance(points, Tensor) or points.ndim < 2 or points.shape[-1] != 3 or points.numel() == 0:
        got = tuple(points.shape) if isinstance(points, Tensor) else shown(points)
        raise ShapeError(f"{who}: expected a VoxelGrid or points (..., 3) as a tensor, got {got}.")
    plain = points.detach().to("cpu", torch.float64)
    if not bool(torch.isfinite(plain).all()):
        raise UnitError(f"{who}: expected finite points in metres, got some that are not.")
    return plain


def _precision(dtype: torch.dtype, who: str) -> torch.dtype:
    if dtype not in PRECISIONS:
        raise UnitError(f"{who}: expected dtype torch.float32 or torch.float64, got {shown(dtype)}.")
    return dtype
