"""Likelihoods of weak light: unbiased at the Cramer-Rao bound, with a slope that leads out of the dark."""

import functools
import itertools
import math

import pytest
import torch

from support.sweeps import together
from torchtransient import losses
from torchtransient.errors import ShapeError
from torchtransient.sensing import SynchronousSPAD

BINS = 64
EACH = {"reduction": "none"}
SINGLE = pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def fitted(loss, start, *, steps=14):
    """The least of a loss of each item: `loss(parameters)` for parameters (items, P), convex or nearly so.

    Newton's method in the logarithms of the parameters, with the curvature by differences of its gradient, both as
    they come out of the precision that is asked for.
    """
    x = start.clone().log()
    for _ in range(steps):
        columns = []
        for k in range(x.shape[1] + 1):
            at = x.detach().clone()
            if k:
                at[:, k - 1] += 1e-2
            leaf = at.requires_grad_()
            columns.append(torch.autograd.grad(loss(leaf.exp()).sum(), leaf)[0].double())
        slope, curvature = columns[0], torch.stack([(c - columns[0]) / 1e-2 for c in columns[1:]], -1)
        curvature = 0.5 * (curvature + curvature.mT)
        # away from the least the curvature in logarithms may vanish: a step is bounded, and downhill
        values, vectors = torch.linalg.eigh(curvature)
        values = values.abs().clamp_min(1e-6 * values.abs().amax(-1, keepdim=True).clamp_min(1e-9))
        step = (vectors @ ((vectors.mT @ slope[..., None]) / values[..., None]))[..., 0]
        x = (x.double() - step.clamp(-1, 1)).to(x.dtype)
    return x.exp()


def pulse(position, sigma=1.5, bins=BINS):
    """Shares of a normal pulse, (..., T, 1, 1); exactly 0 far out in single precision."""
    edges = torch.arange(bins + 1, dtype=torch.float64)
    return (0.5 * torch.erf((edges - position) / (sigma * math.sqrt(2)))).diff().reshape(1, -1, 1, 1)


@pytest.mark.slow
def test_background_under_a_bright_peak():
    """0.2 counts a bin beside 2000 in a peak: a floor of 1e-3 of the mean bin, 0.03, took a seventh of them away.

    Signal and background together; the error of the mean of 2000 fits is their spread over its root.
    """
    items, truth, dtype = 2000, (2000.0, 0.2), torch.float32
    shares = pulse(20.3)
    mean = truth[0] * shares + truth[1]
    counts = torch.poisson(mean.expand(items, -1, -1, -1), generator=seeded(1)).to(dtype)

    def model(p):
        s, b = p[:, 0].reshape(-1, 1, 1, 1), p[:, 1].reshape(-1, 1, 1, 1)
        return s * shares.to(dtype) + b

    start = torch.tensor([[1000.0, 1.0]], dtype=dtype).expand(items, -1)
    found = fitted(lambda p: losses.poisson_nll(model(p), counts, reduction="none"), start).double()
    fisher = torch.stack([shares / mean * shares, shares / mean, shares / mean, 1 / mean]).sum((1, 2, 3, 4))
    bound = torch.linalg.inv(fisher.reshape(2, 2)).diagonal().sqrt()
    error = found.mean(0) - torch.tensor(truth, dtype=torch.float64)
    assert bool((error.abs() < 4 * bound / items**0.5).all()), error / bound * items**0.5
    assert bool((found.std(0) < 1.05 * bound).all()), found.std(0) / bound
    # what docs/losses.md says of a floor of 1e-3 of the mean bin
    floor = 1e-3 * float(mean.mean())
    biased = fitted(lambda p: losses.poisson_nll(model(p), counts, floor=floor, reduction="none"), start).double()
    assert float(biased[:, 1].mean()) / truth[1] - 1 == pytest.approx(-0.16, abs=0.01)


@pytest.mark.slow
def test_background_behind_a_strong_return_of_first_photons():
    """Light of 1e-3 a bin before and behind a return that stops nearly all cycles.

    The bound of one parameter is 1 over the root of the information, sum of armed / expm1(r) times dr^2.
    """
    items, cycles, weak, photons, dtype = 1500, 20_000, 1e-3, 20.0, torch.float32
    shares = pulse(40.2)
    rate = photons * shares + weak
    spad = SynchronousSPAD(cycles)
    counts = spad.sample(rate.expand(items, -1, -1, -1), seeded(2)).to(dtype)

    def model(p):
        return (photons * shares).to(dtype) + p.reshape(-1, 1, 1, 1)

    start = torch.full((items, 1), 1e-2, dtype=dtype)
    found = fitted(lambda p: losses.first_photon_nll(model(p), counts, cycles, reduction="none"), start).double()
    armed = cycles * torch.exp(rate - rate.cumsum(1))
    bound = float((armed / torch.expm1(rate)).sum()) ** -0.5
    assert abs(float(found.mean()) - weak) < 4 * bound / items**0.5
    assert float(found.std()) < 1.06 * bound
    floor = 1e-3 * float(rate.mean())
    biased = fitted(lambda p: losses.first_photon_nll(model(p), counts, cycles, floor=floor, **EACH), start)
    assert float(biased.double().mean()) / weak - 1 == pytest.approx(-0.31, abs=0.01)


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
NAMES = ("poisson_nll", *PER_CYCLE)
each = pytest.mark.parametrize(
    "loss, exposures", [(WITHOUT_FLOOR[name], CYCLES if name in PER_CYCLE else 1) for name in NAMES], ids=NAMES
)


@each
@SINGLE
def test_a_bin_without_counts_has_its_mean_as_value_and_one_as_slope(loss, exposures, dtype):
    m = torch.tensor([0.0, 1e-40, 1e-12, 0.3, 40.0], dtype=dtype).reshape(1, -1, 1, 1).requires_grad_()
    value = loss(m, torch.zeros_like(m), **EACH)
    (slope,) = torch.autograd.grad(value.sum(), m)
    torch.testing.assert_close(value.detach(), exposures * m.detach(), rtol=1e-6, atol=0)
    assert bool((slope == exposures).all())


@each
def test_the_tangent_in_the_dark(loss, exposures):
    """Continuous in value and slope where it begins, straight below, convex, and the formula above."""
    for n in (1.0, 7.0, 300.0):
        counts = torch.tensor([0.0, n, 0.0, 0.0, 0.0], dtype=torch.float64).reshape(1, -1, 1, 1)
        edge = 1e-9 * n / exposures

        def at(level, counts=counts):
            m = torch.full_like(counts, level, requires_grad=True)
            value = loss(m, counts, **EACH)[0, 1, 0, 0]
            return float(value.detach()), float(torch.autograd.grad(value, m)[0][0, 1, 0, 0])

        (below, slope_below), (above, slope_above) = at(edge * (1 - 1e-12)), at(edge * (1 + 1e-12))
        assert below == pytest.approx(above, rel=1e-9) and slope_below == pytest.approx(slope_above, rel=1e-8)
        found = [at(level) for level in (0.0, 1e-30, 0.3 * edge, 0.9 * edge, 3 * edge, 1e3 * edge, 1e8 * edge)]
        slopes = [slope for _, slope in found]
        assert slopes[0] == slopes[1] == pytest.approx(slopes[3], rel=1e-8)
        assert all(a <= b + 1e-9 * abs(a) for a, b in itertools.pairwise(slopes))
        assert found[0][0] - found[2][0] == pytest.approx(-0.3 * edge * slopes[0], rel=1e-6)
        # n (log m) of the formula, 1e8 times brighter: 8 log 10 less for each count, and 1 more at the tangent's end
        assert at(edge)[0] - at(1e3 * edge)[0] == pytest.approx(n * math.log(1e3), rel=1e-4)


@SINGLE
def test_first_photons_of_tiny_and_huge_rates(dtype):
    """log(1 - exp(-r)) against its series and its limit: what is nearly 0 to 1e-15."""
    r = torch.tensor([1e-8, 1e-4, 1.0, 30.0, 200.0, 5e3], dtype=dtype).reshape(-1, 1, 1, 1, 1).requires_grad_()
    counts = torch.full_like(r, 5.0).detach()
    # all cycles fire: nothing but the logarithm is left
    value = losses.first_photon_nll(r, counts, 5, dim=-3, reduction="none")
    (slope,) = torch.autograd.grad(value.sum(), r)
    exact = r.detach().double()
    wanted = torch.where(exact > 1, torch.exp(-exact) + 0.5 * torch.exp(-2 * exact), -torch.log(-torch.expm1(-exact)))
    torch.testing.assert_close(value.detach().double(), 5 * wanted, rtol=1e-5, atol=1e-15)
    torch.testing.assert_close(slope.double(), -5 / torch.expm1(exact), rtol=1e-5, atol=1e-15)


@pytest.mark.parametrize(
    "cycles, reduction, masked", [(40, "mean", False), (1000, "sum", True), (30_000, "sum", False)]
)
def test_slopes_of_half_precision_are_numbers_whatever_the_cycles(cycles, reduction, masked):
    """Slopes are counts over the level, times cycles: -inf of float16 from three cycles on, and of coarse bins."""
    n = torch.zeros(1, 8, 1, 2)
    n[0, 2], n[0, 6, 0, 0] = 5.0, 1.0
    free, first = losses.free_running_nll, functools.partial(losses.first_photon_nll, cycles=cycles)
    each = {
        "first": first,
        "dead time": functools.partial(first, dead_bins=2.5),
        "free": functools.partial(free, periods=cycles, dead_bins=2.5),
        "poisson": losses.poisson_nll,
        "first, coarse": functools.partial(losses.multiscale_loss, compare=first),
        "poisson, coarse": functools.partial(losses.multiscale_loss, compare=losses.poisson_nll),
    }
    mask = torch.tensor([1, 1, 1, 0, 1, 1, 1, 0]).bool().view(1, 8, 1, 1) if masked else None
    for name, loss in each.items():
        for rate in (0.0, 1e-7, 1e-3):
            leaf = torch.full(n.shape, rate, dtype=torch.float16, requires_grad=True)
            (slope,) = torch.autograd.grad(loss(leaf, n, mask=mask, reduction=reduction), leaf)
            assert bool(slope.isfinite().all()), name
            assert float(slope[0, 2, 0, 0]) < 0 or rate > 0, name


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
    leaf = (x.float() if beyond else x).requires_grad_()
    value = loss(leaf, y)
    (slope,) = torch.autograd.grad(value, leaf)
    assert bool(torch.isfinite(value.detach())) and bool((slope < 0).all() if count else (slope > 0).all())
    assert value.item() < 50 * 25 * CYCLES
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
    model = torch.rand(2, 1, 8, 2, 2, generator=torch.Generator().manual_seed(0))
    model[0] = 0.0
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
