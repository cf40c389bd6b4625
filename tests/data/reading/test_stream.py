"""Streams: each sample once an epoch, over ranks and workers, in an order that the seed and the epoch decide."""

from __future__ import annotations

import itertools
import pickle

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

import torchtransient as tt
from support.marks import long_rows
from support.stored_samples import cube, folder
from torchtransient.data import TransientStream
from torchtransient.errors import StorageError, TorchTransientError

N = 23


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return folder(tmp_path_factory.mktemp("data") / "set", N)


def indices(stream):
    return [item["index"] for item in stream]


def test_each_sample_once_in_a_shuffled_order(data):
    stream = TransientStream(data, fields=["depth"])
    first = indices(stream)
    assert sorted(first) == list(range(N)) and first != list(range(N)) and indices(stream) == first
    stream.set_epoch(1)
    second = indices(stream)
    assert sorted(second) == list(range(N)) and second != first and stream.epoch == 1
    assert indices(TransientStream(data, fields=["depth"], seed=1)) != first
    stream.set_epoch(0)
    assert indices(stream) == first and stream.num_samples == N
    assert indices(TransientStream(data, fields=["depth"], shuffle=False)) == list(range(N))


def test_whole_shards_follow_each_other(data):
    """With a buffer of one sample, the files come one behind another."""
    files = [i // 4 for i in indices(TransientStream(data, fields=["depth"], buffer=1))]
    runs = 1 + sum(a != b for a, b in itertools.pairwise(files))
    assert runs == 6 and files != sorted(files)
    # With a buffer of five, nobody comes more than four places early.
    order, base = (TransientStream(data, buffer=size).order(0).tolist() for size in (5, 1))
    assert order != base and sorted(order) == sorted(base)
    assert all(base.index(number) - place <= 4 for place, number in enumerate(order))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("even", "world_size"),
    long_rows(itertools.product([False, True], [1, 2, 5, 30]), [(False, 30), (True, 2), (True, 5)]),
)
def test_ranks(data, world_size, even):
    shares = [
        TransientStream(data, fields=["depth"], rank=r, world_size=world_size, even=even) for r in range(world_size)
    ]
    found = [indices(share) for share in shares]
    assert [len(one) for one in found] == [share.num_samples for share in shares]
    together = sorted(i for one in found for i in one)
    counts = {len(one) for one in found}
    if even:
        assert counts == {N // world_size} and len(set(together)) == N // world_size * world_size
    else:
        assert together == list(range(N)) and max(counts) - min(counts) <= 1


@pytest.mark.slow
@pytest.mark.parametrize("context", ["fork", "spawn"])
def test_workers(data, context):
    """Workers that stay learn of the epoch; each sample comes once, over two ranks of two workers."""
    options = {"num_workers": 2, "multiprocessing_context": context, "persistent_workers": True, "batch_size": 3}
    streams = [TransientStream(data, rank=r, world_size=2, transform=tripled) for r in range(2)]
    loaders = [DataLoader(stream, **options) for stream in streams]
    epochs = []
    for epoch in range(2):
        found = []
        for stream, loader in zip(streams, loaders, strict=True):
            stream.set_epoch(epoch)
            for batch in loader:
                found += batch["index"].tolist()
                for k, i in enumerate(batch["index"].tolist()):
                    assert np.array_equal(batch["measurement"][k].numpy(), 3 * cube(i))
        assert sorted(found) == list(range(N))
        epochs.append(found)
    assert epochs[0] != epochs[1]


def tripled(transient):
    return 3 * transient


def test_ranks_of_the_environment(data, monkeypatch):
    monkeypatch.setenv("RANK", "1")
    monkeypatch.setenv("WORLD_SIZE", "3")
    stream = TransientStream(data, fields=["depth"])
    expected = indices(TransientStream(data, fields=["depth"], rank=1, world_size=3))
    assert indices(stream) == expected
    raw = pickle.dumps(stream)
    # That of a process group counts more; a worker that does not know either takes the one that it was sent with.
    for name, value in (("is_initialized", True), ("get_rank", 2), ("get_world_size", 3)):
        monkeypatch.setattr(torch.distributed, name, lambda value=value: value)
    assert indices(stream) == indices(TransientStream(data, fields=["depth"], rank=2, world_size=3))
    assert indices(pickle.loads(raw)) == expected
    monkeypatch.setattr(torch.distributed, "is_initialized", lambda: False)
    monkeypatch.setenv("RANK", "x")
    with pytest.raises(StorageError, match="whole numbers"):
        indices(stream)


def test_noise_of_epochs(data):
    chain = tt.sensing.ShotNoise()
    stream = TransientStream(data, fields=["values"], transform=chain.sample, noise_seed=1, shuffle=False)
    first, again = (next(iter(stream))["measurement"] for _ in range(2))
    stream.set_epoch(1)
    assert torch.equal(first, again) and not torch.equal(first, next(iter(stream))["measurement"])


@pytest.mark.parametrize("arguments", [{"rank": 0}, {"rank": 2, "world_size": 2}, {"buffer": 0}, {"seed": -1}])
def test_arguments(data, arguments):
    with pytest.raises(TorchTransientError):
        TransientStream(data, **arguments)


STOPPED = [(0, 4, None), (2, 4, None), (3, 2, (1, 2))]


@pytest.mark.parametrize(("workers", "size", "rank"), long_rows(STOPPED, [STOPPED[0]]))
@pytest.mark.filterwarnings("ignore:This DataLoader will create")  # more workers than cores, for once
def test_an_epoch_goes_on_where_it_was_stopped(data, workers, size, rank):
    share = {} if rank is None else {"rank": rank[0], "world_size": rank[1]}

    def read(batches):
        stream = TransientStream(data, fields=["depth"], **share)
        stream.set_epoch(3, batches, size)
        return [batch["index"].tolist() for batch in DataLoader(stream, batch_size=size, num_workers=workers)]

    whole = read(0)
    for stop in range(len(whole) + 1) if workers == 0 else (1, len(whole) - 1):
        assert read(stop) == whole[stop:]
    stream = TransientStream(data, fields=["depth"], **share)
    # The epoch after it begins at its beginning.
    stream.set_epoch(3, 2, size)
    stream.set_epoch(4)
    assert len(indices(stream)) == stream.num_samples
