"""``tt.training.Batches``: every sample once an epoch, the same for any number of ranks, from any step on."""

from __future__ import annotations

import itertools

import pytest
from torch.utils.data import DataLoader

from torchtransient.errors import StorageError, UnitError
from torchtransient.training import Batches


def first(batches, count):
    return list(itertools.islice(batches, count))


def test_every_sample_once_an_epoch():
    # 3 epochs of 10 samples in 5 batches of 6, which do not end with them.
    drawn = list(itertools.chain(*first(Batches(10, 6, seed=1), 5)))
    epochs = [drawn[n : n + 10] for n in (0, 10, 20)]
    assert [sorted(epoch) for epoch in epochs] == [list(range(10))] * 3
    assert len({tuple(epoch) for epoch in epochs}) == 3
    assert list(itertools.chain(*first(Batches(10, 6, seed=2), 5))) != drawn
    assert first(Batches(4, 3, shuffle=False), 3) == [[0, 1, 2], [3, 0, 1], [2, 3, 0]]
    assert Batches(10, 6).epoch(5) == 3


def test_ranks_share_the_batch_of_one():
    whole = first(Batches(10, 6), 7)
    parts = [first(Batches(10, 6, rank=rank, world_size=3), 7) for rank in range(3)]
    assert [a + b + c for a, b, c in zip(*parts, strict=True)] == whole


@pytest.mark.parametrize("workers", [0, 2])
def test_goes_on_where_it_was_stopped(workers):
    data = [float(n) for n in range(10)]

    def read(batches, count):
        loader = DataLoader(data, batch_sampler=batches, num_workers=workers)
        return [batch.tolist() for batch in itertools.islice(loader, count)]

    expected = read(Batches(10, 4), 7)
    stopped = Batches(10, 4)
    begin = read(stopped, 3)
    # What workers have fetched beyond that does not count.
    stopped.step = 3
    resumed = Batches(10, 4)
    resumed.load_state_dict(stopped.state_dict())
    assert begin + read(resumed, 4) == expected


def test_a_state_of_another_order():
    state = Batches(10, 4, world_size=2).state_dict()
    Batches(10, 4).load_state_dict(state)
    for other in (Batches(11, 4), Batches(10, 5), Batches(10, 4, seed=1), Batches(10, 4, shuffle=False)):
        with pytest.raises(StorageError, match="repeat some samples"):
            other.load_state_dict(state)
    with pytest.raises(StorageError, match="expected the order"):
        Batches(10, 4).load_state_dict({})


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"size": 0, "batch_size": 1}, "size: expected a whole number of at least 1, got 0"),
        ({"size": 3, "batch_size": 0.5}, "batch_size"),
        ({"size": 3, "batch_size": 3, "world_size": 2}, "a multiple of the 2 ranks that share it, got 3"),
        ({"size": 3, "batch_size": 4, "world_size": 2, "rank": 2}, "rank below world_size = 2, got 2"),
        ({"size": 3, "batch_size": 4, "seed": -1}, "seed"),
    ],
)
def test_what_they_do_not_take(arguments, message):
    with pytest.raises(UnitError, match=message):
        Batches(**arguments)


def test_steps_that_are_none():
    with pytest.raises(UnitError, match="step"):
        Batches(3, 1).step = -1
