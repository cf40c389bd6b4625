"""Streams: each sample once an epoch, over ranks and workers, in an order that the seed and the epoch decide."""

from __future__ import annotations

import itertools
import pickle
import warnings

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
    monkeypatch.delenv("RANK")
    assert indices(pickle.loads(raw)) == expected  # a worker that does not know
    monkeypatch.setenv("RANK", "x")
    with pytest.raises(StorageError, match="whole numbers"):
        indices(stream)


def test_ranks_of_torch(data, tmp_path):
    torch.distributed.init_process_group("gloo", f"file://{tmp_path / 'meet'}", rank=0, world_size=1)
    try:
        assert sorted(indices(TransientStream(data, fields=["depth"]))) == list(range(N))
    finally:
        torch.distributed.destroy_process_group()


def test_noise_of_epochs(data):
    chain = tt.sensing.ShotNoise()
    stream = TransientStream(data, fields=["values"], transform=chain.sample, noise_seed=1, shuffle=False)
    first = [item["measurement"] for item in stream]
    again = [item["measurement"] for item in stream]
    stream.set_epoch(1)
    other = [item["measurement"] for item in stream]
    assert torch.equal(first[0], again[0]) and not torch.equal(first[0], other[0])


@pytest.mark.parametrize(
    "arguments",
    [{"rank": 0}, {"rank": 2, "world_size": 2}, {"rank": -1, "world_size": 2}, {"buffer": 0}, {"seed": -1},
     {"shuffle": "no"}, {"fields": ["x"]}],
)  # fmt: skip
def test_arguments(data, arguments):
    with pytest.raises(TorchTransientError):
        TransientStream(data, **arguments)


def test_parts_and_axis(data):
    stream = TransientStream(data, window=(4.0, 5.0), pixels=(slice(3), slice(3)))
    assert stream.axis.num_bins == 50 and next(iter(stream))["transient"].shape == (1, 50, 3, 3)
    assert stream.about["spp"] == 16


STOPPED = [(0, 4, None), (2, 4, None), (3, 2, (1, 2))]


@pytest.mark.parametrize(("workers", "size", "rank"), long_rows(STOPPED, [STOPPED[0]]))
def test_an_epoch_goes_on_where_it_was_stopped(data, workers, size, rank):
    share = {} if rank is None else {"rank": rank[0], "world_size": rank[1]}

    def read(batches):
        stream = TransientStream(data, fields=["depth"], **share)
        stream.set_epoch(3, batches, size)
        # More workers than cores, for once.
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="This DataLoader will create")
            batches = list(DataLoader(stream, batch_size=size, num_workers=workers))
        return [batch["index"].tolist() for batch in batches]

    whole = read(0)
    for stop in range(len(whole) + 1) if workers == 0 else (1, len(whole) - 1):
        assert read(stop) == whole[stop:]
    stream = TransientStream(data, fields=["depth"], **share)
    # The epoch after it begins at its beginning.
    stream.set_epoch(3, 2, size)
    stream.set_epoch(4)
    assert len(indices(stream)) == stream.num_samples
    with pytest.raises(TorchTransientError, match="batches: expected a whole number"):
        stream.set_epoch(0, -1)
