"""Depth maps: the scale-invariant error by its closed form."""

from __future__ import annotations

import math

import pytest
import torch

from torchtransient import losses
from torchtransient.errors import ShapeError


def maps(seed=0):
    g = torch.Generator().manual_seed(seed)
    return tuple(1 + torch.rand(2, 1, 6, 7, generator=g, dtype=torch.float64) for _ in range(2))


@pytest.mark.parametrize("balance", [0.0, 0.5, 1.0])
def test_a_common_factor(balance):
    """`log(f)^2 (1 - balance)` of a map times f: nothing of it with a balance of one."""
    _, y = maps()
    found = losses.scale_invariant_depth_loss(3 * y, y, balance=balance, reduction="none")
    assert found.shape == (2, 1)
    torch.testing.assert_close(found, torch.full_like(found, math.log(3) ** 2 * (1 - balance)), atol=1e-14, rtol=1e-12)


def test_it_is_a_variance_of_logarithms():
    x, y = maps()
    d = (x / y).log()
    found = losses.scale_invariant_depth_loss(x, y, balance=1.0, reduction="none")
    torch.testing.assert_close(found, d.var((-2, -1), correction=0))
    torch.testing.assert_close(losses.scale_invariant_depth_loss(7 * x, y, balance=1.0, reduction="none"), found)
    torch.testing.assert_close(losses.scale_invariant_depth_loss(x, y, balance=0.0), d.square().mean())


@pytest.mark.parametrize("factor", [1000.0, 3.0, 1.0])
def test_a_common_factor_in_single_precision(factor):
    """Millimetres against metres: what is left is the variance, 1e-6, of squared logarithms of up to 48."""
    g = torch.Generator().manual_seed(4)
    y = 1 + torch.rand(16, 16, generator=g)
    x = (factor * y * (1 + 1e-3 * torch.randn(16, 16, generator=g))).requires_grad_()
    wide = x.detach().double().requires_grad_()
    value = losses.scale_invariant_depth_loss(x, y, balance=1.0)
    wanted = losses.scale_invariant_depth_loss(wide, y.double(), balance=1.0)
    # logarithms up to 8 are rounded by 2^-22, of deviations of 1e-3
    torch.testing.assert_close(value.double(), wanted, rtol=1e-3, atol=0)
    value.backward()
    wanted.backward()
    torch.testing.assert_close(x.grad.double(), wide.grad, rtol=0, atol=2e-3 * float(wide.grad.abs().max()))


def test_where_there_is_no_surface():
    x, y = maps()
    wanted = losses.scale_invariant_depth_loss(x[:, :, :3], y[:, :, :3])
    for nothing in (math.nan, math.inf, 0.0, -1.0):
        torch.testing.assert_close(
            losses.scale_invariant_depth_loss(x, torch.where(torch.arange(6)[:, None] < 3, y, nothing)), wanted
        )
    # a map without any surface has no part in the mean
    empty = y.clone()
    empty[1] = 0.0
    torch.testing.assert_close(
        losses.scale_invariant_depth_loss(x, empty), losses.scale_invariant_depth_loss(x[:1], y[:1])
    )


def test_depths_below_the_floor_have_a_way_out():
    x = torch.tensor([[[-1.0, 0.0], [1e-3, 2.0]]], dtype=torch.float64, requires_grad=True)
    value = losses.scale_invariant_depth_loss(x, torch.ones(1, 2, 2, dtype=torch.float64), balance=0.0, floor=1e-3)
    d = torch.tensor([math.log(1e-3) - 1001, math.log(1e-3) - 1, math.log(1e-3), math.log(2)], dtype=torch.float64)
    torch.testing.assert_close(value, d.square().mean())
    value.backward()
    assert bool((x.grad[0].flatten()[:3] < 0).all())
    with pytest.raises(ShapeError, match="depth maps"):
        losses.scale_invariant_depth_loss(x[0, 0], x[0, 0])
