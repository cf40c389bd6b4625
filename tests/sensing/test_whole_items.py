"""What acts on detections: drawn item by item, exact to the last count, and nothing of NaN."""

from __future__ import annotations

import pytest
import torch

from torchtransient import TimeAxis, sensing

BINS = 16
AXIS = TimeAxis.from_seconds(0.0, 1e-10, BINS)
MOVES = {
    "DetectionJitter": lambda grad="expected": sensing.DetectionJitter(
        sensing.GaussianResponse(3e-10, learnable=True), AXIS, grad=grad
    ),
    "DetectionSkew": lambda grad="expected": sensing.DetectionSkew(130e-12, AXIS, learnable=True, grad=grad),
    "DetectionSkew of a map": lambda grad="expected": sensing.DetectionSkew(
        torch.tensor([[0.0, -70e-12]]), AXIS, learnable=True, grad=grad
    ),
    "TDC": lambda grad="expected": sensing.TDC(torch.ones(BINS), dither=True, grad=grad),
}
ADDS = {
    "Afterpulsing": lambda grad="expected": sensing.Afterpulsing(0.1, 1e-9, 1e-10, axis=AXIS, grad=grad),
    "Crosstalk": lambda grad="expected": sensing.Crosstalk(0.05, grad=grad),
}


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def three_items(dtype=torch.float64):
    """Counts, means, counts so many that none is followed by itself."""
    counts = torch.poisson(torch.full((1, 1, BINS, 1, 2), 5.0, dtype=dtype), generator=generator())
    return torch.cat([counts, torch.full_like(counts, 0.5), counts * 1000])


@pytest.mark.parametrize("make", MOVES.values(), ids=MOVES)
@pytest.mark.parametrize("policy", ["straight_through", "score"])
def test_moves_of_an_item_do_not_depend_on_what_is_beside_it(make, policy):
    sensor, x = make(policy), three_items().requires_grad_()
    with sensing.ScoreFunction() as score:
        y = sensor(x, generator=generator())
    for found in (y, sensor.sample(x, generator(1))):
        assert torch.equal(found[[0, 2]], found[[0, 2]].round())
        torch.testing.assert_close(found[[0, 2]].sum(2), x[[0, 2]].sum(2))
        torch.testing.assert_close(found[1], sensor.expected(x[1]))
        assert not torch.equal(found[0], sensor.expected(x[0]))
    parameters = [p for p in sensor.parameters() if p.requires_grad]
    if policy == "score" and parameters:
        # the item of means pulls at the parameters by its mean alone, those of counts by their ways
        weight = torch.arange(BINS, dtype=torch.float64).square().view(-1, 1, 1)
        of_mean = torch.autograd.grad((y * weight)[1].sum(), parameters, retain_graph=True)
        alone = torch.autograd.grad((sensor.expected(x[1:2]) * weight).sum(), parameters)
        torch.testing.assert_close(of_mean, alone)
        of_ways = torch.autograd.grad(score.log_prob(()), parameters, retain_graph=True)
        assert all(bool((g != 0).any()) for g in of_ways)
    (slope,) = torch.autograd.grad(y.sum(), x)
    torch.testing.assert_close(slope, torch.ones_like(x))


@pytest.mark.parametrize("make", ADDS.values(), ids=ADDS)
def test_what_is_added_to_an_item_does_not_depend_on_what_is_beside_it(make):
    """Single events of whole counts, which are known by their numbers: the same as of the item alone."""
    sensor, x = make(), three_items()
    beside = torch.cat([x[:1], x[1:2], x[:1] * 10_000])
    for batch in (x[:1], beside):
        y = sensor.sample(batch.expand(len(batch), 1, BINS, 1, 2), generator())
        assert torch.equal(y[0], y[0].round())
    # an item in the dark can get nothing, next to bright ones that are not followed
    dark = torch.cat([torch.zeros_like(x[:1]), x[1:2], x[2:] * 1000])
    y = sensor.sample(dark, generator())
    assert float(y[0].abs().max()) == 0 and bool((y[1] >= dark[1]).all()) and bool((y[2] > dark[2]).any())


@pytest.mark.parametrize("make", ADDS.values(), ids=ADDS)
def test_an_item_beside_bright_ones_is_followed(make, monkeypatch):
    """Poisson numbers for the bright ones alone."""
    seen, sensor = [], make()
    trigger = type(sensor).trigger
    monkeypatch.setattr(type(sensor), "trigger", lambda s, c, g: seen.append(c.clone()) or trigger(s, c, g))
    x = three_items()
    sensor.sample(torch.cat([x[:1], x[2:] * 1000]), generator())
    assert torch.equal(seen[0][0], x[0]) and float(seen[0][1].abs().max()) == 0


@pytest.mark.parametrize("make", MOVES.values(), ids=MOVES)
def test_draws_at_the_end_of_single_precision_are_those_of_double(make):
    """Rounded once, at the end: what is above 2^24 has no odd numbers there."""
    x = torch.full((2, 1, BINS, 1, 2), 2.0**24 - 1)
    single, double = (make().sample(v, generator()) for v in (x, x.double()))
    assert torch.equal(double.sum(2), x.double().sum(2))
    assert torch.equal(single, double.float())


def test_a_skew_is_drawn_with_the_first_photon():
    """One distribution: covariance between bins of the cycles, which a separate draw has as well."""
    x = torch.full((600, 1, BINS, 1, 1), 0.1, dtype=torch.float64)
    stages = [sensing.SynchronousSPAD(50), sensing.DetectionSkew(130e-12, AXIS)]
    together = sensing.Compose(stages).sample(x, generator())
    apart = stages[1].sample(stages[0].sample(x, generator(1)), generator(2))
    assert torch.equal(together, together.round())
    close = 6 * (2 * 2 / len(x)) ** 0.5
    for of in (lambda y: y.sum(2), lambda y: y[:, :, 4] - y[:, :, 5], lambda y: y[:, :, 2]):
        torch.testing.assert_close(of(together).mean(0), of(apart).mean(0), rtol=0.03, atol=0.3)
        torch.testing.assert_close(of(together).var(0), of(apart).var(0), rtol=close, atol=0)
