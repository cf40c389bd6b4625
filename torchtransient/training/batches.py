"""Processes of a training, and the share of the batches that each one takes."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import KW_ONLY, dataclass, field
from datetime import timedelta
from typing import Any

import numpy as np
import torch
import torch.distributed as dist
from numpy.typing import NDArray
from torch.utils.data import DataLoader, Dataset, Sampler, Subset

from torchtransient.checks import count, is_one_of, shown
from torchtransient.errors import DeviceError, StorageError, UnitError

_TORCHRUN = ("RANK", "WORLD_SIZE", "LOCAL_RANK", "LOCAL_WORLD_SIZE")


@dataclass(frozen=True)
class Ranks:
    """Rank of this process in a run. Made by :func:`ranks`.

    Attributes:
        rank: number of the process, below ``size``.
        size: number of processes.
        local: number of the process on its machine, below ``local_size``.
        local_size: number of processes on the machine.
        device: device of the process's tensors.
    """

    rank: int = 0
    size: int = 1
    _: KW_ONLY
    local: int = 0
    local_size: int = 1
    device: torch.device = field(default_factory=lambda: torch.device("cpu"))

    @property
    def is_first(self) -> bool:
        """True for the rank that prints and writes."""
        return self.rank == 0

    @property
    def variant_prefix(self) -> str:
        """"llvm_ad_" or "cuda_ad_"."""
        return "cuda_ad_" if self.device.type == "cuda" else "llvm_ad_"

    def mean(self, value: float) -> float:
        """Return the mean of a number over all ranks, which all have to call this.

        Args:
            value: number that this rank has.
        """
        if self.size == 1:
            return float(value)
        total = torch.tensor(float(value), dtype=torch.float64, device=self.device)
        dist.all_reduce(total)
        return float(total) / self.size

    def wait(self) -> None:
        """Wait until all ranks have come here, for instance until the first one has written a file for the others."""
        if self.size > 1:
            dist.barrier()


@contextmanager
def ranks(device: str = "cpu", *, threads: int | None = None, timeout_s: float = 1800.0) -> Iterator[Ranks]:
    """Join the process group of `torchrun`, and leave it at the end; without torchrun, one rank and no group. ::

        with tt.training.ranks() as ranks:                    # torchrun --nproc-per-node 2 train.py
            model = DistributedDataParallel(model) if ranks.size > 1 else model

    Args:
        device: "cpu" (group "gloo") or "cuda" (group "nccl", one device a rank). Dr.Jit computes on the first device
            that the process can see and has no choice of others, so that with "cuda" every rank is shown its own alone
            (CUDA_VISIBLE_DEVICES): call this before anything has used CUDA, in torch or in a variant of Mitsuba.
        threads: number of threads of torch and of Dr.Jit in each rank, see :func:`torchtransient.threads`; None shares
            the cores of the machine among its ranks. At the end both numbers are what they were before.
        timeout_s: seconds that a rank waits for the others.

    Raises:
        UnitError: for other devices, threads and broken settings of torchrun.
        DeviceError: for "cuda" where there is none, or where it is in use already.
    """
    from torchtransient.rendering.threads import threads as set_threads

    if not is_one_of(device, ("cpu", "cuda")):
        raise UnitError(f"ranks: expected device 'cpu' or 'cuda', got {shown(device)}.")
    found = _found(device)
    if device == "cuda":
        _take_device(found)
    several = found.size > 1
    with set_threads(threads if threads is not None else max(1, _cores() // found.local_size)):
        if several:
            if dist.is_initialized():
                raise DeviceError("ranks: this process is in a group already, and would leave it; open one.")
            dist.init_process_group("nccl" if device == "cuda" else "gloo", timeout=timedelta(seconds=timeout_s))
        try:
            yield found
        finally:
            if several and dist.is_initialized():
                dist.destroy_process_group()


def worker_init(worker: int) -> None:
    """Let a process of a DataLoader compute with one thread, of torch and of Dr.Jit: ``worker_init_fn=worker_init``.

    For data sets that render. Those processes have to be spawned, since Dr.Jit does not survive a fork
    (``multiprocessing_context="spawn"``), and are worth keeping (``persistent_workers=True``): they compile anew.

    Args:
        worker: number of the process, unused.
    """
    from torchtransient.rendering.threads import threads as set_threads

    set_threads(1)


def _found(device: str) -> Ranks:
    if not any(name in os.environ for name in _TORCHRUN):
        return Ranks(device=torch.device(device))
    try:
        rank, size, local, local_size = (int(os.environ[name]) for name in _TORCHRUN)
    except (KeyError, ValueError) as error:
        raise UnitError(f"ranks: expected the variables of torchrun, got {error}; start the script with it.") from error
    return Ranks(rank, size, local=local, local_size=local_size, device=torch.device(device))


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _take_device(found: Ranks) -> None:
    """Show this process one device."""
    mitsuba = sys.modules.get("mitsuba")
    variant = None if mitsuba is None else mitsuba.variant()
    in_use = torch.cuda.is_initialized()  # type: ignore[no-untyped-call]
    if in_use or (variant or "").startswith("cuda"):
        if found.local_size == 1:
            return
        raise DeviceError(
            "ranks: expected to choose the device of this rank before anything uses CUDA, but torch or Mitsuba does "
            "already. Open `with tt.training.ranks('cuda')` first."
        )
    if found.local_size > 1:
        seen = os.environ.get("CUDA_VISIBLE_DEVICES", "")
        names = seen.split(",") if seen else [str(n) for n in range(found.local_size)]
        if found.local >= len(names):
            raise DeviceError(
                f"ranks: {found.local_size} ranks on this machine and {len(names)} devices in "
                f"CUDA_VISIBLE_DEVICES={seen!r}; start as many ranks as devices."
            )
        os.environ["CUDA_VISIBLE_DEVICES"] = names[found.local]
    if not torch.cuda.is_available():
        raise DeviceError("ranks: expected a CUDA device, torch finds none. Use device='cpu'.")


_WHAT = "Batches"


class Batches(Sampler[list[int]]):
    """Numbers of the samples of every step, without an end; :meth:`loader` reads them.

    Samples come in an order that is shuffled anew in every epoch; a batch may begin in one epoch and end in the next,
    so that all batches have one size and no sample is left out. At each step rank r of n reads the r-th of n equal
    parts of the batch. Runs of 1 and of 2 ranks learn from the same samples at the same step.

    The order depends on ``seed``, ``size`` and the number of samples before it alone. :attr:`step` is the position of
    the next iterator. A loop that counts its steps sets it when it goes on; iterators, which prefetch, do not change
    it. A second iterator, or a state, that would repeat batches which an iterator has given since the position was set
    is a StorageError: set it, to the same number where that is meant. ::

        batches = tt.training.Batches(len(data), 32, seed=0, rank=ranks.rank, world_size=ranks.size)
        batches.step = first
        for step, batch in zip(range(first, last), batches.loader(data)):
            ...

    Args:
        size: number of samples in the data set, which is map-style.
        batch_size: number of samples in a batch, of all ranks together.
        seed: seed of the shuffled order.
        shuffle: False keeps the order of the data set.
        rank, world_size: number of this process, and number of processes.

    Raises:
        UnitError: for numbers that cannot be used.
    """

    def __init__(
        self, size: int, batch_size: int, *, seed: int = 0, shuffle: bool = True, rank: int = 0, world_size: int = 1,
    ) -> None:  # fmt: skip
        self.size = count(f"{_WHAT}: size", size, 1, UnitError)
        self.batch_size = count(f"{_WHAT}: batch_size", batch_size, 1, UnitError)
        self.seed, self.shuffle = count(f"{_WHAT}: seed", seed, 0, UnitError, None), shuffle
        self.world_size = count(f"{_WHAT}: world_size", world_size, 1, UnitError)
        self.rank = count(f"{_WHAT}: rank", rank, 0, UnitError)
        if self.rank >= self.world_size:
            raise UnitError(f"{_WHAT}: expected rank below world_size = {self.world_size}, got {self.rank}.")
        if self.batch_size % self.world_size:
            raise UnitError(
                f"{_WHAT}: expected batch_size as a multiple of the {self.world_size} ranks that share it, got "
                f"{self.batch_size}."
            )
        self._step = 0
        # Whether an iterator has given batches since the position was set.
        self._is_left = False
        self._kept: tuple[int, NDArray[np.int64]] | None = None

    @property
    def step(self) -> int:
        """Step of the next iterator; may be set at any time before one is made."""
        return self._step

    @step.setter
    def step(self, value: int) -> None:
        self._step = count(f"{_WHAT}: step", value, 0, UnitError)
        self._is_left = False

    def places(self, step: int) -> list[int]:
        """Return the places of this rank's samples in the batch of all ranks, from 0 on.

        For ``Seeds`` where the same number may come twice in a step (a batch over the end of an epoch, data sets of
        several folders).

        Args:
            step: number of the step.
        """
        count(f"{_WHAT}: step", step, 0, UnitError)
        part = self.batch_size // self.world_size
        return list(range(self.rank * part, (self.rank + 1) * part))

    def samples(self, step: int) -> list[int]:
        """Return the numbers of this rank's samples at a step.

        Args:
            step: number of the step.
        """
        return [self._sample(n) for n in self._draws(step)]

    def loader(self, data: Dataset[Any], *, workers: int = 0, renders: bool = False, **options: Any) -> DataLoader[Any]:
        """Make a DataLoader of these batches, which takes nothing from torch's own generator.

        An iterator of other loaders draws from it, so that a run that is resumed would have other random numbers than
        one that was not. Data sets of ``tt.data`` with a seed, and a ``Subset`` of one, draw maps and noise anew in
        each pass over the samples.

        Args:
            data: map-style data set of ``size`` samples.
            workers: processes that read. Their own generators depend on the seed of these batches, the rank, and the
                position at which the loader was made, and begin anew with each iterator: give noise a seed of its own,
                as ``TransientDataset(seed=)`` does.
            renders: True for a data set that renders; processes are spawned then, and have one thread each
                (:func:`worker_init`).
            options: other arguments of the DataLoader.

        Raises:
            UnitError: for data sets of another size.
        """
        # One of torch's need not know its length.
        size = len(data) if hasattr(data, "__len__") else self.size
        if size != self.size:
            raise UnitError(f"{_WHAT}: they are of {self.size} samples, the data set has {size}.")
        own: dict[str, Any] = {"generator": self._of_workers()}
        if workers and renders:
            own |= {"multiprocessing_context": "spawn", "persistent_workers": True, "worker_init_fn": worker_init}
        whole: Any = data
        places: Sequence[int] = range(self.size)
        while type(whole) is Subset:
            whole, places = whole.dataset, [whole.indices[place] for place in places]
        own["batch_sampler"] = self
        if getattr(whole, "takes_passes", False):
            data, own["batch_sampler"] = whole, _WithPasses(self, places)
        return DataLoader(data, num_workers=workers, **{**own, **options})

    def epoch(self, step: int) -> float:
        """Return the number of passes over the data set before a step.

        Args:
            step: number of the step.
        """
        return count(f"{_WHAT}: step", step, 0, UnitError) * self.batch_size / self.size

    def __iter__(self) -> Iterator[list[int]]:
        self._check_position("an iterator")
        step = self._step
        while True:
            self._is_left = True
            yield self.samples(step)
            step += 1

    def state_dict(self) -> dict[str, Any]:
        """Return position and order; the number of ranks is no part of it."""
        self._check_position("a state")
        return {"step": self._step, **self._order()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Put the position of a state back.

        Args:
            state: result of :meth:`state_dict`.

        Raises:
            StorageError: where samples would come in another order than that of the state.
        """
        self.check_state_dict(state)
        self.step = state["step"]

    def check_state_dict(self, state: dict[str, Any]) -> None:
        """Raise the errors of :meth:`load_state_dict`, and change nothing.

        Args:
            state: result of :meth:`state_dict`.
        """
        order = {name: value for name, value in state.items() if name != "step"}
        if order != self._order() or "step" not in state:
            raise StorageError(
                f"{_WHAT}: expected the order of {order}, these have {self._order()}; another one would repeat some "
                "samples and miss others."
            )

    def _check_position(self, what: str) -> None:
        if self._is_left:
            raise StorageError(
                f"{_WHAT}: {what} would begin at step {self._step} again, from which an iterator has given batches. "
                "Set batches.step to the step that comes next, or to the same one to repeat it."
            )

    def _of_workers(self) -> torch.Generator:
        """Generator of the seeds of a loader's processes: another in each rank, and after a run has gone on."""
        key = np.random.SeedSequence([self.seed, self.rank, self._step]).generate_state(1, np.uint64)[0]
        return torch.Generator().manual_seed(int(key >> np.uint64(1)))

    def _order(self) -> dict[str, Any]:
        return {"size": self.size, "batch_size": self.batch_size, "seed": self.seed, "shuffle": self.shuffle}

    def _draws(self, step: int) -> range:
        """Numbers of this rank's samples at a step, counted over all passes."""
        number, part = count(f"{_WHAT}: step", step, 0, UnitError), self.batch_size // self.world_size
        first = number * self.batch_size + self.rank * part
        return range(first, first + part)

    def _sample(self, number: int) -> int:
        epoch, place = divmod(number, self.size)
        if not self.shuffle:
            return place
        if self._kept is None or self._kept[0] != epoch:
            self._kept = epoch, np.random.Generator(np.random.Philox([self.seed, epoch])).permutation(self.size)
        return int(self._kept[1][place])


class _WithPasses(Sampler[list[tuple[int, int]]]):
    """Batches of (number in the whole data set, passes over the samples before it)."""

    def __init__(self, batches: Batches, places: Sequence[int]) -> None:
        self.batches, self.places = batches, places

    def __iter__(self) -> Iterator[list[tuple[int, int]]]:
        for step, samples in enumerate(self.batches, self.batches.step):
            passes = [draw // self.batches.size for draw in self.batches._draws(step)]
            yield list(zip([self.places[n] for n in samples], passes, strict=True))
