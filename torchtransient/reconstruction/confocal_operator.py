"""What operators of confocal captures on a flat, regular grid share: geometry, volume, captures as data."""

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
from torchtransient.reconstruction.planar_scan import PlanarScan

PRECISIONS = (torch.float32, torch.float64)
LEAST_BINS = 4
# Complex numbers that are worked on at once: a piece that the caches of a CPU hold, and one that fills a GPU.
CPU_CHUNK, GPU_CHUNK = 1 << 17, 1 << 24


def chunk_rows(elements: int, device: torch.device) -> int:
    """How many rows of ``elements`` complex numbers to work on at once."""
    return max(1, (CPU_CHUNK if device.type == "cpu" else GPU_CHUNK) // max(1, elements))


class ConfocalOperator(LinearOperator):
    """A linear operator between a volume (..., Z, Y, X) before a flat wall and confocal transients (..., T, Y, X).

    ``scan``: a :class:`PlanarScan`, or a confocal :class:`Scan` on a regular grid of a flat wall that counts lengths
    from the spot to the sensor point (``first_and_last_leg=False``). ``time_axis``: of the transients. Voxels stand
    behind the points of the grid at :attr:`depths`, one for each bin: half its optical path length. Tables are built in
    double precision and kept in ``dtype``; ``operator.double()`` builds them anew.

    Raises ShapeError for other scans and axes.
    """

    def __init__(self, scan: Scan | PlanarScan, time_axis: TimeAxis, dtype: torch.dtype) -> None:
        super().__init__()
        who = type(self).__name__
        self.grid = scan if isinstance(scan, PlanarScan) else _confocal_grid(scan, who)
        if not isinstance(time_axis, TimeAxis):
            raise ShapeError(f"{who}: expected time_axis as a tt.TimeAxis, got {shown(time_axis)}.")
        if time_axis.num_bins < LEAST_BINS:
            raise ShapeError(f"{who}: expected a time axis of {LEAST_BINS} bins at least, got {time_axis.num_bins}.")
        self.axis = time_axis
        self.dtype = _precision(dtype, who)
        self.data_shape = (time_axis.num_bins, *self.grid.size)
        self.volume_shape = self.data_shape

    @property
    def depths(self) -> Tensor:
        """(Z,) float64: distances of the planes from the wall, metres. Half bins count: half the middle of each bin."""
        return self.axis.centers_opl / 2

    def points(self) -> Tensor:
        """(Z, Y, X, 3) float64: the voxels in world coordinates, metres."""
        return self.grid.points(self.depths)

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
        """The transient (..., T, Y, X) of a tensor or a capture, in the operator's precision.

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
        if _confocal_grid(data.scan, who).size != self.grid.size:
            raise ShapeError(f"{who}: expected a capture of {self.grid.size} points, got {data.scan!r}.")
        return self._taken("transient", data.transient, self.data_shape, real=True)

    def extra_repr(self) -> str:
        rows, columns = self.grid.size
        return f"{rows} x {columns} points, {self.axis}, {str(self.dtype).removeprefix('torch.')}"


class InverseOperator(LinearOperator):
    """A regularised inverse of an operator, itself a linear operator: from its data to its volume."""

    def __init__(self, operator: ConfocalOperator) -> None:
        super().__init__()
        self.operator = operator
        self.volume_shape, self.data_shape = operator.data_shape, operator.volume_shape
        self.dtype = operator.dtype

    def _apply(self, fn: Callable[..., Any], recurse: bool = True) -> Self:
        super()._apply(fn, recurse)  # type: ignore[no-untyped-call]
        self.dtype = self.operator.dtype
        return self


def precision_of(capture: Capture) -> torch.dtype:
    """float64 for captures of float64, float32 for all others."""
    double = capture.transient is not None and capture.transient.dtype == torch.float64
    return torch.float64 if double else torch.float32


def check_capture(capture: Capture, who: str) -> tuple[Tensor, TimeAxis]:
    """Transient and axis of a capture. Raises ShapeError for what is none, or has none."""
    if not isinstance(capture, Capture):
        raise ShapeError(f"{who}: expected a tt.nlos.Capture, got {shown(capture)}. Tensors go to an operator.")
    if capture.transient is None or capture.axis is None:
        raise ShapeError(f"{who}: expected a capture with a transient, got phasors alone.")
    return capture.transient, capture.axis


def _confocal_grid(scan: Scan, who: str) -> PlanarScan:
    if not isinstance(scan, Scan):
        raise ShapeError(f"{who}: expected a tt.nlos.Scan or a PlanarScan, got {shown(scan)}.")
    if scan.kind != "confocal":
        raise ShapeError(
            f"{who}: expected a confocal scan, got a {scan.kind} one. Take the diagonal of an exhaustive capture with "
            "capture.confocal(), bring others to midpoints with MidpointFK, or use Backprojection or PhasorField."
        )
    if scan.first_and_last_leg:
        raise ShapeError(
            f"{who}: expected lengths from the spot to the sensor point, got a scan that counts the first and last leg "
            "too. Subtract scan.legs from the arrivals of each point and build the scan with first_and_last_leg=False."
        )
    return PlanarScan.of_scan(scan, who)


def _precision(dtype: torch.dtype, who: str) -> torch.dtype:
    if dtype not in PRECISIONS:
        raise UnitError(f"{who}: expected dtype torch.float32 or torch.float64, got {shown(dtype)}.")
    return dtype
