"""Losses that are given to losses: none may take a model for a measurement, in whatever guise it comes."""

from __future__ import annotations

import functools
import inspect

import pytest
import torch

from support.sweeps import together
from torchtransient import losses
from torchtransient.errors import ArgumentError

TAKERS = {
    "multiscale_loss": lambda compare: losses.multiscale_loss(X, Y, compare),
    "MultiscaleLoss": lambda compare: losses.MultiscaleLoss(compare),
    "measurement_consistency": lambda compare: losses.measurement_consistency(X, Y, identity, compare=compare),
    "MeasurementConsistency": lambda compare: losses.MeasurementConsistency(identity, compare),
}
X, Y = torch.full((1, 1, 8, 2, 2), 2.0), torch.full((1, 1, 8, 2, 2), 3.0)


def identity(volume):
    return volume


def counts_first(counts, mean, *, floor=None, mask, reduction):
    return losses.poisson_nll(mean, counts, floor=floor, mask=mask, reduction=reduction)


class Callable:
    def __call__(self, counts, mean, *, mask, reduction):
        return counts_first(counts, mean, mask=mask, reduction=reduction)


@functools.wraps(counts_first)
def wrapped(*arguments, **options):
    return counts_first(*arguments, **options)


BACKWARDS = {
    "counts_first": counts_first,
    "counts_first, floor": functools.partial(counts_first, floor=0.0),
    "counts_first, wrapped": wrapped,
    "counts_first, an object": Callable(),
    "first_photon_nll, cycles missing": losses.first_photon_nll,
    "first_photon_nll, model held": functools.partial(losses.first_photon_nll, X),
    "free_running_nll, model held": functools.partial(losses.free_running_nll, X, dead_bins=2.5),
    "two_render_loss": functools.partial(losses.two_render_loss, target=Y),
    "mesh_normal_consistency": losses.mesh_normal_consistency,
}
# (input, target): each likelihood, and each name of one.
FORWARDS = {
    "poisson_nll": losses.poisson_nll,
    "poisson_loss": losses.poisson_loss,
    "first_photon_nll": functools.partial(losses.first_photon_nll, cycles=400),
    "first_photon_loss": functools.partial(losses.first_photon_loss, cycles=400),
    "free_running_nll": functools.partial(losses.free_running_nll, periods=400, dead_bins=2.5),
    "read_noise_nll": functools.partial(losses.read_noise_nll, read_noise=1.0),
    "root_loss": losses.root_loss,
    "turned round": lambda x, y, *, mask, reduction: counts_first(y, x, floor=0.1, mask=mask, reduction=reduction),
}
MODULES = {
    "PoissonNLL": losses.PoissonNLL(),
    "FirstPhotonNLL": losses.FirstPhotonNLL(400),
    "FreeRunningNLL": losses.FreeRunningNLL(400, 2.5),
    "ReadNoiseNLL": losses.ReadNoiseNLL(1.0),
}


def test_every_likelihood_is_among_them():
    names = {name for name in vars(losses) if name.endswith(("nll", "NLL"))}
    assert names == {name for name in (*FORWARDS, *MODULES) if name.lower().endswith("nll")}
    for name in names:
        call = getattr(losses, name)
        taken = inspect.signature(call.forward if inspect.isclass(call) else call).parameters
        assert [*taken][:3] == ["self", "input", "target"] or [*taken][:2] == ["input", "target"]
    assert losses.poisson_loss is losses.poisson_nll and losses.first_photon_loss is losses.first_photon_nll
    assert losses.PoissonLoss is losses.PoissonNLL and losses.FirstPhotonLoss is losses.FirstPhotonNLL


@together("taker", TAKERS)
@together("name", BACKWARDS)
def test_what_takes_no_model_first_is_refused(taker, name):
    with pytest.raises(ArgumentError, match=f"^{taker}: expected compare") as caught:
        TAKERS[taker](BACKWARDS[name])
    if name == "counts_first":
        assert "(input, target)" in str(caught.value) and name in str(caught.value)


@together("taker", TAKERS)
@together("name", FORWARDS)
def test_what_takes_the_model_first_is_taken(taker, name):
    if name == "free_running_nll" and taker.lower().startswith("multiscale"):  # dead for bins, which are others there
        with pytest.raises(ArgumentError, match="without options in bins"):
            TAKERS[taker](FORWARDS[name])
    else:
        TAKERS[taker](FORWARDS[name])


@pytest.mark.parametrize("name", MODULES)
def test_modules_of_likelihoods_hold_a_measurement_consistency(name):
    found = losses.measurement_consistency(X, Y, identity, compare=MODULES[name])
    torch.testing.assert_close(found, MODULES[name](X, Y), rtol=0, atol=0)


@pytest.mark.slow
def test_a_fit_of_many_scales_ends_at_the_mean():
    """Of the Poisson likelihood, whose least is the mean of the counts at every scale."""
    counts = torch.poisson(torch.full((1, 1, 64, 4, 4), 2.0), generator=torch.Generator().manual_seed(0))
    level = torch.tensor(1.0, requires_grad=True)
    optimizer = torch.optim.LBFGS([level], line_search_fn="strong_wolfe")

    def closure():
        optimizer.zero_grad()
        value = losses.multiscale_loss(level * torch.ones_like(counts), counts, losses.poisson_nll)
        value.backward()
        return value

    optimizer.step(closure)
    assert float(level.detach()) == pytest.approx(float(counts.mean()), abs=0.02)
