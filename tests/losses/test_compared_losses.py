"""Losses that are given to losses: none may take a model for a measurement, in whatever guise it comes."""

from __future__ import annotations

import functools

import pytest
import torch

from torchtransient import losses
from torchtransient.errors import ShapeError

TAKERS = {
    "multiscale_loss": lambda compare: losses.multiscale_loss(X, Y, compare),
    "MultiscaleLoss": lambda compare: losses.MultiscaleLoss(compare),
    "measurement_consistency": lambda compare: losses.measurement_consistency(X, Y, identity, compare=compare),
    "MeasurementConsistency": lambda compare: losses.MeasurementConsistency(identity, compare),
}
X, Y = torch.full((1, 1, 8, 2, 2), 2.0), torch.full((1, 1, 8, 2, 2), 3.0)


def identity(volume):
    return volume


class Callable:
    def __call__(self, counts, mean, *, mask, reduction):
        return losses.poisson_nll(counts, mean, mask=mask, reduction=reduction)


@functools.wraps(losses.poisson_nll)
def wrapped(*arguments, **options):
    return losses.poisson_nll(*arguments, **options)


BACKWARDS = {
    "poisson_nll": losses.poisson_nll,
    "poisson_nll, floor": functools.partial(losses.poisson_nll, floor=0.0, dim=-3),
    "poisson_nll, twice": functools.partial(functools.partial(losses.poisson_nll, floor=0.0), constant=True),
    "poisson_nll, wrapped": wrapped,
    "poisson_nll, an object": Callable(),
    "first_photon_nll": functools.partial(losses.first_photon_nll, cycles=400),
    "first_photon_nll, counts held": functools.partial(losses.first_photon_nll, Y),
    "first_photon_loss, model held": functools.partial(losses.first_photon_loss, X),
    "read_noise_nll": functools.partial(losses.read_noise_nll, read_noise=1.0),
    "free_running_nll": functools.partial(losses.free_running_nll, periods=400, dead_bins=2.5),
    "free_running_nll, counts held": functools.partial(losses.free_running_nll, Y, dead_bins=2.5),
    "two_render_loss": functools.partial(losses.two_render_loss, target=Y),
    "mesh_normal_consistency": losses.mesh_normal_consistency,
}
MODULES = {
    "PoissonNLL": losses.PoissonNLL(),
    "FirstPhotonNLL": losses.FirstPhotonNLL(400),
    "FreeRunningNLL": losses.FreeRunningNLL(400, 2.5),
    "ReadNoiseNLL": losses.ReadNoiseNLL(1.0),
}


def test_every_likelihood_of_counts_first_is_among_them():
    names = {name for name in vars(losses) if name.endswith(("nll", "NLL"))}
    assert names == {name.partition(",")[0] for name in (*BACKWARDS, *MODULES) if name.lower().endswith("nll")}


@pytest.mark.parametrize("taker", TAKERS)
@pytest.mark.parametrize("name", [*BACKWARDS, *MODULES])
def test_what_takes_no_model_first_is_refused(taker, name):
    compare = {**BACKWARDS, **MODULES}[name]
    with pytest.raises(ShapeError, match=f"^{taker}: expected compare") as caught:
        TAKERS[taker](compare)
    if name.endswith("nll"):
        assert "(input, target)" in str(caught.value) and name in str(caught.value)


@pytest.mark.parametrize("taker", TAKERS)
@pytest.mark.parametrize(
    "compare",
    [losses.poisson_loss, functools.partial(losses.first_photon_loss, cycles=400), losses.root_loss,
     lambda x, y, *, mask, reduction: losses.poisson_nll(y, x, floor=0.1, mask=mask, reduction=reduction)],
    ids=["poisson_loss", "first_photon_loss", "root_loss", "turned round"],
)  # fmt: skip
def test_what_takes_the_model_first_is_taken(taker, compare):
    TAKERS[taker](compare)


def test_a_fit_of_many_scales_ends_at_the_mean():
    """Of the Poisson likelihood, whose least is the mean of the counts at every scale."""
    counts = torch.poisson(torch.full((1, 1, 64, 4, 4), 2.0), generator=torch.Generator().manual_seed(0))
    level = torch.tensor(1.0, requires_grad=True)
    optimizer = torch.optim.LBFGS([level], line_search_fn="strong_wolfe")

    def closure():
        optimizer.zero_grad()
        exact = functools.partial(losses.poisson_loss, floor=0.0)
        value = losses.multiscale_loss(level * torch.ones_like(counts), counts, exact)
        value.backward()
        return value

    optimizer.step(closure)
    assert float(level.detach()) == pytest.approx(float(counts.mean()), abs=0.02)
