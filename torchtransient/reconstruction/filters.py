"""Filters of filtered backprojection: of transients before it, or of the volume after it.

A filter is linear in rows (..., T) in time and in volumes (..., Z, Y, X), and has the adjoints of both.
``complex_volume``: True where filtered rows are complex. ``check`` raises for volumes that it cannot filter, before
anything is computed; ``image`` makes a picture of a filtered volume. ``samples``: samples per bin that a filtered row
needs, so that lines between them follow it; ``rows(rows, width, samples)`` has them at the middles of bins, evenly
between these, and as far before the first and behind the last as the bins reach (:func:`sample_places`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor
from torch.nn import functional

from torchtransient.axes import fast_length
from torchtransient.checks import positive
from torchtransient.errors import ShapeError, UnitError
from torchtransient.reconstruction.capture_checks import within
from torchtransient.reconstruction.voxels import VoxelGrid

# Samples of a wavelength. Lines between them lose (pi / SAMPLES)^2 / 3 of a wave in the mean, 1.3 %.
SAMPLES = 16


@dataclass(frozen=True)
class PhasorFilter:
    """The virtual illumination of phasor fields (Liu et al. 2019): a pulse under a Gaussian.

    Transients, the light of a bin in its middle, are convolved with exp(2 pi i t / wavelength) exp(-t^2 / 2 sigma^2),
    sigma = cycles wavelength / 6, whose transform is a Gaussian of height one; light before and behind the record
    counts as none, however long the pulse is. The picture is the squared modulus.

    Args:
        wavelength: wavelength in metres of optical path. Twice the scan's pitch and more are free of ghosts.
        cycles: number of wavelengths within three standard deviations to both sides.

    Raises:
        UnitError: for numbers that are not above zero; by an operator for wavelengths below two bins and a sigma below
            a fourth of one.
    """

    complex_volume: ClassVar[bool] = True

    wavelength: float
    cycles: float = 4.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "wavelength", positive("PhasorFilter: wavelength", self.wavelength))
        object.__setattr__(self, "cycles", positive("PhasorFilter: cycles", self.cycles))

    @property
    def sigma(self) -> float:
        """Standard deviation of the pulse's envelope, metres."""
        return self.cycles * self.wavelength / 6

    def check(self, grid: VoxelGrid | None, bin_width_opl: float, who: str) -> None:
        if self.wavelength < 2 * bin_width_opl:
            raise UnitError(f"{who}: expected a wavelength of two bins at least, got {self.wavelength:.4g} m.")
        if self.sigma < bin_width_opl / 4:
            raise UnitError(
                f"{who}: expected a sigma of a fourth of a bin at least, got {self.sigma:.4g} m. Take more cycles."
            )

    def samples(self, bin_width_opl: float) -> int:
        # Pulses of less than a cycle are steeper than their wave.
        return max(1, math.ceil(SAMPLES * bin_width_opl / (self.wavelength * min(1.0, self.cycles)) - 1e-9))

    def rows(self, rows: Tensor, bin_width_opl: float, samples: int) -> Tensor:
        bins, (first, last) = rows.shape[-1], sample_places(rows.shape[-1], samples)
        padded = fast_length(2 * bins)
        # Zeros between bins repeat the spectrum.
        spectrum = torch.fft.fft(rows, n=padded).repeat(*[1] * (rows.ndim - 1), samples)
        spectrum.mul_(self._response(spectrum, bin_width_opl, samples, bins))
        found: Tensor = torch.fft.ifft(spectrum)
        return torch.cat([found[..., first:], found[..., :last]], -1) if first else found[..., :last]

    def rows_adjoint(self, rows: Tensor, bin_width_opl: float, samples: int) -> Tensor:
        bins = (rows.shape[-1] - 1 - 2 * (samples // 2)) // samples + 1
        first, last = sample_places(bins, samples)
        padded = fast_length(2 * bins)
        spread = rows.new_zeros(*rows.shape[:-1], padded * samples)
        spread[..., :last] = rows[..., -first:] if first else rows
        if first:
            spread[..., first:] = rows[..., :-first]
        spectrum = torch.fft.fft(spread)
        spectrum.mul_(self._response(spectrum, bin_width_opl, samples, bins))
        # Bins are every so many samples, and rows are real.
        folded = spectrum.reshape(*spectrum.shape[:-1], samples, padded).sum(-2)
        found: Tensor = torch.fft.ifft(folded)
        return found[..., :bins].real / samples

    def volume(self, volume: Tensor) -> Tensor:
        return volume

    def volume_adjoint(self, volume: Tensor) -> Tensor:
        return volume

    def image(self, volume: Tensor) -> Tensor:
        return volume.real.square() + volume.imag.square()

    def _response(self, like: Tensor, bin_width_opl: float, samples: int, bins: int) -> Tensor:
        """Transform of the pulse, as long as ``like``. The pulse is cut off where no light meets it, so that none wraps
        around; it is Hermitian, and the transform real.
        """
        count = like.shape[-1]
        k = torch.fft.fftfreq(count, 1 / count, dtype=torch.float64, device=like.device)
        t = k * (bin_width_opl / samples)
        height = torch.exp(-t.square() / (2 * self.sigma**2)) * (bin_width_opl / (self.sigma * math.sqrt(2 * math.pi)))
        turns = t / self.wavelength
        pulse = torch.polar(height * (k.abs() < bins * samples), (turns - turns.round()) * (2 * math.pi))
        transform: Tensor = torch.fft.fft(pulse)
        return transform.real.to(like.real.dtype)


@dataclass(frozen=True)
class LaplacianFilter:
    """The negative Laplacian of a Gaussian, on the volume (Velten et al. 2012; Laurenzis and Velten 2014).

    -(d^2/dz^2 + d^2/dy^2 + d^2/dx^2) of the volume smoothed by a Gaussian; the derivatives are per voxel. Values
    outside of the volume count as zero. The picture keeps its negative lobes. Needs a :class:`VoxelGrid` of evenly
    spaced planes.

    Args:
        sigma: standard deviation of the Gaussian in voxels, 0.2 or more: below, the neighbours of a voxel have no part.

    Raises:
        UnitError: for a sigma out of range.
        ShapeError: by an operator, for other volumes.
    """

    complex_volume: ClassVar[bool] = False

    sigma: float = 1.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "sigma", within("LaplacianFilter: sigma", self.sigma, 0.2, 1e3))

    def check(self, grid: VoxelGrid | None, bin_width_opl: float, who: str) -> None:
        if grid is None:
            raise ShapeError(
                f"{who}: expected a VoxelGrid for a LaplacianFilter, whose neighbours are those of a grid, got points."
            )
        steps = grid.depths.diff()
        # Depths of single precision are even enough.
        if len(steps) and float(steps.max() - steps.min()) > 1e-3 * float(steps.max()):
            raise ShapeError(
                f"{who}: expected evenly spaced planes for a LaplacianFilter, got steps of {steps.tolist()} m."
            )

    def samples(self, bin_width_opl: float) -> int:
        return 1

    def rows(self, rows: Tensor, bin_width_opl: float, samples: int) -> Tensor:
        return rows

    def rows_adjoint(self, rows: Tensor, bin_width_opl: float, samples: int) -> Tensor:
        return rows

    def volume(self, volume: Tensor) -> Tensor:
        smooth, curved = self._kernels(volume)
        dims = (-3, -2, -1)
        once = {dim: _convolved(volume, smooth, dim) for dim in dims}
        total = torch.zeros_like(volume)
        for dim in dims:
            # Smoothed along one of the other two already; convolutions along different axes commute.
            other, last = (d for d in dims if d != dim)
            total += _convolved(_convolved(once[other], smooth, last), curved, dim)
        return total

    def volume_adjoint(self, volume: Tensor) -> Tensor:
        # Symmetric kernels between zeros: a symmetric matrix.
        return self.volume(volume)

    def image(self, volume: Tensor) -> Tensor:
        return volume

    def _kernels(self, like: Tensor) -> tuple[Tensor, Tensor]:
        """Gaussian of sum one, and minus its second derivative, of sum zero and second moment -2."""
        reach = max(1, math.ceil(4 * self.sigma))
        t = torch.arange(-reach, reach + 1, dtype=torch.float64, device="cpu")
        smooth = torch.exp(-(t**2) / (2 * self.sigma**2))
        smooth = smooth / smooth.sum()
        curved = (1 - (t / self.sigma) ** 2) * smooth
        # Sampling and cutting off leave a sum and a moment that are slightly off: planes of constant and of quadratic
        # brightness must come out exactly.
        curved = curved - smooth * curved.sum()
        curved = curved * (-2 / (curved * t**2).sum())
        return smooth.to(like.device, like.dtype), curved.to(like.device, like.dtype)


def sample_places(bins: int, samples: int) -> tuple[int, int]:
    """Return the first place and the one behind the last of evenly spaced samples, counted from the middle of the first
    bin.

    Args:
        bins: number of bins.
        samples: number of samples per bin.
    """
    return -(samples // 2), (bins - 1) * samples + samples // 2 + 1


def _convolved(volume: Tensor, kernel: Tensor, dim: int) -> Tensor:
    lines = volume.movedim(dim, -1)
    flat = lines.reshape(-1, 1, lines.shape[-1])
    done = functional.conv1d(flat, kernel[None, None], padding=len(kernel) // 2)
    return done.reshape(lines.shape).movedim(-1, dim)
