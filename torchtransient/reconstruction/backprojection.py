"""Backprojection: a voxel sums the light that each pair of laser spot and sensor point measured at its path length.

Light of one length comes from an ellipsoid around spot and point. Nothing of the size of voxels times pairs is held:
lengths are computed anew, a few rows and a tile of voxels at a time, in units of samples.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from torchtransient.axes import TimeAxis
from torchtransient.capture import Capture, Scan
from torchtransient.checks import finite
from torchtransient.errors import UnitError
from torchtransient.reconstruction.capture_checks import check_wavelength
from torchtransient.reconstruction.filters import LaplacianFilter, PhasorFilter, sample_places
from torchtransient.reconstruction.transient_operator import ScanOperator, reconstructed
from torchtransient.reconstruction.voxels import VoxelGrid

# Pairs of row and voxel that are worked on at once: what the caches of a CPU core hold, and what fills a GPU.
CPU_BLOCK, GPU_BLOCK = 1 << 17, 1 << 24
# Voxels of a tile on a CPU, so that a block holds a few rows.
CPU_TILE = 1 << 14
# Numbers in the rows of a group, which are brought into order together.
GROUP_NUMBERS = 1 << 19
# Laser spots of a group, whose distances to a tile are kept while sensor points take turns.
MOST_SPOTS = 64
# Zeros around each row: two before and two behind, so that interpolation beyond an end reads nothing but them.
_BEFORE, _PAD = 2, 4


@dataclass(frozen=True)
class Group:
    """Rows of a transient: pairs of some ``lasers`` and some ``sensors``, the sensors varying fastest."""

    lasers: slice
    sensors: slice

    @property
    def size(self) -> tuple[int, int]:
        return self.lasers.stop - self.lasers.start, self.sensors.stop - self.sensors.start


Rows = Callable[[Group], Tensor]


class EllipsoidOperator(ScanOperator):
    """Linear interpolation in time of the light that each pair of a scan measures of each voxel, and its transpose.

    Args:
        scan: scan of any kind.
        points: grid, or points (..., 3) in world coordinates, metres, see :class:`ScanOperator`.
        time_axis: time axis of the transients.
        falloff: p of the factor (r_laser r_sensor)^-p, distances in metres, none of them below half a bin.
        dtype: float32 or float64.

    Raises:
        UnitError: for a falloff that is not finite.
    """

    # Values of a row in each bin, see :func:`sample_places`.
    samples = 1

    def __init__(
        self,
        scan: Scan,
        points: VoxelGrid | Tensor,
        *,
        time_axis: TimeAxis,
        falloff: float = 0.0,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        super().__init__(scan, points, time_axis=time_axis, dtype=dtype)
        self.falloff = finite(f"{type(self).__name__}: falloff", falloff)
        self.step = time_axis.bin_width_opl / self.samples
        first, last = sample_places(time_axis.num_bins, self.samples)
        self.row_length = last - first
        self._set_tables()

    def tables(self) -> dict[str, Tensor]:
        """Coordinates (3, N) in samples, from the middle of the sensor points; the place in a padded row that length
        zero of a sensor point falls into, and how many samples the leg of each spot adds.
        """
        scan, width = self.scan, self.step
        sensors = scan.sensor_points.cpu().reshape(-1, 3)
        lasers = scan.laser_points.cpu().reshape(-1, 3)
        middle = sensors.mean(0)
        first, _ = sample_places(self.axis.num_bins, self.samples)
        zero = _BEFORE - first - self.samples / 2 - self.axis.start_opl / width
        bins = torch.full((len(sensors),), zero, dtype=torch.float64, device="cpu")
        spots = torch.zeros(len(lasers), dtype=torch.float64, device="cpu")
        if scan.first_and_last_leg:
            bins = bins + scan.sensor_legs.cpu().reshape(-1) / width
            spots = scan.laser_legs.cpu().reshape(-1) / width
        if scan.kind in ("confocal", "pairs"):
            bins, spots = bins + spots, torch.zeros_like(spots)
        voxels = self.points.reshape(-1, 3)
        longest = 2.0 * max(float((some - middle).abs().max()) for some in (voxels, sensors, lasers))
        if not longest < 1e9 * width:
            raise UnitError(
                f"{type(self).__name__}: expected points within 1e9 bins, got some {longest / width:.3g} bins away."
            )
        return {
            "voxels": ((voxels - middle) / width).T.contiguous(),
            "sensors": ((sensors - middle) / width).T.contiguous(),
            "lasers": ((lasers - middle) / width).T.contiguous(),
            "sensor_bins": bins,
            "laser_bins": spots,
        }

    voxels: Tensor
    sensors: Tensor
    lasers: Tensor
    sensor_bins: Tensor
    laser_bins: Tensor

    # ------------------------------------------------------------------------------------------------------- the sums

    def gather(self, rows_of: Rows, items: int) -> Tensor:
        """Sum over all rows of their values at the lengths of each voxel.

        Args:
            rows_of: real rows (items, R, row_length) of a group.
            items: number of items.

        Returns:
            (items, V).
        """
        out = self.voxels.new_zeros(items, self.voxels.shape[1])
        for group in self.groups():
            padded = functional.pad(rows_of(group), (_BEFORE, _PAD - _BEFORE))
            slopes = padded.diff(dim=-1, append=padded[..., :1] * 0).reshape(items, -1)
            padded = padded.reshape(items, -1)
            for tile, index, fraction, weight in self._blocks(group):
                flat = index.reshape(-1)
                for n in range(items):
                    values = padded[n].index_select(0, flat).view(index.shape)
                    values.addcmul_(fraction, slopes[n].index_select(0, flat).view(index.shape))
                    out[n, tile] += (values if weight is None else values.mul_(weight)).sum(0)
        return out

    def splat(self, volume: Tensor) -> Iterator[tuple[Group, Tensor]]:
        """Yield each group with its rows (items, R, row_length) of a real volume (items, V), the transpose of
        :meth:`gather`.
        """
        items, length = len(volume), self.row_length + _PAD
        for group in self.groups():
            rows = volume.new_zeros(items, math.prod(group.size) * length)
            for tile, index, fraction, weight in self._blocks(group):
                flat = index.reshape(-1)
                after = flat + 1
                for n in range(items):
                    values = volume[n, tile]
                    light = values.expand(index.shape) if weight is None else values * weight
                    late = light * fraction
                    rows[n].index_add_(0, flat, (light - late).reshape(-1))
                    rows[n].index_add_(0, after, late.reshape(-1))
            yield group, rows.view(items, -1, length)[..., _BEFORE : _BEFORE - _PAD]

    def _blocks(self, group: Group) -> Iterator[tuple[slice, Tensor, Tensor, Tensor | None]]:
        """Yield the pieces of a group: the voxels of a tile, (rows, voxels) indices into the padded rows of the group,
        fractions of a bin, and weights unless all are one.
        """
        length, (spots, points) = self.row_length + _PAD, group.size
        on_cpu = self.voxels.device.type == "cpu"
        block = CPU_BLOCK if on_cpu else GPU_BLOCK
        size = min(self.voxels.shape[1], CPU_TILE if on_cpu else GPU_BLOCK)
        step = max(1, block // size)
        confocal, pairs = self.scan.kind == "confocal", self.scan.kind == "pairs"
        starts = torch.arange(points, dtype=torch.int32, device=self.voxels.device)[:, None] * length
        sensors, bins = self.sensors[:, group.sensors], self.sensor_bins[group.sensors]
        for a in range(0, self.voxels.shape[1], size):
            tile = slice(a, min(a + size, self.voxels.shape[1]))
            voxels = self.voxels[:, tile]
            to_spots = None if confocal or pairs else _distances(self.lasers[:, group.lasers], voxels)
            for b in range(0, points, step):
                part = slice(b, min(b + step, points))
                last = _distances(sensors[:, part], voxels)
                if pairs:
                    to_spots = _distances(self.lasers[:, group.sensors][:, part], voxels)[None]
                for spot in range(spots):
                    first = last if to_spots is None else to_spots[spot]
                    position = (last + first).add_(bins[part, None] + self.laser_bins[group.lasers.start + spot])
                    weight = self._weight(last, first)
                    # Lengths before the record read the zero in front of a row, those behind it the ones at its end.
                    position.clamp_(0, length - 2)
                    index = position.to(torch.int32)
                    position.sub_(index)
                    index.add_(starts[part]).add_(spot * points * length)
                    yield tile, index, position, weight

    def _weight(self, last: Tensor, first: Tensor) -> Tensor | None:
        if not self.falloff:
            return None
        half = self.samples / 2
        near = last.clamp_min(half)
        both = near * (near if first is last else first.clamp_min(half))
        return both.mul_(self.step**2).pow_(-self.falloff)

    # ---------------------------------------------------------------------------------------------- groups and layouts

    def groups(self) -> Iterator[Group]:
        """All rows, in pieces of :data:`GROUP_NUMBERS` numbers at most (a row at least)."""
        rows = max(1, GROUP_NUMBERS // (self.row_length + _PAD))
        sensors, spots = self.sensors.shape[1], self._spots
        step = min(rows, sensors)
        many = min(max(1, rows // step), MOST_SPOTS)
        for a in range(0, spots, many):
            for b in range(0, sensors, step):
                yield Group(slice(a, min(a + many, spots)), slice(b, min(b + step, sensors)))

    @property
    def _spots(self) -> int:
        """Number of spots that vary against the sensor points."""
        return self.lasers.shape[1] if self.scan.kind == "exhaustive" else 1

    def split(self, data: Tensor) -> Tensor:
        """Return real data (..., T, *scan.shape) as (items, T, spots, sensors)."""
        return data.reshape(-1, self.axis.num_bins, self._spots, self.sensors.shape[1])

    def rows_of(self, split: Tensor, group: Group) -> Tensor:
        """Return the rows (items, R, T) of a group, a view where possible."""
        part = split[:, :, group.lasers, group.sensors]
        return part.flatten(2).transpose(1, 2)

    def put_rows(self, split: Tensor, group: Group, rows: Tensor) -> None:
        """Write rows (items, R, T) to the place that :meth:`rows_of` reads."""
        part = split[:, :, group.lasers, group.sensors]
        part.copy_(rows.transpose(1, 2).reshape(part.shape))


def _distances(points: Tensor, voxels: Tensor) -> Tensor:
    """(N, V) of (3, N) and (3, V). Plain differences: the product form loses digits."""
    squares = (points[0][:, None] - voxels[0]).square_()
    for k in (1, 2):
        across = points[k][:, None] - voxels[k]
        squares.addcmul_(across, across)
    return squares.sqrt_()


def backproject(capture: Capture, points: VoxelGrid | Tensor, *, falloff: float = 0.0) -> Tensor:
    """Backproject a capture: :meth:`Backprojection.reconstruct` by its own scan and axis.

    Args:
        capture: capture with a transient.
        points: grid, or points (..., 3) in world coordinates, metres.
        falloff: power of 1 / (r_laser r_sensor), see :class:`Backprojection`.

    Returns:
        (..., C, *volume), on the device of the transient.

    Raises:
        ShapeError, UnitError: as the class.
    """
    return reconstructed(capture, Backprojection, points, who="backproject", falloff=falloff)


class Backprojection(EllipsoidOperator):
    """Volume (..., *points) to transients (..., T, *scan.shape); the adjoint is backprojection (Velten et al. 2012).

    ``forward`` puts the value of a voxel at the length laser spot - voxel - sensor point of every pair, shared linearly
    between the two bins whose centres are next to it, so that their sum is the value: the transient of isotropic points
    that hide nothing. ``adjoint`` reads the transients there by linear interpolation and adds up. Light outside of the
    record counts as zero. Takes scans of any kind (confocal, single, exhaustive, pairs), grids and lists of points,
    flat and curved walls, with or without first and last legs.

    Args:
        scan: scan of any kind.
        points: grid, or points (..., 3) in world coordinates, metres.
        time_axis: time axis of the transients, counted as the scan's ``first_and_last_leg`` says.
        falloff: p of a factor (r_laser r_sensor)^-p in both maps. 0 leaves distances alone, 2 is the falloff of small
            diffuse patches, 1 that of retroreflectors in confocal scans; -2 makes ``adjoint`` compensate for it.
            Distances below half a bin count as half a bin. Cosines of wall and surface are not part of it.
        dtype: float32 or float64.

    Raises:
        ShapeError: for other scans, axes and points.
        UnitError: for points that are not finite or far beyond the record, and for a falloff that is not finite.

    Time grows with pairs times voxels (some 4 ns each on a core); memory beyond operands with neither.
    """

    def reconstruct(self, transient: Tensor | Capture) -> Tensor:
        """Return ``adjoint`` of a transient.

        Args:
            transient: (..., T, *scan.shape), or a capture of the operator's scan and axis.

        Returns:
            (..., *volume).

        Raises:
            ShapeError: for another shape, or a capture of another scan or axis.
        """
        return self.adjoint(self.transients(transient))

    def map_(self, x: Tensor) -> Tensor:
        lead = x.shape[: x.ndim - len(self.volume_shape)]
        out = x.new_empty(*lead, *self.data_shape)
        split = self.split(out)
        for group, rows in self.splat(x.reshape(-1, self.voxels.shape[1])):
            self.put_rows(split, group, rows)
        return out

    def adjoint_(self, y: Tensor) -> Tensor:
        split = self.split(y)
        found = self.gather(lambda group: self.rows_of(split, group), len(split))
        lead = y.shape[: y.ndim - len(self.data_shape)]
        volume: Tensor = found.reshape(*lead, *self.volume_shape)
        return volume


def filtered_backproject(
    capture: Capture, points: VoxelGrid | Tensor, *, filter: PhasorFilter | LaplacianFilter, falloff: float = 0.0
) -> Tensor:
    """Backproject a capture behind a filter: :meth:`FilteredBackprojection.reconstruct` by its own scan and axis.

    Args:
        capture: capture with a transient.
        points: grid, or points (..., 3) in world coordinates, metres.
        filter: :class:`PhasorFilter` or :class:`LaplacianFilter`.
        falloff: power of 1 / (r_laser r_sensor), see :class:`Backprojection`.

    Returns:
        (..., C, *volume), on the device of the transient.

    Raises:
        ShapeError, UnitError: as the class.
    """
    return reconstructed(
        capture, FilteredBackprojection, points, who="filtered_backproject", filter=filter, falloff=falloff
    )


class FilteredBackprojection(EllipsoidOperator):
    """Backprojection ``B^H`` with a filter of time ``F`` before and one of the volume ``L`` behind it.

    ``adjoint`` is L B^H F, from transients (..., T, *scan.shape) to volumes (..., *points), complex ones with a
    :class:`PhasorFilter`; ``forward`` is F^H B L^H, its exact adjoint. ``reconstruct`` makes the filter's picture.

    Args:
        scan: scan of any kind.
        points: grid, or points (..., 3) in world coordinates, metres.
        time_axis: time axis of the transients, counted as the scan's ``first_and_last_leg`` says.
        filter: ``PhasorFilter(wavelength, cycles)``, the phasor field of any scan and any points (Liu et al. 2019), or
            ``LaplacianFilter(sigma)`` (Velten et al. 2012).
        falloff: p of a factor (r_laser r_sensor)^-p, see :class:`Backprojection`.
        dtype: float32 or float64.

    Raises:
        ShapeError, UnitError: as :class:`Backprojection` and the filter.

    Rows are filtered a group at a time, at wavelengths below 16 bins with more than one sample a bin. Lines between
    samples are within 1.7 % of the pulse's own value at every length, at wavelengths of two bins as at long ones (1 %
    but for their common scale). On planes before a flat, regular grid :class:`PhasorField` has the same result to that
    for less.
    """

    def __init__(
        self,
        scan: Scan,
        points: VoxelGrid | Tensor,
        *,
        time_axis: TimeAxis,
        filter: PhasorFilter | LaplacianFilter,
        falloff: float = 0.0,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        width = time_axis.bin_width_opl
        filter.check(points if isinstance(points, VoxelGrid) else None, width, "FilteredBackprojection")
        self.samples = filter.samples(width)
        super().__init__(scan, points, time_axis=time_axis, falloff=falloff, dtype=dtype)
        if isinstance(filter, PhasorFilter):
            check_wavelength(filter.wavelength, self.scan, time_axis, "FilteredBackprojection")
        self.filter = filter
        self.real_volume = not filter.complex_volume

    def reconstruct(self, transient: Tensor | Capture) -> Tensor:
        """Return the picture of a transient: the squared modulus with a :class:`PhasorFilter`, else ``adjoint`` itself.

        Args:
            transient: (..., T, *scan.shape), or a capture of the operator's scan and axis.

        Returns:
            (..., *volume), real.

        Raises:
            ShapeError: for another shape, or a capture of another scan or axis.
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


def _real_items(x: Tensor) -> Tensor:
    """Complex items (N, ...) as 2 N real ones, all real parts first."""
    return torch.cat([x.real, x.imag]) if x.is_complex() else x


def _complex_items(x: Tensor) -> Tensor:
    real, imaginary = x.chunk(2)
    return torch.complex(real, imaginary)
