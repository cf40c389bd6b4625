"""Filters of images bin by bin: time is no channel."""

from __future__ import annotations

import kornia
import pytest
import torch

from torchtransient.data import SpatialFilter, spatial_filter
from torchtransient.errors import ShapeError, UnitError

FILTERS = {
    "gaussian": lambda x: kornia.filters.gaussian_blur2d(x, (3, 3), (1.0, 1.0)),
    "median": lambda x: kornia.filters.median_blur(x, (3, 3)),
    "bilateral": lambda x: kornia.filters.bilateral_blur(x, (3, 3), 0.2, (1.0, 1.0)),
    "half the size": kornia.geometry.transform.PyrDown(),
}


@pytest.mark.parametrize("name", FILTERS)
def test_each_bin_is_an_image_of_its_own(name):
    light = torch.rand(2, 3, 7, 8, 6, generator=torch.Generator().manual_seed(1))
    found = spatial_filter(FILTERS[name], light, images_at_once=10)
    for k in ((0, 0, 0), (1, 2, 6), (1, 0, 3)):
        assert torch.allclose(found[k], FILTERS[name](light[k][None, None])[0, 0], atol=1e-6)
    assert torch.allclose(SpatialFilter(FILTERS[name])(light), found, atol=1e-6)
    # A bin alone: what is in the others has no part in it.
    alone = torch.zeros_like(light)
    alone[:, :, 3] = light[:, :, 3]
    assert torch.allclose(spatial_filter(FILTERS[name], alone)[:, :, 3], found[:, :, 3], atol=1e-6)
    assert not spatial_filter(FILTERS[name], alone)[:, :, 4].any()


def test_gradients_and_empty():
    light = torch.rand(1, 3, 4, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(2)).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: spatial_filter(FILTERS["gaussian"], x), (light,))
    assert spatial_filter(FILTERS["gaussian"], torch.zeros(0, 3, 4, 4)).shape == (0, 3, 4, 4)


def test_what_it_refuses():
    with pytest.raises(UnitError, match="floating dtype"):
        spatial_filter(FILTERS["median"], torch.ones(3, 4, 4, dtype=torch.complex64))
    with pytest.raises(ShapeError, match=r"images \(\.\.\., H, W\)"):
        spatial_filter(FILTERS["median"], torch.ones(4))
    with pytest.raises(ShapeError, match=r"to make images \(3, 1, 4, 4\), got \(1, 4, 4\)"):
        spatial_filter(lambda x: x[0], torch.ones(3, 4, 4))
