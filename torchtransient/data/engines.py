"""Engines of a run: processes on this machine that take shards one at a time and end with the run, the calling process
alone, and tasks of Ray on a cluster, each of which is a run of its own with one process.
"""

from __future__ import annotations

import contextlib
import functools
import multiprocessing
import os
import pickle
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from multiprocessing import connection
from multiprocessing.connection import Connection
from typing import Any, NoReturn

from torchtransient.array_files.part_files import remove_unfinished
from torchtransient.data.crew import MOST_IN_A_ROW, POLL_S, Crew, Ledger, Member
from torchtransient.data.processes import PluginNames, add_plugins, registered_plugins, spawned, unpacked
from torchtransient.data.run_settings import RunSettings
from torchtransient.data.shard_making import ShardMaker, execute, fatal
from torchtransient.errors import MissingPackageError, TorchTransientError
from torchtransient.rendering.threads import threads

# Seconds for a render that is under way when the supervisor is gone, and for workers at the end of a run.
LAST_SECONDS, END_S = 10.0, 10.0
# Exit status of a worker without a supervisor.
_GONE = 3
_FROM_OUTSIDE = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP)


class LocalWorker(Member):
    """Process and the pipe to it. It is spawned: a forked one has no threads of Dr.Jit.

    Args:
        settings: settings of the run.
    """

    def __init__(self, settings: RunSettings) -> None:
        super().__init__()
        self.process, self.link = spawned(work, pickle.dumps(settings), "generate")

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
            stopped: whether they are stopped in the middle of their work; then they are terminated.
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
        settings: settings of the run.
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
                self.receive(worker, *execute(task, worker.maker, functools.partial(self.receive, worker)))

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
            link.send(execute(task, maker, lambda *message: link.send(message)))
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


# ----------------------------------------------------------------------------------------------- tasks of a cluster


def make_on_ray(
    make: Callable[..., Any], calls: Sequence[Mapping[str, Any]], address: str | None, tick: Callable[[], object]
) -> int:
    """Make shares of a data set as tasks of Ray with one processor each. Ray starts a task again where its process or
    machine is lost, and its run goes on with the shards that are missing.

    Args:
        make: ``generate``.
        calls: its arguments for each share.
        address: address of a running cluster. None takes the one that this process is connected to, or that RAY_ADDRESS
            names, or a new one on this machine.
        tick: function that is called every half second.

    Returns:
        Workers that were replaced within the tasks.

    Raises:
        MissingPackageError: without the package ray.
        TorchTransientError: without a connection, and for a task that is lost again and again; errors of runs pass.
    """
    ray = ray_package()
    connects, restarts = not ray.is_initialized(), 0
    left: list[Any] = []
    try:
        if connects:
            given = {} if address is None else {"address": address}
            ray.init(log_to_driver=False, logging_level="ERROR", **given)
        task = ray.remote(num_cpus=1, max_retries=MOST_IN_A_ROW)(make_share)
        left = [task.remote(make, call, registered_plugins()) for call in calls]
        while left:
            done, left = ray.wait(left, timeout=POLL_S)
            restarts += sum(ray.get(done))
            tick()
    except TorchTransientError:
        raise
    except (ray.exceptions.RayError, ConnectionError, RuntimeError, ValueError) as error:
        raise TorchTransientError(f"generate: Ray gave up, or cannot be reached: {error}") from error
    finally:
        for ref in left:
            ray.cancel(ref, force=True)
        if connects:
            ray.shutdown()
    return restarts


def make_share(make: Callable[..., Any], call: Mapping[str, Any], plugins: PluginNames) -> int:
    """Make a share of a data set: the body of a task.

    Args:
        make: ``generate``.
        call: its arguments.
        plugins: modules that were added in the calling process.

    Returns:
        Workers that were replaced.
    """
    add_plugins(plugins, "generate")
    return int(make(**call, workers=1, progress=False).restarts)


def ray_package() -> Any:
    """Import Ray. Raises MissingPackageError where it is not installed."""
    try:
        import ray
        import ray.exceptions
    except ImportError as error:
        raise MissingPackageError(
            "generate: engine='ray' needs the package ray. Install it with pip install 'torchtransient[ray]'."
        ) from error
    return ray
