"""Workers of `generate` that live in this process, one step at a time."""

from __future__ import annotations

from contextlib import contextmanager

import pytest

import torchtransient as tt
from torchtransient.data import local_engine
from torchtransient.data.crew import Crew, Member
from torchtransient.data.shard_making import Messages, ShardMaker, execute


class WorkerHere(Member):
    """What it has to do waits until it is looked at."""

    def __init__(self, settings):
        super().__init__()
        self.maker, self.task = ShardMaker(settings), None

    def send(self, task):
        self.task = task

    def end(self):
        self.maker.close()


class CrewHere(Crew):
    """In place of a crew of processes."""

    def start(self):
        return WorkerHere(self.settings)

    def poll(self):
        for worker in list(self.workers):
            task, worker.task = worker.task, None
            if not worker.ready:
                self.receive(worker, "ready")
            elif task is not None:
                messages = Messages(lambda message, worker=worker: self.receive(worker, *message))
                self.receive(worker, *execute(task, worker.maker, messages))

    def close(self, stopped):
        for worker in self.workers:
            worker.end()
        self.workers.clear()


@contextmanager
def workers_here():
    """`generate` with such a crew, of one thread."""
    with pytest.MonkeyPatch.context() as patch, tt.threads(1):
        patch.setattr(local_engine, "Supervisor", CrewHere)
        yield
