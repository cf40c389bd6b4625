"""Spatial point spread functions: energy, symmetry, widths, gradients."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from torchtransient.errors import ShapeError
from torchtransient.sensing import LensBlur, SpatialPSF, blur_image, defocus_psf, gaussian_psf
from torchtransient.sensing.responses import FWHM_PER_SIGMA


def point(height=15, width=15):
    x = torch.zeros(1, 2, height, width, dtype=torch.float64)
    x[..., height // 2, width // 2] = 1
    return x


def test_a_point_becomes_the_psf():
    psf = torch.rand(5, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    y = SpatialPSF(psf)(point())
    torch.testing.assert_close(y[0, 0, 5:10, 6:9], psf / psf.sum())
    assert float(y[0, 1].sum()) == pytest.approx(1)


def test_gaussian_blur_has_its_width_and_keeps_energy():
    y = LensBlur(2.0, border="circular", size=13)(point())[0, 0]
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


@pytest.mark.parametrize("border", MODES)
def test_how_far_a_spread_reaches(border):
    """Mirrors and rings need a picture larger than half the PSF, in each direction; the others none."""
    for size, image, fits in (((3, 7), (2, 4), True), ((3, 7), (2, 3), False), ((5, 1), (2, 9), False),
                              ((5, 1), (3, 1), True)):  # fmt: skip
        x, psf = torch.ones(1, 1, *image), torch.ones(size) / (size[0] * size[1])
        if fits or border in ("constant", "replicate"):
            found = blur_image(x, psf, border)
            assert found.shape == x.shape and (border == "constant" or bool(((found - 1).abs() < 1e-6).all()))
        else:
            with pytest.raises(ShapeError, match="a picture larger than the half PSF"):
                blur_image(x, psf, border)


@pytest.mark.parametrize("radius", [0.3, 0.5, 0.51, 1.5, 1.6, 2.5, 2.7])
def test_discs_are_sampled_over_their_pixels(radius):
    """The share of 9 x 9 points of each pixel inside the radius; as many pixels as it reaches."""
    disc = defocus_psf(radius, oversampling=9)
    size = 2 * max(math.ceil(radius - 0.5), 0) + 1
    y, x = np.meshgrid(*(((np.arange(size * 9) - (size * 9 - 1) / 2) / 9,) * 2), indexing="ij")
    inside = (x**2 + y**2 <= radius**2).reshape(size, 9, size, 9).sum((1, 3))
    np.testing.assert_allclose(disc.numpy(), inside / inside.sum(), rtol=1e-13)


@pytest.mark.parametrize(("fwhm", "size"), [(0.2, 3), (0.5, 3), (0.6, 5), (1.0, 5), (1.3, 7)])
def test_the_size_of_a_lens_blur(fwhm, size):
    """Twice the width at half maximum to each side, one pixel at least; a normal spot integrated over pixels."""
    layer = LensBlur(fwhm)
    assert layer.size == size and layer.border == "reflect" and float(layer.fwhm_px) == pytest.approx(fwhm)
    edges = (torch.arange(size + 1, dtype=torch.float64) - size / 2) * FWHM_PER_SIGMA / fwhm
    line = torch.special.ndtr(edges).diff() / torch.special.ndtr(edges)[[0, -1]].diff()
    spot = gaussian_psf(torch.tensor(fwhm, dtype=torch.float64), size)
    torch.testing.assert_close(spot, line.unsqueeze(0) * line.unsqueeze(1), rtol=1e-9, atol=1e-15)
    torch.testing.assert_close(layer(point())[0, 0, 3:12, 3:12].sum(), torch.tensor(1.0, dtype=torch.float64))
    assert LensBlur(fwhm, size=1).size == 1


def test_learnable_width():
    layer = LensBlur(1.5, learnable=True)
    x = torch.rand(1, 2, 11, 11, dtype=torch.float64)
    assert torch.autograd.gradcheck(
        lambda w: blur_image(x, gaussian_psf(w, 5)), layer.fwhm_px.detach().requires_grad_()
    )
    layer(x).square().sum().backward()
    assert float(layer.log_fwhm_px.grad) < 0


def test_pixels_without_light_can_be_learnt():
    """They start at e^-30 of all, from where a gradient leads on."""
    module = SpatialPSF(torch.tensor([[0.0, 3.0, 1.0]]), learnable=True)
    assert module.psf_logits.flatten().tolist() == pytest.approx([math.log(1e-13), math.log(0.75), math.log(0.25)])
    x = torch.rand(1, 2, 1, 5, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    (slope,) = torch.autograd.grad(module(x)[..., 2].sum(), module.psf_logits)
    assert bool((slope != 0).all())


def test_errors():
    with pytest.raises(ShapeError, match="odd"):
        SpatialPSF(torch.ones(4, 4))
    with pytest.raises(ShapeError, match="larger"):
        blur_image(torch.ones(1, 1, 3, 3), torch.ones(9, 9))


@pytest.mark.parametrize("shape", [(3,), (3, 3, 3), (2, 3), (3, 4)])
def test_sizes_of_a_psf(shape):
    with pytest.raises(ShapeError, match=r"SpatialPSF: expected a PSF \(h, w\) of odd sizes"):
        SpatialPSF(torch.ones(shape))
