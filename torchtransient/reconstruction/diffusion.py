"""Captures through a diffusing slab: what it does to them, and how that is undone (Lindell and Wetzstein,
"Three-dimensional imaging through scattering media based on confocal diffuse tomography", Nature Communications 11,
2020).

Between wall and hidden things lies a slab of turbid matter. Light passes it on its way there and on its way back, each
time spread by the slab's transmittance (Contini, Martelli, Zaccanti, "Photon migration through a turbid slab described
by a model based on diffusion approximation", Applied Optics 36, 1997). To what a confocal scan would measure at the
slab's far side, the capture is the convolution in time and along the slab with that kernel twice.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchtransient.axes import TimeAxis
from torchtransient.capture import Capture, Scan
from torchtransient.errors import UnitError
from torchtransient.quantities import finite, positive
from torchtransient.reconstruction.confocal_operator import ConfocalOperator, InverseOperator
from torchtransient.reconstruction.linear import each
from torchtransient.reconstruction.planar_scan import PlanarScan
from torchtransient.reconstruction.proportions import check_thickness
from torchtransient.volume_methods import SLAB_SNR

IMAGES = 20
# Room-temperature foam of the paper: reduced scattering and absorption per metre, index, length behind its sides at
# which the fluence vanishes.
FOAM = (262.0, 0.53, 1.12, 0.0036)
FOAM_THICKNESS = 0.0254


def slab_transmittance(
    opl: Tensor,
    rho_squared: Tensor,
    *,
    thickness: float,
    reduced_scattering: float,
    absorption: float,
    index: float,
    extrapolation: float,
) -> Tensor:
    """Light of a pencil beam that leaves a slab's far side, per metre of ``opl`` and square metre, at the squared
    distance ``rho_squared`` (m^2) from the beam; both tensors broadcast. Zero at times of zero and before.

    The dipole sum of Contini et al., equation 36, with ``IMAGES`` pairs on each side. Times are optical path lengths in
    vacuum, c t. Valid where the slab is thick beside 1 / ``reduced_scattering``.
    """
    diffusion = 1 / (3 * (absorption + reduced_scattering))
    source = 1 / reduced_scattering
    m = torch.arange(-IMAGES, IMAGES + 1, dtype=torch.float64, device=opl.device)
    above = thickness * (1 - 2 * m) - 4 * m * extrapolation - source
    below = thickness * (1 - 2 * m) - (4 * m - 2) * extrapolation + source
    travelled = torch.where(opl > 0, opl, torch.ones_like(opl)) / index
    spread = 4 * diffusion * travelled
    dipoles = above * torch.exp(-(above**2) / spread[..., None]) - below * torch.exp(-(below**2) / spread[..., None])
    amplitude = torch.exp(-absorption * travelled) / (2 * (4 * math.pi * diffusion) ** 1.5 * travelled**2.5 * index)
    light = amplitude * dipoles.sum(-1) * torch.exp(-rho_squared / spread)
    return torch.where(opl > 0, light, torch.zeros_like(light))


class DiffusionDeconvolution(ConfocalOperator):
    """Confocal captures through a slab that lies on the scanned wall, as a linear operator, and its Wiener inverse.

    ``operator(transient)``: what arrives through the slab, (..., T, Y, X), of what would be measured at its far side;
    ``operator.adjoint``: its adjoint; ``operator.inverse``: the Wiener inverse, an operator itself;
    ``operator.reconstruct(transient)``: the capture without the slab, whose volume another operator finds. Linear and
    differentiable; results go below zero. ``passes``: how often light crosses the slab, 2 of confocal captures.

    ``thickness`` in metres. ``properties``: (reduced scattering per metre, absorption per metre, index of refraction,
    extrapolation length in metres, at which behind its sides the fluence vanishes); the defaults of both are those
    of the paper's foam. ``snr``: power of the light over that of the noise where nothing is lost, at frequency zero;
    what the slab takes more than that cannot come back. Light is kept: the kernel's sum is one. Time, height and width
    are padded to twice their size.

    Not supported: slabs apart from the wall, refraction at their far side, light that misses them. Raises ShapeError
    for scans it cannot take, UnitError for quantities out of range.
    """

    kernel: Tensor

    def __init__(
        self,
        scan: Scan | PlanarScan,
        *,
        time_axis: TimeAxis,
        thickness: float = FOAM_THICKNESS,
        properties: tuple[float, float, float, float] = FOAM,
        passes: int = 2,
        snr: float = SLAB_SNR,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        super().__init__(scan, time_axis=time_axis, dtype=dtype)
        check_thickness(positive("DiffusionDeconvolution: thickness", thickness), scan, "DiffusionDeconvolution")
        who = type(self).__name__
        self.thickness = positive(f"{who}: thickness", thickness)
        self.properties = _slab_properties(properties, who)
        if passes not in (1, 2):
            raise UnitError(f"{who}: expected light that crosses the slab once or twice, got passes={passes!r}.")
        self.passes, self.snr = int(passes), positive(f"{who}: snr", snr)
        self._set_tables()

    def tables(self) -> dict[str, Tensor]:
        """``kernel`` (2 T, 2 Y, X + 1, 2): the transform of what the slab makes of one flash, real and imaginary."""
        bins, rows, columns = self.data_shape
        # Delays, whose origin is the moment when light enters: bin k of the capture gets light of bin k - l by delay l.
        delay = self.axis.bin_width_opl * torch.arange(2 * bins, dtype=torch.float64)
        y, x = (
            torch.fft.fftfreq(2 * n, 1 / (2 * n), dtype=torch.float64) * pitch
            for n, pitch in zip((rows, columns), self.grid.pitch, strict=True)
        )
        reduced_scattering, absorption, index, extrapolation = self.properties
        flash = slab_transmittance(
            delay[:, None, None],
            y[:, None] ** 2 + x**2,
            thickness=self.thickness,
            reduced_scattering=reduced_scattering,
            absorption=absorption,
            index=index,
            extrapolation=extrapolation,
        ).clamp_min(0)
        total = float(flash.sum())
        if not total > 0:
            raise UnitError(
                f"DiffusionDeconvolution: expected a slab whose light falls into the record, got none within "
                f"{float(delay[-1]):.3g} m of optical path. Let the time axis be longer, or the slab thinner."
            )
        return {"kernel": torch.view_as_real(torch.fft.rfftn(flash / total) ** self.passes)}

    def map_(self, x: Tensor) -> Tensor:
        return each(lambda item: self._filtered(item, torch.view_as_complex(self.kernel)), x, 3)

    def adjoint_(self, y: Tensor) -> Tensor:
        return each(lambda item: self._filtered(item, torch.view_as_complex(self.kernel).conj()), y, 3)

    @property
    def inverse(self) -> SlabInverse:
        """The Wiener inverse: captures through the slab to captures without, (..., T, Y, X) both."""
        return SlabInverse(self)

    def reconstruct(self, transient: Tensor | Capture) -> Tensor:
        """The transient (..., T, Y, X) without the slab, of one or of a capture's (C, T, Y, X). Raises ShapeError,
        DeviceError.
        """
        found: Tensor = self.inverse(self.transients(transient))
        return found

    def _filtered(self, x: Tensor, spectrum: Tensor) -> Tensor:
        bins, rows, columns = self.data_shape
        padded = (2 * bins, 2 * rows, 2 * columns)
        of_frequency: Tensor = torch.fft.rfftn(x, s=padded).mul_(spectrum)
        found: Tensor = torch.fft.irfftn(of_frequency, s=padded)
        return found[:bins, :rows, :columns]

    def _wiener(self) -> Tensor:
        kernel = torch.view_as_complex(self.kernel)
        return kernel.conj() / (kernel.abs().square() + 1 / self.snr)


class SlabInverse(InverseOperator):
    """The Wiener inverse of :class:`DiffusionDeconvolution`."""

    operator: DiffusionDeconvolution

    def map_(self, x: Tensor) -> Tensor:
        wiener = self.operator._wiener()
        return each(lambda item: self.operator._filtered(item, wiener), x, 3)

    def adjoint_(self, y: Tensor) -> Tensor:
        wiener = self.operator._wiener().conj()
        return each(lambda item: self.operator._filtered(item, wiener), y, 3)


def _slab_properties(properties: tuple[float, float, float, float], who: str) -> tuple[float, float, float, float]:
    if not isinstance(properties, tuple) or len(properties) != len(FOAM):
        raise UnitError(
            f"{who}: expected properties as (reduced scattering 1/m, absorption 1/m, index, extrapolation length m), "
            f"got {properties!r}."
        )
    scattering, absorption, index, extrapolation = properties
    absorption = finite(f"{who}: absorption", absorption)
    if absorption < 0:
        raise UnitError(f"{who}: expected an absorption of zero or more per metre, got {absorption!r}.")
    return (
        positive(f"{who}: reduced scattering", scattering),
        absorption,
        positive(f"{who}: index", index),
        positive(f"{who}: extrapolation length", extrapolation),
    )
