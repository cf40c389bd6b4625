"""Backprojection with a filter: phasor fields of any geometry, or a Laplacian of the volume."""

from __future__ import annotations

import torch
from torch import Tensor

from torchtransient.axes import TimeAxis
from torchtransient.capture import Capture, Scan
from torchtransient.checks import shown
from torchtransient.errors import ArgumentError
from torchtransient.reconstruction.capture_checks import checked_axis
from torchtransient.reconstruction.ellipsoids import EllipsoidOperator, Group
from torchtransient.reconstruction.filters import PhasorFilter, ReconstructionFilter
from torchtransient.reconstruction.proportions import check_wavelength
from torchtransient.reconstruction.transient_operator import reconstructed
from torchtransient.reconstruction.voxels import VoxelGrid


def filtered_backproject(
    capture: Capture, points: VoxelGrid | Tensor, *, filter: ReconstructionFilter, falloff: float = 0.0
) -> Tensor:
    """:meth:`FilteredBackprojection.reconstruct` of a capture by its own scan and axis: (..., C, *volume), on the
    device of its transient. Raises as the class.
    """
    options = {"filter": filter, "falloff": falloff}
    return reconstructed(capture, FilteredBackprojection, points, who="filtered_backproject", **options)


class FilteredBackprojection(EllipsoidOperator):
    """Backprojection ``B^H`` with a filter of time ``F`` before and one of the volume ``L`` behind it.

    ``adjoint`` is L B^H F, from transients (..., T, *scan.shape) to volumes (..., *points), complex ones with a
    :class:`PhasorFilter`; ``forward`` is F^H B L^H, its exact adjoint. ``reconstruct`` makes the filter's picture.

    ``filter``: ``PhasorFilter(wavelength, cycles)``, the phasor field of any scan and any points (Liu et al. 2019), or
    ``LaplacianFilter(sigma)`` (Velten et al. 2012), or what has the methods of :class:`ReconstructionFilter`. The other
    arguments, what scans are taken, time and memory are those of :class:`Backprojection`; rows are filtered a group at
    a time, those of wavelengths below 16 bins at more than one sample a bin. Lines between samples are within 1.7 % of
    the pulse's own value at every length, at wavelengths of two bins as at long ones (1 % but for their common scale).
    On planes before a flat, regular grid :class:`PhasorField` has the same result to that for less. Raises ShapeError
    and UnitError.
    """

    def __init__(
        self,
        scan: Scan,
        points: VoxelGrid | Tensor,
        *,
        time_axis: TimeAxis,
        filter: ReconstructionFilter,
        falloff: float = 0.0,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        if not callable(getattr(filter, "rows_adjoint", None)):
            raise ArgumentError(
                f"FilteredBackprojection: expected filter as a PhasorFilter or a LaplacianFilter, got {shown(filter)}."
            )
        width = checked_axis(time_axis, "FilteredBackprojection").bin_width_opl
        filter.check(points if isinstance(points, VoxelGrid) else None, width, "FilteredBackprojection")
        samples = filter.samples(width)
        super().__init__(scan, points, time_axis=time_axis, falloff=falloff, dtype=dtype, samples=samples)
        if isinstance(filter, PhasorFilter):
            check_wavelength(filter.wavelength, self.scan, time_axis, "FilteredBackprojection")
        self.filter = filter
        self.real_volume = not filter.complex_volume

    def reconstruct(self, transient: Tensor | Capture) -> Tensor:
        """The picture (..., *volume) of a transient (..., T, *scan.shape) or a capture: the squared modulus with a
        :class:`PhasorFilter`, ``adjoint`` itself with a :class:`LaplacianFilter`. Raises ShapeError.
        """
        return self.filter.image(self.adjoint(self.transients(transient)))

    def map_(self, x: Tensor) -> Tensor:
        lead = x.shape[: x.ndim - len(self.volume_shape)]
        out = x.new_empty(*lead, *self.data_shape, dtype=self.dtype)
        split, width = self.split(out), self.axis.bin_width_opl
        volume = self.filter.volume_adjoint(x).reshape(-1, self.voxels.shape[1])
        for group, rows in self.splat(_real_items(volume)):
            complex_rows = _complex_items(rows) if volume.is_complex() else rows
            self.put_rows(split, group, self.filter.rows_adjoint(complex_rows, width, self.samples))
        return out

    def adjoint_(self, y: Tensor) -> Tensor:
        split, width = self.split(y), self.axis.bin_width_opl
        parts = 1 if self.real_volume else 2

        def rows_of(group: Group) -> Tensor:
            return _real_items(self.filter.rows(self.rows_of(split, group), width, self.samples))

        found = self.gather(rows_of, parts * len(split))
        volume = found if self.real_volume else _complex_items(found)
        lead = y.shape[: y.ndim - len(self.data_shape)]
        return self.filter.volume(volume.reshape(*lead, *self.volume_shape))

    def extra_repr(self) -> str:
        return f"{super().extra_repr()}, {self.filter}"


def _real_items(x: Tensor) -> Tensor:
    """Complex items (N, ...) as 2 N real ones, all real parts first."""
    return torch.cat([x.real, x.imag]) if x.is_complex() else x


def _complex_items(x: Tensor) -> Tensor:
    real, imaginary = x.chunk(2)
    return torch.complex(real, imaginary)
