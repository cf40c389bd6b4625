"""Captures through a diffusing slab: its effect, and the removal of that effect (Lindell and Wetzstein,
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
from torchtransient.capture import Scan
from torchtransient.checks import finite, positive
from torchtransient.errors import UnitError
from torchtransient.reconstruction.capture_checks import SNR, check_thickness, within
from torchtransient.reconstruction.linear import each
from torchtransient.reconstruction.transient_operator import InvertibleOperator
from torchtransient.reconstruction.voxels import PlanarScan
from torchtransient.volume_methods import SLAB_SNR

IMAGES = 20
# Spacings to both sides that hold a Gaussian of two of them; steps of a sum in time; the least share of the light that
# a record has to hold.
NARROW, MOST_STEPS, SHARE_OF_LIGHT = 14, 1 << 15, 1e-30
# Room-temperature foam of the paper: reduced scattering and absorption per metre, index, length behind its sides at
# which the fluence vanishes.
FOAM = (262.0, 0.53, 1.12, 0.0036)
FOAM_THICKNESS = 0.0254


class DiffusionDeconvolution(InvertibleOperator):
    """Confocal captures through a slab that lies on the scanned wall, as a linear operator, and its Wiener inverse.

    ``operator(transient)``: the light (..., T, Y, X) that arrives through the slab, of the light at its far side;
    ``operator.adjoint``: its adjoint; ``operator.inverse``: the Wiener inverse, an operator itself;
    ``operator.reconstruct(transient)``: the capture without the slab, whose volume another operator finds. Linear and
    differentiable; results of the inverse go below zero.

    Args:
        scan: confocal scan on a regular grid of a flat wall, without legs.
        time_axis: time axis of the transients; bins before time zero are accepted.
        thickness: thickness of the slab, metres.
        properties: (reduced scattering 1/m, absorption 1/m, index of refraction, extrapolation length in metres at
            which behind its sides the fluence vanishes); the defaults of both are those of the paper's foam.
        snr: power of the light over that of the noise where nothing is lost, at frequency zero; light that the slab
            takes beyond that cannot come back.
        dtype: float32 or float64.

    Raises:
        ShapeError: for other scans.
        UnitError: for quantities out of range.

    Light is kept: of all that comes through, however late and far aside, the sum is one, and the light within the
    record does not depend on its length. The convolutions are linear: nothing wraps around in time or along the slab,
    between the two crossings either. Not supported: slabs apart from the wall, refraction at their far side, light that
    misses them.
    """

    kernel: Tensor
    volume_name = data_name = "transient"
    early = True

    def __init__(
        self,
        scan: Scan | PlanarScan,
        *,
        time_axis: TimeAxis,
        thickness: float = FOAM_THICKNESS,
        properties: tuple[float, float, float, float] = FOAM,
        snr: float = SLAB_SNR,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        super().__init__(scan, time_axis=time_axis, dtype=dtype)
        who = "DiffusionDeconvolution"
        self.thickness = positive(f"{who}: thickness", thickness)
        check_thickness(self.thickness, scan, who)
        scattering, absorption, index, extrapolation = properties
        positive(f"{who}: reduced scattering", scattering)
        if finite(f"{who}: absorption", absorption) < 0:
            raise UnitError(f"{who}: expected an absorption of zero or more per metre, got {absorption!r}.")
        positive(f"{who}: index", index)
        positive(f"{who}: extrapolation length", extrapolation)
        self.properties, self.snr = tuple(properties), within(f"{who}: snr", snr, *SNR)
        self._set_tables()

    def tables(self) -> dict[str, Tensor]:
        """``kernel`` (2 T, 2 Y, X + 1, 2): the transform of what the slab makes of one flash, real and imaginary."""
        (bins, rows, columns), width = self.data_shape, self.axis.bin_width_opl
        light, spread = self._flash(width * torch.arange(bins, dtype=torch.float64, device="cpu"))
        along = [
            _gaussians(spread, torch.arange(self._reach(n, pitch, spread), dtype=torch.float64, device="cpu") * pitch)
            for n, pitch in zip((rows, columns), self.grid.pitch, strict=True)
        ]
        kernel = _crossed_twice(light, *along, size=(rows + 1, columns + 1)).clamp_min_(0)
        kernel /= max(self._total(), 1e-300) ** 2
        if not float(kernel.sum()) > SHARE_OF_LIGHT:
            raise UnitError(
                "DiffusionDeconvolution: no light is in the record. Let the axis be longer, or the slab thinner."
            )
        # Later light than the record's would come round as early light; displacements are the same to both sides.
        whole = torch.zeros(2 * bins, 2 * rows, 2 * columns, dtype=torch.float64, device="cpu")
        whole[:bins, : rows + 1, : columns + 1] = kernel
        whole[:bins, rows + 1 :] = whole[:bins, 1:rows].flip(1)
        whole[..., columns + 1 :] = whole[..., 1:columns].flip(2)
        return {"kernel": torch.view_as_real(torch.fft.rfftn(whole))}

    def _flash(self, delay: Tensor) -> tuple[Tensor, Tensor]:
        """Light (D,) of a pencil beam straight behind the slab after optical path lengths ``delay`` (D,), metres, per
        metre and square metre, and s (D,) of the Gaussian exp(-rho^2 / s) over which it is spread.

        The dipole sum of Contini et al., equation 36, of ``IMAGES`` pairs on each side. Valid where the slab is thick
        beside the inverse of the reduced scattering.
        """
        reduced_scattering, absorption, index, extrapolation = self.properties
        diffusion, source = 1 / (3 * (absorption + reduced_scattering)), 1 / reduced_scattering
        m = torch.arange(-IMAGES, IMAGES + 1, dtype=torch.float64, device="cpu")
        above = self.thickness * (1 - 2 * m) - 4 * m * extrapolation - source
        below = self.thickness * (1 - 2 * m) - (4 * m - 2) * extrapolation + source
        # Delay zero has no light: any width will do.
        travelled = torch.where(delay > 0, delay, torch.ones_like(delay)) / index
        spread = 4 * diffusion * travelled
        dipoles = above * torch.exp(-(above**2) / spread[:, None]) - below * torch.exp(-(below**2) / spread[:, None])
        amplitude = torch.exp(-absorption * travelled) / (2 * (4 * math.pi * diffusion) ** 1.5 * travelled**2.5 * index)
        light = amplitude * dipoles.sum(-1)
        return torch.where(delay > 0, light, torch.zeros_like(light)).clamp_min(0), spread

    def _total(self) -> float:
        """The sum over all bins and points of light that passes once, however late and far aside."""
        reduced_scattering, absorption, index, extrapolation = self.properties
        diffusion = 1 / (3 * (absorption + reduced_scattering))
        decay = (absorption + diffusion * (math.pi / (self.thickness + 2 * extrapolation)) ** 2) / index
        # Sums of a smooth function do not depend on fine steps.
        step = max(self.axis.bin_width_opl, 40 / decay / MOST_STEPS)
        delays = step * torch.arange(math.ceil(40 / (decay * step)) + 2, dtype=torch.float64, device="cpu")
        light, spread = self._flash(delays)
        for pitch in self.grid.pitch:
            light = light * _sum_of_gaussians(spread, pitch)
        return float(light.sum()) * step / self.axis.bin_width_opl

    def _reach(self, points: int, pitch: float, spread: Tensor) -> int:
        """Displacements on one side that light between two crossings of the slab may have: so many that what strays
        farther is less than 1e-12 of what comes to the scan.
        """
        strays = 28 * float(spread.amax()) / pitch**2
        return max(2 * points, math.ceil((points + math.sqrt(points**2 + strays)) / 2)) + 1

    def map_(self, x: Tensor) -> Tensor:
        return each(lambda item: self._spread(item, torch.view_as_complex(self.kernel)), x, 3)

    def adjoint_(self, y: Tensor) -> Tensor:
        return each(lambda item: self._spread(item, torch.view_as_complex(self.kernel).conj()), y, 3)

    def invert(self, data: Tensor) -> Tensor:
        return self._filtered(data, self._wiener())

    def invert_adjoint(self, volume: Tensor) -> Tensor:
        return self._filtered(volume, self._wiener().conj())

    def _spread(self, x: Tensor, spectrum: Tensor) -> Tensor:
        """Convolve with the kernel, which is nowhere negative.

        The result of light without negative values has none either: those that the rounding of the transform leaves are
        0. Signed operands keep them, and the derivative is the linear map's.
        """
        found = self._filtered(x, spectrum)
        return found.clamp_(min=torch.where((x >= 0).all(), 0.0, -math.inf).to(found))

    def _filtered(self, x: Tensor, spectrum: Tensor) -> Tensor:
        bins, rows, columns = self.data_shape
        padded = (2 * bins, 2 * rows, 2 * columns)
        of_frequency: Tensor = torch.fft.rfftn(x, s=padded).mul_(spectrum)
        found: Tensor = torch.fft.irfftn(of_frequency, s=padded)
        return found[:bins, :rows, :columns]

    def _wiener(self) -> Tensor:
        kernel = torch.view_as_complex(self.kernel)
        return kernel.conj() / (kernel.abs().square() + 1 / self.snr)


def _gaussians(spread: Tensor, at: Tensor) -> Tensor:
    """exp(-x^2 / spread), (D, N)."""
    return torch.exp(-at.square() / spread[:, None])


def _sum_of_gaussians(spread: Tensor, pitch: float) -> Tensor:
    """The sum of exp(-(k pitch)^2 / spread) over all whole numbers k; wide ones as their integral, right to 1e-16."""
    k = torch.arange(-NARROW, NARROW + 1, dtype=torch.float64, device="cpu")
    wide = spread > (2 * pitch) ** 2
    return torch.where(wide, torch.sqrt(math.pi * spread) / pitch, _gaussians(spread, k * pitch).sum(1))


def _crossed_twice(light: Tensor, along_y: Tensor, along_x: Tensor, *, size: tuple[int, int]) -> Tensor:
    """(D, *size): ``light`` (D,) times Gaussians (D, Ny) and (D, Nx) of displacements from zero on, which are the same
    to both sides, convolved with itself in time and along the slab.
    """
    # Cosine transforms, in which places are multiplied while delays are convolved.
    (to_y, from_y), (to_x, from_x) = (_cosines(a.shape[1]) for a in (along_y, along_x))
    of_y, of_x = along_y @ to_y, (along_x @ to_x) * light[:, None]
    count = len(light)
    found = light.new_empty(count, size[0], of_x.shape[1])
    for k in range(of_x.shape[1]):
        once = torch.fft.rfft((of_x[:, k, None] * of_y).T.contiguous(), n=2 * count)
        twice = torch.fft.irfft(once.square_(), n=2 * count)[:, :count]
        found[..., k] = twice.T @ from_y[:, : size[0]]
    return found @ from_x[:, : size[1]]


def _cosines(count: int) -> tuple[Tensor, Tensor]:
    """Transform (N, N) of an even function of period 2 N - 2 from its values at 0 ... N - 1, and its inverse."""
    k = torch.arange(count, dtype=torch.float64, device="cpu")
    turns = k[:, None] * k / (2 * (count - 1))
    matrix = torch.cos(2 * math.pi * (turns - turns.round())) * 2
    matrix[0], matrix[-1] = matrix[0] / 2, matrix[-1] / 2
    return matrix, matrix / (2 * (count - 1))
