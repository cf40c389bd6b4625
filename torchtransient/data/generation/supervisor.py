"""The local engine: processes that are watched, replaced when they die or hang, and ended with the run."""

from __future__ import annotations

import contextlib
import multiprocessing
import pickle
import signal
import time
from collections.abc import Iterator
from multiprocessing import connection
from typing import Any

from torchtransient.data.generation.crew import LOOK_S, Crew, Member
from torchtransient.data.generation.settings import Settings
from torchtransient.data.generation.worker import work

END_S = 10.0
_FROM_OUTSIDE = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP)


class LocalWorker(Member):
    """A process, and the pipe to it. It is spawned: a forked one has no threads of Dr.Jit."""

    def __init__(self, settings: Settings) -> None:
        super().__init__()
        context = multiprocessing.get_context("spawn")
        self.link, theirs = context.Pipe()
        self.process = context.Process(target=work, args=(theirs, pickle.dumps(settings)), daemon=True)
        # The child inherits this: Ctrl-C at a terminal reaches it before it can say that it does not want any.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            self.process.start()
        finally:
            theirs.close()
            signal.pthread_sigmask(signal.SIG_SETMASK, before)

    def send(self, task: tuple[Any, ...]) -> None:
        """Through the pipe."""
        with contextlib.suppress(OSError):
            self.link.send(task)

    def messages(self) -> Iterator[tuple[Any, ...]]:
        """What it has said since."""
        while True:
            try:
                if not self.link.poll():
                    return
                message = self.link.recv()
            except (EOFError, OSError):
                return
            yield message

    def end(self) -> None:
        """Kill it, if it lives."""
        self.process.kill()
        # One that hangs in the kernel, on a disk that is gone, is left to it.
        self.process.join(END_S)
        self.link.close()


class Supervisor(Crew[LocalWorker]):
    """The crew of one machine."""

    hint = (
        "What it said itself stands above. Workers import a script that calls generate: put the call under "
        "if __name__ == '__main__'."
    )

    def start(self) -> LocalWorker:
        """A process."""
        return LocalWorker(self.settings)

    def look(self) -> None:
        """Pipes and ends of processes."""
        connection.wait(
            [end for worker in self.workers for end in (worker.link, worker.process.sentinel)], timeout=LOOK_S
        )
        for worker in list(self.workers):
            # What a worker said before it died comes first.
            dead = not worker.process.is_alive()
            for message in worker.messages():
                self.heard(worker, *message)
            if dead:
                self._bury(worker, worker.process.exitcode or 0)

    def _bury(self, worker: LocalWorker, code: int) -> None:
        if code < 0:
            try:
                how = f"by {signal.Signals(-code).name}"
            except ValueError:
                how = f"by signal {-code}"
            self.bury(worker, how, own_fault=-code not in _FROM_OUTSIDE)
        else:
            # An exit of its own, before it could say anything, comes again.
            self.bury(worker, f"with status {code}", own_fault=True, for_good=True)

    def close(self, stopped: bool) -> None:
        """Workers that have nothing to do are asked to end, others are told to; after ten seconds they are killed."""
        try:
            for worker in self.workers:
                with contextlib.suppress(OSError):
                    worker.process.terminate() if stopped else worker.link.send(("stop",))
            until = time.monotonic() + END_S
            for worker in self.workers:
                worker.process.join(max(0.0, until - time.monotonic()))
        finally:
            for worker in self.workers:
                worker.end()
            self.workers.clear()
