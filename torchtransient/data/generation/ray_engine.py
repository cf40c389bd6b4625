"""The engine for clusters: actors of Ray, each with scenes of its own, that write their shards themselves.

An actor that is gone is replaced here and not by Ray, which would repeat its shard without a word: only so the sample
over which actors die is found.
"""

from __future__ import annotations

import contextlib
import time
import warnings
from typing import Any

from torchtransient.data.generation.crew import LOOK_S, PATIENCE_S, Crew, Member
from torchtransient.data.generation.ledger import Ledger
from torchtransient.data.generation.settings import Settings
from torchtransient.data.generation.shard_making import ShardMaker, fatal
from torchtransient.data.generation.telling import Telling
from torchtransient.errors import MissingPackageError, TorchTransientError, TorchTransientWarning, level_of_user


class Board:
    """An actor to which workers say what becomes of samples, and of which the run asks it."""

    def __init__(self) -> None:
        self._said: list[tuple[Any, ...]] = []

    def say(self, *message: Any) -> None:
        """One message: number of the worker, kind, facts."""
        self._said.append(message)

    def heard(self) -> list[tuple[Any, ...]]:
        """What was said since the last call."""
        said, self._said = self._said, []
        return said


class ShardActor:
    """The actor. Messages are those of local workers."""

    def __init__(self, settings: Settings, board: Any, number: int) -> None:
        self._settings, self._board, self._number = settings, board, number
        self._maker: ShardMaker | None = None

    def begin(self) -> tuple[Any, ...]:
        """Build the scenes."""
        try:
            self._maker = ShardMaker(self._settings)
        except Exception as error:  # noqa: BLE001  told, and raised by the run
            return "fatal", *fatal(error)
        return ("ready",)

    def do(self, task: tuple[Any, ...]) -> tuple[Any, ...]:
        """A task; returns the message that tells its end."""
        assert self._maker is not None  # begin() came first
        kind, *rest = task
        try:
            if kind == "measure":
                indices, skip = rest
                return "measured", self._maker.measure(indices, Telling(self._say, skip))
            shard, described, skip, first = rest
            return "wrote", shard, *self._maker.make(shard, described, Telling(self._say, skip), first)
        except Exception as error:  # noqa: BLE001  told, and raised by the run
            return "fatal", *fatal(error)

    def _say(self, message: tuple[Any, ...]) -> None:
        import ray

        # Waited for, so that the board knows where a worker was when it died.
        ray.get(self._board.say.remote(self._number, *message))


class RayWorker(Member):
    """A handle to an actor, and what is awaited of it."""

    def __init__(self, actor: Any) -> None:
        super().__init__()
        self.actor = actor
        self.awaited: Any = actor.begin.remote()

    def send(self, task: tuple[Any, ...]) -> None:
        """A call whose result is awaited."""
        self.awaited = self.actor.do.remote(task)

    def end(self) -> None:
        """Kill it."""
        import ray

        with contextlib.suppress(Exception):
            ray.kill(self.actor, no_restart=True)


class RayCrew(Crew[RayWorker]):
    """The crew of a cluster. ``address``: of a cluster that runs; None: the one that this process is connected to, or
    that RAY_ADDRESS names, or a new one on this machine. A connection that was made here is ended here.
    """

    hint = "All machines of the cluster need torchtransient and the modules of the recipe."

    def __init__(
        self, settings: Settings, workers: int, ledger: Ledger, timeout_s: float | None, address: str | None
    ) -> None:
        super().__init__(settings, workers, ledger, timeout_s)
        self._ray = ray_package()
        self._own = not self._ray.is_initialized()
        self._board: Any = None
        if self._own:
            self._connect(address)
        try:
            self._prepare()
        except BaseException:
            self.close(stopped=True)
            raise

    def _prepare(self) -> None:
        """Everything after the connection."""
        self._cpus = max(1, int(self._ray.cluster_resources().get("CPU", 1)))
        if self.wanted > self._cpus:
            told = f"generate: the cluster has {self._cpus} processors, and {self.wanted} workers were asked for; "
            warnings.warn(f"{told}{self._cpus} are started.", TorchTransientWarning, level_of_user())
            self.ledger.log("fewer workers", asked=self.wanted, workers=self._cpus)
            self.wanted = self._cpus
        self._count = 0
        restarts = {"max_restarts": -1, "max_task_retries": -1}
        self._board = self._ray.remote(num_cpus=0, **restarts)(Board).remote()
        self._actor = self._ray.remote(num_cpus=1, max_restarts=0, max_task_retries=0)(ShardActor)
        self._numbers: dict[int, RayWorker] = {}

    def _connect(self, address: str | None) -> None:
        given = {} if address is None else {"address": address}
        try:
            self._ray.init(log_to_driver=False, logging_level="ERROR", **given)
        except (ConnectionError, RuntimeError, ValueError, OSError) as error:
            where = "" if address is None else f" at {address!r}"
            raise TorchTransientError(f"generate: no connection to a cluster of Ray{where}: {error}") from error

    def start(self) -> RayWorker:
        """An actor, which waits for a free processor."""
        self._count += 1
        worker = RayWorker(self._actor.remote(self.settings, self._board, self._count))
        self._numbers[self._count] = worker
        return worker

    def patience_to_start(self) -> float:
        """Others may use the cluster: a worker waits for its processor."""
        return float("inf") if any(worker.ready for worker in self.workers) else 6 * PATIENCE_S

    def look(self) -> None:
        """Results, then the board, on which all stands that led to them."""
        awaited = {worker.awaited: worker for worker in self.workers if worker.awaited is not None}
        if not awaited:
            time.sleep(LOOK_S)
            return
        done, _ = self._ray.wait(list(awaited), num_returns=1, timeout=LOOK_S)
        for number, kind, *facts in self._ray.get(self._board.heard.remote()):
            worker = self._numbers.get(number)
            if worker is not None and worker in self.workers:
                self.heard(worker, kind, *facts)
        for ref in done:
            worker = awaited[ref]
            try:
                said = self._ray.get(ref)
            except self._ray.exceptions.RayError as error:
                said_there = str(error).strip()
                # Not that the process died, but that it could not take its arguments.
                for_good = "creation task" in said_there or isinstance(error, self._ray.exceptions.RayTaskError)
                how = f"by {type(error).__name__}: {said_there.splitlines()[-1]}"
                self.bury(worker, how, own_fault=False, for_good=for_good)
                continue
            worker.awaited = None
            self.heard(worker, *said)

    def close(self, stopped: bool) -> None:
        """End the actors, and the connection where it was made here."""
        for worker in self.workers:
            worker.end()
        self.workers.clear()
        if self._board is not None:
            with contextlib.suppress(Exception):
                self._ray.kill(self._board)
        if self._own:
            self._ray.shutdown()


def ray_package() -> Any:
    """The module ray. Raises MissingPackageError where it is not installed."""
    try:
        import ray
        import ray.exceptions
    except ImportError as error:
        raise MissingPackageError(
            "generate: engine='ray' needs the package ray. Install it with pip install 'torchtransient[ray]'."
        ) from error
    return ray
