"""Where reconstruction around a corner breaks: roots of empty bins, 0 / 0 at frequency zero, transforms that come
round, single precision, half bins, and ratios of signal to noise that depend on units.
"""

import pytest
import torch

from support.grid_operators import confocal_points
from torchtransient.axes import TimeAxis
from torchtransient.capture import Scan, Wall
from torchtransient.reconstruction import FK, LCT, DiffusionDeconvolution, DirectionalLCT

F64 = torch.float64
AXIS = TimeAxis(0.0, 0.04, 96)
SCAN = Scan.grid(Wall.plane(1.0, 1.0), 16, kind="confocal")
METHODS = {
    "fk": FK(SCAN, time_axis=AXIS, dtype=F64),
    "fk, floor": FK(SCAN, time_axis=AXIS, floor=0.25, dtype=F64),
    "lct": LCT(SCAN, time_axis=AXIS, dtype=F64),
    "directional lct": DirectionalLCT(SCAN, time_axis=AXIS, dtype=F64),
    "slab": DiffusionDeconvolution(SCAN, time_axis=AXIS, dtype=F64),
}


def gradient(operator, capture):
    x = capture.clone().requires_grad_()
    (found,) = torch.autograd.grad(operator.reconstruct(x).square().sum(), x)
    return found


@pytest.mark.parametrize("name", METHODS)
def test_empty_and_nearly_empty_captures_have_finite_gradients(name):
    operator = METHODS[name]
    one = torch.zeros(operator.data_shape, dtype=F64)
    one[40, 8, 8] = 1.0
    for capture in (torch.zeros_like(one), one, -one, 1e-300 * one):
        assert torch.isfinite(operator.reconstruct(capture)).all()
        assert torch.isfinite(gradient(operator, capture)).all()
    assert (operator.reconstruct(torch.zeros_like(one)) == 0).all()


def test_the_plain_root_has_no_gradient_where_nothing_was_measured():
    counts = torch.poisson(
        300 * confocal_points([(0.1, -0.15, 1.0)], SCAN, AXIS), generator=torch.Generator().manual_seed(0)
    )
    assert (counts == 0).double().mean() > 0.5
    plain, bounded = gradient(METHODS["fk"], counts), gradient(METHODS["fk, floor"], counts)
    assert (plain[counts == 0] == 0).all()
    # With a floor, empty bins learn what light there would do.
    assert (bounded[counts == 0] != 0).double().mean() > 0.9
    # The picture is that of the root, to the share of counts of one.
    a, b = METHODS["fk"].reconstruct(counts), METHODS["fk, floor"].reconstruct(counts)
    assert float((a * b).sum() / (a.norm() * b.norm())) > 0.99


def test_frequency_zero_of_migration():
    # kz / k is 0 / 0 at the origin: a constant wavefield has no wave that travels.
    operator = METHODS["fk"]
    weights = operator.weights
    assert torch.isfinite(weights).all()
    assert (weights[..., 0, :] == 0).all()
    steady = torch.ones(operator.data_shape, dtype=F64)
    field = operator.adjoint(steady)
    assert torch.isfinite(torch.view_as_real(field)).all()
    # Its mean over the padded volume, which is frequency zero, is gone; what is left are its edges.
    assert float(field.sum().abs()) < 0.5 * float(steady.sum())


@pytest.mark.parametrize("target, power", [("diffuse", 4), ("retroreflective", 2)])
def test_light_near_the_end_does_not_come_round_to_the_wall(target, power):
    # 93 % of the record, at the edge of the scan.
    axis = TimeAxis(0.0, 0.02, 192)
    place = (-0.45, 0.45, 1.75)
    light = confocal_points([place], SCAN, axis, power=power)
    for method in (FK, LCT):
        operator = method(SCAN, time_axis=axis, target=target, dtype=F64)
        volume = operator.reconstruct(light)
        depth, y, x = (int(i) for i in torch.unravel_index(volume.argmax(), volume.shape))
        assert float(operator.depths[depth]) == pytest.approx(1.75, abs=0.02)
        # Seen from one side alone, the place is uncertain by a step.
        assert y >= 14 and x <= 1
        near = volume[: axis.num_bins // 4].abs().amax()
        assert float(near) < 0.02 * float(volume.max())


def test_late_noise_of_the_light_cone_is_that_of_its_falloff():
    # r^4 compensation: the same noise weighs more the later it comes, which the Wiener filter bounds by its ratio.
    noise = torch.randn(METHODS["lct"].data_shape, dtype=F64, generator=torch.Generator().manual_seed(0))
    strong, weak = (LCT(SCAN, time_axis=AXIS, snr=snr, dtype=F64).reconstruct(noise) for snr in (1e4, 1e-2))
    early, late = slice(12, 36), slice(60, 84)
    assert float(strong[late].norm() / strong[early].norm()) > 2
    assert float(weak.norm()) < 0.05 * float(strong.norm())


@pytest.mark.parametrize("scale", [1e-12, 1e9])
def test_wiener_ratio_has_no_unit(scale):
    # Neither that of the light nor that of lengths: a scene of twice the size has the same picture.
    light = confocal_points([(0.1, -0.15, 1.0)], SCAN, AXIS)
    expected = METHODS["lct"].reconstruct(light)
    torch.testing.assert_close(METHODS["lct"].reconstruct(scale * light), scale * expected, rtol=1e-9, atol=0)
    doubled = Scan.grid(Wall.plane(2.0, 2.0), 16, kind="confocal")
    operator = LCT(doubled, time_axis=TimeAxis(0.0, 0.08, 96), dtype=F64)
    found = operator.reconstruct(light)
    torch.testing.assert_close(found / found.max(), expected / expected.max(), rtol=0, atol=1e-9)
    finer = Scan.grid(Wall.plane(1.0, 1.0), 32, kind="confocal")
    coarse_ratio = METHODS["lct"].mean_power() / (4 * 16 * 16)
    assert LCT(finer, time_axis=AXIS, dtype=F64).mean_power() / (4 * 32 * 32) == pytest.approx(coarse_ratio)
