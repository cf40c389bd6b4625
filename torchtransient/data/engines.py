"""Engines of a run: processes on this machine that take shards one at a time and end with the run, the calling process
alone, and actors of Ray on a cluster, which write their shards themselves.

A dead actor is replaced by the crew and not by Ray, which would repeat its shard silently: the crew knows which sample
was rendered when it died.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import pickle
import signal
import sys
import threading
import time
import warnings
from collections.abc import Iterator
from multiprocessing import connection
from multiprocessing.connection import Connection
from typing import Any, NoReturn

from torchtransient.array_files.part_files import remove_unfinished
from torchtransient.data.crew import PATIENCE_S, POLL_S, Crew, Ledger, Member
from torchtransient.data.processes import interrupts_blocked, unpacked
from torchtransient.data.run_settings import RunSettings
from torchtransient.data.shard_making import Messages, ShardMaker, execute, fatal
from torchtransient.errors import MissingPackageError, TorchTransientError, TorchTransientWarning, level_of_user
from torchtransient.rendering.threads import threads

# Seconds for a render that is under way when the supervisor is gone, and for workers at the end of a run.
LAST_SECONDS, END_S = 10.0, 10.0
# Exit status of a worker without a supervisor.
_GONE = 3
_FROM_OUTSIDE = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP)


class LocalWorker(Member):
    """Process and the pipe to it. It is spawned: a forked one has no threads of Dr.Jit.

    Args:
        settings: of the run.
    """

    def __init__(self, settings: RunSettings) -> None:
        super().__init__()
        context = multiprocessing.get_context("spawn")
        self.link, theirs = context.Pipe()
        self.process = context.Process(target=work, args=(theirs, pickle.dumps(settings)), daemon=True)
        try:
            with interrupts_blocked():
                self.process.start()
        finally:
            theirs.close()

    def send(self, task: tuple[Any, ...]) -> None:
        """Send a task through the pipe.

        Args:
            task: see ``Member.assign``.
        """
        with contextlib.suppress(OSError):
            self.link.send(task)

    def messages(self) -> Iterator[tuple[Any, ...]]:
        """Yield the messages that have come."""
        while True:
            try:
                if not self.link.poll():
                    return
                message = self.link.recv()
            except (EOFError, OSError):
                return
            yield message

    def end(self) -> None:
        """Kill the process if it lives."""
        self.process.kill()
        # A process that hangs in the kernel, on a lost disk, is left behind.
        self.process.join(END_S)
        self.link.close()


class Supervisor(Crew[LocalWorker]):
    """Crew of one machine."""

    hint = (
        "Its own output stands above. Workers import a script that calls generate: put the call under "
        "if __name__ == '__main__'."
    )

    def start(self) -> LocalWorker:
        """Start a process."""
        return LocalWorker(self.settings)

    def poll(self) -> None:
        """Read pipes, and find processes that have ended."""
        connection.wait(
            [end for worker in self.workers for end in (worker.link, worker.process.sentinel)], timeout=POLL_S
        )
        for worker in list(self.workers):
            # Messages sent before a death come first.
            dead = not worker.process.is_alive()
            for message in worker.messages():
                self.receive(worker, *message)
            if dead:
                self._remove_dead(worker, worker.process.exitcode or 0)

    def _remove_dead(self, worker: LocalWorker, code: int) -> None:
        if code < 0:
            try:
                reason = f"by {signal.Signals(-code).name}"
            except ValueError:
                reason = f"by signal {-code}"
            self.remove(worker, reason, own_fault=-code not in _FROM_OUTSIDE)
        else:
            # An exit of its own, before its first message, comes again.
            self.remove(worker, f"with status {code}", own_fault=True, for_good=True)

    def close(self, stopped: bool) -> None:
        """End the workers: idle ones are asked to, after ten seconds all are killed.

        Args:
            stopped: in the middle of their work; they are terminated.
        """
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


class InProcessWorker(Member):
    """Worker without a process, which executes its task when the crew polls.

    Args:
        settings: of the run.
    """

    def __init__(self, settings: RunSettings) -> None:
        super().__init__()
        self.maker = ShardMaker(settings)
        self.task: tuple[Any, ...] | None = None

    def send(self, task: tuple[Any, ...]) -> None:
        """Keep a task.

        Args:
            task: see ``Member.assign``.
        """
        self.task = task

    def end(self) -> None:
        """Free the scenes."""
        self.maker.close()


class InProcessCrew(Crew[InProcessWorker]):
    """Crew of the calling process, which has one thread until the run ends. Errors of samples are retried as on other
    engines; a crash ends the run.
    """

    def __init__(self, settings: RunSettings, workers: int, ledger: Ledger, timeout_s: float | None) -> None:
        super().__init__(settings, 1, ledger, timeout_s)
        self._threads = threads(1)

    def start(self) -> InProcessWorker:
        """Build the scenes."""
        return InProcessWorker(self.settings)

    def poll(self) -> None:
        """Execute the task."""
        for worker in self.workers:
            task, worker.task = worker.task, None
            if not worker.ready:
                self.receive(worker, "ready")
            elif task is not None:
                messages = Messages(lambda message: self.receive(worker, *message))  # noqa: B023  done before the next
                self.receive(worker, *execute(task, worker.maker, messages))

    def close(self, stopped: bool) -> None:
        """Free the scenes, and put back the numbers of threads.

        Args:
            stopped: without effect.
        """
        for worker in self.workers:
            worker.end()
        self.workers.clear()
        with self._threads:
            pass


# ---------------------------------------------------------------------------------------------- in the worker's process


def work(link: Connection, packed: bytes) -> None:
    """Execute tasks until the supervisor ends: the life of a worker.

    Args:
        link: pipe to the supervisor.
        packed: pickled ``RunSettings``.
    """
    # Ctrl-C reaches the whole group of processes; the supervisor decides.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    signal.signal(signal.SIGTERM, _end)
    _end_with_supervisor()
    try:
        maker = ShardMaker(unpacked(packed, "generate"))
        link.send(("ready",))
        while True:
            task = link.recv()
            if task[0] == "stop":
                maker.close()
                return
            link.send(execute(task, maker, Messages(link.send)))
    except (EOFError, BrokenPipeError, ConnectionResetError):
        sys.exit(_GONE)
    except Exception as error:  # noqa: BLE001  sent, and raised by the supervisor
        with contextlib.suppress(OSError):
            link.send(("fatal", *fatal(error)))
        sys.exit(1)
    finally:
        # The end of the interpreter need not be orderly.
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


def _end(*_: Any) -> NoReturn:
    # No exception: where Python calls back (of weak references, from plugins) it would be printed and forgotten, or
    # become an error of the scene.
    remove_unfinished()
    os._exit(_GONE)


def _end_with_supervisor() -> None:
    """Start a thread that waits for the supervisor's end: a render takes no notice of a closed pipe."""
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def wait() -> None:
        connection.wait([parent.sentinel])
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(LAST_SECONDS)
        _end()

    threading.Thread(target=wait, daemon=True).start()


# ---------------------------------------------------------------------------------------------- actors of a cluster


class RayCrew(Crew["RayWorker"]):
    """Crew of a cluster. A connection that is made here is ended here.

    Args:
        settings: of the run.
        workers: actors, one processor each; at most the processors of the cluster, with a warning.
        ledger: shards to do.
        timeout_s: seconds for one sample, None for a limit by the slowest one.
        address: of a running cluster. None: the one that this process is connected to, or that RAY_ADDRESS names, or a
            new one on this machine.

    Raises:
        MissingPackageError: without the package ray.
        TorchTransientError: without a connection.
    """

    hint = "All machines of the cluster need torchtransient and the modules of the recipe."

    def __init__(
        self, settings: RunSettings, workers: int, ledger: Ledger, timeout_s: float | None, address: str | None
    ) -> None:
        super().__init__(settings, workers, ledger, timeout_s)
        self._ray = _ray()
        self._own = not self._ray.is_initialized()
        self._queue: Any = None
        self._numbers: dict[int, RayWorker] = {}
        if self._own:
            self._connect(address)
        try:
            self._prepare()
        except BaseException:
            self.close(stopped=True)
            raise

    def _connect(self, address: str | None) -> None:
        given = {} if address is None else {"address": address}
        try:
            self._ray.init(log_to_driver=False, logging_level="ERROR", **given)
        except (ConnectionError, RuntimeError, ValueError, OSError) as error:
            where = "" if address is None else f" at {address!r}"
            raise TorchTransientError(f"generate: no connection to a cluster of Ray{where}: {error}") from error

    def _prepare(self) -> None:
        from ray.util.queue import Queue

        cpus = max(1, int(self._ray.cluster_resources().get("CPU", 1)))
        if self.wanted > cpus:
            asked = f"generate: the cluster has {cpus} processors, and {self.wanted} workers were asked for; "
            warnings.warn(f"{asked}{cpus} are started.", TorchTransientWarning, level_of_user())
            self.ledger.log("fewer workers", asked=self.wanted, workers=cpus)
            self.wanted = cpus
        self._queue = Queue(actor_options={"num_cpus": 0, "max_restarts": -1, "max_task_retries": -1})
        self._actor = self._ray.remote(num_cpus=1, max_restarts=0, max_task_retries=0)(ShardActor)

    def start(self) -> RayWorker:
        """Start an actor, which waits for a free processor."""
        number = len(self._numbers)
        self._numbers[number] = RayWorker(self._actor.remote(self.settings, self._queue, number))
        return self._numbers[number]

    def patience_to_start(self) -> float:
        """Return the seconds until a worker has to be ready: an hour, unlimited beside workers that are ready (the
        processors of the cluster may be in use).
        """
        return float("inf") if any(worker.ready for worker in self.workers) else 6 * PATIENCE_S

    def poll(self) -> None:
        """Read results, and before them the messages that were sent until then."""
        awaited = {worker.awaited: worker for worker in self.workers if worker.awaited is not None}
        if not awaited:
            time.sleep(POLL_S)
            return
        done, _ = self._ray.wait(list(awaited), num_returns=1, timeout=POLL_S)
        for number, kind, *facts in self._queue.get_nowait_batch(self._queue.qsize()):
            worker = self._numbers[number]
            if worker in self.workers:
                self.receive(worker, kind, *facts)
        for ref in done:
            worker = awaited[ref]
            try:
                result = self._ray.get(ref)
            except self._ray.exceptions.RayError as error:
                text = str(error).strip()
                # Not a death of the process: it could not take its arguments.
                for_good = "creation task" in text or isinstance(error, self._ray.exceptions.RayTaskError)
                reason = f"by {type(error).__name__}: {text.splitlines()[-1]}"
                self.remove(worker, reason, own_fault=False, for_good=for_good)
                continue
            worker.awaited = None
            self.receive(worker, *result)

    def close(self, stopped: bool) -> None:
        """End the actors, and the connection where it was made here.

        Args:
            stopped: without effect: actors are killed at once.
        """
        for worker in self.workers:
            worker.end()
        self.workers.clear()
        if self._queue is not None:
            with contextlib.suppress(Exception):
                self._queue.shutdown(force=True)
        if self._own:
            self._ray.shutdown()


class RayWorker(Member):
    """Handle to an actor, with the result that is awaited of it.

    Args:
        actor: handle of Ray.
    """

    def __init__(self, actor: Any) -> None:
        super().__init__()
        self.actor = actor
        self.awaited: Any = actor.begin.remote()

    def send(self, task: tuple[Any, ...]) -> None:
        """Call the actor; the result is awaited by ``RayCrew.poll``.

        Args:
            task: see ``Member.assign``.
        """
        self.awaited = self.actor.do.remote(task)

    def end(self) -> None:
        """Kill the actor."""
        with contextlib.suppress(Exception):
            _ray().kill(self.actor, no_restart=True)


class ShardActor:
    """Body of an actor: messages are those of local workers.

    Args:
        settings: of the run.
        queue: queue of Ray that takes the messages.
        number: of the worker, which begins each message.
    """

    def __init__(self, settings: RunSettings, queue: Any, number: int) -> None:
        self._settings, self._queue, self._number = settings, queue, number
        self._maker: ShardMaker | None = None

    def begin(self) -> tuple[Any, ...]:
        """Build the scenes. Returns the message "ready" or "fatal"."""
        try:
            self._maker = ShardMaker(self._settings)
        except Exception as error:  # noqa: BLE001  sent, and raised by the run
            return "fatal", *fatal(error)
        return ("ready",)

    def do(self, task: tuple[Any, ...]) -> tuple[Any, ...]:
        """Execute a task.

        Args:
            task: see ``Member.assign``.

        Returns:
            Its last message.
        """
        assert self._maker is not None  # begin() came first
        try:
            # Each message is waited for, so that the queue has the place at which a worker died.
            return execute(task, self._maker, Messages(lambda message: self._queue.put((self._number, *message))))
        except Exception as error:  # noqa: BLE001  sent, and raised by the run
            return "fatal", *fatal(error)


def _ray() -> Any:
    try:
        import ray
        import ray.exceptions
    except ImportError as error:
        raise MissingPackageError(
            "generate: engine='ray' needs the package ray. Install it with pip install 'torchtransient[ray]'."
        ) from error
    return ray
