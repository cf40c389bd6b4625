"""``tt.training.Batches``: every sample once an epoch, the same for any number of ranks, from any step on; and
``tt.training.ranks`` without other processes: settings of torchrun, threads, devices.
"""

from __future__ import annotations

import itertools
import os

import pytest
import torch
import torch.distributed as dist
from torch.utils.data import DataLoader

import torchtransient as tt
from support.marks import long
from torchtransient.errors import DeviceError, StorageError, UnitError
from torchtransient.training import Batches, Seeds, ranks, worker_init


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


@pytest.mark.parametrize("workers", long([0, 2], [0]))
def test_goes_on_where_it_was_stopped(workers):
    data = [float(n) for n in range(10)]

    def read(batches, count):
        loader = batches.loader(data, workers=workers)
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


def test_its_loader_leaves_random_numbers_alone():
    batches = Batches(3, 1)
    before = torch.get_rng_state()
    first = next(iter(batches.loader([1.0, 2.0, 3.0])))
    assert torch.equal(torch.get_rng_state(), before)
    batches.step = 0
    # Another one of torch's does not, which is why it is there.
    assert next(iter(DataLoader([1.0, 2.0, 3.0], batch_sampler=batches))) == first
    assert not torch.equal(torch.get_rng_state(), before)
    apart = batches.loader([1.0, 2.0, 3.0], workers=1, renders=True)
    assert apart.multiprocessing_context.get_start_method() == "spawn"
    assert (apart.worker_init_fn, apart.persistent_workers) == (worker_init, True)
    with pytest.raises(UnitError, match="of 3 samples, the data set has 2"):
        batches.loader([1.0, 2.0])


def test_a_position_that_is_left_behind():
    """An iterator does not move the position: what would silently begin there again is told."""
    batches = Batches(6, 2)
    loader = batches.loader(list(range(6)))
    for step, _ in zip(range(3), loader, strict=False):
        with pytest.raises(StorageError, match=r"Set batches\.step to the step that comes next"):
            batches.state_dict()
        batches.step = step + 1
        assert batches.state_dict()["step"] == step + 1
    next(iter(loader))
    with pytest.raises(StorageError, match="would begin at step 3 again"):
        next(iter(loader))
    batches.step = 3
    next(iter(loader))


@pytest.mark.slow
def test_workers_of_ranks_draw_other_numbers():
    def drawn(rank, step=0, seed=0):
        batches = Batches(8, 4, rank=rank, world_size=2, seed=seed)
        batches.step = step
        return next(iter(batches.loader(Drawing(), workers=1))).tolist()

    cases = [drawn(0), drawn(1), drawn(0, step=1), drawn(0, seed=1)]
    assert len({tuple(case) for case in cases}) == 4 and drawn(0) == cases[0]


class Drawing(torch.utils.data.Dataset):
    def __len__(self):
        return 8

    def __getitem__(self, number):
        return torch.rand(())


def test_places_are_apart_where_numbers_come_twice():
    batches = Batches(12, 8)
    samples = batches.samples(1)
    seeds = Seeds(0)
    assert len(set(samples)) < 8 == len(set(seeds(1, batches.places(1))))
    parts = [Batches(12, 8, rank=rank, world_size=2).places(1) for rank in (0, 1)]
    assert parts[0] + parts[1] == batches.places(1)


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


# ---------------------------------------------------------------------------------------- ranks without other processes


@pytest.fixture(autouse=True)
def no_torchrun(monkeypatch):
    for name in ("RANK", "WORLD_SIZE", "LOCAL_RANK", "LOCAL_WORLD_SIZE", "CUDA_VISIBLE_DEVICES"):
        monkeypatch.delenv(name, raising=False)


def torchrun(monkeypatch, rank, size):
    values = {"RANK": rank, "WORLD_SIZE": size, "LOCAL_RANK": rank, "LOCAL_WORLD_SIZE": size}
    for name, value in values.items():
        monkeypatch.setenv(name, str(value))


def test_alone():
    before = tt.threads()
    with ranks(threads=3) as found:
        assert (found.rank, found.size, found.local, found.local_size, found.is_first) == (0, 1, 0, 1, True)
        assert (found.device, found.variant_prefix) == (torch.device("cpu"), "llvm_ad_")
        assert found.mean(3.5) == 3.5
        found.wait()  # for nobody
        assert not dist.is_initialized()
        assert (tt.threads().torch, tt.threads().drjit) == (3, 3)
    assert tt.threads() == before


def test_cores_are_shared(monkeypatch):
    torchrun(monkeypatch, 0, 1)
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "2")
    for cores, threads in ((7, 3), (1, 1)):
        monkeypatch.setattr("torchtransient.training.batches._cores", lambda cores=cores: cores)
        with ranks():
            assert tt.threads().drjit == threads
    with tt.threads(3):
        worker_init(0)
        assert (tt.threads().torch, tt.threads().drjit) == (1, 1)


def test_broken_settings(monkeypatch):
    with pytest.raises(UnitError, match="'cpu' or 'cuda', got 'tpu'"), ranks("tpu"):
        pass
    monkeypatch.setenv("RANK", "0")
    with pytest.raises(UnitError, match="variables of torchrun, got 'WORLD_SIZE'"), ranks():
        pass
    torchrun(monkeypatch, 0, 1)
    monkeypatch.setenv("WORLD_SIZE", "two")
    with pytest.raises(UnitError, match=r"variables of torchrun, got .*'two'"), ranks():
        pass


def test_groups_that_cannot_be_joined(monkeypatch):
    torchrun(monkeypatch, 0, 2)
    monkeypatch.setattr(dist, "is_initialized", lambda: True)
    with pytest.raises(DeviceError, match="in a group already"), ranks():
        pass


def test_a_group_of_others_is_left_alone(tmp_path):
    dist.init_process_group("gloo", init_method=f"file://{tmp_path}/store", rank=0, world_size=1)
    try:
        with ranks() as found:
            assert found.size == 1
        assert dist.is_initialized()
    finally:
        dist.destroy_process_group()


@pytest.mark.parametrize(("seen", "shown"), [(None, "1"), ("4,6", "6")])
def test_a_rank_is_shown_its_own_device(monkeypatch, seen, shown):
    torchrun(monkeypatch, 1, 2)
    if seen is not None:
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", seen)
    monkeypatch.setattr(torch.cuda, "is_initialized", lambda: False)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    begun = []
    monkeypatch.setattr(dist, "init_process_group", lambda backend, timeout: begun.append(backend))
    with ranks("cuda") as found:
        assert (os.environ["CUDA_VISIBLE_DEVICES"], found.variant_prefix) == (shown, "cuda_ad_")
    assert begun == ["nccl"]


def test_devices_that_cannot_be_had(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_initialized", lambda: False)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(DeviceError, match="torch finds none"), ranks("cuda"):
        pass
    torchrun(monkeypatch, 1, 2)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3")
    with pytest.raises(DeviceError, match="2 ranks on this machine and 1 devices"), ranks("cuda"):
        pass
    monkeypatch.setattr(torch.cuda, "is_initialized", lambda: True)
    with pytest.raises(DeviceError, match="before anything uses CUDA"), ranks("cuda"):
        pass
