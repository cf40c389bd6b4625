"""Bases of operators between hidden volumes and transients: any scan, any points, and confocal grids of a flat wall."""

from __future__ import annotations

import copy
import inspect
from abc import abstractmethod
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from torchtransient.axes import TimeAxis
from torchtransient.capture import Capture, Scan
from torchtransient.capture.capture import precision_of
from torchtransient.checks import arguments_of
from torchtransient.errors import ShapeError
from torchtransient.reconstruction.capture_checks import (
    check_from_zero,
    check_proportions,
    check_reach,
    checked_capture,
    checked_intensities,
    checked_points,
    confocal_wall,
    telling,
)
from torchtransient.reconstruction.linear import (
    LinearOperator,
    check_same,
    checked_precision,
    each,
    packed,
    plain,
    unpacked,
)
from torchtransient.reconstruction.voxels import PlanarScan, VoxelGrid
from torchtransient.tensor_record import same


class TransientOperator(LinearOperator):
    """A linear operator between a volume and transients (..., T, *scan points).

    ``scan``: a copy of the argument, detached; ``axis``: as given. ``grid``: the :class:`VoxelGrid` that volumes stand
    on, None for points that stand on none. Tables are built in double precision on the CPU, whatever torch's default
    device is, and kept in ``dtype``; ``operator.double()`` builds them anew. ``state_dict`` holds no tables but the
    scan, axis, points and settings of the operator, not the precision. Loading the state of another operator raises
    ShapeError; ``strict=False`` loads models without such a state.

    Classes define :meth:`tables`, ``map_``, ``adjoint_`` and :meth:`reconstruct`, set ``data_shape``, ``volume_shape``
    and ``grid`` (without one, they define :attr:`points`), and call ``_set_tables()`` last.

    Args:
        scan: scan of any kind, or the grid of a flat wall.
        time_axis: time axis of the transients.
        dtype: float32 or float64.

    Raises:
        UnitError: for another dtype, and a wall and a record that are not of one size.
    """

    scan: Scan | PlanarScan
    grid: VoxelGrid | None = None

    def __init__(self, scan: Scan | PlanarScan, *, time_axis: TimeAxis, dtype: torch.dtype) -> None:
        super().__init__()
        who = type(self).__name__
        # A copy that later changes of the caller's tensors do not reach.
        copies: dict[str, Any] = {k: v.detach().clone() for k, v in vars(scan).items() if isinstance(v, Tensor)}
        self.scan, self.axis, self.dtype = replace(scan, **copies), time_axis, checked_precision(dtype, who)
        check_proportions(scan, time_axis, who)

    @property
    def points(self) -> Tensor:
        """Places of the values of a volume in world coordinates, (..., 3) float64 on the CPU, metres."""
        assert self.grid is not None  # else the class has points of its own
        return self.grid.points

    @property
    def depths(self) -> Tensor | None:
        """(Z,) float64: distances of the planes from the wall, metres; None for points that stand on no planes."""
        return None if self.grid is None else self.grid.depths

    def reconstruct(self, transient: Tensor | Capture) -> Tensor:
        """Return the picture of a transient, real and differentiable.

        Args:
            transient: (..., *data_shape), or a capture.
        """
        raise NotImplementedError

    def tables(self) -> dict[str, Tensor]:
        """Return the tables of the operator on the CPU, float64 or whole numbers; complex ones as pairs of reals."""
        return {}

    def _set_tables(self, device: torch.device | str = "cpu") -> None:
        for name, table in self.tables().items():
            kept = table.to(device, self.dtype if table.is_floating_point() else None)
            # Not part of the state: the arguments make them.
            self.register_buffer(name, kept, persistent=False)

    def _converted(self) -> None:
        # Converted tables have the digits of the old ones.
        self._set_tables(self.device or "cpu")

    def get_extra_state(self) -> Tensor:
        """Return the settings of the operator as bytes.

        They are the arguments of the class that it keeps under their own names, records and tensors among them; other
        objects are known by their class alone.
        """
        return packed(self._described())

    def set_extra_state(self, state: Any) -> None:
        """Compare a state with the settings of the operator.

        Args:
            state: state that :meth:`get_extra_state` returned.

        Raises:
            ShapeError: for the state of another operator.
            StorageError: for other objects.
        """
        who = type(self).__name__
        check_same(self._described(), unpacked(state, who), who)

    def _described(self) -> dict[str, Any]:
        # Children have a state of their own.
        names = inspect.signature(type(self)).parameters.keys() - {"scan", "points", "time_axis", "dtype"}
        return {
            "class": type(self).__name__,
            "time axis": [self.axis.start_opl, self.axis.bin_width_opl, self.axis.num_bins],
            "scan": plain(self._measured()),
            "points": plain(self.points if self.grid is None else self.grid),
            **{name: plain(vars(self)[name]) for name in sorted(names) if name in vars(self)},
        }

    def _measured(self) -> Any:
        """Return the part of the scan that the operator depends on."""
        return telling(self.scan) if isinstance(self.scan, Scan) else self.scan

    def transients(self, data: Tensor | Capture) -> Tensor:
        """Return a transient in the operator's precision.

        Args:
            data: (..., *data_shape), or a capture.

        Raises:
            ShapeError: for a capture of another scan or axis, of polarized light, or without a transient.
        """
        if not isinstance(data, Capture):
            return self._taken("transient", data, self.data_shape, real=True)
        transient = checked_intensities(data, self.axis, type(self).__name__)
        if not self._takes(data.scan):
            raise ShapeError(
                f"{type(self).__name__}: expected a capture of the operator's own scan, {self.scan!r}, got one of "
                f"{data.scan!r} with other points or legs. Make an operator for it."
            )
        return self._taken("transient", transient, self.data_shape, real=True)

    def _takes(self, scan: Scan) -> bool:
        """Return True where captures of a scan are the operator's data: equal kind, points and, where they count,
        legs.
        """
        if scan is self.scan:
            return True
        mine, theirs = self._measured(), telling(scan)
        return len(mine) == len(theirs) and all(same(a, b) for a, b in zip(mine, theirs, strict=True))

    def extra_repr(self) -> str:
        volume = " x ".join(map(str, self.volume_shape))
        what = "voxels" if self.volume_name == "volume" else "bins and points"
        return f"{volume} {what}, {self.scan!r}, {self.axis}, {str(self.dtype).removeprefix('torch.')}"


def reconstructed(capture: Capture, kind: Callable[..., Any], *points: Any, who: str, **options: Any) -> Tensor:
    """Reconstruct a capture by an operator for its own scan and axis, on the device of its transient.

    Args:
        capture: capture with a transient.
        kind: class of the operator.
        points: points of the volume, for classes that take some.
        who: begins the message.
        options: options of the class; ``dtype`` is double for captures in double precision, else single, unless given.

    Returns:
        ``reconstruct`` of the capture.

    Raises:
        ShapeError: for phasors alone, and as the class.
    """
    transient, axis = checked_capture(capture, who)
    options.setdefault("dtype", precision_of(transient))
    with arguments_of(who, kind.__init__, ("scan", "time_axis")):
        operator = kind(capture.scan, *points, time_axis=axis, **options).to(transient.device)
    volume: Tensor = operator.reconstruct(capture)
    return volume


class ScanOperator(TransientOperator):
    """A linear operator between values at hidden points and transients (..., T, *scan.shape) of a scan of any kind.

    Args:
        scan: scan of any kind.
        points: grid, or points (..., 3) in world coordinates, metres; volumes have their leading dimensions. Points
            that carry gradients are taken as they are, detached: operators are differentiable by volumes and transients
            alone.
        time_axis: time axis of the transients, counted as the scan's ``first_and_last_leg`` says.
        dtype: float32 or float64.

    Raises:
        ShapeError: for other objects than points.
        UnitError: for points that are not finite or far beyond the record, and for another dtype.
    """

    scan: Scan

    def __init__(self, scan: Scan, points: VoxelGrid | Tensor, *, time_axis: TimeAxis, dtype: torch.dtype) -> None:
        who = type(self).__name__
        super().__init__(scan, time_axis=time_axis, dtype=dtype)
        self.grid = points if isinstance(points, VoxelGrid) else None
        self._points = None if isinstance(points, VoxelGrid) else checked_points(points, who)
        check_reach(scan, points if self._points is None else self._points, time_axis, who)
        self.volume_shape = tuple(self.points.shape[:-1])
        self.data_shape = (time_axis.num_bins, *scan.shape)

    @property
    def points(self) -> Tensor:
        """(..., 3) float64 on the CPU: the hidden points in world coordinates, metres."""
        return super().points if self._points is None else self._points


LEAST_BINS = 4
# Complex numbers that are worked on at once: a piece that the caches of a CPU hold, and one that fills a GPU.
CPU_CHUNK, GPU_CHUNK = 1 << 17, 1 << 24


def chunk_rows(elements: int, device: torch.device) -> int:
    """Return the number of rows to work on at once.

    Args:
        elements: complex numbers of a row.
        device: device of the operands.
    """
    return max(1, (CPU_CHUNK if device.type == "cpu" else GPU_CHUNK) // max(1, elements))


class ConfocalOperator(TransientOperator):
    """A linear operator between a volume (..., Z, Y, X) before a flat wall and confocal transients (..., T, Y, X).

    Voxels stand behind the points of the wall (:attr:`wall`) at :attr:`depths`, one for each bin: half its optical path
    length. Time axes start at zero or later, unless a class sets :attr:`early`.

    Args:
        scan: a :class:`PlanarScan`, or a confocal :class:`Scan` on a regular grid of a flat wall that counts lengths
            from the spot to the sensor point (``first_and_last_leg=False``).
        time_axis: time axis of the transients.
        dtype: float32 or float64.

    Raises:
        ShapeError: for other scans and axes.
        UnitError: for time axes that begin before zero, and for another dtype.
    """

    grid: VoxelGrid
    # Whether bins before time zero are taken: they are where no voxel is.
    early = False

    def __init__(self, scan: Scan | PlanarScan, *, time_axis: TimeAxis, dtype: torch.dtype) -> None:
        who = type(self).__name__
        confocal_wall(scan, who)
        bins = time_axis.num_bins
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


class InvertibleOperator(ConfocalOperator):
    """A confocal operator with a regularised inverse, which classes define for one item of a batch."""

    @abstractmethod
    def invert(self, data: Tensor) -> Tensor:
        """Return the volume of one transient, (*data_shape) to (*volume_shape)."""

    @abstractmethod
    def invert_adjoint(self, volume: Tensor) -> Tensor:
        """Return the adjoint of :meth:`invert`, (*volume_shape) to (*data_shape)."""

    @property
    def inverse(self) -> InverseOperator:
        """The Wiener inverse: transients (..., T, Y, X) to volumes, a linear operator with an adjoint of its own."""
        return InverseOperator(self)

    def reconstruct(self, transient: Tensor | Capture) -> Tensor:
        """Return the Wiener inverse of a transient, linear and differentiable.

        Args:
            transient: (..., T, Y, X), or a capture of the operator's scan and axis.

        Returns:
            As many volumes.

        Raises:
            ShapeError: for other transients and captures.
        """
        volume: Tensor = self.inverse(self.transients(transient))
        return volume


class InverseOperator(LinearOperator):
    """A regularised inverse of an operator, itself a linear operator from its data to its volume.

    It has the ``points``, ``depths`` and ``grid`` of the operator, and shares its tables until one of them is moved or
    converted, which leaves the other as it was.

    Args:
        operator: operator that is inverted.
    """

    def __init__(self, operator: InvertibleOperator) -> None:
        super().__init__()
        # Modules that share tables but not the lists of them.
        self.operator = copy.copy(operator)
        for name in ("_buffers", "_parameters", "_modules"):
            setattr(self.operator, name, dict(getattr(operator, name)))
        self.volume_shape, self.data_shape = operator.data_shape, operator.volume_shape
        self.axis, self.grid, self.depths = operator.axis, operator.grid, operator.depths
        self.dtype = operator.dtype
        self.volume_name, self.data_name = "transient", operator.volume_name

    @property
    def points(self) -> Tensor:
        """(Z, Y, X, 3) float64 on the CPU: these voxels in world coordinates, metres."""
        return self.grid.points

    def map_(self, x: Tensor) -> Tensor:
        return each(self.operator.invert, x, len(self.volume_shape))

    def adjoint_(self, y: Tensor) -> Tensor:
        return each(self.operator.invert_adjoint, y, len(self.data_shape))
