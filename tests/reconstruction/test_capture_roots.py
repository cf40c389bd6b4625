"""Roots of captures: values, bounds and derivatives at empty bins."""

import pytest
import torch

from support.grid_operators import AXIS, SCAN, SINGLE
from torchtransient.errors import ShapeError, UnitError
from torchtransient.reconstruction import FK, MidpointFK, stabilized_root

F64 = torch.float64
VALUES = torch.tensor([-4.0, -0.5, 0.0, 1e-30, 1e-8, 1.0, 100.0, 1e12], dtype=F64)


@pytest.mark.parametrize("floor", [0.0, 0.25])
def test_odd_and_growing_and_the_root_far_above_the_floor(floor):
    found = stabilized_root(VALUES, floor)
    torch.testing.assert_close(found, -stabilized_root(-VALUES, floor), rtol=0, atol=0)
    assert (found.diff() > 0).all()
    assert float(found[2]) == 0
    assert float(found[-1]) == pytest.approx(1e6, rel=1e-10)
    torch.testing.assert_close(found, VALUES / (VALUES.abs() + floor).sqrt().clamp_min(1e-300))


def test_slope_has_a_bound():
    x = VALUES.clone().requires_grad_()
    (slope,) = torch.autograd.grad(stabilized_root(x, 0.25).sum(), x)
    assert float(slope.max()) == float(slope[2]) == 2.0
    assert float(stabilized_root(torch.ones(1), 0.25)) == pytest.approx(0.894, abs=1e-3)


@pytest.mark.parametrize("floor", [0.0, 0.25])
def test_derivatives(floor):
    x = torch.tensor([-3.0, -0.2, 0.4, 7.0], dtype=F64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda h: stabilized_root(h, floor), x, check_forward_ad=True)
    assert torch.autograd.gradgradcheck(lambda h: stabilized_root(h, floor), x)


def test_kinds_of_numbers():
    assert stabilized_root(torch.tensor([4]), 0.0).dtype == torch.float32
    assert stabilized_root(torch.ones(2, dtype=torch.float16)).dtype == torch.float16
    with pytest.raises(UnitError, match="floor"):
        stabilized_root(torch.ones(1), -1.0)
    with pytest.raises(UnitError, match="finite"):
        stabilized_root(torch.ones(1), float("nan"))


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float32])
def test_floors_that_a_precision_takes_for_zero(dtype):
    least = torch.finfo(dtype).tiny
    assert stabilized_root(torch.tensor([0.0, 1.0], dtype=dtype), least).tolist() == [0.0, 1.0]
    with pytest.raises(UnitError, match="at least in"):
        stabilized_root(torch.tensor([0.0, 1.0], dtype=dtype), least / 2)


def test_roots_of_other_things_are_refused():
    with pytest.raises(ShapeError, match="real numbers"):
        stabilized_root(torch.tensor([3 + 4j]))
    for kind, scan in ((FK, SCAN), (MidpointFK, SINGLE)):
        with pytest.raises(UnitError, match="floor"):
            kind(scan, time_axis=AXIS, floor=1e-46)
        operator = kind(scan, time_axis=AXIS, floor=1e-46, dtype=F64)
        with pytest.raises(UnitError, match="floor"):
            operator.float().reconstruct(torch.zeros(operator.data_shape))
