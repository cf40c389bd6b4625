"""What all operators between hidden volumes and transients share: where voxels stand, captures as data, tables."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from torchtransient.axes import TimeAxis
from torchtransient.capture import Capture, Scan
from torchtransient.checks import arguments_of
from torchtransient.errors import ShapeError
from torchtransient.reconstruction.capture_checks import (
    checked_axis,
    checked_capture,
    checked_intensities,
    checked_precision,
    checked_scan,
    same_light,
    telling,
)
from torchtransient.reconstruction.linear import LinearOperator
from torchtransient.reconstruction.operator_state import check_same, packed, plain, unpacked
from torchtransient.reconstruction.planar_scan import PlanarScan
from torchtransient.reconstruction.proportions import check_proportions
from torchtransient.reconstruction.voxels import VoxelGrid


class TransientOperator(LinearOperator):
    """A linear operator between a volume and transients (..., T, *scan points).

    ``scan``: a copy of what was given, detached; ``axis``: as given. ``grid``: the :class:`VoxelGrid` that volumes
    stand on, None for points that stand on none. Tables are built in double precision and kept in ``dtype``;
    ``operator.double()`` builds them anew. They are made on the CPU, whatever torch's default device is. ``state_dict``
    holds no tables but what the operator was made from: scan, axis, points and settings, not the precision. Loading
    the state of another operator raises ShapeError; ``strict=False`` loads what has none.

    Classes say :meth:`tables`, ``map_``, ``adjoint_`` and :meth:`reconstruct`, set ``data_shape``, ``volume_shape`` and
    ``grid`` (without one, they say :attr:`points`), and call ``_set_tables()`` last. Raises ShapeError for what is
    no axis, UnitError for a dtype other than float32 and float64.
    """

    scan: Scan | PlanarScan
    grid: VoxelGrid | None = None

    def __init__(self, scan: Scan | PlanarScan, *, time_axis: TimeAxis, dtype: torch.dtype) -> None:
        super().__init__()
        who = type(self).__name__
        scan = scan if isinstance(scan, PlanarScan) else checked_scan(scan, who)
        self.scan, self.axis = _kept(scan), checked_axis(time_axis, who)
        self.dtype = checked_precision(dtype, who)
        check_proportions(scan, self.axis, who)

    @property
    def points(self) -> Tensor:
        """(..., 3) float64 on the CPU: where the values of a volume stand in world coordinates, metres."""
        if self.grid is None:
            who = type(self).__name__
            raise ShapeError(f"{who}: expected a grid, or points of the class itself, got neither. Set its grid.")
        return self.grid.points

    @property
    def depths(self) -> Tensor | None:
        """(Z,) float64: distances of the planes from the wall, metres; None for points that stand on no planes."""
        return None if self.grid is None else self.grid.depths

    def reconstruct(self, transient: Tensor | Capture) -> Tensor:
        """The picture of a transient (..., *data_shape) or of a capture's: real, differentiable."""
        raise NotImplementedError

    def tables(self) -> dict[str, Tensor]:
        """The tables of the operator on the CPU, float64 or whole numbers; complex ones as pairs of reals."""
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
        """What the operator was made from, as bytes: its settings are those arguments of the class that it keeps under
        their own names, records and tensors among them; of other objects it is their class alone.
        """
        return packed(self._described())

    def set_extra_state(self, state: Any) -> None:
        """Raises ShapeError for the state of another operator, StorageError for what is none."""
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
        """What of the scan the operator depends on."""
        return telling(self.scan) if isinstance(self.scan, Scan) else self.scan

    def transients(self, data: Tensor | Capture) -> Tensor:
        """The transient (..., *data_shape) of a tensor or a capture, in the operator's precision.

        Raises ShapeError for a capture of another scan or axis, of polarized light, or without a transient.
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
        """Whether captures of a scan are the operator's data."""
        return isinstance(self.scan, Scan) and same_light(scan, self.scan)

    def extra_repr(self) -> str:
        volume = " x ".join(map(str, self.volume_shape))
        what = "voxels" if self.volume_name == "volume" else "bins and points"
        return f"{volume} {what}, {self.scan!r}, {self.axis}, {str(self.dtype).removeprefix('torch.')}"


def _kept(scan: Scan | PlanarScan) -> Scan | PlanarScan:
    """A copy that later changes of the caller's tensors do not reach."""
    copies: dict[str, Any] = {k: v.detach().clone() for k, v in vars(scan).items() if isinstance(v, Tensor)}
    return replace(scan, **copies)


def reconstructed(capture: Capture, kind: Callable[..., Any], *points: Any, who: str, **options: Any) -> Tensor:
    """``reconstruct`` of a capture by an operator of class ``kind`` for its own scan and axis, where its transient is,
    in double precision for captures of that, else in single, unless ``options`` say ``dtype``.

    Raises ShapeError for what is no capture, or has no transient, and what the class raises.
    """
    transient, axis = checked_capture(capture, who)
    options.setdefault("dtype", torch.float64 if transient.dtype == torch.float64 else torch.float32)
    with arguments_of(who, kind.__init__, ("scan", "time_axis")):
        operator = kind(capture.scan, *points, time_axis=axis, **options)
    operator = operator.to(transient.device)
    volume: Tensor = operator.reconstruct(capture)
    return volume
