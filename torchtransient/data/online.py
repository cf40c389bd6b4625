"""Rendering while training: processes fill a ring of samples in shared memory, and the trainer draws from it at random.
"""

from __future__ import annotations

import math
import os
import pickle
import random
import shutil
import threading
import time
import warnings
import weakref
from collections import Counter, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import torch
import torch.multiprocessing  # lets connections carry shared tensors
from torch.utils.data import IterableDataset

from torchtransient.array_files.free_memory import size_in_words
from torchtransient.checks import MOST, a_recipe, as_number, count, shown
from torchtransient.data.online_worker import Layout, empty_ring, layout_text, produce
from torchtransient.data.processes import WorkerError, registered_plugins, spawned
from torchtransient.data.sample import OutsideLight, measurement, outside_tensor, value_tensors
from torchtransient.errors import (
    ShapeError,
    StorageError,
    TorchTransientError,
    TorchTransientWarning,
    UnitError,
    level_of_user,
)

# Samples that are ordered ahead from one producer at most: it renders them while the trainer is busy.
MOST_AHEAD = 64
WHAT = "OnlineDataset"
_SHARED = Path("/dev/shm")
# Ends of producers that are an error, at the same sample and between samples.
_MOST_ENDS, _MOST_IDLE_ENDS = 2, 3
# Failed samples in a row that are an error.
_MOST_FAILED = 16
# Seconds for producers to end, and of one wait for messages.
_PATIENCE_S, _WAIT_S = 2.0, 1.0


class OnlineDataset(IterableDataset[dict[str, Any]]):
    """Samples of a recipe, rendered while they are used: endless, drawn at random from the latest ``capacity`` of them.

    A sample is a dictionary like those of :class:`~torchtransient.data.TransientDataset`: its arrays by name as tensors
    of the caller's own, ``values`` by key, ``outside`` and ``index`` in the recipe. ``DataLoader(data, batch_size=8)``
    makes batches; ``num_workers`` other than 0 is an error, since the data set has processes of its own. ::

        with OnlineDataset(recipe, workers=2) as data:
            for step, batch in zip(range(10_000), DataLoader(data, batch_size=8)):
                ...

    A sample depends on recipe and number alone, the order of samples on the speed at which they are made. Ranks that
    train together have a data set each, with another ``first``. ``made``, ``drawn`` and ``waited_s`` (seconds) report
    the progress. Before the first sample is drawn, a PhysicsWarning gives the number of samples that have more than 1 %
    of their light outside of the time window; they are kept.

    A sample that fails (a TorchTransientError of its scene) is left out with a warning, and counted in ``failed``; 16
    in a row are an error. Any other exception of a producer is raised where samples are drawn. A producer that ends
    otherwise (killed, a crash) is started again with a warning; one that ends twice at the same sample is an error.
    ``close()``, the end of the with-block, of the object or of the process end the producers and free the memory.

    Args:
        recipe: :class:`Recipe`, or an object that pickles and has ``maker()``.
        capacity: number of samples that are kept, in shared memory.
        workers: processes that render, with one thread each. They are spawned, so a script needs ``if __name__ ==
            "__main__":``.
        uses: number of times that a sample is used on average. The trainer waits for a new sample where it has drawn
            ``uses`` times as many as were made; a producer waits until the samples that it would replace have been used
            that often. With ``math.inf`` none of them waits, and the oldest sample is replaced.
        seed: seed of the random choice of samples.
        warm: number of samples that are made before the first is drawn, at most ``capacity``.
        first: number of the first sample; the others follow, each once. Leaves out the samples of a validation set.
        transform: function of the transient; its result stands under ``measurement``.
        timeout_s: seconds without news from a producer that are an error.

    Raises:
        UnitError: for numbers out of range.
        StorageError: for too little shared memory.
        ShapeError: for samples of several kinds.
        TorchTransientError: for producers that end or fail.

    Not supported: pickling, use in processes that were forked.
    """

    def __init__(
        self, recipe: Any, capacity: int = 1024, *, workers: int = 1, uses: float = 5.0, seed: int = 0, warm: int = 64,
        first: int = 0, transform: Callable[[torch.Tensor], Any] | None = None, timeout_s: float = 600.0,
    ) -> None:  # fmt: skip
        super().__init__()

        def whole(name: str, value: Any, least: int = 1) -> int:
            return count(f"{WHAT}: {name}", value, least, UnitError, None if name == "seed" else MOST)

        capacity, workers, warm = whole("capacity", capacity, 2), whole("workers", workers), whole("warm", warm)
        first, seed = whole("first", first, 0), whole("seed", seed, 0)
        for name, value in (("uses", uses), ("timeout_s", timeout_s)):
            if (number := as_number(value)) is None or not number > 0:
                raise UnitError(f"{WHAT}: expected {name} as a number above zero, got {shown(value)}.")
        a_recipe(WHAT, recipe, "maker")
        self.transform = transform
        schedule = Schedule(capacity, workers, float(uses), min(warm, capacity), first, seed)
        self._producers = Producers(recipe, schedule, capacity, workers, float(timeout_s))
        # Also when the object is freed, and at the end of the interpreter.
        self._finalizer = weakref.finalize(self, self._producers.close)
        try:
            self._producers.start()
        except BaseException:
            self.close()
            raise

    def __iter__(self) -> Iterator[dict[str, Any]]:
        while True:
            yield self.draw()

    def draw(self) -> dict[str, Any]:
        """Draw one sample; waits where no sample may be used."""
        sample = self._producers.draw()
        if self.transform is not None:
            sample["measurement"] = measurement(WHAT, self.transform, sample)
        return sample

    @property
    def made(self) -> int:
        """Samples that were rendered."""
        return self._producers.schedule.made

    @property
    def failed(self) -> int:
        """Samples that could not be rendered."""
        return self._producers.failed

    @property
    def drawn(self) -> int:
        """Samples that were drawn."""
        return self._producers.schedule.drawn

    @property
    def waited_s(self) -> float:
        """Seconds that draws have waited for samples."""
        return self._producers.waited_s

    def close(self) -> None:
        """End the producers and free the memory; samples that were drawn stay."""
        self._finalizer()

    def __enter__(self) -> OnlineDataset:
        return self

    def __exit__(self, *raised: object) -> None:
        self.close()

class Producers:
    """Processes that render, their ring, and their messages, which are read when a sample is drawn. A lock keeps
    threads apart.

    Args:
        recipe: recipe that pickles.
        schedule: order in which places of the ring are written and read.
        capacity: number of samples in the ring.
        workers: number of processes.
        timeout_s: seconds without news from a producer that are an error.
    """

    def __init__(self, recipe: Any, schedule: Schedule, capacity: int, workers: int, timeout_s: float) -> None:
        self.schedule, self.waited_s = schedule, 0.0
        self._packed = pickle.dumps((recipe, registered_plugins()))
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
        """Start the processes, and order the first samples."""
        for _ in range(self._count):
            self._workers.append(_Worker(*spawned(produce, self._packed, WHAT)))
        self._give_orders()

    # --------------------------------------------------------------------------------------------------- one draw

    def draw(self) -> dict[str, Any]:
        """Draw a sample of the caller's own. Raises the errors of producers."""
        with self._lock:
            self._check()
            try:
                self._listen(0.0)
                if not self.schedule.can_draw():
                    self._wait()
                if not self.schedule.drawn:
                    OutsideLight.of(outside for _, _, outside in self._beside.values()).warn(WHAT)
                sample = self._copy(self.schedule.draw())
                # After the copy: the next order may go to its place.
                self._give_orders()
            except BaseException as error:
                # Interrupts too, which may have cut a message.
                self._failure = error if isinstance(error, Exception) else None
                self.close()
                raise
            return sample

    def _copy(self, slot: int) -> dict[str, Any]:
        """Copy of the sample at a place of the ring."""
        index, values, outside = self._beside[slot]
        sample: dict[str, Any] = {name: array[slot].clone() for name, array in self._ring.items()}
        return {**sample, "values": value_tensors(values), "outside": outside_tensor(outside), "index": index}

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
        """Read messages, waiting so long for them, and give new orders; True where there was a message."""
        self._give_orders()
        # The messages of a dead producer are read to the end; its connection closes with it.
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
        """Leave out a sample that fails."""
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
            # It has ended, which the next reading finds.
            return

    def _give_orders(self) -> None:
        for n, worker in enumerate(self._workers):
            while (order := self.schedule.order(n)) is not None:
                self._say(worker, "make", order.index, order.slot)

    def _agree(self, layout: Layout) -> None:
        """Make the ring for the layout of the first sample, and refuse other layouts."""
        if self._layout is None:
            _check_memory(layout, self._capacity)
            self._ring, self._layout = empty_ring(layout, self._capacity), layout
        elif layout != self._layout:
            raise ShapeError(
                f"{WHAT}: the samples of a recipe have the same names, shapes and types, expected "
                f"{layout_text(self._layout)}, got {layout_text(layout)}."
            )

    # -------------------------------------------------------------------------------------------------------- ends

    def _replacement(self, number: int, worker: _Worker) -> _Worker:
        """Start another process in place of one that has ended without a message."""
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
        return _Worker(*spawned(produce, self._packed, WHAT))

    def close(self) -> None:
        """End all processes and free the ring. Does nothing in a process that was forked from this one."""
        if os.getpid() != self._pid or self._closed:
            return
        self._closed = True
        workers, self._workers = self._workers, []
        _end(workers)
        self._ring, self._beside = {}, {}


class Schedule:
    """Turns of a ring of samples. Every place is free, ordered (a producer may write) or readable, so that no sample is
    read while it is written.

    ``made`` samples were finished, ``drawn`` times one was drawn, and ``replaced`` made room. A reader waits where one
    more draw would make ``drawn > uses * made``: that bounds the mean number of uses. A producer waits before it
    replaces a sample as long as a reader could use the replaced ones once more, ``drawn + 1 <= uses * (replaced + 1)``.
    The two never wait for each other, since ``made`` is more than ``replaced`` as long as a sample is readable. The
    oldest is replaced first.

    Args:
        capacity: number of places.
        producers: number of producers.
        uses: mean number of uses of a sample.
        warm: number of samples that are made before the first draw.
        first: number of the first sample.
        seed: seed of the random choice of samples.
    """

    def __init__(self, capacity: int, producers: int, uses: float, warm: int, first: int, seed: int) -> None:
        self.uses, self.warm = uses, warm
        self.made = self.drawn = self.replaced = 0
        self.ahead = max(1, min(MOST_AHEAD, capacity // (4 * producers)))
        self.orders: dict[int, Order] = {}
        self._next = first
        # Samples of producers that have ended.
        self._again: deque[int] = deque()
        self._free: deque[int] = deque(range(capacity))
        self._readable: deque[int] = deque()
        self._random = random.Random(seed)

    def order(self, producer: int) -> Order | None:
        """Return the next sample for a producer.

        Args:
            producer: number of the producer.

        Returns:
            Order, None where it has enough or has to wait.
        """
        if sum(order.producer == producer for order in self.orders.values()) >= self.ahead:
            return None
        if self._free:
            slot = self._free.popleft()
        elif len(self._readable) > 1 and self._has_served():
            slot = self._readable.popleft()
            self.replaced += 1
        else:
            return None
        if self._again:
            index = self._again.popleft()
        else:
            index, self._next = self._next, self._next + 1
        order = self.orders[index] = Order(index, slot, producer)
        return order

    def _has_served(self) -> bool:
        return math.isinf(self.uses) or self.drawn + 1 > self.uses * (self.replaced + 1)

    def finished(self, index: int) -> int:
        """Record a finished sample.

        Args:
            index: number of the sample in the recipe, from 0.

        Returns:
            Its place.
        """
        slot = self.orders.pop(index).slot
        self._readable.append(slot)
        self.made += 1
        return slot

    def failed(self, index: int) -> None:
        """Record a sample that cannot be made: its place is free for another one.

        Args:
            index: number of the sample in the recipe, from 0.
        """
        self._free.append(self.orders.pop(index).slot)

    def lost(self, producer: int) -> None:
        """Record a producer that has ended: its samples are ordered again, from others.

        Args:
            producer: number of the producer.
        """
        orders = sorted((o for o in self.orders.values() if o.producer == producer), key=lambda order: order.index)
        for order in orders:
            del self.orders[order.index]
            self._free.append(order.slot)
        self._again.extendleft(order.index for order in reversed(orders))

    def can_draw(self) -> bool:
        """Return True where a reader need not wait."""
        return bool(self._readable) and self.made >= self.warm and self.drawn + 1 <= self.uses * self.made

    def draw(self) -> int:
        """Draw a readable place at random."""
        self.drawn += 1
        return self._readable[self._random.randrange(len(self._readable))]


@dataclass
class Order:
    """Sample that was ordered from a producer.

    Args:
        index: number of the sample in the recipe, from 0.
        slot: place that it goes to.
        producer: number of the producer.
    """

    index: int
    slot: int
    producer: int


@dataclass
class _Worker:
    """Producer. ``ready``: it has sent a message; ``rendering``: number of its sample, None between samples."""

    process: Any
    connection: Connection
    ready: bool = False
    rendering: int | None = None


class _EndedError(Exception):
    """A producer has ended without a message."""


def _raise(error: BaseException | None, text: str) -> NoReturn:
    """Raise the exception of a producer, caused by the traceback that was printed there."""
    if isinstance(error, Exception):
        raise error from WorkerError(text)
    raise TorchTransientError(f"{WHAT}: a producer failed: {text.strip().splitlines()[-1]}") from WorkerError(text)


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


def _check_memory(layout: Layout, capacity: int) -> None:
    """Memory that the system shares has a limit of its own, beyond which a write ends the process."""
    sizes = [int(np.prod(shape, dtype=np.int64)) * np.dtype(kind).itemsize for shape, kind in layout.values()]
    needed = capacity * sum(sizes)
    if not _SHARED.is_dir():
        return
    free = shutil.disk_usage(_SHARED).free
    if needed > free:
        raise StorageError(
            f"{WHAT}: {capacity} samples of {size_in_words(needed / capacity)} need {size_in_words(needed)} of "
            f"shared memory, {_SHARED} has {size_in_words(free)}. Use a smaller capacity "
            f"({int(free * 0.8 * capacity // needed)}), or give it more (of a container: --shm-size)."
        )
