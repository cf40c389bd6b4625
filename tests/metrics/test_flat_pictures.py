"""Correlations of volumes and pictures in which nothing differs have a slope, and it is zero."""

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
