"""How workers are driven, whatever they are: shards are handed out one at a time, signs of life are listened for, who
dies or hangs is replaced. Engines say what a worker is.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from types import TracebackType
from typing import Any, Generic, Self, TypeVar

from torchtransient.data.generation.ledger import MEASURING, Ledger
from torchtransient.data.generation.settings import Settings
from torchtransient.data.generation.shard_making import Measured, raised
from torchtransient.data.generation.told_errors import ToldError
from torchtransient.errors import TorchTransientError

# Seconds without a sign of life: while a worker starts or finishes a file, and in its first sample, which compiles; in
# later samples at least so long, and so many times the slowest one so far.
PATIENCE_S, LEAST_S, TIMES_SLOWEST = 600.0, 120.0, 30.0
# Starts in a row that may come to nothing.
MOST_STARTS = 10
LOOK_S = 0.5


class Member:
    """A worker as the run sees it."""

    def __init__(self) -> None:
        self.ready = self.warm = False
        self.shard: int | None = None
        self.sample: int | None = None
        self.heard = self.began = time.monotonic()

    def hand(self, task: tuple[Any, ...]) -> None:
        """Give it something to do: ("measure", indices, skip) or ("shard", number, description, skip, first)."""
        self.shard, self.sample = MEASURING if task[0] == "measure" else task[1], None
        self.heard = time.monotonic()
        self.send(task)

    def send(self, task: tuple[Any, ...]) -> None:
        """Bring it there. That the worker is gone is found later."""
        raise NotImplementedError

    def end(self) -> None:
        """End it at once, if it lives."""
        raise NotImplementedError


AnyMember = TypeVar("AnyMember", bound=Member)


class Crew(ABC, Generic[AnyMember]):
    """Workers over the shards of a ledger. A context manager: on the way out no worker is left."""

    def __init__(self, settings: Settings, workers: int, ledger: Ledger, timeout_s: float | None) -> None:
        self.settings, self.wanted, self.ledger, self.timeout_s = settings, workers, ledger, timeout_s
        self.workers: list[AnyMember] = []
        self._starts = 0
        self._slowest = 0.0
        self._looked = time.monotonic()
        self._measured: Measured | None = None

    # What to do where workers do not start.
    hint = ""

    @abstractmethod
    def start(self) -> AnyMember:
        """A new worker."""

    @abstractmethod
    def look(self) -> None:
        """Wait half a second at most; call :meth:`heard` for what workers said, then :meth:`bury` for who is gone."""

    @abstractmethod
    def close(self, stopped: bool) -> None:
        """End all workers; ``stopped``: in the middle of their work."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close(kind is not None)

    def measure(self, indices: range) -> Measured:
        """What the first sample that can be made tells."""
        self.ledger.add([MEASURING])
        self._run(lambda shard: ("measure", indices, self.ledger.skip(shard)))
        if self._measured is None:
            raise TorchTransientError("generate: no sample was measured.")
        return self._measured

    def make(self, shards: list[int], described: dict[str, Any]) -> None:
        """Make these shards."""
        self.ledger.add(shards)
        ledger = self.ledger
        self._run(lambda shard: ("shard", shard, described, ledger.skip(shard), ledger.suspects(shard)))

    def _run(self, task: Callable[[int], tuple[Any, ...]]) -> None:
        ledger = self.ledger
        self._looked = time.monotonic()
        while ledger.waiting or any(worker.shard is not None for worker in self.workers):
            busy = sum(worker.shard is not None for worker in self.workers)
            while len(self.workers) < min(self.wanted, busy + len(ledger.waiting)):
                self.workers.append(self.start())
            for worker in self.workers:
                if worker.ready and worker.shard is None and (shard := ledger.take()) is not None:
                    worker.hand(task(shard))
            self.look()
            self._end_hung()

    def bury(self, worker: AnyMember, how: str, own_fault: bool, for_good: bool = False) -> None:
        """A worker is gone. ``for_good``: the next one will not start either, if this one did not. Raises
        TorchTransientError where that has no end.
        """
        worker.end()
        self.workers.remove(worker)
        if not worker.ready:
            self._starts += 1
            if for_good or self._starts >= MOST_STARTS:
                raise TorchTransientError(f"generate: a worker ended {how} while it started. {self.hint}")
        self.ledger.lost(worker.shard, worker.sample, how, own_fault)

    def _end_hung(self) -> None:
        now = time.monotonic()
        # Where this process was stopped for a while, workers had no ear to talk to.
        away = now - self._looked > 4 * LOOK_S
        self._looked = now
        for worker in list(self.workers):
            if away:
                worker.heard = now
            silent = now - worker.heard
            limit = self._limit(worker) if worker.ready else self.patience_to_start()
            if (worker.shard is not None or not worker.ready) and silent > limit:
                self.bury(worker, f"by no sign of life for {silent:.0f} s", own_fault=True)

    def patience_to_start(self) -> float:
        """Seconds that a worker may take until it is ready."""
        return PATIENCE_S

    def _limit(self, worker: AnyMember) -> float:
        if worker.sample is None:
            return PATIENCE_S
        if self.timeout_s is not None:
            return self.timeout_s
        return max(LEAST_S if worker.warm else PATIENCE_S, TIMES_SLOWEST * self._slowest)

    # ---------------------------------------------------------------------------------------------- what workers say

    def heard(self, worker: AnyMember, kind: str, *facts: Any) -> None:
        """A message of a worker. Raises the error that it says ends the run."""
        worker.heard = time.monotonic()
        getattr(self, f"_on_{kind}")(worker, *facts)

    def _on_ready(self, worker: AnyMember) -> None:
        worker.ready = True
        self._starts = 0

    def _on_begin(self, worker: AnyMember, _shard: int, index: int) -> None:
        worker.sample, worker.began = index, time.monotonic()

    def _on_end(self, worker: AnyMember, shard: int, index: int, failed: str | None) -> None:
        if worker.sample == index and worker.warm:
            self._slowest = max(self._slowest, time.monotonic() - worker.began)
        worker.sample, worker.warm = None, True
        self.ledger.ended(shard, index, failed)

    def _on_retry(self, worker: AnyMember, shard: int, index: int, reason: str) -> None:
        # A fresh maker compiles again.
        worker.warm = False
        self.ledger.log("retry", shard=shard, sample=index, reason=reason)

    def _on_closing(self, worker: AnyMember, _shard: int) -> None:
        worker.sample = None

    def _on_wrote(self, worker: AnyMember, shard: int, samples: int, failed: int, size: int) -> None:
        worker.shard = worker.sample = None
        self.ledger.wrote(shard, samples, failed, size)

    def _on_measured(self, worker: AnyMember, measured: Measured) -> None:
        worker.shard = worker.sample = None
        self._measured = measured

    def _on_traced(self, _worker: AnyMember, shard: int, index: int, trace: str) -> None:
        self.ledger.log("traceback", shard=shard, sample=index, trace=trace)

    def _on_fatal(self, worker: AnyMember, kind: str, message: str, trace: str) -> None:
        self.ledger.log("error", shard=worker.shard, sample=worker.sample, error=f"{kind}: {message}", trace=trace)
        raise raised(kind, message) from ToldError(trace)
