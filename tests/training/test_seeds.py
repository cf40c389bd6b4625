"""``tt.training.Seeds``: a function of run, step and sample; no collisions in a step, no related bits."""

from __future__ import annotations

import pytest
import torch

from torchtransient.errors import UnitError
from torchtransient.training import Seeds


def test_a_function_of_run_step_and_sample_alone():
    whole = Seeds(3)(7, range(10))
    assert Seeds(3)(7, torch.arange(10)) == whole
    # However a batch is divided, and in whatever order it comes.
    assert Seeds(3)(7, [5, 2]) + Seeds(3)(7, [9]) == [whole[5], whole[2], whole[9]]
    others = {tuple(s) for s in (whole, Seeds(4)(7, range(10)), Seeds(3)(8, range(10)), Seeds(3, "b")(7, range(10)))}
    assert len(others) == 4
    # Written down: a run that is resumed years later draws the same.
    assert Seeds(0)(0, [0, 1, 2]) == [1099802580, 340961415, 818740969]
    assert Seeds(0).generator(0).initial_seed() == 4575342053079085010


@pytest.mark.slow
def test_no_collisions_in_a_step():
    seeds = Seeds(0)(12, range(200_000))
    # Of so many random numbers 4.7 pairs would collide, exp(-4.7) = 0.009 is the chance of none.
    assert len(set(seeds)) == len(seeds)
    assert 0 <= min(seeds) <= max(seeds) < 2**32


@pytest.mark.parametrize(("a", "b"), [((0, 0), (0, 1)), ((5, 2), (6, 1))])
def test_bits_of_neighbours_are_unrelated(a, b):
    count = 4000
    first = torch.tensor([Seeds(n)(a[0], [a[1]])[0] for n in range(count)])
    second = torch.tensor([Seeds(n)(b[0], [b[1]])[0] for n in range(count)])
    differing = ((first ^ second).unsqueeze(1) >> torch.arange(32)) & 1
    # 32 shares of a binomial of standard error 0.5 / sqrt(n): five of them are never reached.
    assert (differing.double().mean(0) - 0.5).abs().max() < 5 * 0.5 / count**0.5


def test_generators():
    seeds = Seeds(0)

    def draw(*arguments):
        return torch.rand(3, generator=seeds.generator(*arguments)).tolist()

    assert draw(4) == draw(4, 0)
    assert len({tuple(draw(*a)) for a in ((4,), (5,), (4, 1))}) == 3
    assert Seeds(0, "other").generator(4).initial_seed() != seeds.generator(4).initial_seed()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: Seeds(-1), "seed: expected a whole number of at least 0, got -1"),
        (lambda: Seeds(0)(-1, [0]), "step: expected a whole number"),
        (lambda: Seeds(0)(0, [2**32]), "sample: expected"),
        (lambda: Seeds(0)(0, torch.tensor([1.5])), "sample: expected a whole number"),
        (lambda: Seeds(0)(0, torch.tensor([[1]])), "sample: expected a whole number"),
    ],
)
def test_what_they_do_not_take(call, message):
    with pytest.raises(UnitError, match=message):
        call()
