"""Flat pictures and those without pixels: correlations have slope zero, ratios are NaN."""

from __future__ import annotations

import pytest
import torch

import torchtransient as tt


@pytest.mark.parametrize("centered", [False, True])
@pytest.mark.parametrize("name", ["picture_correlation", "volume_correlation"])
def test_flat_pictures_have_slope_zero(name, centered):
    flat = torch.zeros(2, 4, 4, 4, dtype=torch.float64)
    target = torch.rand(flat.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    flat[1] = target[1] ** 2
    flat.requires_grad_()
    getattr(tt.metrics, name)(flat, target, centered=centered).backward()
    assert torch.equal(flat.grad[0], torch.zeros_like(flat.grad[0]))
    assert flat.grad[1].isfinite().all()
    assert flat.grad[1].abs().max() > 0


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("shape", [(3, 0, 4), (2, 3, 0, 4), (2, 0, 4, 4), (0, 3, 4, 4)])
def test_pictures_without_pixels_have_no_ratio(shape, masked):
    empty = torch.zeros(shape)
    mask = torch.ones(shape, dtype=torch.bool) if masked else None
    each = tt.metrics.psnr(empty, empty, value_range=1.0, mask=mask, reduction="item")
    assert each.shape == shape[:-3]
    assert each.isnan().all()
    assert tt.metrics.psnr(empty, empty, value_range=1.0, mask=mask).isnan()
