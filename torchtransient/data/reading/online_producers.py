"""The producers of an online data set from the trainer's side: processes, the ring, and what goes to and fro."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import shutil
import signal
import threading
import time
import warnings
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import torch
import torch.multiprocessing  # teaches connections to hand over shared tensors

from torchtransient.data.generation.told_errors import ToldError
from torchtransient.data.reading.online_schedule import Schedule
from torchtransient.data.reading.online_worker import Layout, empty_ring, produce, said
from torchtransient.data.reading.sample_draws import outside_tensor
from torchtransient.data.recipes.outside_light import OutsideLight
from torchtransient.data.recipes.plugin_modules import plugins_here
from torchtransient.errors import ShapeError, StorageError, TorchTransientError, TorchTransientWarning, level_of_user

WHAT = "OnlineDataset"
_SHARED = Path("/dev/shm")
# Ends of producers while the same sample was rendered, and while none was, that are an error.
_MOST_ENDS, _MOST_IDLE_ENDS = 2, 3
# Samples in a row that may fail.
_MOST_FAILED = 16
# Seconds that a producer has to end once it was told to, and that one wait for messages takes.
_PATIENCE_S, _WAIT_S = 2.0, 1.0


@dataclass
class _Worker:
    """A producer. ``ready``: it has got as far as its first message; ``rendering``: number of its sample, None between
    them.
    """

    process: Any
    connection: Connection
    ready: bool = False
    rendering: int | None = None


class _EndedError(Exception):
    """A producer is gone without having said why."""


class Producers:
    """What producers say is heard when a sample is drawn. A lock keeps threads apart."""

    def __init__(self, recipe: Any, schedule: Schedule, capacity: int, workers: int, timeout_s: float) -> None:
        self.schedule, self.waited_s = schedule, 0.0
        self._packed = pickle.dumps((recipe, plugins_here()))
        self._capacity, self._count, self._timeout_s = capacity, workers, timeout_s
        self._pid, self._lock = os.getpid(), threading.Lock()
        self._workers: list[_Worker] = []
        self._ring: dict[str, torch.Tensor] = {}
        self._layout: Layout | None = None
        # By place in the ring: number of the sample, its values, and shares of its light outside of the window.
        self._beside: dict[int, tuple[int, dict[str, Any], tuple[float, float]]] = {}
        self._ends: Counter[int | None] = Counter()
        self._failure: BaseException | None = None
        self._closed = False
        self.failed = self._failed_in_a_row = 0

    def start(self) -> None:
        """Start the processes, and tell them what to make."""
        for _ in range(self._count):
            self._workers.append(self._started())
        self._give_orders()

    def _started(self) -> _Worker:
        context = multiprocessing.get_context("spawn")
        here, there = context.Pipe()
        process = context.Process(target=produce, args=(there, self._packed), name=WHAT, daemon=True)
        try:
            with _interrupts_held_back():
                process.start()
        except BaseException:
            here.close()
            raise
        finally:
            there.close()
        return _Worker(process, here)

    # --------------------------------------------------------------------------------------------------- one draw

    def draw(self) -> dict[str, Any]:
        """A sample that is the caller's own. Raises what a producer has raised."""
        with self._lock:
            self._check()
            try:
                self._listen(0.0)
                if not self.schedule.can_draw():
                    self._wait()
                if not self.schedule.drawn:
                    OutsideLight.of(outside for _, _, outside in self._beside.values()).warn(WHAT)
                sample = self._copy(self.schedule.draw())
                # Not before it is copied: its place may be the oldest, which the next order goes to.
                self._give_orders()
            except BaseException as error:
                # An interrupt too: it may have cut a message in two.
                self._failure = error if isinstance(error, Exception) else None
                self.close()
                raise
            return sample

    def _copy(self, slot: int) -> dict[str, Any]:
        """What stands at a place of the ring, as the caller's own."""
        index, values, outside = self._beside[slot]
        sample: dict[str, Any] = {name: array[slot].clone() for name, array in self._ring.items()}
        sample["values"] = {key: v if isinstance(v, str) else _own_tensor(v) for key, v in values.items()}
        sample |= {"outside": outside_tensor(outside), "index": index}
        return sample

    def _check(self) -> None:
        if os.getpid() != self._pid:
            raise TorchTransientError(
                f"{WHAT}: it belongs to the process that made it, and this one was forked from that; make one here, or "
                "use DataLoader(..., num_workers=0)."
            )
        if self._failure is not None:
            raise self._failure
        if self._closed:
            raise TorchTransientError(f"{WHAT}: it is closed; make a new one.")

    def _wait(self) -> None:
        started = news = time.monotonic()
        while not self.schedule.can_draw():
            if self._listen(_WAIT_S):
                news = time.monotonic()
            elif time.monotonic() - news > self._timeout_s:
                busy = [str(worker.rendering) for worker in self._workers if worker.rendering is not None]
                raise TorchTransientError(
                    f"{WHAT}: no news of {len(self._workers)} producers for {self._timeout_s:g} s, at work on samples "
                    f"{', '.join(busy) or '(none)'}. If samples take so long, set timeout_s."
                )
        self.waited_s += time.monotonic() - started

    # --------------------------------------------------------------------------------------------------- messages

    def _listen(self, seconds: float) -> bool:
        """Take in what has been said, wait so long for it, and give new orders; whether there was anything."""
        self._give_orders()
        # A producer that has ended is heard to the end: its connection closes with it.
        heard = wait([worker.connection for worker in self._workers], seconds)
        for n, worker in enumerate(self._workers):
            if worker.connection in heard:
                try:
                    self._hear(worker)
                except _EndedError:
                    self._workers[n] = self._replacement(n, worker)
        self._give_orders()
        return bool(heard)

    def _hear(self, worker: _Worker) -> None:
        while True:
            try:
                if not worker.connection.poll(0):
                    return
                message = worker.connection.recv()
            except (EOFError, OSError):
                raise _EndedError from None
            self._take(worker, *message)

    def _take(self, worker: _Worker, kind: str, *rest: Any) -> None:
        worker.ready = True
        if kind == "start":
            worker.rendering = rest[0]
        elif kind == "layout":
            self._agree(rest[0])
            self._say(worker, "ring", self._ring)
        elif kind == "done":
            index, values, outside = rest
            worker.rendering = None
            self._beside[self.schedule.finished(index)] = index, values, outside
            self._failed_in_a_row = 0
        elif kind == "failed":
            worker.rendering = None
            self._leave_out(*rest)
        elif kind == "error":
            _raise(*rest)

    def _leave_out(self, index: int, reason: str) -> None:
        """Of a sample that fails."""
        self.schedule.failed(index)
        self.failed += 1
        self._failed_in_a_row += 1
        if self._failed_in_a_row >= _MOST_FAILED:
            raise TorchTransientError(
                f"{WHAT}: {_MOST_FAILED} samples failed one after another, the last one, {index}: {reason}"
            )
        warnings.warn(f"{WHAT}: sample {index} is left out: {reason}", TorchTransientWarning, level_of_user())

    def _say(self, worker: _Worker, *message: Any) -> None:
        try:
            worker.connection.send(message)
        except OSError:
            # It has ended, which is found when it is listened to.
            return

    def _give_orders(self) -> None:
        for n, worker in enumerate(self._workers):
            while (order := self.schedule.order(n)) is not None:
                self._say(worker, "make", order.index, order.slot)

    def _agree(self, layout: Layout) -> None:
        """Make the ring for samples of a layout, or see that it is the one that it was made for."""
        if self._layout is None:
            _check_memory(layout, self._capacity)
            self._ring, self._layout = empty_ring(layout, self._capacity), layout
        elif layout != self._layout:
            raise ShapeError(
                f"{WHAT}: the samples of a recipe have the same names, shapes and types, expected "
                f"{said(self._layout)}, got {said(layout)}."
            )

    # -------------------------------------------------------------------------------------------------------- ends

    def _replacement(self, number: int, worker: _Worker) -> _Worker:
        """Another process in place of one that has ended without saying why."""
        _end([worker])
        code = worker.process.exitcode
        how = f"by signal {-code}" if code is not None and code < 0 else f"with exit code {code}"
        if not worker.ready:
            raise TorchTransientError(
                f"{WHAT}: a producer ended {how} before it could say anything; its own output has the reason. A script "
                'that makes an online data set needs `if __name__ == "__main__":`, and its recipe has to be found by '
                "import."
            )
        index = worker.rendering
        self._ends[index] += 1
        doing = "between two samples" if index is None else f"while it rendered sample {index}"
        if self._ends[index] >= (_MOST_IDLE_ENDS if index is None else _MOST_ENDS):
            raise TorchTransientError(
                f"{WHAT}: a producer ended {how} {doing}, {self._ends[index]} times now. Signal 9 is most likely the "
                "system's, for want of memory: use fewer workers, or a smaller capacity."
            )
        warnings.warn(
            f"{WHAT}: a producer ended {how} {doing}; another one takes its place.", TorchTransientWarning, stacklevel=6
        )
        self.schedule.lost(number)
        return self._started()

    def close(self) -> None:
        """End all processes, and let go of the ring. Does nothing in a process that was forked from this one."""
        if os.getpid() != self._pid or self._closed:
            return
        self._closed = True
        workers, self._workers = self._workers, []
        _end(workers)
        self._ring, self._beside = {}, {}


def _own_tensor(value: Any) -> torch.Tensor:
    return torch.from_numpy(np.array(value))


def _raise(error: BaseException | None, text: str) -> NoReturn:
    """The exception of a producer, with what was printed of it there."""
    if isinstance(error, Exception):
        raise error from ToldError(text)
    raise TorchTransientError(f"{WHAT}: a producer failed: {text.strip().splitlines()[-1]}") from ToldError(text)


def _end(workers: list[_Worker]) -> None:
    for worker in workers:
        worker.connection.close()
        worker.process.terminate()
    until = time.monotonic() + _PATIENCE_S
    for worker in workers:
        worker.process.join(max(0.0, until - time.monotonic()))
        if worker.process.is_alive():
            worker.process.kill()
            worker.process.join()


@contextmanager
def _interrupts_held_back() -> Iterator[None]:
    """Processes that are started meanwhile do not get Ctrl-C, from their first instruction on."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _check_memory(layout: Layout, capacity: int) -> None:
    """Memory that the system shares has a limit of its own, beyond which a write ends the process."""
    sizes = [int(np.prod(shape, dtype=np.int64)) * np.dtype(kind).itemsize for shape, kind in layout.values()]
    needed = capacity * sum(sizes)
    if not _SHARED.is_dir():
        return
    free = shutil.disk_usage(_SHARED).free
    if needed > free:
        raise StorageError(
            f"{WHAT}: {capacity} samples of {needed / capacity / 2**20:.3g} MiB need {needed / 2**30:.3g} GiB of "
            f"shared memory, {_SHARED} has {free / 2**30:.3g} GiB. Use a smaller capacity "
            f"({int(free * 0.8 * capacity // needed)}), or give it more (of a container: --shm-size)."
        )
