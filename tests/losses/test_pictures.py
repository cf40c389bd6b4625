"""Losses of pictures: depth maps with holes and of any scale, structural similarity, projections of volumes."""

import math

import pytest
import torch

from torchtransient import losses
from torchtransient.errors import ShapeError


def draw(*shape, seed=0):
    return torch.rand(shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def test_depth_in_metres_where_there_is_a_surface():
    truth = torch.tensor([[1.0, 2.0, float("nan")], [float("inf"), 0.5, 1.5]])
    found = torch.tensor([[1.1, 1.8, 7.0], [3.0, 0.5, 9.0]], requires_grad=True)
    mask = torch.tensor([[True, True, True], [True, True, False]])
    value = losses.depth_loss(found, truth, mask=mask)
    assert value.item() == pytest.approx((0.1 + 0.2 + 0) / 3, rel=1e-6)
    value.backward()
    torch.testing.assert_close(found.grad, torch.tensor([[1.0, -1.0, 0.0], [0.0, 0.0, 0.0]]) / 3)
    nowhere = losses.depth_loss(found, torch.full_like(truth, float("nan")))
    assert float(nowhere) == 0
    # a network that gives NaN where there is a surface is not passed over
    assert torch.isnan(losses.depth_loss(torch.full((2, 3), float("nan")), truth))


def test_similarity_against_its_definition():
    """Moments of a Gaussian window, summed by hand, at a pixel whose window is inside."""
    a, b = draw(1, 11, 11), draw(1, 11, 11, seed=1)
    x = torch.arange(11, dtype=torch.float64) - 5
    line = torch.exp(-(x**2) / (2 * 1.5**2))
    w = torch.outer(line, line) / line.sum() ** 2
    ma, mb = (w * a).sum(), (w * b).sum()
    va, vb, cov = (w * a * a).sum() - ma**2, (w * b * b).sum() - mb**2, (w * a * b).sum() - ma * mb
    c1, c2 = 0.01**2, 0.03**2
    wanted = 1 - (2 * ma * mb + c1) * (2 * cov + c2) / ((ma**2 + mb**2 + c1) * (va + vb + c2))
    for scale in (1.0, 50.0):
        found = losses.ssim_loss(scale * a, scale * b, value_range=scale, reduction="none")[0, 5, 5]
        torch.testing.assert_close(found, wanted, rtol=1e-9, atol=0)


def test_the_default_range_knows_the_scale():
    a, b = draw(2, 1, 12, 12), draw(2, 1, 12, 12, seed=1)
    torch.testing.assert_close(losses.ssim_loss(1e9 * a, 1e9 * b), losses.ssim_loss(a, b))
    opposite = losses.ssim_loss(1 - a, a)
    assert 1 < float(opposite) < 2
    assert float(losses.ssim_loss(0 * a, 0 * a)) == 0


def test_projections():
    volume = draw(2, 1, 3, 4, 5)
    front, top, side = losses.maximum_projections(volume)
    assert (front.shape, top.shape, side.shape) == ((2, 1, 4, 5), (2, 1, 3, 5), (2, 1, 3, 4))
    point = torch.zeros(1, 8, 8, 8, dtype=torch.float64)
    point[0, 2, 3, 5] = 4.0
    for view, place in zip(losses.maximum_projections(point), ((3, 5), (2, 5), (2, 3)), strict=True):
        assert float(view[0][place]) == 4 and float(view.sum()) == 4


def test_similarity_of_volumes_is_that_of_three_views():
    a, b = draw(2, 1, 8, 9, 10), draw(2, 1, 8, 9, 10, seed=1)
    views = zip(losses.maximum_projections(a), losses.maximum_projections(b), strict=True)
    wanted = torch.stack([losses.ssim_loss(x, y, window=7) for x, y in views]).mean()
    torch.testing.assert_close(losses.projection_ssim_loss(a, b, window=7), wanted)
    assert losses.projection_ssim_loss(a, b, window=7, reduction="none").shape == (2, 1)


def test_pictures_that_are_too_small():
    a = draw(1, 8, 8)
    with pytest.raises(ShapeError, match="window"):
        losses.ssim_loss(a, a, window=17)


def test_the_range_of_a_target_has_no_gradient():
    """A range that is not given is the largest modulus of each target, and held fixed: as one that is given."""
    generator = torch.Generator().manual_seed(3)
    a, b = (torch.rand(2, 1, 9, 9, dtype=torch.float64, generator=generator) for _ in range(2))
    b[1] *= 7
    peaks = b.abs().amax((-3, -2, -1), keepdim=True)
    slopes = []
    for value_range in (None, peaks):
        target = b.clone().requires_grad_()
        losses.ssim_loss(a, target, window=3, value_range=value_range).backward()
        slopes.append(target.grad)
    torch.testing.assert_close(*slopes, rtol=1e-9, atol=1e-12)


# ------------------------------------------------------------------------------------ depth maps of any scale


def maps(seed=0):
    g = torch.Generator().manual_seed(seed)
    return tuple(1 + torch.rand(2, 1, 6, 7, generator=g, dtype=torch.float64) for _ in range(2))


@pytest.mark.parametrize("balance", [0.0, 0.5, 1.0])
def test_moments_of_logarithms(balance):
    """`mean(d^2) - balance mean(d)^2`: of a balance of one a common factor has no part."""
    x, y = maps()
    for factor in (1.0, 7.0):
        d = (factor * x / y).log()
        found = losses.scale_invariant_depth_loss(factor * x, y, balance=balance, reduction="none")
        assert found.shape == (2, 1)
        torch.testing.assert_close(found, d.square().mean((-2, -1)) - balance * d.mean((-2, -1)).square())


@pytest.mark.parametrize("factor", [1000.0, 1.0])
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
