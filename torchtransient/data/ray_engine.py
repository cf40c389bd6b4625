"""Workers on a cluster: actors of Ray, each with scenes of its own, that write their shards themselves.

Ray starts actors, carries calls, and holds the queue of messages. A dead actor is replaced by the crew and not by Ray,
which would repeat its shard silently: the crew knows which sample was rendered when it died.
"""

from __future__ import annotations

import contextlib
import time
import warnings
from typing import Any

from torchtransient.data.crew import PATIENCE_S, POLL_S, Crew, Ledger, Member
from torchtransient.data.run_settings import RunSettings
from torchtransient.data.shard_making import Messages, ShardMaker, execute, fatal
from torchtransient.errors import MissingPackageError, TorchTransientError, TorchTransientWarning, level_of_user


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
        self._ray = ray_package()
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
        """Seconds until a worker has to be ready: an hour, unlimited beside workers that are ready (the processors of
        the cluster may be in use).
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
        import ray

        with contextlib.suppress(Exception):
            ray.kill(self.actor, no_restart=True)


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


def ray_package() -> Any:
    """Import ray.

    Raises:
        MissingPackageError: where it is not installed.
    """
    try:
        import ray
        import ray.exceptions
    except ImportError as error:
        raise MissingPackageError(
            "generate: engine='ray' needs the package ray. Install it with pip install 'torchtransient[ray]'."
        ) from error
    return ray
