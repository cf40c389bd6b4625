"""Phasor fields on planes before a flat scan: Rayleigh-Sommerfeld diffraction by Fourier transforms, plane by plane."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from torchtransient.axes import TimeAxis, fast_length
from torchtransient.capture import Capture, Scan
from torchtransient.checks import finite, real_array, shown
from torchtransient.errors import ArgumentError, SceneError, ShapeError, UnitError
from torchtransient.reconstruction.capture_checks import check_wavelength, refuse_pairs
from torchtransient.reconstruction.filters import PhasorFilter
from torchtransient.reconstruction.transient_operator import ScanOperator, reconstructed
from torchtransient.reconstruction.voxels import OFF_GRID, PlanarScan, VoxelGrid


@dataclass(frozen=True)
class DirectLight:
    """The image of light that met one voxel and nothing else.

    Laser and sensor are focused on the voxel itself, and the picture is taken at the moment of focus. Volumes are
    (..., Z, Y, X).
    """

    times: ClassVar[None] = None
    focuses_laser: ClassVar[bool] = True


@dataclass(frozen=True, eq=False)
class ConfocalCamera:
    """A video of voxels that laser and sensor are both focused on. Volumes are (..., N, Z, Y, X).

    Args:
        times: times of the frames (N,), metres of optical path after the focus: at zero it is :class:`DirectLight`,
            later the other light that came back.

    Raises:
        ShapeError, UnitError: for other shapes, and times that are not finite.
    """

    focuses_laser: ClassVar[bool] = True

    times: Tensor

    def __post_init__(self) -> None:
        object.__setattr__(self, "times", _times(self.times, "ConfocalCamera"))


@dataclass(frozen=True, eq=False)
class TransientCamera:
    """A video of the pulse that leaves the laser's spot and passes through the hidden scene. Volumes are (..., N, Z, Y,
    X).

    Needs a scan with one spot.

    Args:
        times: times of the frames (N,), lengths of optical path from the spot, metres, so that a voxel lights up at its
            distance from it.

    Raises:
        ShapeError, UnitError: for other shapes, and times that are not finite.
    """

    focuses_laser: ClassVar[bool] = False

    times: Tensor

    def __post_init__(self) -> None:
        object.__setattr__(self, "times", _times(self.times, "TransientCamera"))


Camera = DirectLight | ConfocalCamera | TransientCamera


def _times(values: Any, who: str) -> Tensor:
    plain = real_array(values)
    if plain is None or plain.ndim != 1 or len(plain) == 0:
        raise ShapeError(f"{who}: expected times (N,) in metres of optical path, got {shown(values)}.")
    times = torch.from_numpy(plain)
    if not bool(torch.isfinite(times).all()):
        raise UnitError(f"{who}: expected finite times, got {shown(plain.tolist())}.")
    return times


def _waves(distances: Tensor, frequencies: Tensor, falloff: float, dtype: torch.dtype, nearest: float) -> Tensor:
    """Return ``exp(2 pi i f r) / r^falloff``, (F, ...), of distances r (...) at evenly spaced frequencies f (F,).

    Phases have the digits of double precision: single precision has none left for r of many wavelengths. A sine of each
    frequency would be most of the work of a plane, so waves follow from each other by products, which lose F ulp.
    Distances below ``nearest`` fall off as it does.
    """
    count = len(frequencies)
    wave = _turned(distances * frequencies[0])
    if falloff:
        wave = wave * distances.clamp_min(nearest).pow(-falloff)
    out = torch.empty(count, *distances.shape, dtype=dtype, device=distances.device)
    out[0] = wave
    if count > 1:
        step = _turned(distances * ((frequencies[-1] - frequencies[0]) / (count - 1)))
        for k in range(1, count):
            wave = wave.mul_(step)
            out[k] = wave
    return out


def _turned(turns: Tensor) -> Tensor:
    return torch.polar(torch.ones_like(turns), (turns - turns.round()) * (2 * math.pi))


# Complex numbers of spectra that are worked on at once.
CPU_CHUNK, GPU_CHUNK = 1 << 20, 1 << 25
# Standard deviations of the pulse's spectrum that are kept to both sides.
BAND = 4.0


def phasor_image(
    capture: Capture, points: VoxelGrid, *, pulse: PhasorFilter, camera: Camera | None = None, falloff: float = 0.0
) -> Tensor:
    """Image a capture by phasor fields: :meth:`PhasorField.reconstruct` by its own scan and axis.

    Args:
        capture: capture with a transient, of a flat, regular grid.
        points: grid of planes parallel to the wall, with its pitch.
        pulse: pulse of the virtual illumination.
        camera: virtual camera, None for :class:`DirectLight`.
        falloff: power of 1 / (r_laser r_sensor), see :class:`PhasorField`.

    Returns:
        Intensity (..., C, *volume), on the device of the transient.

    Raises:
        ShapeError, SceneError, UnitError: as the class.
    """
    return reconstructed(capture, PhasorField, points, who="phasor_image", pulse=pulse, camera=camera, falloff=falloff)


class PhasorField(ScanOperator):
    """Phasor fields (Liu et al. 2019) from a regular grid of sensor points to planes before it (Liu et al. 2020).

    ``adjoint`` takes a transient (..., T, *scan.shape) to the complex field (..., Z, Y, X) at the moment of focus: the
    transient convolved with the ``pulse`` of a virtual illumination, at the length laser spot - voxel - sensor point,
    times (r_laser r_sensor)^-falloff, summed over all pairs. ``forward`` is its adjoint, a real transient.

    Args:
        scan: confocal or single scan, or exhaustive scan with any laser spots; all sensor points on a flat, regular
            grid, with or without first and last legs.
        points: grid of planes parallel to the wall, with the pitch of the sensor grid, as ``VoxelGrid.before(scan,
            depths)`` makes them; size and place of the planes are free, `at_depths` and larger ``size`` and ``extent``
            of the same pitch too.
        time_axis: time axis of the transients.
        pulse: pulse of the virtual illumination.
        camera: virtual camera: :class:`DirectLight` (None), or :class:`ConfocalCamera` or :class:`TransientCamera`,
            whose fields are videos (..., N, Z, Y, X).
        falloff: p of a factor (r_laser r_sensor)^-p. With 1 the field is the Rayleigh-Sommerfeld integral; with 0 its
            phases alone, which is :class:`FilteredBackprojection` with the same filter. Distances below half a bin fall
            off as half a bin does.
        dtype: float32 or float64.

    Raises:
        ShapeError: for other scans (pairs, lists and curved walls go to :class:`FilteredBackprojection`) and grids.
        ArgumentError: for other objects than a grid and a camera.
        SceneError: for a transient camera without one laser spot.
        UnitError: for quantities out of range.

    The convolution is linear: nothing wraps around, neither in space nor in time. Frequencies within 4 standard
    deviations of the pulse's spectrum are kept, zero and below for pulses of less than 3.9 cycles: all but 2e-8 of its
    energy. The rest is 3e-4 of the height of the spectrum at most; a steady background is part of it. Time grows with
    planes times frequencies (times laser spots) times sensor points; spectra are made a chunk of frequencies and spots
    at a time.
    """

    def __init__(
        self,
        scan: Scan,
        points: VoxelGrid,
        *,
        time_axis: TimeAxis,
        pulse: PhasorFilter,
        camera: Camera | None = None,
        falloff: float = 0.0,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        if not isinstance(points, VoxelGrid):
            raise ArgumentError(
                f"PhasorField: expected a VoxelGrid, got {shown(points)}. FilteredBackprojection takes points."
            )
        super().__init__(scan, points, time_axis=time_axis, dtype=dtype)
        pulse.check(points, time_axis.bin_width_opl, "PhasorField")
        check_wavelength(pulse.wavelength, scan, time_axis, "PhasorField")
        self.camera: Camera = DirectLight() if camera is None else camera
        if not isinstance(self.camera, Camera):
            raise ArgumentError(
                f"PhasorField: expected a DirectLight, ConfocalCamera or TransientCamera, got {shown(camera)}."
            )
        if not self.camera.focuses_laser and scan.kind != "single":
            raise SceneError(
                f"PhasorField: expected one laser spot for a TransientCamera, got {scan!r}. See capture.single(index)."
            )
        self.pulse, self.falloff = pulse, finite("PhasorField: falloff", falloff)
        self.real_volume = False
        refuse_pairs(scan, "PhasorField")
        self.wall = PlanarScan.of_scan(scan, "PhasorField")
        self._check_planes()
        self.lasers = self.wall.local(scan.laser_points).reshape(-1, 3)
        if self.camera.times is not None:
            self.volume_shape = (len(self.camera.times), *self.volume_shape)
        self.frequencies, self.band_weights = self._band()
        self.shape_fft = tuple(fast_length(s + v - 1) for s, v in zip(self.wall.size, points.size, strict=True))
        self._set_tables()

    grid: VoxelGrid
    dft: Tensor
    legs: Tensor
    moments: Tensor

    def _check_planes(self) -> None:
        grid, wall = self.grid, self.wall
        parallel = all(float(a @ b) > 1 - 1e-6 for a, b in ((grid.along_x, wall.along_x), (grid.along_y, wall.along_y)))
        same = all(abs(a - b) * n <= OFF_GRID * b for a, b, n in zip(grid.pitch, wall.pitch, grid.size, strict=True))
        if not (parallel and same):
            raise ShapeError(
                f"PhasorField: expected planes along the wall's rows and columns with its pitch {wall!r}, got {grid!r}."
            )
        # Along the axes of the wall, from its first point; the normal of the planes may be the opposite one.
        self.corner = wall.local(grid.first)
        self.heights = self.corner[2] + grid.depths * float(grid.normal @ wall.normal)
        nearest, farthest = float(self.heights.min()), float(self.heights.max())
        # Where nothing says which side is the hidden one, all may be on either.
        if not (nearest > 0 or (farthest < 0 and self.scan.sensor_normals is None)):
            raise ShapeError(
                f"PhasorField: expected planes before the wall, got some {nearest:.3g} to {farthest:.3g} m before it."
            )

    def _leg_lengths(self) -> tuple[Tensor, Tensor]:
        """Return the legs of the spots (L,) and the sensor points (S,), metres, zeros where they do not count."""
        spots, points = (legs.cpu().reshape(-1) for legs in (self.scan.laser_legs, self.scan.sensor_legs))
        if not self.scan.first_and_last_leg:
            return torch.zeros_like(spots), torch.zeros_like(points)
        if self.scan.kind != "confocal":
            return spots, points
        return torch.zeros(1, dtype=torch.float64, device="cpu"), points + spots

    def _band(self) -> tuple[Tensor, Tensor]:
        """Frequencies (F,) in cycles per metre and their weights. They are so dense that the field of one record does
        not come back within the lengths that are looked at.
        """
        low, high = self._lengths()
        spots, points = self._leg_lengths()
        start = self.axis.start_opl - float(spots.max() + points.max())
        end = self.axis.end_opl - float(spots.min() + points.min())
        period = max(high, end) - min(low, start) + self.pulse.cycles * self.pulse.wavelength
        middle, spread = 1 / self.pulse.wavelength, 1 / (2 * math.pi * self.pulse.sigma)
        # Short pulses have frequencies of zero and below.
        first = math.ceil((middle - BAND * spread) * period)
        last = math.floor((middle + BAND * spread) * period)
        frequencies = torch.arange(first, max(first, last) + 1, dtype=torch.float64, device="cpu") / period
        weights = torch.exp(-(((frequencies - middle) / spread) ** 2) / 2) * (self.axis.bin_width_opl / period)
        return frequencies, weights

    def _lengths(self) -> tuple[float, float]:
        """Lengths that are looked at, without legs: none is shorter or longer."""
        rows, columns = self.grid.size
        dy, dx = self.grid.pitch
        ends = itertools.product((0, columns - 1), (0, rows - 1), self.heights[[0, -1]].tolist())
        of_planes = [[float(self.corner[0]) + i * dx, float(self.corner[1]) + j * dy, h] for i, j, h in ends]
        edges = itertools.product((0, self.wall.size[1] - 1), (0, self.wall.size[0] - 1))
        of_wall = [[i * self.wall.pitch[1], j * self.wall.pitch[0], 0.0] for i, j in edges]
        corners, sensors = (torch.tensor(x, dtype=torch.float64, device="cpu") for x in (of_planes, of_wall))
        # Distances are convex: the longest ends at corners. None is shorter than the way along the normal.
        far, near = float(torch.cdist(corners, sensors).max()), float(self.heights.abs().min())
        if self.scan.kind == "confocal":
            low, high = 2 * near, 2 * far
        elif self.camera.focuses_laser:
            low, high = near, far + float(torch.cdist(corners, self.lasers).max())
        else:
            low, high = near, far
        times = self.camera.times
        return (low, high) if times is None else (low + float(times.min()), high + float(times.max()))

    def tables(self) -> dict[str, Tensor]:
        """Return the transform to the band (2 F, T), real parts first; phases of the legs (F, L + S, 2); phases of the
        camera's moments (N, F, 2).
        """
        turns = self.frequencies[:, None] * self.axis.centers_opl
        phase = -2 * math.pi * (turns - turns.round())
        weights = self.band_weights[:, None]
        spots, points = self._leg_lengths()
        times = torch.zeros(1, dtype=torch.float64, device="cpu") if self.camera.times is None else self.camera.times
        return {
            "dft": torch.cat([weights * phase.cos(), weights * phase.sin()]),
            "legs": torch.view_as_real(_turned(self.frequencies[:, None] * torch.cat([spots, points]))),
            "moments": torch.view_as_real(_turned(times[:, None] * self.frequencies)),
        }

    def reconstruct(self, transient: Tensor | Capture) -> Tensor:
        """Return the intensity |field|^2 of a transient.

        Args:
            transient: (..., T, *scan.shape), or a capture of the operator's scan and axis.

        Returns:
            (..., *volume).

        Raises:
            ShapeError: for other transients and captures.
        """
        return self.pulse.image(self.adjoint(self.transients(transient)))

    # ------------------------------------------------------------------------------------------------- the two maps

    def adjoint_(self, y: Tensor) -> Tensor:
        spots, (rows, columns) = self._spots, self.wall.size
        data = y.reshape(-1, self.axis.num_bins, spots, rows * columns)
        frames, (height, width) = len(self.moments), self.grid.size
        out = torch.zeros(
            len(data), frames, len(self.heights), height, width, dtype=self.dtype.to_complex(), device=y.device
        )
        for band, some in self._chunks(len(data), y.device):
            spectra = torch.fft.fft2(self._to_band(data[:, :, some], band, some), s=self.shape_fft)
            moments = torch.view_as_complex(self.moments[:, band].contiguous())
            for k, kernel in enumerate(self._kernels(band, y.device)):
                through = spectra * kernel[:, None]
                if self.scan.kind == "confocal":
                    field = torch.einsum("af,nfyx->nayx", moments, through[:, :, 0])
                    out[:, :, k] += torch.fft.ifft2(field)[..., :height, :width]
                    continue
                field = torch.fft.ifft2(through)[..., :height, :width]
                lit = self._illumination(k, band, some, y.device)
                total = field.sum(2) if lit is None else (field * lit).sum(2)
                out[:, :, k] += torch.einsum("af,nfyx->nayx", moments, total)
        lead = y.shape[: y.ndim - len(self.data_shape)]
        return out.reshape(*lead, *self.volume_shape)

    def map_(self, x: Tensor) -> Tensor:
        spots, (rows, columns) = self._spots, self.wall.size
        frames, (height, width) = len(self.moments), self.grid.size
        field = x.reshape(-1, frames, len(self.heights), height, width)
        out = torch.zeros(len(field), self.axis.num_bins, spots, rows * columns, dtype=self.dtype, device=x.device)
        for band, some in self._chunks(len(field), x.device):
            size = (len(field), band.stop - band.start, some.stop - some.start, *self.shape_fft)
            spectra = torch.zeros(size, dtype=x.dtype, device=x.device)
            moments = torch.view_as_complex(self.moments[:, band].contiguous()).conj()
            for k, kernel in enumerate(self._kernels(band, x.device)):
                plane = field[:, :, k]
                if self.scan.kind == "confocal":
                    plane = torch.fft.fft2(plane, s=self.shape_fft)
                    back = torch.einsum("af,nayx->nfyx", moments, plane)[:, :, None]
                else:
                    lit = self._illumination(k, band, some, x.device)
                    back = torch.einsum("af,nayx->nfyx", moments, plane)[:, :, None]
                    back = torch.fft.fft2(back if lit is None else back * lit.conj(), s=self.shape_fft)
                spectra += back * kernel.conj()[:, None]
            self._from_band(torch.fft.ifft2(spectra)[..., :rows, :columns], band, some, out)
        lead = x.shape[: x.ndim - len(self.volume_shape)]
        return out.reshape(*lead, *self.data_shape)

    # ---------------------------------------------------------------------------------------------------------- parts

    @property
    def _spots(self) -> int:
        return len(self.lasers) if self.scan.kind == "exhaustive" else 1

    def _chunks(self, items: int, device: torch.device) -> Iterator[tuple[slice, slice]]:
        """Slices of frequencies and of spots."""
        budget = (CPU_CHUNK if device.type == "cpu" else GPU_CHUNK) // max(1, items * math.prod(self.shape_fft))
        count = len(self.frequencies)
        bands, spots = max(1, min(count, budget)), max(1, min(self._spots, budget // count))
        for a in range(0, count, bands):
            for b in range(0, self._spots, spots):
                yield slice(a, min(a + bands, count)), slice(b, min(b + spots, self._spots))

    def _to_band(self, data: Tensor, band: slice, some: slice) -> Tensor:
        """(items, F, L, Sy, Sx) phasors of transients (items, T, L, S), without their legs."""
        count = band.stop - band.start
        parts = self._transform(band) @ data.flatten(2)
        phasors = torch.complex(parts[:, :count], parts[:, count:]).reshape(len(data), count, *data.shape[2:])
        if self.scan.first_and_last_leg:
            phasors = phasors * self._leg_phases(band, some)
        return phasors.reshape(*phasors.shape[:-1], *self.wall.size)

    def _from_band(self, phasors: Tensor, band: slice, some: slice, out: Tensor) -> None:
        """Add the transpose of :meth:`_to_band` to transients (items, T, L, S)."""
        phasors = phasors.flatten(3)
        if self.scan.first_and_last_leg:
            phasors = phasors * self._leg_phases(band, some).conj()
        parts = torch.cat([phasors.real, phasors.imag], 1).flatten(2)
        found = self._transform(band).T @ parts
        out[:, :, some] += found.reshape(len(out), out.shape[1], *phasors.shape[2:])

    def _transform(self, band: slice) -> Tensor:
        count = len(self.frequencies)
        return torch.cat([self.dft[band], self.dft[count + band.start : count + band.stop]])

    def _leg_phases(self, band: slice, some: slice) -> Tensor:
        """(F, L, S)."""
        legs = torch.view_as_complex(self.legs[band].contiguous())
        spots = legs.shape[1] - math.prod(self.wall.size)
        return legs[:, :spots][:, some, None] * legs[:, None, spots:]

    def _kernels(self, band: slice, device: torch.device) -> Iterator[Tensor]:
        """Yield for each plane the transform (F, Y, X) of waves from a sensor point to voxels at every displacement."""
        confocal = self.scan.kind == "confocal"
        along = []
        for axis, (voxels, pitch) in enumerate(zip(self.grid.size, self.wall.pitch, strict=True)):
            places = torch.arange(self.shape_fft[axis], dtype=torch.float64, device=device)
            # Displacements that are negative stand at the end.
            places = torch.where(places < voxels, places, places - self.shape_fft[axis])
            along.append((places * pitch + float(self.corner[1 - axis])).square())
        across = along[0][:, None] + along[1]
        # There and back: twice the length, the falloff of both.
        frequencies = self.frequencies[band].to(device) * (2 if confocal else 1)
        falloff = self.falloff * (2 if confocal else 1)
        for height in self.heights.tolist():
            distances = (across + height**2).sqrt_()
            yield torch.fft.fft2(_waves(distances, frequencies, falloff, self.dtype.to_complex(), self._nearest))

    def _illumination(self, plane: int, band: slice, some: slice, device: torch.device) -> Tensor | None:
        """(F, L, Y, X): waves from some spots to the voxels of a plane; None where the laser is not focused."""
        if not self.camera.focuses_laser:
            return None
        spots = self.lasers[some].to(device)
        sides = []
        for axis, (voxels, pitch) in enumerate(zip(self.grid.size, self.wall.pitch, strict=True)):
            places = torch.arange(voxels, dtype=torch.float64, device=device) * pitch + float(self.corner[1 - axis])
            sides.append((places - spots[:, 1 - axis, None]).square())
        height = (float(self.heights[plane]) - spots[:, 2]).square()
        distances = (sides[0][:, :, None] + sides[1][:, None, :] + height[:, None, None]).sqrt_()
        frequencies = self.frequencies[band].to(device)
        return _waves(distances, frequencies, self.falloff, self.dtype.to_complex(), self._nearest)

    @property
    def _nearest(self) -> float:
        """Half a bin, metres."""
        return self.axis.bin_width_opl / 2
