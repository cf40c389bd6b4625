"""Spatial point spread functions: energy, symmetry, widths, gradients."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from torchtransient.sensing import LensBlur, SpatialPSF, blur_image, defocus_psf, gaussian_psf

FWHM_PER_SIGMA = 2.3548200450309493  # 2 sqrt(2 log 2)


def point(height=15, width=15):
    x = torch.zeros(1, 2, height, width, dtype=torch.float64)
    x[..., height // 2, width // 2] = 1
    return x


def test_gaussian_blur_has_its_width_and_keeps_energy():
    y = LensBlur(2.0, border="circular")(point())[0, 0]
    i = torch.arange(15, dtype=torch.float64) - 7
    # integrating over pixels adds 1/12
    assert float((y.sum(1) * i**2).sum()) == pytest.approx((2 / FWHM_PER_SIGMA) ** 2 + 1 / 12, rel=1e-3)
    x = torch.rand(2, 3, 4, 9, 9, dtype=torch.float64)
    blurred = LensBlur(1.0, border="circular")(x)
    torch.testing.assert_close(blurred.sum((-1, -2)), x.sum((-1, -2)))


def test_defocus_disc():
    disc = defocus_psf(3.0)
    assert disc.shape == (7, 7)
    assert float(disc.sum()) == pytest.approx(1)
    assert float(disc.max()) == pytest.approx(1 / (torch.pi * 9), rel=5e-3)
    assert defocus_psf(0.4).shape == (1, 1)


MODES = {"constant": "constant", "reflect": "reflect", "replicate": "edge", "circular": "wrap"}


@pytest.mark.parametrize("border", MODES)
@pytest.mark.parametrize("size", [(1, 3), (3, 1), (5, 3), (3, 7)])
def test_spread_of_a_picture_by_hand(border, size):
    """Every point sends its light to where the PSF says, over the borders, in each bin of each item alike."""
    g = torch.Generator().manual_seed(1)
    psf = torch.rand(size, dtype=torch.float64, generator=g)
    x = torch.rand(2, 1, 3, 4, 6, dtype=torch.float64, generator=g)
    down, across = size[0] // 2, size[1] // 2
    wide = np.pad(x.numpy(), ((0, 0),) * 3 + ((down, down), (across, across)), mode=MODES[border])
    wanted = np.zeros(x.shape)
    for i in range(size[0]):
        for j in range(size[1]):
            wanted += float(psf[i, j]) * wide[..., 2 * down - i :, 2 * across - j :][..., :4, :6]
    torch.testing.assert_close(blur_image(x, psf, border), torch.from_numpy(wanted))
    for sensor in (SpatialPSF(3 * psf, border), SpatialPSF(3 * psf, border, learnable=True)):
        torch.testing.assert_close(sensor(x), torch.from_numpy(wanted) / psf.sum())
    assert not list(SpatialPSF(psf).parameters()) and not list(LensBlur(1.0).parameters())


def test_learnable_width():
    layer = LensBlur(1.5, learnable=True)
    x = torch.rand(1, 2, 11, 11, dtype=torch.float64)
    assert torch.autograd.gradcheck(
        lambda w: blur_image(x, gaussian_psf(w, 5)), layer.fwhm_px.detach().requires_grad_()
    )
    layer(x).square().sum().backward()
    assert float(layer.log_fwhm_px.grad) < 0
