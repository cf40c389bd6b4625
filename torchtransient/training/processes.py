"""The processes of a run: what `torchrun` has started, its devices and threads, and those of data loaders."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import KW_ONLY, dataclass, field
from datetime import timedelta

import torch
import torch.distributed as dist

from torchtransient.checks import as_number, count, is_one_of, positive, shown
from torchtransient.errors import DeviceError, UnitError

_TORCHRUN = ("RANK", "WORLD_SIZE", "LOCAL_RANK", "LOCAL_WORLD_SIZE")


@dataclass(frozen=True)
class Ranks:
    """This process among those of a run.

    ``rank``: its number of ``size``; ``local``: its number on this machine of ``local_size``. ``device``: where its
    tensors live. ``variant_prefix``: how the names of Mitsuba variants begin that compute there.
    """

    rank: int = 0
    size: int = 1
    _: KW_ONLY
    local: int = 0
    local_size: int = 1
    device: torch.device = field(default_factory=lambda: torch.device("cpu"))

    @property
    def is_first(self) -> bool:
        """Whether it is the one that prints and writes."""
        return self.rank == 0

    @property
    def variant_prefix(self) -> str:
        """"llvm_ad_" or "cuda_ad_"."""
        return "cuda_ad_" if self.device.type == "cuda" else "llvm_ad_"

    def mean(self, value: float) -> float:
        """The mean of a number over all ranks, which all have to ask for it. Raises UnitError."""
        number = as_number(value)
        if number is None:
            raise UnitError(f"ranks: expected one number to take the mean of, got {shown(value)}.")
        if self.size == 1:
            return number
        total = torch.tensor(number, dtype=torch.float64, device=self.device)
        dist.all_reduce(total)
        return float(total) / self.size

    def wait(self) -> None:
        """Go on when all ranks have come here: after the first one has written what the others read."""
        if self.size > 1:
            dist.barrier()


@contextmanager
def ranks(
    device: str = "cpu", *, threads: int | None = None, backend: str | None = None, timeout_s: float = 1800.0
) -> Iterator[Ranks]:
    """Join the process group of `torchrun`, and leave it at the end; without torchrun, one rank and no group. ::

        with tt.training.ranks() as ranks:                    # torchrun --nproc-per-node 2 train.py
            model = DistributedDataParallel(model) if ranks.size > 1 else model

    ``device``: "cpu" (group "gloo") or "cuda" (group "nccl", one device a rank). Dr.Jit computes on the first device
    that the process can see and has no choice of others, so that with "cuda" every rank is shown its own alone
    (CUDA_VISIBLE_DEVICES): call this before anything has used CUDA, in torch or in a variant of Mitsuba.

    ``threads``: of torch and of Dr.Jit in each rank, see :func:`torchtransient.threads`; None shares the cores of the
    machine among its ranks. They come back to what they were. ``backend``: instead of those. ``timeout_s``: so long a
    rank waits for the others.

    Raises UnitError for other devices, threads and broken settings of torchrun, DeviceError for "cuda" where there is
    none, or where it is in use already.
    """
    from torchtransient.rendering.threads import threads as set_threads

    if not is_one_of(device, ("cpu", "cuda")):
        raise UnitError(f"ranks: expected device 'cpu' or 'cuda', got {shown(device)}.")
    timeout_s = positive("ranks: timeout_s", timeout_s)
    found = _found(device)
    if device == "cuda":
        _take_device(found)
    several = found.size > 1
    with set_threads(threads if threads is not None else max(1, _cores() // found.local_size)):
        if several:
            kind = backend or ("nccl" if device == "cuda" else "gloo")
            _join(kind, timeout_s)
        try:
            yield found
        finally:
            if several and dist.is_initialized():
                dist.destroy_process_group()


def worker_init(worker: int) -> None:
    """Let a process of a DataLoader compute with one thread, of torch and of Dr.Jit: ``worker_init_fn=worker_init``.

    For data sets that render. Those processes have to be spawned, since Dr.Jit does not survive a fork
    (``multiprocessing_context="spawn"``), and are worth keeping (``persistent_workers=True``): they compile anew.
    """
    from torchtransient.rendering.threads import threads as set_threads

    set_threads(1)


def _join(kind: str, timeout_s: float) -> None:
    if dist.is_initialized():
        raise DeviceError("ranks: this process is in a group already, which it would leave at the end; open one.")
    try:
        dist.init_process_group(kind, timeout=timedelta(seconds=timeout_s))
    except ValueError as error:
        raise UnitError(f"ranks: the group cannot be joined: {error}. Start the script with torchrun.") from error


def _found(device: str) -> Ranks:
    given = {name: os.environ[name] for name in _TORCHRUN if name in os.environ}
    if not given:
        return Ranks(device=torch.device(device))
    if len(given) < len(_TORCHRUN):
        missing = ", ".join(name for name in _TORCHRUN if name not in given)
        raise UnitError(f"ranks: {', '.join(given)} are set and {missing} not; start the script with torchrun.")
    least = {"RANK": 0, "WORLD_SIZE": 1, "LOCAL_RANK": 0, "LOCAL_WORLD_SIZE": 1}
    rank, size, local, local_size = (
        count(f"ranks: {name}", _whole(given[name]), least[name], UnitError) for name in _TORCHRUN
    )
    if rank >= size or local >= local_size:
        raise UnitError(
            f"ranks: expected RANK below WORLD_SIZE and LOCAL_RANK below LOCAL_WORLD_SIZE, got {rank} of {size} and "
            f"{local} of {local_size}; start the script with torchrun."
        )
    return Ranks(rank, size, local=local, local_size=local_size, device=torch.device(device))


def _whole(text: str) -> int | str:
    return int(text) if text.isdecimal() else text


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
