"""Depth maps and quantities that repeat, by closed forms."""

import functools
import math
from types import SimpleNamespace

import pytest
import torch

from torchtransient import metrics, stokes
from torchtransient.errors import ArgumentError, ShapeError, UnitError

TRUTH = torch.tensor([[1.0, 2.0, 4.0], [8.0, math.nan, math.inf]])
GUESS = torch.tensor([[1.5, 2.0, 3.0], [8.0, 99.0, math.nan]])


def test_depths_by_hand():
    found = {
        "mae": metrics.depth_mae(GUESS, TRUTH),
        "rmse": metrics.depth_rmse(GUESS, TRUTH),
        "bias": metrics.depth_bias(GUESS, TRUTH),
        "abs_rel": metrics.depth_abs_rel(GUESS, TRUTH),
        "1.25": metrics.depth_delta(GUESS, TRUTH),
        "1.4": metrics.depth_delta(GUESS, TRUTH, threshold=1.4),
        "1.6": metrics.depth_delta(GUESS, TRUTH, threshold=1.6),
        "gross": metrics.depth_gross_errors(GUESS, TRUTH, beyond_m=0.5),
        "median": metrics.depth_median_error(GUESS, TRUTH),
    }
    wanted = {
        "mae": 1.5 / 4, "rmse": math.sqrt(1.25 / 4), "bias": -0.5 / 4, "abs_rel": 0.75 / 4, "1.25": 0.5, "1.4": 0.75,
        "1.6": 1.0, "gross": 0.25, "median": 0.0,
    }  # fmt: skip
    assert {name: float(value) for name, value in found.items()} == pytest.approx(wanted, rel=1e-6)
    assert metrics.depth_mae(GUESS, TRUTH, reduction="none").isnan().sum() == 2


def test_relative_errors_need_a_target_above_zero():
    x, y = torch.tensor([[1.0, -1.0, 0.0, 2.0]]), torch.tensor([[0.0, 1.0, 2.0, -2.0]])
    assert float(metrics.depth_delta(x, y)) == 0.0
    assert float(metrics.depth_abs_rel(x, y)) == pytest.approx(1.5)
    assert float(metrics.depth_mae(x, y)) == pytest.approx(9 / 4)


def test_small_errors_of_far_depths_and_many_pixels():
    """Squares of 1e-30 m and sums of 1e6 pixels keep their digits."""
    assert float(metrics.depth_rmse(torch.full((3, 3), 1e-30), torch.zeros(3, 3))) == pytest.approx(1e-30)
    x = torch.full((1000, 1000), 0.1)
    assert float(metrics.depth_mae(x, torch.zeros_like(x))) == pytest.approx(float(x[0, 0]), rel=1e-7)


# ------------------------------------------------------------------------------------------------------------- phases


@pytest.mark.parametrize("turns", [-1000, 0, 3])
def test_turns_do_not_count(turns):
    x = torch.linspace(-3, 3, 12, dtype=torch.float64).view(3, 4)
    shifted = x + turns * 2 * math.pi + 0.3
    assert float(metrics.phase_mae(shifted, x)) == pytest.approx(0.3, abs=1e-9)
    assert float(metrics.phase_rmse(x, shifted)) == pytest.approx(0.3, abs=1e-9)
    assert float(metrics.phase_bias(x, shifted)) == pytest.approx(-0.3, abs=1e-9)
    torch.testing.assert_close(metrics.wrapped_difference(shifted, x), torch.full_like(x, 0.3), atol=1e-9, rtol=0)


def test_the_mean_goes_across_the_jump():
    x, y = torch.tensor([3.0, -3.0 + 0.2]), torch.tensor([-3.2, 3.2])
    # 6.2 and -6.0 are -0.083 and 0.283 round the circle
    assert float(metrics.phase_bias(x, y)) == pytest.approx((6.2 - 6.0) / 2, abs=1e-6)
    x, y = torch.tensor([math.pi - 0.1, math.pi + 0.3]), torch.zeros(2)
    assert float(metrics.phase_bias(x, y)) == pytest.approx(0.1 - math.pi, abs=1e-6)
    assert abs(float(metrics.phase_bias(x, y, period=10.0)) - (math.pi + 0.1)) < 1e-5


def test_phasors_are_compared_by_phase():
    x = torch.polar(torch.tensor([1e-30, 2.0, 3.0, 4.0]), torch.tensor([3.0, 0.1, 0.2, 0.0]))
    y = torch.polar(torch.tensor([1e30, 1.0, 0.0, 1.0]), torch.tensor([-3.0, 0.0, 1.0, 0.0]))
    wrapped = 2 * math.pi - 6.0
    assert float(metrics.phase_mae(x, y)) == pytest.approx((wrapped + 0.1) / 3, rel=1e-5)
    assert float(metrics.phase_mae(x, y, weight=torch.tensor([0.0, 3.0, 1.0, 1.0]))) == pytest.approx(0.075, rel=1e-5)
    as_part = metrics.phase_mae(x, y, period=1.0)
    assert float(as_part) == pytest.approx((wrapped + 0.1) / 3 / (2 * math.pi), rel=1e-5)
    rendered = SimpleNamespace(phasor=x, transient=None, steady=None)
    assert float(metrics.phase_rmse(rendered, y)) == float(metrics.phase_rmse(x, y))
    with pytest.raises(UnitError, match="phasors other than zero"):
        metrics.phase_mae(y, x)
    with pytest.raises(UnitError, match=r"torch\.angle"):
        metrics.phase_mae(x, y.real)


# ------------------------------------------------------------------------------------------------------- polarization


def light(degree, angle, power=2.0):
    """(4, 1, 1, N) linear light of degrees and angles (N,)."""
    parts = [torch.ones_like(degree), degree * torch.cos(2 * angle), degree * torch.sin(2 * angle), 0 * degree]
    return power * torch.stack(parts)[:, None, None]


def test_angles_modulo_half_a_turn():
    degree = torch.tensor([0.1, 0.9])
    truth, found = torch.tensor([1.5, 0.0]), torch.tensor([-1.5, 0.2])
    x, y = light(torch.full_like(degree, 0.5), found), light(degree, truth)
    short = math.pi - 3.0
    assert float(metrics.aolp_mae(x, y)) == pytest.approx(0.1 * short + 0.9 * 0.2, rel=1e-5)
    assert float(metrics.phase_mae(found, truth, period=math.pi)) == pytest.approx((short + 0.2) / 2, rel=1e-5)
    assert float(metrics.dop_mae(x, y)) == pytest.approx(0.4, rel=1e-5)
    assert float(metrics.dop_rmse(x, y, part="linear")) == pytest.approx(0.4, rel=1e-5)
    assert float(metrics.dop_mae(x, y, part="circular")) == 0.0
    assert float(metrics.aolp_mae(x, y, floor=1.0)) == pytest.approx(0.2, rel=1e-5)
    # the frame turns both
    turned = [stokes.rotate_frame(one, 0.7, 0) for one in (x, y)]
    assert float(metrics.aolp_mae(*turned)) == pytest.approx(float(metrics.aolp_mae(x, y)), rel=1e-4)


def test_dark_and_unpolarized_light():
    degree, angle = torch.tensor([0.5, 0.5]), torch.zeros(2)
    y = light(degree, angle)
    y[..., 0] = 0
    x = light(degree, angle + 0.1)
    x[..., 0] = 7
    assert float(metrics.aolp_mae(x, y)) == pytest.approx(0.1, rel=1e-5)
    assert float(metrics.dop_mae(x, y)) == pytest.approx(0.0, abs=1e-6)
    with pytest.raises(UnitError, match="an input with linear polarization"):
        metrics.aolp_mae(light(0 * degree, angle), y)
    with pytest.raises(UnitError, match="an input with light"):
        metrics.dop_mae(0 * x, y)
    with pytest.raises(ShapeError, match="four Stokes components"):
        metrics.dop_mae(x[:3], y[:3])
    with pytest.raises(ArgumentError, match="part"):
        metrics.dop_mae(x, y, part="all")
    assert float(metrics.aolp_mae(SimpleNamespace(steady=x), SimpleNamespace(steady=x))) == 0.0
    four = SimpleNamespace(steady=x.movedim(-1, 1).expand(4, 2, 1, 1), polarized=False)
    with pytest.raises(ShapeError, match="polarized variant"):
        metrics.dop_mae(four, four)


@pytest.mark.parametrize("reduction", ["mean", "item", "none"])
@pytest.mark.parametrize("name", ["depth_rmse", "phase_rmse", "dop_rmse"])
def test_roots_have_a_slope_where_nothing_is_wrong(name, reduction):
    """Zero, that of a lowest point, and elsewhere that of finite differences."""
    x = torch.rand(2, 4, 1, 2, 3, dtype=torch.float64) + 0.5
    y = x.clone()
    y[1] += 0.05 * torch.rand_like(y[1])
    found = (torch.complex(x, x / 2), torch.complex(y, y.square())) if name == "phase_rmse" else (x, y)
    found[1][0] = found[0][0]
    guess = found[0].clone().requires_grad_()
    f = functools.partial(getattr(metrics, name), target=found[1], reduction=reduction)
    f(guess).sum().backward()
    assert (guess.grad[0] == 0).all() and torch.isfinite(torch.view_as_real(guess.grad + 0j)).all()
    along, step = torch.zeros_like(found[0]), 1e-6
    along[1] = torch.rand(4, 1, 2, 3)
    across = (f(found[0] + step * along) - f(found[0] - step * along)).sum() / (2 * step)
    torch.testing.assert_close((guess.grad.conj() * along).sum().real, across, rtol=1e-5, atol=1e-8)


def test_median_of_batches():
    x, y = torch.rand(3, 4, 5), torch.rand(3, 4, 5)
    mask = torch.rand(3, 4, 5) > 0.4
    mask[2] = False
    each = torch.func.vmap(lambda x, y, mask: metrics.depth_median_error(x, y, mask=mask))(x, y, mask)
    for found, a, b, counts in zip(each, x, y, mask, strict=True):
        expected = (a - b).abs()[counts].median() if counts.any() else torch.tensor(torch.nan)
        torch.testing.assert_close(found, expected, equal_nan=True)
    assert torch.isnan(metrics.depth_median_error(x[:0], y[:0]))


def test_a_floor_of_polarization_has_to_be_exceeded():
    """Light as dim as the floor does not count."""
    stokes = torch.tensor([[0.5, 1.0], [0.5, 0.0], [0.0, 0.0], [0.0, 0.0]]).reshape(4, 1, 1, 2)
    other = torch.zeros(4, 1, 1, 2)
    other[0] = stokes[0]
    each = metrics.dop_mae(other, stokes, floor=0.5, reduction="none")
    assert each.isnan().flatten().tolist() == [True, False]
    each = metrics.dop_mae(other, stokes, floor=0.499, reduction="none")
    assert each.flatten().tolist() == [1.0, 0.0]
    # nor does light of fewer digits than numbers have, whatever the floor
    tiny = torch.finfo(torch.float32).tiny
    for metric in (metrics.dop_mae, metrics.aolp_mae):
        faint = stokes.clone()
        faint[:2, ..., 0] = tiny
        each = metric(faint, faint, floor=0.0, reduction="none")
        assert each.isnan().flatten().tolist()[0]
        faint[:2, ..., 0] = 4 * tiny
        assert metric(faint, faint, floor=0.0, reduction="none").flatten().tolist()[0] == 0.0
