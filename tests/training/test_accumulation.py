"""``tt.training.accumulate``: the gradient of a batch, part by part, of scaled and of half losses too."""

from __future__ import annotations

import pytest
import torch
from torch import nn

import torchtransient as tt
from tools.small_room import COLOUR, VARIANT, make_room
from torchtransient.errors import GradientError, ShapeError, UnitError
from torchtransient.training import Seeds, accumulate

EPS = torch.finfo(torch.float32).eps


class Proposer(nn.Module):
    """A colour from a measurement, and the light of the room with it."""

    def __init__(self):
        super().__init__()
        torch.manual_seed(0)
        self.network = nn.Linear(5, 3)
        self.renderer = tt.TransientRenderer(tt.load(make_room(), variant=VARIANT), parameters=[COLOUR], spp=8)

    def forward(self, measured, seed):
        return self.renderer({COLOUR: torch.sigmoid(self.network(measured))}, seed=seed).transient


@pytest.fixture(scope="module")
def model():
    return Proposer()


def gradients(model):
    return {name: p.grad.clone() for name, p in model.named_parameters() if p.grad is not None}


def test_parts_have_the_gradient_of_the_batch(model):
    measured = torch.randn(6, 5, generator=torch.Generator().manual_seed(1))
    seeds = Seeds(0)

    def loss_of(samples):
        return model(measured[samples], seeds(0, samples)).square().sum((1, 2, 3, 4)).mean()

    model.zero_grad()
    whole = loss_of(list(range(6)))
    whole.backward()
    expected = gradients(model)
    # Of each sample alone: what float sums of them can lose is a share of the sum of their magnitudes.
    magnitude = {name: torch.zeros_like(value) for name, value in expected.items()}
    for n in range(6):
        model.zero_grad()
        (loss_of([n]) / 6).backward()
        for name, value in gradients(model).items():
            magnitude[name] += value.abs()
    for parts, weights in (([[0, 1, 2], [3, 4, 5]], None), ([[0, 1, 2, 3], [4, 5]], [4 / 6, 2 / 6])):
        model.zero_grad()
        total = accumulate(loss_of, parts, weights=weights)
        assert total == pytest.approx(whole.item(), rel=8 * EPS)
        for name, value in gradients(model).items():
            # 6 samples and 2 weights are at most 8 roundings of a sum.
            assert ((value - expected[name]).abs() <= 8 * EPS * magnitude[name]).all(), name
    assert expected["network.weight"].abs().max() > 0


def test_memory_is_that_of_a_part():
    """Each part's graph is gone before the next one is made."""
    weight, events = torch.ones(2, requires_grad=True), []

    def loss_of(part):
        events.append(("made", part))
        loss = (weight * part).sum()
        loss.register_hook(lambda _: events.append(("gone", part)))
        return loss

    accumulate(loss_of, range(3))
    assert events == [(what, part) for part in range(3) for what in ("made", "gone")]


def test_a_scaler_skips_a_step_whose_gradient_is_infinite():
    model = nn.Linear(5, 1)
    scaler = torch.amp.GradScaler("cpu", init_scale=2.0**8)
    optimizer = torch.optim.SGD(model.parameters(), lr=0.1)
    before = model.weight.detach().clone()
    for factor, skipped in ((float("inf"), True), (1.0, False)):
        optimizer.zero_grad()
        accumulate(lambda part: factor * model(part).mean(), [torch.ones(1, 5)] * 2, scaler=scaler)  # noqa: B023
        scaler.step(optimizer)
        scaler.update()
        assert torch.equal(model.weight, before) == skipped and scaler.get_scale() == 2.0**7


def test_small_shares_of_half_losses_are_not_lost():
    weight = torch.zeros(3, requires_grad=True)
    found = accumulate(lambda part: ((weight + 1).sum() * part).half(), [1e-4 / 3] * 1024)
    # Parts are rounded to half precision each, not what is made of their shares.
    assert found == pytest.approx(1e-4, rel=0.01) and float(weight.grad[0]) == pytest.approx(1e-4 / 3, rel=0.01)
    infinite = accumulate(lambda part: weight.sum() + part, [float("inf"), float("-inf")])
    assert infinite != infinite


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda: accumulate(lambda _: torch.ones((), dtype=torch.complex64), [1]), ShapeError, "one real number"),
        (lambda: accumulate(torch.sum, []), ShapeError, "at least one part"),
        (lambda: accumulate(torch.sum, [1, 2], weights=[1.0]), ShapeError, "each of 2 parts, got 1"),
        (lambda: accumulate(torch.sum, [1], weights=[float("nan")]), UnitError, "finite"),
        (lambda: accumulate(lambda _: torch.ones(2), [1]), ShapeError, r"got torch\.float32 \(2,\)"),
        (lambda: accumulate(lambda _: torch.ones(()), [1]), GradientError, "has a gradient"),
    ],
)
def test_what_it_does_not_take(call, error, message):
    with pytest.raises(error, match=message):
        call()
