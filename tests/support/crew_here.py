"""Workers of `generate` that live in this process, one step at a time."""

from __future__ import annotations

from contextlib import contextmanager

import pytest

import torchtransient as tt
from torchtransient.data.generation import supervisor
from torchtransient.data.generation.crew import Crew, Member
from torchtransient.data.generation.shard_making import ShardMaker
from torchtransient.data.generation.telling import Telling
from torchtransient.data.generation.worker import _carry_out


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

    def look(self):
        for worker in list(self.workers):
            task, worker.task = worker.task, None
            if not worker.ready:
                self.heard(worker, "ready")
            elif task is not None:
                telling = Telling(lambda message, worker=worker: self.heard(worker, *message))
                _carry_out(task, worker.maker, telling)

    def close(self, stopped):
        for worker in self.workers:
            worker.end()
        self.workers.clear()


@contextmanager
def workers_here():
    """`generate` with such a crew, of one thread."""
    with pytest.MonkeyPatch.context() as patch, tt.threads(1):
        patch.setattr(supervisor, "Supervisor", CrewHere)
        yield
