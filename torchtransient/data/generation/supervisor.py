"""The local engine: processes that are watched, replaced when they die or hang, and ended with the run."""

from __future__ import annotations

import contextlib
import multiprocessing
import signal
import time
from multiprocessing import connection
from typing import Any

from torchtransient.data.generation.ledger import MEASURING, Ledger
from torchtransient.data.generation.settings import Settings
from torchtransient.data.generation.shard_making import Measured, raised
from torchtransient.data.generation.worker import work
from torchtransient.errors import TorchTransientError

# Seconds without a sign of life: while a worker starts or finishes a file, in its first sample, which compiles, and, as
# a least value and as a multiple of the slowest sample so far, in later ones.
PATIENCE_S, LEAST_S, TIMES_SLOWEST = 600.0, 120.0, 30.0
# Starts in a row that may come to nothing.
MOST_STARTS = 10
END_S = 10.0
_LOOK_S = 0.5
_OUTSIDE = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP)


class _Worker:
    """A process, what it does, and when it was last heard of."""

    def __init__(self, settings: Settings) -> None:
        context = multiprocessing.get_context("spawn")
        self.link, theirs = context.Pipe()
        self.process = context.Process(target=work, args=(theirs, settings), daemon=True)
        # The child inherits this: Ctrl-C at a terminal reaches it before it can say that it does not want any.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            self.process.start()
        finally:
            theirs.close()
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        self.ready = self.warm = False
        self.shard: int | None = None
        self.sample: int | None = None
        self.heard = self.began = time.monotonic()

    def hand(self, task: tuple[Any, ...]) -> None:
        """Give it something to do. That it is gone is found later."""
        self.shard, self.sample, self.heard = (MEASURING if task[0] == "measure" else task[1]), None, time.monotonic()
        with contextlib.suppress(OSError):
            self.link.send(task)

    def how(self) -> str:
        """How it ended."""
        code = self.process.exitcode
        if code is not None and code < 0:
            with contextlib.suppress(ValueError):
                return f"by {signal.Signals(-code).name}"
        return f"with status {code}"

    def own_fault(self) -> bool:
        """Whether nobody ended it from outside."""
        code = self.process.exitcode
        return code is None or -code not in _OUTSIDE

    def end(self) -> None:
        """Kill it, if it lives."""
        self.process.kill()
        self.process.join()
        self.link.close()


class Supervisor:
    """Runs workers over the shards of a ledger. Use as a context manager: on the way out no process is left."""

    def __init__(self, settings: Settings, workers: int, ledger: Ledger, timeout_s: float | None) -> None:
        self.settings, self.wanted, self.ledger, self.timeout_s = settings, workers, ledger, timeout_s
        self._workers: list[_Worker] = []
        self._starts = 0
        self._slowest = 0.0
        self._looked = time.monotonic()
        self._task: Any = None
        self._measured: Measured | None = None

    def __enter__(self) -> Supervisor:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: Any) -> None:
        """Workers that have nothing to do are asked to end, those of a run that was stopped are told to."""
        try:
            for worker in self._workers:
                with contextlib.suppress(OSError):
                    worker.link.send(("stop",)) if kind is None else worker.process.terminate()
            until = time.monotonic() + END_S
            for worker in self._workers:
                worker.process.join(max(0.0, until - time.monotonic()))
        finally:
            for worker in self._workers:
                worker.end()
            self._workers.clear()

    def measure(self, indices: range) -> Measured:
        """What the first sample that can be made tells."""
        self.ledger.add([MEASURING])
        self._task = lambda shard: ("measure", indices, self.ledger.skip(shard))
        self._run()
        if self._measured is None:
            raise TorchTransientError("generate: no sample was measured.")
        return self._measured

    def make(self, shards: list[int], described: dict[str, Any]) -> None:
        """Make these shards."""
        self.ledger.add(shards)
        self._task = lambda shard: (
            "shard", shard, described, self.ledger.skip(shard), self.ledger.suspects(shard),
        )  # fmt: skip
        self._run()

    # ------------------------------------------------------------------------------------------------------- the loop

    def _run(self) -> None:
        while self.ledger.waiting or any(worker.shard is not None for worker in self._workers):
            self._staff()
            for worker in self._workers:
                if worker.ready and worker.shard is None and (shard := self.ledger.take()) is not None:
                    worker.hand(self._task(shard))
            ends = [end for worker in self._workers for end in (worker.link, worker.process.sentinel)]
            connection.wait(ends, timeout=_LOOK_S)
            for worker in list(self._workers):
                # What a worker said before it died comes first.
                dead = not worker.process.is_alive()
                self._listen(worker)
                if dead:
                    self._bury(worker, worker.how(), worker.own_fault())
            self._end_hung()

    def _staff(self) -> None:
        """As many workers as there is work for."""
        busy = sum(worker.shard is not None for worker in self._workers)
        while len(self._workers) < min(self.wanted, busy + len(self.ledger.waiting)):
            self._workers.append(_Worker(self.settings))

    def _listen(self, worker: _Worker) -> None:
        with contextlib.suppress(EOFError, OSError):
            while worker.link.poll():
                kind, *rest = worker.link.recv()
                worker.heard = time.monotonic()
                getattr(self, f"_on_{kind}")(worker, *rest)

    def _bury(self, worker: _Worker, how: str, own_fault: bool) -> None:
        worker.end()
        self._workers.remove(worker)
        if not worker.ready:
            self._starts += 1
            # An exit of its own, before it could say anything, comes again.
            if not how.startswith("by ") or self._starts >= MOST_STARTS:
                raise TorchTransientError(
                    f"generate: a worker ended {how} while it started; what it said itself stands above. A script that "
                    "calls generate is imported by its workers: put the call under if __name__ == '__main__'."
                )
        self.ledger.lost(worker.shard, worker.sample, how, own_fault)

    def _end_hung(self) -> None:
        now = time.monotonic()
        # Where this process was stopped for a while, workers had no ear to talk to.
        away = now - self._looked - 2 * _LOOK_S
        self._looked = now
        for worker in list(self._workers):
            if away > 0:
                worker.heard += away
            if (worker.shard is not None or not worker.ready) and now - worker.heard > self._limit(worker):
                self._bury(worker, f"by no sign of life for {now - worker.heard:.0f} s", True)

    def _limit(self, worker: _Worker) -> float:
        if worker.sample is None:
            return PATIENCE_S
        if self.timeout_s is not None:
            return self.timeout_s
        return max(LEAST_S, TIMES_SLOWEST * self._slowest) if worker.warm else max(PATIENCE_S, 2 * self._slowest)

    # ---------------------------------------------------------------------------------------------- what workers say

    def _on_ready(self, worker: _Worker) -> None:
        worker.ready = True
        self._starts = 0

    def _on_begin(self, worker: _Worker, _shard: int, index: int) -> None:
        worker.sample, worker.began = index, time.monotonic()

    def _on_end(self, worker: _Worker, shard: int, index: int, failed: str | None) -> None:
        if worker.sample == index and worker.warm:
            self._slowest = max(self._slowest, time.monotonic() - worker.began)
        worker.sample, worker.warm = None, True
        self.ledger.ended(shard, index, failed)

    def _on_retry(self, worker: _Worker, shard: int, index: int, reason: str) -> None:
        # A fresh maker compiles again.
        worker.warm = False
        self.ledger.log("retry", shard=shard, sample=index, reason=reason)

    def _on_closing(self, worker: _Worker, _shard: int) -> None:
        worker.sample = None

    def _on_wrote(self, worker: _Worker, shard: int, samples: int, failed: int, size: int) -> None:
        worker.shard = worker.sample = None
        self.ledger.wrote(shard, samples, failed, size)

    def _on_measured(self, worker: _Worker, measured: Measured) -> None:
        worker.shard = worker.sample = None
        self._measured = measured

    def _on_fatal(self, _worker: _Worker, kind: str, message: str) -> None:
        raise raised(kind, message)
