"""Workers of a run: shards are handed out one at a time, dead and silent workers are replaced, and the ledger names the
sample at which they died. Engines define the workers.
"""

from __future__ import annotations

import contextlib
import json
import os
import time
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Generic, Self, TypeVar

from torchtransient.data.processes import WorkerError
from torchtransient.data.run_settings import RunSettings
from torchtransient.data.shard_making import Measured, raised
from torchtransient.errors import TorchTransientError

LOG_FILE = "log.jsonl"
# The same words in every run; the log has the details.
DIED = "its process died or did not answer at every attempt"
MEASURING = -1
# Blame of a sample for the death of its worker: a crash or a hang, and a kill, which may come from outside.
_OWN_FAULT, _KILLED = 2, 1
# Most deaths at one shard, and of all workers without a sample in between.
MOST_OF_A_SHARD, MOST_IN_A_ROW = 20, 30
# Most deaths before the first sample: the recipe may not render at all.
MOST_BEFORE_ANY = 3
# Most seconds without a message: at the start, while a file is finished, and in the first sample, which compiles; in
# later samples the larger of the second number and so many times the slowest sample.
PATIENCE_S, LEAST_S, TIMES_SLOWEST = 600.0, 120.0, 30.0
# Failed starts in a row.
MOST_STARTS = 10
POLL_S = 0.5


class Member:
    """A worker as the run sees it. Engines define :meth:`send` and :meth:`end`."""

    def __init__(self) -> None:
        self.ready = self.warm = False
        self.shard: int | None = None
        self.sample: int | None = None
        self.last_message = self.began = time.monotonic()

    def assign(self, task: tuple[Any, ...]) -> None:
        """Hand out a task.

        Args:
            task: ("measure", indices, skip) or ("shard", number, description, skip, first).
        """
        self.shard, self.sample = MEASURING if task[0] == "measure" else task[1], None
        self.last_message = time.monotonic()
        self.send(task)

    def send(self, task: tuple[Any, ...]) -> None:
        """Send a task to the worker. A dead worker is found later.

        Args:
            task: see :meth:`assign`.
        """
        raise NotImplementedError

    def end(self) -> None:
        """End the worker at once, if it lives."""
        raise NotImplementedError


AnyMember = TypeVar("AnyMember", bound=Member)


class Crew(ABC, Generic[AnyMember]):
    """Workers over the shards of a ledger, a context manager: on exit no worker is left. Engines define :meth:`start`,
    :meth:`poll` and :meth:`close`.

    Args:
        settings: settings of the run.
        workers: largest number of workers.
        ledger: ledger of the shards to make.
        timeout_s: seconds for one sample; None for 30 times the slowest so far, at least 120.
    """

    def __init__(self, settings: RunSettings, workers: int, ledger: Ledger, timeout_s: float | None) -> None:
        self.settings, self.wanted, self.ledger, self.timeout_s = settings, workers, ledger, timeout_s
        self.workers: list[AnyMember] = []
        self._starts = 0
        self._slowest = 0.0
        self._polled = time.monotonic()
        self._measured: Measured | None = None

    @abstractmethod
    def start(self) -> AnyMember:
        """Start a worker."""

    @abstractmethod
    def poll(self) -> None:
        """Wait half a second at most; call :meth:`receive` for each message, then :meth:`remove` for each dead worker.
        """

    @abstractmethod
    def close(self, stopped: bool) -> None:
        """End all workers.

        Args:
            stopped: whether they are stopped in the middle of their work.
        """

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *raised: object) -> None:
        self.close(kind is not None)

    def measure(self, indices: range) -> Measured:
        """Measure the first sample that can be made.

        Args:
            indices: numbers of the samples to try.

        Returns:
            ``Measured`` of it.

        Raises:
            TorchTransientError: without a measurement, or as :meth:`receive`.
        """
        self.ledger.waiting.append(MEASURING)
        self._run(lambda shard: ("measure", indices, self.ledger.skip(shard)))
        if self._measured is None:
            raise TorchTransientError("generate: no sample was measured.")
        return self._measured

    def make(self, shards: list[int], described: dict[str, Any]) -> None:
        """Make shards.

        Args:
            shards: numbers of the shards.
            described: content of ``recipe.json``.

        Raises:
            TorchTransientError: where workers die without end, or the error of a worker.
        """
        ledger = self.ledger
        ledger.waiting.extend(shards)
        self._run(lambda shard: ("shard", shard, described, ledger.skip(shard), ledger.suspects(shard)))

    def _run(self, task: Callable[[int], tuple[Any, ...]]) -> None:
        ledger = self.ledger
        self._polled = time.monotonic()
        while ledger.waiting or any(worker.shard is not None for worker in self.workers):
            busy = sum(worker.shard is not None for worker in self.workers)
            while len(self.workers) < min(self.wanted, busy + len(ledger.waiting)):
                self.workers.append(self.start())
            for worker in self.workers:
                if worker.ready and worker.shard is None and (shard := ledger.take()) is not None:
                    worker.assign(task(shard))
            self.poll()
            self._end_hung()

    def remove(self, worker: AnyMember, reason: str, own_fault: bool, for_good: bool = False) -> None:
        """Remove a dead worker, whose shard is done again.

        Args:
            worker: one of ``workers``.
            reason: "by SIGKILL", for the log.
            own_fault: the worker crashed or hung, rather than being killed from outside.
            for_good: the next worker will not start either, if this one did not.

        Raises:
            TorchTransientError: where workers die without end.
        """
        worker.end()
        self.workers.remove(worker)
        if not worker.ready:
            self._starts += 1
            if for_good or self._starts >= MOST_STARTS:
                raise TorchTransientError(
                    f"generate: a worker ended {reason} while it started. Its own output stands above. Workers import "
                    "a script that calls generate: put the call under if __name__ == '__main__'."
                )
        self.ledger.lost(worker.shard, worker.sample, reason, own_fault)

    def _end_hung(self) -> None:
        now = time.monotonic()
        # This process was stopped for a while and read no messages.
        away = now - self._polled > 4 * POLL_S
        self._polled = now
        for worker in list(self.workers):
            if away:
                worker.last_message = now
            silent = now - worker.last_message
            limit = self._limit(worker) if worker.ready else PATIENCE_S
            if (worker.shard is not None or not worker.ready) and silent > limit:
                self.remove(worker, f"by no sign of life for {silent:.0f} s", own_fault=True)

    def _limit(self, worker: AnyMember) -> float:
        if worker.sample is None:
            return PATIENCE_S
        if self.timeout_s is not None:
            return self.timeout_s
        return max(LEAST_S if worker.warm else PATIENCE_S, TIMES_SLOWEST * self._slowest)

    # ---------------------------------------------------------------------------------------------- what workers say

    def receive(self, worker: AnyMember, kind: str, *facts: Any) -> None:
        """Take in a message of a worker.

        Args:
            worker: worker that has sent it.
            kind: first word, see ``ShardMaker``, and "ready", "measured", "wrote", "fatal".
            facts: its other entries.

        Raises:
            TorchTransientError: of a worker that cannot go on, of the class that it was there.
        """
        worker.last_message = time.monotonic()
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
        raise raised(kind, message) from WorkerError(trace)


class RunLog:
    """Log of a run, one line of JSON for each event in ``log.jsonl``.

    Runs on one folder share the file: a line is one write at its end. A full disk does not keep a run from ending
    properly, so lines may be missing then.

    Args:
        folder: folder of the data set.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / LOG_FILE
        with contextlib.suppress(OSError), self._path.open("ab+") as file:
            size = file.seek(0, os.SEEK_END)
            file.seek(max(0, size - 1))
            # A killed run may have left a part of a line.
            if size and file.read() != b"\n":
                file.write(b"\n")

    def __call__(self, event: str, **facts: Any) -> None:
        stamp = datetime.now(UTC).isoformat(timespec="milliseconds")
        line = json.dumps({"time": stamp, "event": event, "run": os.getpid(), **facts}, default=str) + "\n"
        with contextlib.suppress(OSError), self._path.open("ab") as file:
            file.write(line.encode())


class SampleBar:
    """Progress bar over samples, with numbers of failures and of replaced workers.

    Args:
        total: number of all samples.
        done: number of samples that are there already.
        shown: whether there is a bar.
    """

    def __init__(self, total: int, done: int, shown: bool) -> None:
        from tqdm.auto import tqdm

        self.failed = self.restarts = 0
        self._bar: Any = tqdm(
            total=total, initial=done, desc="samples", unit="sample", dynamic_ncols=True, disable=not shown
        )

    def __call__(self, samples: int, failed: int = 0, restarts: int = 0) -> None:
        """Move the bar.

        Args:
            samples: number of samples that were made; negative for samples that were lost with their shard.
            failed: number of failed ones among them.
            restarts: number of workers that were replaced.
        """
        self.failed += failed
        self.restarts += restarts
        # The terminal may be closed; the run goes on.
        with contextlib.suppress(OSError, ValueError):
            if failed or restarts:
                self._bar.set_postfix({"failed": self.failed, "restarts": self.restarts}, refresh=False)
            self._bar.update(samples)

    def close(self) -> None:
        """End the bar."""
        with contextlib.suppress(OSError, ValueError):
            self._bar.close()


@dataclass
class Ledger:
    """Shards that wait and shards that are being made, and the blame of samples at which workers die.

    A crash counts twice, a kill once, since it may come from outside; a sample with 2 (retries + 1) points is given up
    and recorded as failed.

    Args:
        retries: deaths at one sample that are tolerated.
        log: log of the run.
        bar: progress bar of the run.
        waiting: numbers of shards.
        skipped: reasons of samples that are given up, by shard.
        samples: number of samples that were made.
        failed: number of samples that failed.
        bytes: bytes of the finished shards.
        restarts: number of workers that were replaced.
        shards: number of finished shards.
    """

    retries: int
    log: RunLog
    bar: SampleBar
    waiting: deque[int] = field(default_factory=deque)
    skipped: dict[int, dict[int, str]] = field(default_factory=dict)
    samples: int = 0
    failed: int = 0
    bytes: int = 0
    restarts: int = 0
    shards: int = 0
    # Samples of shards in work, and failures among them.
    _ended: Counter[int] = field(default_factory=Counter)
    _failed: Counter[int] = field(default_factory=Counter)
    _blame: Counter[tuple[int, int]] = field(default_factory=Counter)
    _deaths: Counter[int] = field(default_factory=Counter)
    _in_a_row: int = 0

    def take(self) -> int | None:
        """Take the next shard, None where there is none."""
        return self.waiting.popleft() if self.waiting else None

    def skip(self, shard: int) -> dict[int, str]:
        """Return the samples of a shard that are given up, with the reason.

        Args:
            shard: number of the shard.

        Returns:
            Reasons by index.
        """
        return self.skipped.get(shard, {})

    def suspects(self, shard: int) -> list[int]:
        """Return the samples of a shard at which workers died; they are made first, so that no sample before them can
        be to blame.

        Args:
            shard: number of the shard.

        Returns:
            Indices in order.
        """
        skip = self.skip(shard)
        return sorted(index for of, index in self._blame if of == shard and index not in skip)

    def ended(self, shard: int, index: int, failed: str | None) -> None:
        """Record a sample that was made or failed.

        Args:
            shard: number of the shard.
            index: number of the sample in the recipe, from 0.
            failed: reason of a failure, or None.
        """
        self._in_a_row = 0
        self._blame.pop((shard, index), None)
        if shard == MEASURING:
            return
        self._ended[shard] += 1
        self._failed[shard] += failed is not None
        self.bar(1, failed=int(failed is not None))
        if failed is not None:
            self.log("failed", shard=shard, sample=index, reason=failed)

    def wrote(self, shard: int, samples: int, failed: int, size: int) -> None:
        """Record a finished shard.

        Args:
            shard: number of the shard.
            samples: number of samples in it, failed ones included.
            failed: number of failed ones among them.
            size: bytes of the file.
        """
        for counted in (self._ended, self._failed, self._deaths):
            counted.pop(shard, None)
        self.samples += samples - failed
        self.failed += failed
        self.bytes += size
        self.shards += 1
        self.log("shard", shard=shard, samples=samples - failed, failed=failed, bytes=size)

    def lost(self, shard: int | None, index: int | None, reason: str, own_fault: bool) -> None:
        """Record the death of a worker; its shard waits again.

        Args:
            shard: number of the shard that it worked on, or None.
            index: number of the sample that it worked on, or None.
            reason: cause of its death, for the log.
            own_fault: the worker crashed or hung, rather than being killed from outside.

        Raises:
            TorchTransientError: after 20 deaths at one shard, 30 in a row without a sample, 3 before the first sample.
        """
        self.restarts += 1
        self.log("death", shard=shard, sample=index, how=reason)
        self._in_a_row += 1
        if shard is None:
            self.bar(0, restarts=1)
        else:
            self.bar(-self._ended.pop(shard, 0), failed=-self._failed.pop(shard, 0), restarts=1)
            self.waiting.appendleft(shard)
            self._deaths[shard] += 1
            if index is not None:
                self._charge(shard, index, own_fault)
            deaths = self._deaths[shard]
            if shard == MEASURING and index is None and deaths >= MOST_BEFORE_ANY:
                self._give_up(f"{deaths} workers died before the first samples were made, the last one {reason}")
            if deaths > MOST_OF_A_SHARD:
                where = "the first samples" if shard == MEASURING else f"shard {shard}"
                self._give_up(f"{deaths} workers died over {where}, the last one {reason}")
        if self._in_a_row > MOST_IN_A_ROW:
            self._give_up(f"{self._in_a_row} workers died one after another without a sample, the last one {reason}")

    def totals(self) -> dict[str, int]:
        """Return the totals of the run, as log and result name them."""
        return {name: getattr(self, name) for name in ("shards", "samples", "failed", "bytes", "restarts")}

    def _charge(self, shard: int, index: int, own_fault: bool) -> None:
        self._blame[shard, index] += _OWN_FAULT if own_fault else _KILLED
        if self._blame[shard, index] >= _OWN_FAULT * (self.retries + 1):
            self.skipped.setdefault(shard, {})[index] = DIED
            self._deaths[shard] = 0
            self.log("given up", shard=shard, sample=index, reason=DIED)

    def _give_up(self, what: str) -> None:
        raise TorchTransientError(
            f"generate: {what}. log.jsonl has all of them; where the system ends processes for want of memory, take "
            "fewer workers. Finished shards are kept: the same call goes on."
        )
