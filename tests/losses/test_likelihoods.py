"""Likelihoods against torch.distributions, photons one by one, and their own minima; values and gradients at zero."""

import inspect
import warnings

import pytest
import torch

from support import loss_cases
from torchtransient import losses
from torchtransient.errors import GradientError, TorchTransientWarning, UnitError
from torchtransient.losses import (
    armed_periods,
    first_photon_nll,
    free_running_nll,
    poisson_nll,
    read_noise_nll,
)
from torchtransient.sensing import FreeRunningSPAD, SynchronousSPAD, coates

BINS = 20
CYCLES = 400


def rates(total=1.5, bins=BINS):
    t = torch.arange(bins, dtype=torch.float64)
    shape = 0.3 / bins + torch.exp(-0.5 * ((t - 0.6 * bins) / 2) ** 2) / 5
    return (total * shape / shape.sum()).view(1, -1, 1, 1)


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


# name, loss(rate, counts), a draw of counts at `rate`
CASES = {
    "poisson": (
        lambda r, n, **k: poisson_nll(100 * r, n, **k),
        lambda r, g: torch.poisson(100 * r, generator=g),
    ),
    "first photon": (
        lambda r, n, **k: first_photon_nll(r, n, CYCLES, **k),
        lambda r, g: SynchronousSPAD(CYCLES).sample(r, g),
    ),
    "first photon with dead time": (
        lambda r, n, **k: first_photon_nll(r, n, CYCLES, dead_bins=4.5, **k),
        lambda r, g: SynchronousSPAD(CYCLES, dead_time_s=4.5e-10, bin_width_s=1e-10).sample(r, g),
    ),
    "read noise": (
        lambda r, n, **k: read_noise_nll(100 * r, n, 5.0, **{a: b for a, b in k.items() if a != "floor"}),
        lambda r, g: 100 * r + (25 + 100 * r).sqrt() * torch.randn(r.shape, dtype=r.dtype, generator=g),
    ),
}
each = pytest.mark.parametrize("loss, draw", CASES.values(), ids=CASES.keys())


@each
def test_the_score_has_mean_zero_at_the_truth(loss, draw):
    repeats = 4000
    x = rates().unsqueeze(0).expand(repeats, 1, BINS, 1, 1).clone().requires_grad_()
    n = draw(x.detach(), seeded(1))
    loss(x, n, reduction="sum").backward()
    z = x.grad.mean(0) / (x.grad.std(0) / repeats**0.5)
    assert float(z.abs().max()) < 4.5


def test_poisson_value():
    n = torch.tensor([0.0, 3, 0, 12], dtype=torch.float64)
    m = torch.tensor([0.5, 2, 1, 10], dtype=torch.float64)
    wanted = -torch.distributions.Poisson(m).log_prob(n)
    torch.testing.assert_close(poisson_nll(m, n, constant=True, reduction="none"), wanted)
    assert float(poisson_nll(torch.tensor([0.0]), torch.tensor([3.0]), floor=0)) == float("inf")
    with pytest.raises(UnitError, match="negative"):
        poisson_nll(-m, n)


@pytest.mark.parametrize("dead_bins", [None, 4.5])
def test_first_photon_is_least_at_coates(dead_bins):
    spad = SynchronousSPAD(CYCLES, dead_time_s=None if dead_bins is None else dead_bins * 1e-10, bin_width_s=1e-10)
    n = spad.sample(rates(2.0), seeded(3))
    best = coates(n, CYCLES, dead_bins).rate
    least = first_photon_nll(best, n, CYCLES, dead_bins=dead_bins, reduction="none")
    for factor in (0.9, 1.1):
        other = first_photon_nll(best * factor, n, CYCLES, dead_bins=dead_bins, reduction="none")
        assert bool((other >= least - 1e-9).all())


@pytest.mark.parametrize("dead_bins", [7.5, 33.2])
def test_free_running(dead_bins):
    """At the expectation, the best rate is the true one; on samples the score vanishes on average."""
    spad = FreeRunningSPAD(50_000, dead_bins * 1e-10, bin_width_s=1e-10)
    n = spad(rates())
    best = n / armed_periods(n, 50_000, dead_bins)
    r = best.clone().requires_grad_()
    free_running_nll(r, n, periods=50_000, dead_bins=dead_bins, reduction="sum").backward()
    assert float(r.grad.abs().max()) < 1e-9 * 50_000
    # where in its bin a detection lies is not known: an error of second order
    errors = []
    for total in (1.5, 0.75):
        found = spad(rates(total))
        again = found / armed_periods(found, 50_000, dead_bins)
        errors.append(float((again / rates(total) - 1).abs().max()))
        assert errors[-1] < float(found.max()) / 50_000 * float(rates(total).max())
    assert errors[1] < errors[0] / 2.5
    with pytest.raises(UnitError, match="fit into"):
        free_running_nll(rates(), n, periods=5_000, dead_bins=dead_bins)


def test_read_noise_value():
    """Of means below zero, of a record less its background, the read noise alone is left."""
    y = torch.tensor([3.0, -2.0, 40.0, 1.0], dtype=torch.float64)
    m = torch.tensor([1.0, 0.0, 50.0, -3.0], dtype=torch.float64)
    wanted = -torch.distributions.Normal(m, (4 + m.clamp_min(0)).sqrt()).log_prob(y)
    torch.testing.assert_close(read_noise_nll(m, y, 2.0, reduction="none"), wanted)
    plain = -torch.distributions.Normal(m, torch.full_like(m, 2.0)).log_prob(y)
    torch.testing.assert_close(read_noise_nll(m, y, 2.0, shot_noise=False, reduction="none"), plain)


def test_masked_bins_still_take_cycles():
    """The window of a first-photon histogram: what came before it stays detected."""
    r, mask = rates(3.0), torch.zeros(BINS, 1, 1, dtype=torch.bool)
    mask[10:] = True
    n = SynchronousSPAD(CYCLES).sample(r, seeded(8))
    each = first_photon_nll(r, n, CYCLES, reduction="none")
    torch.testing.assert_close(first_photon_nll(r, n, CYCLES, mask=mask), each[:, 10:].mean())
    alone = first_photon_nll(r[:, 10:], n[:, 10:], CYCLES)
    assert abs(float(alone) - float(each[:, 10:].mean())) > 0.1


SWAPPED = {
    "poisson_nll": poisson_nll,
    "first_photon_nll": lambda r, n: first_photon_nll(r, n, 10**4),
    "free_running_nll": lambda r, n: free_running_nll(r, n, periods=10**4, dead_bins=2.5),
    "read_noise_nll": lambda r, n: read_noise_nll(r, n, 2.0),
}


@pytest.mark.parametrize("name", SWAPPED)
def test_counts_in_the_place_of_the_prediction_are_told(name):
    """By their dtype, by the gradient of what stands in their place, and, with neither, by their numbers."""
    loss = SWAPPED[name]
    r = rates(bins=64)
    n = torch.poisson(50 * r, generator=seeded(7))
    leaf = r.clone().requires_grad_()
    with pytest.raises(UnitError, match=f"^{name}: expected a floating prediction first"):
        loss(n.long(), r)
    with pytest.raises(GradientError, match=f"^{name}: expected the prediction first"):
        loss(n, leaf)
    with pytest.warns(TorchTransientWarning, match=f"^{name}: the first argument holds counts"):
        loss(n, r)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        loss(leaf, n), loss(r, n.long()), loss(leaf.detach(), n > 0), loss(n, n.flip(1)), loss(leaf, leaf)
        loss(torch.full_like(n, 2.0), r)
        loss(torch.where(n % 2 == 0, r, 0.0), n)  # whole numbers here and there
        loss(n[:, 30:40], r[:, 30:40])  # an example made by hand may be of whole numbers


@pytest.mark.parametrize("name", SWAPPED)
def test_draws_in_the_place_of_their_own_mean_are_told(name):
    """Both have the gradient of what a chain has learnt: straight_through gives its counts that of the mean."""
    loss = SWAPPED[name]
    gain = torch.tensor(1.0, requires_grad=True)
    r = rates(bins=64) * gain
    chain = SynchronousSPAD(10**4, grad="straight_through")
    n = chain(r, generator=seeded(7))
    assert n.requires_grad and r.requires_grad
    with pytest.raises(GradientError, match=f"^{name}: expected the prediction first, .*counts"):
        loss(n, r)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        loss(r, n).backward()
    assert bool(torch.isfinite(gain.grad))


# --------------------------------------------------------------------------------- one rule for what counts may be

_COUNTS = [case for case in loss_cases.CASES if case.draw_target is not None]
COUNTED = [case for case in _COUNTS if case.function is not losses.multiscale_loss]
counted = pytest.mark.parametrize("case", COUNTED, ids=str)


@counted
def test_counts_have_gradients(case):
    """Of a sensor that is learnt, say. Bins without counts have one too, and counts take cycles from later bins."""
    x, y = case.tensors()
    x, y = x.clone().requires_grad_(), y.clone().requires_grad_()
    assert bool((y == 0).any())
    (found,) = torch.autograd.grad(case(x, y, reduction="sum"), y)
    step = 1e-6 * torch.rand(y.shape, generator=seeded(), dtype=torch.float64)
    with torch.no_grad():
        wanted = (4 * case(x, y + step, reduction="sum") - case(x, y + 2 * step, reduction="sum")
                  - 3 * case(x, y, reduction="sum")) / 2  # fmt: skip
    assert float((found * step).sum()) == pytest.approx(float(wanted), rel=1e-4)


@counted
def test_counts_below_zero_enter_the_same_formula(case):
    """Poisson, first photons and free-running detectors are linear in the counts, so the mean over +n and -n is that of
    none; read noise is a normal distribution anyway. Under masks, too. The constant has no such formula.
    """
    x, y = case.tensors()
    y = 0.3 * y
    mask = torch.rand(y.shape, generator=torch.Generator().manual_seed(9)) < 0.6
    for given in (None, mask):
        up, down, none = (case(x, sign * y, given, "none") for sign in (1, -1, 0))
        if case.function is losses.read_noise_nll:
            none = none + (y**2 / (2 * (x + 0.7**2)) if given is None else mask * y**2 / (2 * (x + 0.7**2)))
        torch.testing.assert_close(up + down, 2 * none)
    if "constant" in inspect.signature(case.function).parameters and case.function is not losses.read_noise_nll:
        with pytest.raises(UnitError, match=f"{case.function.__name__}: expected counts >= 0 with constant=True"):
            case(x, -y, constant=True)
        hidden = torch.where(mask.any(2, keepdim=True), y, -y)
        assert bool(torch.isfinite(case(x, hidden, mask.any(2, keepdim=True), constant=True)))


@counted
@pytest.mark.parametrize("whose", ["counts", "model"])
def test_nan_that_counts_is_nan(case, whose):
    """Where a mask leaves it out it has no part, but for the detectors that were dead after it."""
    x, y = case.tensors()
    broken = (x if whose == "model" else y).clone()
    broken[0, 0, 3, 1, 2] = float("nan")
    pair = (broken, y) if whose == "model" else (x, broken)
    assert bool(case(*pair).isnan())
    mask = torch.ones_like(y, dtype=torch.bool)
    mask[0, 0, 3, 1, 2] = False
    found = case(*pair, mask, "none")
    dead = whose == "counts" and any(name in case.options for name in ("cycles", "periods"))
    assert bool(found[0, 0, 4, 1, 2].isnan()) == dead
    elsewhere = torch.ones_like(mask)
    elsewhere[0, 0, :, 1, 2] = False
    for seen in (elsewhere, mask.all(2, keepdim=True)):
        found = case(*pair, seen.expand_as(mask), "none")
        assert bool(torch.isfinite(found).all())
        torch.testing.assert_close(found, case(x, y, seen.expand_as(mask), "none"), rtol=0, atol=0)
        leaf = pair[0].clone().requires_grad_()
        case(leaf, pair[1], seen.expand_as(mask)).backward()
        assert bool(torch.isfinite(leaf.grad).all())


@counted
def test_errors_of_values_say_who_was_called(case):
    x, y = case.tensors()
    if case.function is not losses.read_noise_nll:
        with pytest.raises(UnitError, match=f"^{case.function.__name__}: expected rates"):
            case(-x, y)
    if {"cycles", "periods"} & set(case.options):
        with pytest.raises(UnitError, match=f"^{case.function.__name__}: expected counts"):
            case(x, 1000 * y)


def test_histograms_of_detectors_that_run_free():
    """Of (2, 0, 1) in 10 periods, dead for 1.5 bins: the rest of the bin, the next, and a part of the one behind."""
    counts = torch.tensor([2.0, 0.0, 1.0], dtype=torch.float64).reshape(3, 1, 1)
    found = armed_periods(counts, 10, 1.5).flatten().tolist()
    y = (torch.arange(10_000, dtype=torch.float64) + 0.5) / 10_000
    wanted = [10.0] * 3
    for k, n in ((0, 2.0), (2, 1.0)):
        for ahead in range(4):
            shut = (torch.clamp(y + 1.5 - ahead, 0, 1) - torch.clamp(y - ahead, 0, 1)).mean().item()
            wanted[(k + ahead) % 3] -= n * shut
    assert found == pytest.approx(wanted, abs=1e-3)
