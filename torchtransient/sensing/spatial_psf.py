"""Spatial point spread functions: blur by lens and sensor stack, the same in every time bin. Needs kornia."""

from __future__ import annotations

import math
from typing import Literal

import torch
from torch import Tensor, nn

from torchtransient.errors import ShapeError, UnitError
from torchtransient.floating import single, without_autocast
from torchtransient.sensing.checks import check_choice, check_count, check_number, check_transient, reals
from torchtransient.sensing.parameters import keep_number
from torchtransient.sensing.responses import FWHM_PER_SIGMA
from torchtransient.sensing.sensor import Sensor

_LARGEST = 1 << 15  # points across a PSF, whose square still fits into memory
_POINTS = 15  # across a pixel of a disc
Border = Literal["constant", "reflect", "replicate", "circular"]


@without_autocast
def blur_image(x: Tensor, psf: Tensor, border: Border = "reflect") -> Tensor:
    """Convolve light with a point spread function over the image plane; the PSF's own centre stays put.

    Differentiable in both arguments.

    Args:
        x: (..., C, T, H, W).
        psf: point spread function (h, w), odd sizes.
        border: values outside of the picture: "constant" darkness (light is lost), "reflect", "replicate", "circular"
            (sums are conserved).

    Returns:
        Shape and dtype of `x`.

    Raises:
        ShapeError: for even sizes.
    """
    check_transient(x, "blur_image")
    check_choice(border, Border, "border", "blur_image")
    if psf.ndim != 2 or psf.shape[0] % 2 == 0 or psf.shape[1] % 2 == 0:
        raise ShapeError(f"blur_image: expected a PSF (h, w) of odd sizes, got {tuple(psf.shape)}.")
    from kornia.filters import filter2d

    flat = single(x.reshape(-1, 1, *x.shape[-2:]))
    # filter2d correlates; a PSF says where the light of one point goes, so it is turned round
    kernel = psf.flip(0, 1).unsqueeze(0).to(flat.dtype)
    blurred: Tensor = filter2d(flat, kernel, border_type=border)
    return blurred.reshape(x.shape).to(x.dtype)


def gaussian_psf(fwhm_px: Tensor, size: int) -> Tensor:
    """Normal spot integrated over pixels, sum 1; differentiable in the width.

    Args:
        fwhm_px: full width at half maximum in pixels, a scalar tensor.
        size: width of the kernel in pixels.

    Returns:
        (size, size) float64.
    """
    size = check_count(size, "size", "gaussian_psf", most=_LARGEST)
    sigma = fwhm_px.double() / FWHM_PER_SIGMA
    edges = torch.arange(size + 1, dtype=torch.float64, device=fwhm_px.device) - size / 2
    line = 0.5 * torch.special.erf(edges / (sigma * math.sqrt(2))).diff()
    line = line / line.sum()
    return torch.outer(line, line)


def defocus_psf(radius_px: float) -> Tensor:
    """Area-sampled disc, the defocus of a round aperture, sum 1. Not differentiable in the radius.

    Args:
        radius_px: radius in pixels.

    Returns:
        (n, n) float64.

    Raises:
        UnitError: for radii out of range.
    """
    radius = check_number(radius_px, "radius_px", "defocus_psf", open_low=True, high=1000.0)
    half = math.ceil(radius - 0.5) if radius > 0.5 else 0
    size = 2 * half + 1
    fine = (torch.arange(size * _POINTS, dtype=torch.float64) + 0.5) / _POINTS - size / 2
    inside = (fine[:, None] ** 2 + fine[None, :] ** 2 <= radius**2).double()
    area = inside.view(size, _POINTS, size, _POINTS).mean((1, 3))
    return area / area.sum()


class SpatialPSF(Sensor):
    """Blur by a measured point spread function; see `blur_image`.

    Args:
        psf: point spread function (h, w), odd sizes, values >= 0; normalised to 1.
        border: treatment of light outside of the picture, see `blur_image`.
        learnable: learn the PSF, as logits.

    Raises:
        UnitError: for negative values, or none.
    """

    gives = "the same"

    psf: Tensor

    def __init__(self, psf: Tensor, border: Border = "reflect", *, learnable: bool = False) -> None:
        super().__init__()
        (psf,) = reals("SpatialPSF", torch.float64, psf=psf)
        values = psf.detach().double()
        if not bool(torch.isfinite(values).all()) or bool((values < 0).any()) or not float(values.sum()) > 0:
            raise UnitError("SpatialPSF: expected finite values >= 0 with a positive sum.")
        self.border: Border = border
        self.learnable = bool(learnable)
        shares = values / values.sum()
        if self.learnable:
            self.psf_logits = nn.Parameter(shares.clamp_min(1e-13).log())
        else:
            self.register_buffer("psf", shares)

    def expected(self, x: Tensor) -> Tensor:
        if self.learnable:
            return blur_image(x, self.psf_logits.double().flatten().softmax(0).view_as(self.psf_logits), self.border)
        return blur_image(x, self.psf, self.border)


class LensBlur(Sensor):
    """Gaussian blur of a lens.

    The size of the kernel is fixed when the module is made: 2 FWHM (4.7 standard deviations) to each side.

    Args:
        fwhm_px: full width at half maximum in pixels.
        border: treatment of light outside of the picture, see `blur_image`.
        learnable: make the logarithm `log_fwhm_px` a parameter.

    Raises:
        UnitError: for widths out of range.
    """

    gives = "the same"

    log_fwhm_px: Tensor

    def __init__(self, fwhm_px: float, border: Border = "reflect", *, learnable: bool = False) -> None:
        super().__init__()
        fwhm = check_number(fwhm_px, "fwhm_px", "LensBlur", open_low=True)
        self.border: Border = border
        self.size = 2 * max(1, math.ceil(2 * fwhm)) + 1
        value = torch.tensor(math.log(fwhm), dtype=torch.float64)
        keep_number(self, "log_fwhm_px", value, learnable)

    @property
    def fwhm_px(self) -> Tensor:
        """Full width at half maximum, in pixels."""
        return self.log_fwhm_px.double().exp()

    def expected(self, x: Tensor) -> Tensor:
        return blur_image(x, gaussian_psf(self.fwhm_px, self.size), self.border)
