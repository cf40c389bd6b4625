"""Consistency of a volume with its measurement: the free scale, other comparisons, an operator of the library."""

import functools

import pytest
import torch

from support.loss_cases import CASES
from support.sweeps import together
from torchtransient import TimeAxis, losses
from torchtransient.capture import Scan, Wall
from torchtransient.errors import ArgumentError, ShapeError
from torchtransient.reconstruction import FK


def draw(*shape, seed=0):
    return torch.rand(shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("dtype", [torch.float64, torch.complex128], ids=str)
def test_the_free_scale_is_that_of_least_squares(dtype):
    """`|y|^2 - Re<Av, y>^2 / |Av|^2` of each item: 0 for every multiple, and what a lattice of scales finds."""
    volume, measured = draw(2, 1, 4, 3, 3), draw(2, 1, 4, 3, 3, seed=1)
    if dtype.is_complex:
        volume = torch.complex(volume - 0.5, draw(2, 1, 4, 3, 3, seed=2))
        measured = torch.complex(measured, draw(2, 1, 4, 3, 3, seed=3) - 0.5)
    loss = functools.partial(
        losses.measurement_consistency, operator=lambda v: 3 * v, scale_invariant=True, reduction="sum"
    )
    inner = (volume * measured.conj()).real.sum((1, 2, 3, 4))
    power = volume.abs().square().sum((1, 2, 3, 4))
    wanted = measured.abs().square().sum((1, 2, 3, 4)) - inner**2 / power
    torch.testing.assert_close(loss(volume, measured), wanted.sum())
    for factor in (1e-20, 0.1, 1.0, 1e20):
        torch.testing.assert_close(loss(factor * volume, measured), wanted.sum())
    items = torch.tensor([0.2, 7.0], dtype=torch.float64).reshape(2, 1, 1, 1, 1)
    assert float(loss(items * measured, measured)) < 1e-28 * float(wanted.sum()) + 1e-28
    assert float(losses.measurement_consistency(items * measured, measured, lambda v: v)) > 0.1


def test_the_free_scale_reads_no_masked_bins():
    volume, measured = draw(1, 1, 4, 3, 3), draw(1, 1, 4, 3, 3, seed=1)
    measured[..., 1:] = 5 * volume[..., 1:]
    mask = torch.tensor([False, True, True])
    loss = functools.partial(losses.measurement_consistency, operator=lambda v: v, scale_invariant=True, mask=mask)
    assert float(loss(volume, measured)) < 1e-28
    measured[..., 0] = float("nan")
    volume[..., 0] = float("nan")
    volume.requires_grad_()
    loss(volume, measured).backward()
    assert bool(torch.isfinite(volume.grad).all())


def test_a_dark_volume_is_led_out_of_the_dark():
    volume, measured = torch.zeros(1, 1, 4, 3, 3, requires_grad=True), draw(1, 1, 4, 3, 3).float()
    losses.measurement_consistency(volume, measured, lambda v: 2 * v, scale_invariant=True, reduction="sum").backward()
    torch.testing.assert_close(volume.grad, -4 * measured)


def test_dimension_of_time_is_handed_to_the_loss_that_compares():
    """A list of points: given once, to either of both, it is known to both; two dimensions are refused."""
    x, y = (0.1 + draw(2, 5, 9, 4, seed=seed) for seed in (1, 2))
    plain = functools.partial(losses.wasserstein_loss, bin_width_opl=0.1)
    held, module = functools.partial(plain, dim=-2), losses.WassersteinLoss(0.1, dim=-2)
    loss = functools.partial(losses.measurement_consistency, operator=torch.clone, scale_invariant=True)
    wanted = loss(x[..., None], y[..., None], compare=plain, dim=-3)
    for compare, dim in ((plain, -2), (held, None), (held, 2), (module, None)):
        torch.testing.assert_close(loss(x, y, compare=compare, dim=dim), wanted)
    for compare in (held, module):
        with pytest.raises(ArgumentError, match="dim=-3, and dim=-2"):
            loss(x, y, compare=compare, dim=-3)


def test_items_may_have_more_dimensions():
    """An exhaustive capture (C, T, Ly, Lx, Sy, Sx) is one item of six, and has one scale."""
    volume = draw(1, 3, 2, 2, 2, 2)
    measured = volume * torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64).reshape(3, 1, 1, 1, 1)
    loss = functools.partial(losses.measurement_consistency, operator=lambda v: v, scale_invariant=True)
    assert float(loss(volume, measured, dim=-3)) < 1e-28
    assert float(loss(volume, measured, dim=-5)) > 0.01
    with pytest.raises(ShapeError, match="dim="):
        loss(volume, measured)


def test_an_operator_of_the_library_learns_a_volume():
    """Descent along the gradient of `A = FK`'s adjoint, which is a volume of a measured wavefield; its tables move."""
    scan = Scan.grid(Wall.plane(1.0, 1.0), (4, 4), kind="confocal")
    fk = FK(scan, time_axis=TimeAxis(0.0, 0.1, 8), dtype=torch.float64)
    loss = losses.MeasurementConsistency(fk, reduction="sum")
    assert any(module is fk for module in loss.modules())
    # it has no tensors but those
    assert {name.partition(".")[0] for name, _ in loss.named_buffers()} == {"operator"}
    assert set(loss.state_dict()) == {f"operator.{name}" for name in fk.state_dict()}
    truth = torch.complex(draw(1, 8, 4, 4), draw(1, 8, 4, 4, seed=1))
    measured = fk(truth)
    volume = torch.zeros_like(truth, requires_grad=True)
    loss(volume, measured).backward()
    torch.testing.assert_close(volume.grad, -2 * fk.adjoint(measured))
    assert float(loss(truth, measured)) == 0


def test_says_what_the_operator_did_not_make():
    with pytest.raises(ShapeError, match=r"measurement's shape \(1, 4, 3, 3\)"):
        losses.measurement_consistency(draw(1, 4, 3, 3), draw(1, 4, 3, 3), lambda v: v[..., :-1])
    with pytest.raises(ShapeError, match="dimension 4"):
        losses.measurement_consistency(draw(1, 4, 3, 3), draw(1, 4, 3, 3), lambda v: v, scale_invariant=True, dim=4)


# ------------------------------------------------------------------------------------------------------------- compare

PAIRS = [case for case in CASES if case.pair and case.target_shape is None and case.second is None]


@together("case", PAIRS)
def test_compares_by_every_module_of_the_room(case):
    """As by the function; the module is a part of this one, and its `reduction` is the same."""
    x, y = case.tensors()
    mask = torch.rand(y.shape, generator=torch.Generator().manual_seed(9)) < 0.6
    wanted = case(2 * x, y, mask, "none")
    module = case.module(**case.options, reduction="none")
    for compare in (module, functools.partial(case.function, **case.options)):
        loss = losses.MeasurementConsistency(lambda v: 2 * v, compare, reduction="none")
        torch.testing.assert_close(loss(x, y, mask), wanted, rtol=0, atol=0)
        assert isinstance(compare, functools.partial) or compare in loss.modules()
    with pytest.raises(ArgumentError, match="reduction 'sum'"):
        losses.MeasurementConsistency(lambda v: v, module, reduction="sum")(x, y)
