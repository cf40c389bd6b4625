"""f-k migration of confocal captures (Lindell, Wetzstein, O'Toole, "Wave-based non-line-of-sight imaging using fast f-k
migration", SIGGRAPH 2019), after R. H. Stolt, "Migration by Fourier transform", Geophysics 43 (1978).

A confocal scan is taken for the wavefield u(x, y, t) of hidden points that light up at t = 0 and are seen through a
medium of half the speed of light. Its field at t = 0 has the transform

    psi(kx, ky, kz) = J U(kx, ky, k),    k^2 = kx^2 + ky^2 + kz^2,    J = kz / k,

with k per metre of optical path over 2, that is, along the record. In bins of the transforms of twice the length,

    jt^2 = jz^2 + (T dt / (2 Y dy))^2 jy^2 + (T dt / (2 X dx))^2 jx^2 .

U is interpolated along jt. Three things make that exact to 1e-3 of the field: the record's middle is moved to t = 0,
where its transform varies least; the taps are those of a Kaiser-Bessel window, whose transform the data are divided by
beforehand; the place of the samples is in the phase: bin k at start + (k + 1/2) dt, plane k at half of that.

Captures that are not confocal: midpoints and normal moveout, seismology's approximation. Light of a spot and a sensor
point with the distance d between them arrives about as that of a confocal scan at their middle, only later:
tau^2 = tau_0^2 + d^2, which is exact for points straight behind the middle and for surfaces parallel to the wall.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from torchtransient.axes import TimeAxis
from torchtransient.capture import Capture, Scan
from torchtransient.errors import ShapeError
from torchtransient.reconstruction.capture_checks import check_from_zero, one_of, refuse_legs, refuse_pairs
from torchtransient.reconstruction.captures import checked_floor, stabilized_root
from torchtransient.reconstruction.linear import each
from torchtransient.reconstruction.transient_operator import (
    ConfocalOperator,
    TransientOperator,
    chunk_rows,
    reconstructed,
)
from torchtransient.reconstruction.voxels import OFF_GRID, PlanarScan, VoxelGrid
from torchtransient.volume_methods import TARGETS

TAPS = (2, 4)


class FK(ConfocalOperator):
    """f-k migration as a linear operator, for confocal captures of a flat wall.

    ``operator(field)``: complex (..., Z, Y, X) at time zero to the real wavefield (..., T, Y, X) on the wall, the
    exploding-reflector model; ``operator.adjoint(wavefield)``: the migration. They are each other's adjoints exactly,
    and nearly inverses: migration of the model is J / 2 times the field, J being the cosine of each wave's direction.
    ``operator.reconstruct(transient)``: from measured light to the squared field.

    Args:
        scan: confocal scan on a regular grid of a flat wall, without legs.
        time_axis: time axis of the transients, from zero on.
        target: kind of the hidden surface: "diffuse", light falls with the fourth power of the distance and psi = z
            sqrt(H), or "retroreflective", with the second and psi = sqrt(H), where z is half the optical path length.
        floor: number added to the light under the root, in the unit of the transient, see :func:`stabilized_root`; 0 is
            the root itself, with no derivative at empty bins. Take 1/4 for photon counts and wherever gradients go
            through.
        taps: number of interpolation taps: 4 are right to 3e-4 of the field, 2 (linear) to some percent.
        dtype: float32 or float64.

    Raises:
        ShapeError: for other scans.
        ArgumentError: for an unknown target and other taps.
        UnitError: for a negative floor and for time axes that begin before zero.

    Wall, time and depth are padded to twice their length. Memory: two complex cubes of the wavefield for each call, and
    tables of 4 + 8 taps bytes (float32) for each quarter of a voxel of the padded spectrum. Not supported: scans that
    are not confocal (:class:`MidpointFK`), curved walls, cosines of wall and hidden surfaces.
    """

    real_volume = False
    place: Tensor
    weights: Tensor
    taper: Tensor

    def __init__(
        self,
        scan: Scan | PlanarScan,
        *,
        time_axis: TimeAxis,
        target: str = "diffuse",
        floor: float = 0.0,
        taps: int = 4,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        super().__init__(scan, time_axis=time_axis, dtype=dtype)
        self.target = one_of("FK: target", target, TARGETS)
        self.taps = one_of("FK: taps", taps, TAPS)
        self.floor = checked_floor(floor, dtype)
        self._set_tables()

    def tables(self) -> dict[str, Tensor]:
        """``place`` (X + 1, Y + 1, T): the first bin to interpolate from; ``weights`` (X + 1, taps, Y + 1, T, 2): of
        the bins from there on, real and imaginary; ``taper`` (T,): what the data are multiplied by. Frequencies below
        zero are mirrors of these.
        """
        bins, rows, columns = self.data_shape
        width = self.axis.bin_width_opl
        depth = bins * width
        jz = torch.arange(bins, dtype=torch.float64, device="cpu")
        ky = torch.arange(rows + 1, dtype=torch.float64, device="cpu")[:, None]
        ky = ky * (depth / (2 * rows * self.grid.pitch[0]))
        kx = torch.arange(columns + 1, dtype=torch.float64, device="cpu")[:, None, None]
        kx = kx * (depth / (2 * columns * self.grid.pitch[1]))
        jt = torch.sqrt(jz**2 + ky**2 + kx**2)
        # Waves along the wall (kz = 0) never came from the volume; at the origin the quotient is 0 / 0.
        jacobian = torch.where(jz > 0, jz / jt.clamp_min(1.0), 0.0)
        middle, first = bins // 2, (self.axis.start_opl + width / 2) / width
        phase = -(math.pi / bins) * ((jt - jz) * first + jt * middle)
        # Moved into the record where it ends; the window says which bins count. Above the highest frequency there is
        # nothing, and below zero come only waves whose J is 0.
        place = (torch.floor(jt) - (self.taps // 2 - 1)).clamp_(0, bins + 1 - self.taps)
        weights = torch.empty(columns + 1, self.taps, rows + 1, bins, 2, dtype=torch.float64, device="cpu")
        for tap in range(self.taps):
            j = place + tap
            size, angle = _window(jt - j, self.taps) * jacobian, phase + (math.pi * middle / bins) * j
            weights[:, tap, ..., 0], weights[:, tap, ..., 1] = size * angle.cos(), size * angle.sin()
        offset = (torch.arange(bins, dtype=torch.float64, device="cpu") - middle) / (2 * bins)
        return {"place": place.to(torch.int32), "weights": weights, "taper": 1 / _window_transform(offset, self.taps)}

    def adjoint_(self, y: Tensor) -> Tensor:
        return each(self._migrate, y, 3)

    def map_(self, x: Tensor) -> Tensor:
        return each(self._model, x, 3)

    def reconstruct(self, transient: Tensor | Capture) -> Tensor:
        """Return the squared modulus of the migrated field. With ``floor=0`` empty bins get no gradient.

        Args:
            transient: (..., T, Y, X), or a capture of the operator's scan and axis.

        Returns:
            (..., Z, Y, X), of a capture (C, Z, Y, X).

        Raises:
            ShapeError: for other transients and captures.
        """
        return self.picture(stabilized_root(self.transients(transient), self.floor))

    def wavefield(self, transient: Tensor | Capture) -> Tensor:
        """Return psi of a transient: z sqrt(H) of a diffuse target, sqrt(H) of a retroreflective one.

        Args:
            transient: (..., T, Y, X), or a capture.

        Returns:
            (..., T, Y, X).
        """
        return self._falling(stabilized_root(self.transients(transient), self.floor))

    def picture(self, root: Tensor) -> Tensor:
        """Return the squared modulus of the field that a root migrates to.

        Args:
            root: root of a transient, (..., T, Y, X).

        Returns:
            (..., Z, Y, X).
        """
        field = self.adjoint(self._falling(root))
        return field.real.square() + field.imag.square()

    def _falling(self, root: Tensor) -> Tensor:
        return root * self.depths.to(root)[:, None, None] if self.target == "diffuse" else root

    # ---------------------------------------------------------------------------------------------------- the two maps

    def _migrate(self, wavefield: Tensor) -> Tensor:
        bins, rows, columns = self.data_shape
        spectrum = wavefield.new_empty(2 * columns, rows, bins + 1, dtype=self.dtype.to_complex())
        tapered = wavefield * self.taper[:, None, None]
        step = chunk_rows(2 * columns * (bins + 1), wavefield.device)
        for y in range(0, rows, step):
            of_time = torch.fft.rfft(tapered[:, y : y + step].permute(1, 2, 0).contiguous(), n=2 * bins)
            spectrum[:, y : y + step] = torch.fft.fft(of_time, n=2 * columns, dim=1).transpose(0, 1)
        for part, table in self._blocks(spectrum):
            place, weights = self._mirrored(table)
            over_y = torch.fft.fft(part, n=2 * rows, dim=1)
            field = torch.gather(over_y, 2, place).mul_(weights[:, 0])
            for tap in range(1, self.taps):
                field.addcmul_(torch.gather(over_y, 2, place.add_(1)), weights[:, tap])
            part[..., :bins] = torch.fft.ifft(field, dim=1)[:, :rows]
        out = torch.empty(bins, rows, columns, dtype=spectrum.dtype, device=spectrum.device)
        for y in range(0, rows, step):
            over_x = torch.fft.ifft(spectrum[:, y : y + step, :bins], dim=0)[:columns]
            out[:, y : y + step] = torch.fft.ifft(over_x, n=2 * bins)[..., :bins].permute(2, 1, 0)
        return out

    def _model(self, field: Tensor) -> Tensor:
        bins, rows, columns = self.data_shape
        spectrum = field.new_empty(2 * columns, rows, bins + 1, dtype=self.dtype.to_complex())
        step = chunk_rows(2 * columns * (bins + 1), field.device)
        for y in range(0, rows, step):
            of_depth = torch.fft.fft(field[:, y : y + step].permute(2, 1, 0).contiguous(), n=2 * bins)[..., :bins]
            spectrum[:, y : y + step, :bins] = torch.fft.fft(of_depth, n=2 * columns, dim=0)
        for part, table in self._blocks(spectrum):
            place, weights = self._mirrored(table)
            over_y = torch.fft.fft(part[..., :bins], n=2 * rows, dim=1)
            found = torch.zeros(*over_y.shape[:2], bins + 1, dtype=over_y.dtype, device=over_y.device)
            for tap in range(self.taps):
                found.scatter_add_(2, place, over_y * weights[:, tap].conj())
                place.add_(1)
            part.copy_(torch.fft.ifft(found, dim=1)[:, :rows])
        out = torch.empty(bins, rows, columns, dtype=self.dtype, device=field.device)
        # irfft counts all frequencies but the first and the last twice, the adjoint of rfft none.
        half = torch.full((bins + 1,), 0.5, dtype=self.dtype, device=field.device)
        half[0] = half[-1] = 1.0
        for y in range(0, rows, step):
            over_x = torch.fft.ifft(spectrum[:, y : y + step], dim=0)[:columns] * half
            out[:, y : y + step] = torch.fft.irfft(over_x, n=2 * bins)[..., :bins].permute(2, 1, 0)
        return out.mul_(self.taper[:, None, None])

    def _blocks(self, spectrum: Tensor) -> Iterator[tuple[Tensor, slice]]:
        """Parts (kx, Y, T + 1) of a spectrum to be changed in place, with the slice of the tables that they need; the
        frequencies below zero in the order of their mirrors.
        """
        bins, rows, columns = self.data_shape
        step = chunk_rows(2 * rows * (bins + 1), spectrum.device)
        for first in range(0, columns + 1, step):
            last = min(first + step, columns + 1)
            yield spectrum[first:last], slice(first, last)
            low, high = max(first, 1), min(last, columns)
            if low < high:
                mirrored = spectrum[2 * columns - high + 1 : 2 * columns - low + 1]
                part = mirrored.flip(0)
                yield part, slice(low, high)
                mirrored.copy_(part.flip(0))

    def _mirrored(self, rows: slice) -> tuple[Tensor, Tensor]:
        """Tables of some kx for all ky, those below zero too."""
        height = self.place.shape[1]
        order = torch.arange(2 * height - 2, device=self.place.device)
        order = torch.minimum(order, 2 * height - 2 - order)
        place = self.place[rows].index_select(1, order).to(torch.int64)
        return place, torch.view_as_complex(self.weights[rows].index_select(2, order))


def fk(capture: Capture, **options: Any) -> Tensor:
    """Migrate a confocal capture: :meth:`FK.reconstruct` by its own scan and axis.

    Args:
        capture: confocal capture of a flat wall.
        options: options of :class:`FK`.

    Returns:
        Squared field (C, Z, Y, X), on the device of the transient.

    Raises:
        ShapeError, UnitError: as the class.
    """
    return reconstructed(capture, FK, who="fk", **options)


# ------------------------------------------------------------------------------------------------ interpolation windows


def _window(distance: Tensor, taps: int) -> Tensor:
    """The interpolation window at a distance in bins: a triangle, or Kaiser and Bessel's."""
    if taps == 2:
        return (1 - distance.abs()).clamp_min(0)
    inside = (1 - (2 * distance / taps) ** 2).clamp_min(0)
    window: Tensor = torch.special.i0(_beta(taps) * torch.sqrt(inside))
    return window * (distance.abs() < taps / 2)


def _window_transform(time: Tensor, taps: int) -> Tensor:
    """The factor that interpolation puts on a record at ``time``, in units of the padded record."""
    if taps == 2:
        return torch.sinc(time) ** 2
    root = torch.sqrt(_beta(taps) ** 2 - (math.pi * taps * time) ** 2)
    return taps * torch.sinh(root) / root


def _beta(taps: int) -> float:
    """The window's shape for a record that is padded to twice its length (Beatty, Nishimura, Pauly, "Rapid gridding
    reconstruction with a minimal oversampling ratio", IEEE Trans. Medical Imaging 24, 2005, equation 5).
    """
    return math.pi * math.sqrt((taps / 2) ** 2 * 1.5**2 - 0.8)


class Midpoints(TransientOperator):
    """Confocal light at midpoints, and the light that pairs of spot and sensor point measure of it.

    ``operator(confocal)``: (..., T, 2 Y, 2 X) on a grid of half the sensors' pitch (:attr:`wall`) to the scan's (...,
    T, *scan.shape); ``operator.adjoint``: its adjoint, the mean over the pairs of each midpoint, moved to the time of a
    confocal pair by linear interpolation between bins, zero before and behind the record. Midpoints are rounded to the
    grid; with one spot they stand on it. Midpoints without a pair are dark.

    Args:
        scan: single or exhaustive scan with sensor points on a regular grid of a flat wall, without legs.
        time_axis: time axis of the transients, from zero on.
        dtype: float32 or float64.

    Raises:
        ShapeError: for other scans, and spots off the sensors' plane or beside their rectangle.
        UnitError: for times before zero.
    """

    place: Tensor
    distance_squared: Tensor
    share: Tensor
    times: Tensor

    def __init__(self, scan: Scan, *, time_axis: TimeAxis, dtype: torch.dtype = torch.float32) -> None:
        if scan.kind == "confocal":
            raise ShapeError("MidpointFK: expected a single or exhaustive scan, got a confocal one. Use FK.")
        refuse_pairs(scan, "MidpointFK")
        refuse_legs(scan, "MidpointFK")
        check_from_zero(time_axis, "MidpointFK")
        super().__init__(scan, time_axis=time_axis, dtype=dtype)
        sensors = PlanarScan.of_scan(scan, "MidpointFK")
        rows, columns = sensors.size
        spots, points = (sensors.local(p).reshape(-1, 3) for p in (scan.laser_points, scan.sensor_points))
        pitch = torch.tensor([sensors.pitch[1], sensors.pitch[0], 1.0], dtype=torch.float64, device="cpu")
        extent = torch.tensor([columns - 1, rows - 1, 0], dtype=torch.float64, device="cpu")
        off = (spots / pitch - (spots / pitch).clamp_min(0).minimum(extent)).abs()
        if float(off[:, 2].max()) > OFF_GRID * min(sensors.pitch) or float(off[:, :2].max()) > 0.5 + OFF_GRID:
            raise ShapeError(
                "MidpointFK: expected spots among the sensor points, within their rectangle. Use Backprojection."
            )
        # In steps of half the pitch from the first sensor point; (M, N, 2) of spots and sensor points.
        middles = ((spots[:, None] + points) / pitch)[..., :2]
        phase = middles[0, 0] - middles[0, 0].round()
        index = (middles - phase).round().to(torch.int64)
        size = (2 * rows, 2 * columns)
        index = torch.stack([index[..., 0].clamp(0, size[1] - 1), index[..., 1].clamp(0, size[0] - 1)], -1)
        step = (sensors.pitch[0] / 2, sensors.pitch[1] / 2)
        first = sensors.first + float(phase[0]) * step[1] * sensors.along_x
        first = first + float(phase[1]) * step[0] * sensors.along_y
        self.wall = replace(sensors, size=size, pitch=step, first=first)
        self.grid = VoxelGrid.of_wall(self.wall, time_axis.centers_opl / 2)
        self._place = (index[..., 1] * size[1] + index[..., 0]).reshape(-1)
        self._distance_squared = (spots[:, None] - points).square().sum(-1).reshape(-1)
        self.data_shape, self.volume_shape = (time_axis.num_bins, *scan.shape), (time_axis.num_bins, *size)
        self._set_tables()

    def tables(self) -> dict[str, Tensor]:
        """Return ``place`` on the grid and ``distance_squared``, m^2, of each pair; the ``share`` of a pair in the
        light of each place; ``times`` (T,) of the bins.
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
    to the squared field.

    Args:
        scan: single or exhaustive scan with sensor points on a regular grid of a flat wall, without legs.
        time_axis: time axis of the transients, from zero on.
        target: "diffuse" or "retroreflective", see :class:`FK`.
        floor: number added to the light under the root, in the unit of the transient, see :func:`stabilized_root`.
        taps: number of interpolation taps: 4 are right to 3e-4 of the field, 2 (linear) to some percent.
        dtype: float32 or float64.

    Raises:
        ShapeError, UnitError, ArgumentError: as :class:`Midpoints` and :class:`FK`.

    An approximation: a letter that faces the wall comes out of a capture by one laser with a correlation of 0.8, of 4 x
    4 lasers 0.9, and tilted ones worse. One laser sees half of the wall's width. Filtered backprojection and phasor
    fields are better, and take longer.
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
        super().__init__(scan, time_axis=time_axis, dtype=dtype)
        self.midpoints = Midpoints(scan, time_axis=time_axis, dtype=dtype)
        self.fk = FK(self.midpoints.wall, time_axis=time_axis, target=target, floor=floor, taps=taps, dtype=dtype)
        self.grid = self.fk.grid
        self.volume_shape, self.data_shape = self.fk.volume_shape, self.midpoints.data_shape

    def map_(self, x: Tensor) -> Tensor:
        return self.midpoints.map_(self.fk.map_(x))

    def adjoint_(self, y: Tensor) -> Tensor:
        return self.fk.adjoint_(self.midpoints.adjoint_(y))

    def reconstruct(self, transient: Tensor | Capture) -> Tensor:
        """Return the squared modulus of the migrated field. With ``floor=0`` empty bins get no gradient.

        Args:
            transient: (..., T, *scan.shape), or a capture of the operator's scan and axis.

        Returns:
            (..., Z, 2 Y, 2 X).

        Raises:
            ShapeError: for other transients and captures.
        """
        data = self.transients(transient)
        return self.fk.picture(self.midpoints.adjoint(stabilized_root(data, self.fk.floor)))


def midpoint_fk(capture: Capture, **options: Any) -> Tensor:
    """Migrate a single or exhaustive capture: :meth:`MidpointFK.reconstruct` by its own scan and axis.

    Args:
        capture: single or exhaustive capture of a flat wall.
        options: options of :class:`MidpointFK`.

    Returns:
        Squared field (C, Z, 2 Y, 2 X), on the device of the transient.

    Raises:
        ShapeError, UnitError: as the class.
    """
    return reconstructed(capture, MidpointFK, who="midpoint_fk", **options)
