"""Wasserstein distances and running sums over time: shifts in metres, missing light, empty pixels."""

import itertools
import math

import pytest
import torch
from scipy import stats

from torchtransient import losses

WIDTH = 0.03


def record(*values):
    return torch.tensor(values, dtype=torch.float64).reshape(1, -1, 1, 1)


def delta(k, height=1.0, bins=40):
    return record(*(height if i == k else 0.0 for i in range(bins)))


def draw(bins, seed):
    return torch.rand(1, bins, 2, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize(("shift", "height"), [(0, 1.0), (1, 1e-20), (39, 3e8)])
def test_a_shift_in_metres(shift, height):
    found = losses.wasserstein_loss(delta(0), delta(shift, height), WIDTH)
    assert float(found) == pytest.approx(WIDTH * shift, rel=1e-12)


def test_agrees_with_scipy():
    a, b = draw(25, 0), draw(25, 1) ** 4
    found = losses.wasserstein_loss(a, b, WIDTH, reduction="none")
    assert found.shape == (1, 2, 3)
    places = (torch.arange(25, dtype=torch.float64) * WIDTH).numpy()
    for y, x in itertools.product(range(2), range(3)):
        wanted = stats.wasserstein_distance(places, places, a[0, :, y, x].numpy(), b[0, :, y, x].numpy())
        assert float(found[0, y, x]) == pytest.approx(wanted, rel=1e-10)


def test_the_gradient_sees_pulses_that_do_not_overlap():
    """Where the squared difference is blind: light that is moved later by one bin brings the loss down by its share."""
    x = delta(5, bins=20).requires_grad_()
    losses.wasserstein_loss(x, delta(15, bins=20), WIDTH).backward()
    slope = x.grad[0, :, 0, 0]
    torch.testing.assert_close(slope[5:16].diff(), torch.full((10,), -WIDTH, dtype=torch.float64))


def test_missing_light_costs_its_length():
    """`m W1 + L |difference of masses|`, by hand: 2 units move 3 bins, 1 is missing."""
    a, b = delta(4, 2.0), delta(7, 3.0)
    found = losses.wasserstein_loss(a, b, WIDTH, creation_cost_opl=0.4)
    assert float(found) == pytest.approx(2 * 3 * WIDTH + 0.4, rel=1e-12)
    assert float(losses.wasserstein_loss(a, 0 * a, WIDTH, creation_cost_opl=0.4)) == pytest.approx(0.8, rel=1e-12)
    # equal masses: the balanced distance times the mass
    c, d = draw(25, 0), draw(25, 1)
    c, d = 3 * c / c.sum(1), 3 * d / d.sum(1)
    found = losses.wasserstein_loss(c, d, WIDTH, creation_cost_opl=0.4)
    torch.testing.assert_close(found, 3 * losses.wasserstein_loss(c, d, WIDTH))


def test_unbalanced_gradient_of_an_empty_pixel():
    """Light anywhere is better than none: each bin by the cost of what is missing."""
    x = torch.zeros(1, 10, 1, 1, requires_grad=True)
    losses.wasserstein_loss(x, delta(3, 2.0, bins=10).float(), WIDTH, creation_cost_opl=0.4).backward()
    torch.testing.assert_close(x.grad, torch.full_like(x, -0.4))


def test_dim_pixels_fade_into_even_light():
    """Continuous at the floor, and linear below it."""
    a, b = delta(3, bins=10), delta(6, bins=10)
    values = [float(losses.wasserstein_loss(m * a, b, WIDTH, floor=0.5)) for m in (0.0, 0.25, 0.5 - 1e-9, 0.5, 2.0)]
    assert values[2] == pytest.approx(values[3], rel=1e-7)
    assert values[3] == values[4] == pytest.approx(3 * WIDTH)
    # 6 bins early and 3 late at most: 2.7 on average; half of the light is 3 early
    assert values[0] == pytest.approx(2.7 * WIDTH)
    assert values[1] == pytest.approx((3 + 2.7) / 2 * WIDTH)


def test_single_precision_over_a_long_record():
    bins = 16384
    a, b = (torch.rand(1, bins, 1, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(s)) for s in (0, 1))
    wanted = losses.wasserstein_loss(a, b, WIDTH)
    # a cumulative sum of n roundings of 6e-8 of at most one wanders by sqrt(n) of them
    found = losses.wasserstein_loss(a.float(), b.float(), WIDTH)
    assert abs(float(found) - float(wanted)) < 6e-8 * bins**0.5 * bins * WIDTH


# --------------------------------------------------------------------------------------------------------- running sums


def test_the_area_between_running_sums():
    """Light that is late costs its delay, light that is missing its way to the end of the window."""
    a, b = torch.zeros(1, 1, 10, 1, 1), torch.zeros(1, 1, 10, 1, 1)
    a[0, 0, 2], b[0, 0, 5] = 3.0, 3.0
    assert float(losses.cumulative_loss(a, b, 0.02)) == pytest.approx(3 * 3 * 0.02)
    assert float(losses.cumulative_loss(a, 0 * b, 0.02)) == pytest.approx(3 * 8 * 0.02)
    assert float(losses.cumulative_loss(a, 2 * a, 0.02)) == pytest.approx(3 * 8 * 0.02)
    assert float(losses.cumulative_loss(a, b, 0.02, per_root_count=True)) == pytest.approx(9 * 0.02 / math.sqrt(3))
    assert float(losses.cumulative_loss(a, 0 * b, 0.02, per_root_count=True)) == pytest.approx(24 * 0.02)
    # of equal sums the Wasserstein distance times the light
    torch.testing.assert_close(losses.cumulative_loss(a, b, 0.02), 3 * losses.wasserstein_loss(a, b, 0.02))


def test_running_sums_pull_from_any_distance():
    """The slope of a pulse that is 90 bins off is that of one at 10 bins, and that of a squared difference none."""
    t = torch.arange(100, dtype=torch.float64)

    def pulse(at):
        return torch.exp(-0.5 * (t - at) ** 2).reshape(1, 100, 1, 1)

    for offset in (10.0, 40.0, 85.0):
        at = torch.tensor(5.0 + offset, dtype=torch.float64, requires_grad=True)
        (pull,) = torch.autograd.grad(losses.cumulative_loss(pulse(at), pulse(5.0), 0.02), at)
        assert float(pull) == pytest.approx(0.02 * math.sqrt(2 * math.pi), rel=1e-6)
        (none,) = torch.autograd.grad(losses.squared_loss(pulse(at), pulse(5.0), reduction="sum"), at)
        assert abs(float(none)) < 1e-8
