"""Rows of transients against voxels: light of one length comes from an ellipsoid around laser spot and sensor point.

Nothing that has the size of voxels times pairs is ever held: lengths are computed anew, a few rows and a tile of voxels
at a time, in units of samples.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from torchtransient.axes import TimeAxis
from torchtransient.capture import Scan
from torchtransient.checks import finite
from torchtransient.errors import UnitError
from torchtransient.reconstruction.capture_checks import check_falloff
from torchtransient.reconstruction.filters import sample_places
from torchtransient.reconstruction.scan_operator import ScanOperator
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
    """Linear interpolation in time of what each pair of a scan measures of each voxel, and its transpose.

    ``falloff``: p of the factor (r_laser r_sensor)^-p, distances in metres, which no distance below half a bin makes
    larger. ``samples``: how many values of a row stand in a bin (:func:`sample_places`). Otherwise as
    :class:`ScanOperator`. Raises UnitError for a falloff that is not finite or beyond what the precision holds.
    """

    def __init__(
        self,
        scan: Scan,
        points: VoxelGrid | Tensor,
        *,
        time_axis: TimeAxis,
        falloff: float,
        dtype: torch.dtype,
        samples: int = 1,
    ) -> None:
        super().__init__(scan, points, time_axis=time_axis, dtype=dtype)
        self.falloff = finite(f"{type(self).__name__}: falloff", falloff)
        self.samples, self.step = samples, time_axis.bin_width_opl / samples
        first, last = sample_places(time_axis.num_bins, samples)
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
        self._check_lengths(voxels - middle, sensors - middle, lasers - middle)
        return {
            "voxels": ((voxels - middle) / width).T.contiguous(),
            "sensors": ((sensors - middle) / width).T.contiguous(),
            "lasers": ((lasers - middle) / width).T.contiguous(),
            "sensor_bins": bins,
            "laser_bins": spots,
        }

    def _check_lengths(self, voxels: Tensor, sensors: Tensor, lasers: Tensor) -> None:
        who, half = type(self).__name__, self.axis.bin_width_opl / 2
        longest = 2.0 * float(voxels.abs().max() + sensors.abs().max() + lasers.abs().max())
        if not longest < 1e9 * self.step:
            raise UnitError(
                f"{who}: expected points within 1e9 bins of each other, got some {longest / self.step:.3g} bins away. "
                "Lengths are in metres."
            )
        near = max(half, apart(voxels, sensors)) * max(half, apart(voxels, lasers))
        check_falloff(self.falloff, near, longest**2, self.dtype, who)

    voxels: Tensor
    sensors: Tensor
    lasers: Tensor
    sensor_bins: Tensor
    laser_bins: Tensor

    # ------------------------------------------------------------------------------------------------------- the sums

    def gather(self, rows_of: Rows, items: int) -> Tensor:
        """(items, V): the sum over all rows of their values at the lengths of each voxel.

        ``rows_of(group)``: real rows (items, R, row_length) of a group.
        """
        out = self.voxels.new_zeros(items, self.voxels.shape[1])
        for group in self.groups():
            padded = self._padded(rows_of(group))
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
        """The transpose of :meth:`gather`: for each group its rows (items, R, row_length) of a real volume
        (items, V)."""
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

    def _padded(self, rows: Tensor) -> Tensor:
        out = rows.new_zeros(*rows.shape[:-1], rows.shape[-1] + _PAD)
        out[..., _BEFORE : _BEFORE - _PAD] = rows
        return out

    def _blocks(self, group: Group) -> Iterator[tuple[slice, Tensor, Tensor, Tensor | None]]:
        """Of each piece of a group: the voxels of a tile, and (rows, voxels) indices into the padded rows of the group,
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
            first = None if confocal or pairs else _distances(self.lasers[:, group.lasers], voxels)
            for b in range(0, points, step):
                part = slice(b, min(b + step, points))
                last = _distances(sensors[:, part], voxels)
                to_spot = _distances(self.lasers[:, group.sensors][:, part], voxels) if pairs else None
                for spot in range(spots):
                    if to_spot is not None:
                        position = (last + to_spot).add_(bins[part, None])
                        weight = self._weight(last, to_spot)
                    elif first is None:
                        position = (last + last).add_(bins[part, None])
                        weight = self._weight(last, last)
                    else:
                        offset = bins[part, None] + self.laser_bins[group.lasers.start + spot]
                        position = (last + first[spot]).add_(offset)
                        weight = self._weight(last, first[spot])
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
        """How many spots vary against the sensor points."""
        return self.lasers.shape[1] if self.scan.kind == "exhaustive" else 1

    def split(self, data: Tensor) -> Tensor:
        """(items, T, spots, sensors) of real data (..., T, *scan.shape)."""
        return data.reshape(-1, self.axis.num_bins, self._spots, self.sensors.shape[1])

    def rows_of(self, split: Tensor, group: Group) -> Tensor:
        """(items, R, T): the rows of a group, a view where it can be."""
        part = split[:, :, group.lasers, group.sensors]
        return part.flatten(2).transpose(1, 2)

    def put_rows(self, split: Tensor, group: Group, rows: Tensor) -> None:
        """Write rows (items, R, T) to where :meth:`rows_of` has them from."""
        part = split[:, :, group.lasers, group.sensors]
        part.copy_(rows.transpose(1, 2).reshape(part.shape))


def apart(a: Tensor, b: Tensor) -> float:
    """What no distance between points (N, 3) and (M, 3) falls short of: that of the boxes around them."""
    gaps = torch.maximum(a.amin(0) - b.amax(0), b.amin(0) - a.amax(0)).clamp_min(0)
    return float(gaps.norm())


def _distances(points: Tensor, voxels: Tensor) -> Tensor:
    """(N, V) of (3, N) and (3, V). Plain differences: the product form loses digits."""
    squares = (points[0][:, None] - voxels[0]).square_()
    for k in (1, 2):
        across = points[k][:, None] - voxels[k]
        squares.addcmul_(across, across)
    return squares.sqrt_()
