"""Items of a batch that are dark, or of other levels: finite in every loss, by themselves, and led out of the dark."""

from __future__ import annotations

import functools
import itertools
import math

import pytest
import torch

from support.sweeps import together
from torchtransient import losses
from torchtransient.errors import ShapeError

CYCLES = 400
# (model, counts): without a floor that is given
WITHOUT_FLOOR = {
    "poisson_nll": losses.poisson_nll,
    "first_photon_nll": functools.partial(losses.first_photon_nll, cycles=CYCLES),
    "first_photon_nll, dead time": functools.partial(losses.first_photon_nll, cycles=CYCLES, dead_bins=2.5),
    "free_running_nll": functools.partial(losses.free_running_nll, periods=CYCLES, dead_bins=2.5),
    "multiscale_loss": functools.partial(losses.multiscale_loss, compare=losses.poisson_nll),
    "measurement_consistency": functools.partial(
        losses.measurement_consistency, operator=lambda v: 1.0 * v, compare=losses.poisson_nll
    ),
}
own = pytest.mark.parametrize("name, loss", WITHOUT_FLOOR.items(), ids=WITHOUT_FLOOR.keys())
# Of the mean of the rates per cycle; the others take mean counts.
PER_CYCLE = ("first_photon_nll", "first_photon_nll, dead time", "free_running_nll")


def items(x, first):
    """A batch of two, the first one times a level."""
    return x * torch.tensor([first, 1.0], dtype=x.dtype).reshape(2, *[1] * (x.ndim - 1))


def slope_of(loss, x, y, **more):
    leaf = x.detach().clone().requires_grad_()
    value = loss(leaf, y, **more)
    (slope,) = torch.autograd.grad(value.sum(), leaf)
    return value.detach(), slope


@own
@together("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
@together("count", [0, 1, 50])
def test_a_model_without_light_has_a_slope(name, loss, dtype, count):
    """Every number of counts, in every precision: towards light where there are counts, to none where there are none.

    The tangent at 1e-9 of the counts of a bin: slopes of a sum are at most 1e9 (of float16, whose numbers end at 65504,
    3e4; of rates per cycle, which are as many times more, and of many scales, the gradient is looked at before it is
    given in that). What Adam holds, the square, is a number of float32.
    """
    x, y = torch.zeros(2, 1, 8, 2, 2, dtype=dtype), torch.full((2, 1, 8, 2, 2), count)
    assert bool(torch.isfinite(loss(x, y)))
    beyond = dtype == torch.float16 and name in (*PER_CYCLE, "multiscale_loss")
    value, slope = slope_of(loss, x.float() if beyond else x, y)
    assert bool(torch.isfinite(value)) and bool((slope < 0).all() if count else (slope > 0).all())
    assert float(value) < 50 * 25 * CYCLES
    most = 1.01e9 * (CYCLES if name in PER_CYCLE else 1) / y.numel()
    assert float(slope.abs().max()) <= most and bool(torch.isfinite(slope.float().square()).all())


@own
def test_the_loss_falls_all_the_way_out_of_the_dark(name, loss):
    """From no light to the right one no level is dearer than a darker one."""
    y = torch.full((1, 1, 8, 2, 2), 6.0, dtype=torch.float64)
    levels = [0.0, *(10.0**k for k in range(-40, 1))]
    scale = 6.0 / CYCLES if name in PER_CYCLE else 6.0
    found = [float(loss(torch.full_like(y, scale * level), y)) for level in levels]
    assert all(a >= b - 1e-12 * abs(a) for a, b in itertools.pairwise(found)), found
    assert found[0] > found[-1] + 1


def test_the_floor_of_a_dark_model():
    """A thousandth of its own mean; of a tenth of what was measured where that is more; of each item."""
    model = items(torch.rand(2, 1, 8, 2, 2, generator=torch.Generator().manual_seed(0)), 0.0)
    measured = torch.full_like(model, 3.0)
    floor = losses.relative_floor(model, measured=measured)
    assert floor.flatten().tolist() == pytest.approx([1e-3 * 0.1 * 3, 1e-3 * float(model[1].mean())])
    torch.testing.assert_close(floor[:1], losses.relative_floor(model[:1], measured=measured[:1]))
    assert float(losses.relative_floor(model)[0]) == torch.finfo(torch.float32).tiny
    mask = torch.zeros(8, 1, 1, dtype=torch.bool)
    mask[:4] = True
    measured[0, :, 4:] = math.nan
    masked = losses.relative_floor(model, mask=mask, measured=measured)
    assert masked.flatten().tolist() == pytest.approx([3e-4, 1e-3 * float(model[1, :, :4].mean())])
    with pytest.raises(ShapeError, match="relative_floor: expected model and measured of one shape"):
        losses.relative_floor(model, measured=measured[:1])
