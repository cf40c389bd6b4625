"""``tt.training.ranks`` without other processes: settings of torchrun, threads, devices."""

from __future__ import annotations

import os

import pytest
import torch
import torch.distributed as dist

import torchtransient as tt
from torchtransient.errors import DeviceError, UnitError
from torchtransient.training import ranks, worker_init


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
    with pytest.raises(UnitError, match="RANK are set and WORLD_SIZE, LOCAL_RANK, LOCAL_WORLD_SIZE not"), ranks():
        pass
    wrong = {"WORLD_SIZE": ("two", 1), "RANK": (-1, 0), "LOCAL_RANK": (-1, 0), "LOCAL_WORLD_SIZE": (0, 1)}
    for name, (value, least) in wrong.items():
        torchrun(monkeypatch, 0, 1)
        monkeypatch.setenv(name, str(value))
        with pytest.raises(UnitError, match=f"^ranks: {name}: expected a whole number of at least {least}"), ranks():
            pass


def test_groups_that_cannot_be_joined(monkeypatch):
    torchrun(monkeypatch, 0, 2)
    for name in ("MASTER_ADDR", "MASTER_PORT"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(UnitError, match=r"cannot be joined.*torchrun"), ranks():
        pass
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
