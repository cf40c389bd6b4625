"""Seeds of a call: one number for each film, and what is none."""

import warnings

import pytest
import torch

from torchtransient.errors import ShapeError, TorchTransientWarning, UnitError
from torchtransient.rendering.job import Item, Seeding, draw_seed, mix_seed, whole_number


def test_numbers_are_those_of_splitmix64():
    """Its first outputs for the seed 1234567, as the reference implementation prints them; the lower half counts."""
    published = (
        6457827717110365317,
        3203168211198807973,
        9817491932198370423,
        4593380528125082431,
        16408922859458223821,
    )
    assert [mix_seed(1234567, n) for n in (1, 2, 3, 4, 5)] == [value % 2**32 for value in published]
    assert mix_seed(2**32 + 9, 0) == 9


def test_films_of_one_number():
    """Entries one after the other, the sensors of each in their order; the gradient has seeds of its own."""
    films = Seeding((4, 7), 3, None).items(11)
    assert [(film.entry, film.sensor) for film in films] == [(0, 4), (0, 7), (1, 4), (1, 7), (2, 4), (2, 7)]
    assert [film.seed for film in films] == [11, *(mix_seed(11, n) for n in range(1, 6))]
    assert [film.grad_seed for film in films] == [mix_seed(film.seed, 0x5EED) for film in films]
    assert len({film.seed for film in films} | {film.grad_seed for film in films}) == 12


def test_films_of_one_number_for_each_entry():
    films = Seeding((4, 7), 3, "same").items([5, 6, 5])
    assert [film.seed for film in films] == [5, mix_seed(5, 1), 6, mix_seed(6, 1), 5, mix_seed(5, 1)]
    assert [film.grad_seed for film in films] == [film.seed for film in films]
    assert Seeding((2,), 2, 9).items([5, 5]) == (Item(0, 2, 5, 9), Item(1, 2, 5, mix_seed(9, 1)))


@pytest.mark.parametrize("seeds", [[], [1, 2], [1, 2, 3, 4]])
def test_as_many_as_entries(seeds):
    with pytest.raises(ShapeError, match=rf"one for each of 3 batch entries, got {len(seeds)}\."):
        Seeding((0,), 3, None).items(seeds)


def test_seeds_that_count_as_others():
    """Modulo 2^32: said of what lies outside, refused where two different numbers are one."""
    seeding = Seeding((0,), 2, None)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert [film.seed for film in seeding.items([0, 2**32 - 1])] == [0, 2**32 - 1]
        seeding.items(0)
    with pytest.warns(TorchTransientWarning, match="got 4294967301, which counts as 5:"):
        assert seeding.items([3, 2**32 + 5])[1].seed == 5
    with pytest.warns(TorchTransientWarning, match="got 4294967296, which counts as 0:"):
        seeding.items(2**32)
    with pytest.warns(TorchTransientWarning, match="got -1, which counts as 4294967295:"):
        seeding.items(-1)
    with pytest.raises(UnitError, match="7 and 4294967303 are one seed"):
        seeding.items([7, 2**32 + 7])


@pytest.mark.parametrize("seed", ["12", b"12", {0: 1}, 1.5, None, True, object()])
def test_what_is_no_seed(seed):
    with pytest.raises(UnitError, match="seed: expected a whole number, or one for each batch entry, got"):
        whole_number(seed)


def test_what_is_no_seed_among_others():
    with pytest.raises(UnitError, match=r"one for each batch entry, got 2\.5 among them"):
        Seeding((0,), 2, None).items([1, 2.5])
    assert whole_number(torch.tensor(3)) == 3
    assert whole_number([1.5]) is None


def test_tensors_are_taken_apart_where_they_are_one_number():
    assert draw_seed(torch.tensor(3)) == (3, None)
    assert type(draw_seed(torch.tensor(3))[0]) is int
    for other in (torch.tensor([3, 4]), torch.tensor(3.0), torch.tensor(True)):
        assert draw_seed(other)[0] is other and draw_seed(other)[1] is None
    assert draw_seed([1, 2]) == ([1, 2], None)


def test_without_a_seed_torch_s_generator_draws():
    torch.manual_seed(5)
    first = draw_seed(None), draw_seed(None)
    torch.manual_seed(5)
    assert (draw_seed(None), draw_seed(None)) == first
    assert first[0] != first[1]
    assert all(0 <= seed < 2**32 and tensor is None for seed, tensor in first)


def test_what_torch_says_of_other_things_is_passed_on(monkeypatch):
    def broken(*_arguments, **_settings):
        raise RuntimeError("no memory")

    monkeypatch.setattr(torch, "randint", broken)
    with pytest.raises(RuntimeError, match="no memory"):
        draw_seed(None)


def test_entries_of_a_vmap():
    """Each has its tensor, which no one number stands for; a draw says what it wants to know."""
    seen = []

    def take(x, seed):
        seen.append(draw_seed(seed))
        return x

    torch.func.vmap(take)(torch.zeros(2), torch.tensor([1, 2]))
    assert seen[0][0] is None and isinstance(seen[0][1], torch.Tensor)
    with pytest.raises(UnitError, match=r"randomness='same'\) draws one seed"):
        torch.func.vmap(lambda x: x + draw_seed(None)[0])(torch.zeros(2))
    torch.func.vmap(lambda x: take(x, None), randomness="same")(torch.zeros(2))
    assert isinstance(seen[1][0], int)
