"""A local worker and its supervisor, in one process: what is said, which end how, and whose fault it is."""

from __future__ import annotations

import contextlib
import pickle
import signal
import subprocess
import sys
from multiprocessing import Pipe
from types import SimpleNamespace

import pytest

import torchtransient as tt
from support.fake_recipe import FakeRecipe
from support.generation_runs import environment
from torchtransient.array_files.part_files import whole_file
from torchtransient.data.generation import supervisor, worker
from torchtransient.data.generation.crew import Member
from torchtransient.data.generation.ledger import Ledger
from torchtransient.data.generation.run_log import SampleBar
from torchtransient.data.generation.settings import Settings, description
from torchtransient.data.generation.supervisor import LocalWorker, Supervisor
from torchtransient.data.generation.telling import Telling
from torchtransient.data.generation.told_errors import MOST_LINES, ToldError, traced, unpacked
from torchtransient.errors import SceneError, TorchTransientError, UnitError

RECIPE = FakeRecipe(shape=(1, 2, 2, 3))


def settings_of(folder, recipe=RECIPE):
    return Settings(recipe, str(folder), 4, "exact", "none", 0)


@pytest.fixture
def logged():
    """A ledger, and what it logs."""
    lines = []
    ledger = Ledger(2, lambda *words, **facts: lines.append((*words, facts)), SampleBar(0, 0, shown=False))
    return ledger, lines


# --------------------------------------------------------------------------------------------- a process of its own


@pytest.fixture
def working(tmp_path, monkeypatch):
    """Runs a local worker to its end: what it said, and its exit status."""
    noted = SimpleNamespace(signals={}, masks=[], watched=0)

    def set_signal(number, handler):
        if sys._getframe(1).f_code.co_filename == worker.__file__:  # others let signals wait meanwhile
            noted.signals.setdefault(number, []).append(handler)

    monkeypatch.setattr(worker.signal, "signal", set_signal)
    monkeypatch.setattr(worker.signal, "pthread_sigmask", lambda *given: noted.masks.append(given))
    monkeypatch.setattr(worker, "_end_with_supervisor", lambda: setattr(noted, "watched", 1))

    def run(*told, recipe=RECIPE, packed=None):
        here, there = Pipe()
        for one in told:
            here.send(one)
        here.close() if not told else None
        status, said = None, []
        try:
            worker.work(there, pickle.dumps(settings_of(tmp_path, recipe)) if packed is None else packed)
        except SystemExit as error:
            status = error.code
        while told and here.poll():
            said.append(here.recv())
        return said, status

    run.noted = noted
    with tt.threads(1):
        yield run


def described(folder):
    return description(settings_of(folder), 2, RECIPE.maker().about(), None)


def test_a_worker_and_its_tasks(working, tmp_path):
    said, status = working(
        ("measure", range(3), {0: "given up"}), ("shard", 1, described(tmp_path), {3: "given up"}, [3]), ("stop",)
    )
    kinds = [one[:3] for one in said]
    assert status is None and kinds[0] == ("ready",) and said[-1][:4] == ("wrote", 1, 2, 1)
    measured = next(one for one in said if one[0] == "measured")
    assert measured[1].sample_bytes == 4 * 12 + 4 * 6 and ("begin", -1, 0) not in kinds and ("begin", -1, 1) in kinds
    assert said[-1][4] == (tmp_path / "shard-000001.h5").stat().st_size
    assert ("end", 1, 3, "given up") in said and ("end", 1, 2, None) in said and ("begin", 1, 3) not in kinds
    noted = working.noted
    assert noted.signals[signal.SIGINT] == [signal.SIG_IGN]
    assert noted.signals[signal.SIGTERM] == [worker._end, signal.SIG_DFL] and noted.watched == 1
    assert noted.masks == [(signal.SIG_UNBLOCK, {signal.SIGINT})]


def test_what_ends_a_worker(working, tmp_path):
    """Its supervisor is gone; a recipe that cannot be built or unpacked, and a task that fails, are told."""
    assert working() == ([], 3)
    for arguments, words in (
        ({"recipe": FakeRecipe(unbuilt="no light in it")}, "no light in it"),
        ({"packed": b"cnowhere.module\nName\n."}, "generate: the process that renders cannot unpickle the recipe: Mod"),
        ({"recipe": FakeRecipe(raising=(0, 1, 2))}, "none of the samples 0 to 2"),
    ):
        said, status = working(("measure", range(3), {}), **arguments)
        assert said[-1][:2] == ("fatal", "SceneError") and words in said[-1][2] and status == 1
        assert "Error" in said[-1][3]


def test_a_worker_that_is_told_to_end_leaves_nothing_unfinished(tmp_path, monkeypatch):
    statuses = []
    monkeypatch.setattr(worker.os, "_exit", statuses.append)
    with whole_file(tmp_path / "whole", "test") as part:
        part.write_text("whole")
    ending = contextlib.suppress(InterruptedError)
    with ending, whole_file(tmp_path / "a", "test"), whole_file(tmp_path / "b", "test"):
        begun = len(list(tmp_path.iterdir()))
        worker._end(signal.SIGTERM, None)
        left = [path.name for path in tmp_path.iterdir()]
        raise InterruptedError
    assert begun == 3 and left == ["whole"] and statuses == [3]


IN_A_CALLBACK = """
import signal, sys, time, weakref
from pathlib import Path
from torchtransient.array_files.part_files import whole_file
from torchtransient.data.generation import worker

class Thing:
    pass

def called_back(_):
    print("here", flush=True)
    time.sleep(60)

signal.signal(signal.SIGTERM, worker._end)
with whole_file(Path(sys.argv[1]) / "a", "test"):
    thing = Thing()
    kept = weakref.ref(thing, called_back)
    del thing
"""


@pytest.mark.slow
def test_a_worker_is_told_to_end_in_a_callback(tmp_path):
    """Of a weak reference, for instance: Python forgets what is raised there."""
    command = [sys.executable, "-c", IN_A_CALLBACK, str(tmp_path)]
    child = subprocess.Popen(command, env=environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert child.stdout.readline() == "here\n"
    child.terminate()
    _, said = child.communicate(timeout=20)
    assert (child.returncode, said, list(tmp_path.iterdir())) == (3, "", [])


def test_a_worker_ends_with_its_supervisor(monkeypatch):
    """Ten seconds after it was told to, whatever it does."""
    started, done = [], []
    monkeypatch.setattr(worker.threading, "Thread", lambda target, daemon: started.append(target) or SimpleNamespace(
        start=lambda: done.append("started")))  # fmt: skip
    monkeypatch.setattr("multiprocessing.parent_process", lambda: None)
    worker._end_with_supervisor()
    assert started == []
    monkeypatch.setattr("multiprocessing.parent_process", lambda: SimpleNamespace(sentinel=7))
    monkeypatch.setattr("multiprocessing.connection.wait", lambda ends: done.append(ends))
    monkeypatch.setattr(worker.os, "kill", lambda pid, number: done.append(number))
    monkeypatch.setattr(worker.os, "_exit", done.append)
    monkeypatch.setattr(worker, "time", SimpleNamespace(sleep=done.append))
    worker._end_with_supervisor()
    started[0]()
    assert done == ["started", [7], signal.SIGTERM, 10.0, 3]


def test_what_is_said_of_samples():
    said = []
    telling = Telling(said.append, {5: "why"})
    assert telling.begin(1, 5) == "why" and telling.begin(1, 6) is None
    telling.end(1, 6, "bad")
    telling.retry(2, 7, "late")
    telling.traced(2, 8, "lines")
    telling.closing(3)
    assert said == [("begin", 1, 6), ("end", 1, 6, "bad"), ("retry", 2, 7, "late"), ("traced", 2, 8, "lines"),
                    ("closing", 3)]  # fmt: skip
    assert Telling(said.append).begin(1, 5) is None


def test_errors_of_other_processes():
    def deep(depth):
        if depth:
            deep(depth - 1)
        raise RuntimeError("x\n" * 60 + "last")

    for depth in (0, 3):
        with pytest.raises(RuntimeError) as caught:
            deep(depth)
        lines = traced(caught.value).splitlines()
        assert len(lines) == MOST_LINES + 1 and lines[0] == "..." and lines[-1] == "last"
    room = traced(RuntimeError("\n".join("x" * MOST_LINES))).splitlines()
    assert len(room) == MOST_LINES and room[-1] == "x" and room[0] != "..."
    assert str(ToldError("one\ntwo")) == "\none\ntwo"
    assert unpacked(pickle.dumps([3]), "what") == [3]
    with pytest.raises(SceneError, match=r"what: the process that renders cannot unpickle the recipe: Unpickling"):
        unpacked(b"no pickle", "what")
    with pytest.raises(UnitError, match=r"^mine$"):
        unpacked(pickle.dumps(Refusing()), "what")


class Refusing:
    def __reduce__(self):
        return refuse, ()


def refuse():
    raise UnitError("mine")


# ------------------------------------------------------------------------------------------------------ its supervisor


class Process:
    def __init__(self, exitcode=None):
        self.exitcode, self.done = exitcode, []
        self.sentinel, self._end = Pipe()
        if exitcode is not None:
            self._end.close()

    def is_alive(self):
        return self.exitcode is None

    def join(self, seconds):
        self.done.append(seconds)

    def kill(self):
        self.done.append("kill")

    def terminate(self):
        self.done.append("terminate")


def local(exitcode=None):
    """A worker whose process is played, and the other end of its pipe."""
    made = object.__new__(LocalWorker)
    Member.__init__(made)
    made.process = Process(exitcode)
    made.link, there = Pipe()
    return made, there


def watched(logged, *exitcodes):
    crew = Supervisor(SimpleNamespace(), len(exitcodes), logged[0], None)
    ends = []
    for exitcode in exitcodes:
        made, there = local(exitcode)
        crew.workers.append(made)
        ends.append(there)
    return crew, ends


def test_what_was_said_before_an_end_comes_first(logged):
    crew, ends = watched(logged, None, -11)
    logged[0].add([4])
    ends[1].send(("ready",))
    ends[1].send(("begin", 4, 9))
    dead = crew.workers[1]
    dead.shard = logged[0].take()
    ends[0].send(("ready",))
    crew.look()
    assert [one.ready for one in crew.workers] == [True] and dead.process.done == ["kill", 10.0]
    assert logged[1] == [("death", {"shard": 4, "sample": 9, "how": "by SIGSEGV"})]
    assert logged[0]._blame[4, 9] == 2
    assert dead.link.closed and not crew.workers[0].link.closed


@pytest.mark.parametrize(
    ("exitcode", "how", "blame"),
    [
        (-9, "by SIGKILL", 1), (-15, "by SIGTERM", 1), (-2, "by SIGINT", 1), (-1, "by SIGHUP", 1),
        (-11, "by SIGSEGV", 2), (-6, "by SIGABRT", 2), (-99, "by signal 99", 2), (1, "with status 1", 2),
        (0, "with status 0", 2),
    ],
)  # fmt: skip
def test_whose_fault_an_end_is(logged, exitcode, how, blame):
    """A signal that others send, or one of its own; an exit is its own."""
    crew, _ = watched(logged, exitcode)
    logged[0].add([4])
    dead = crew.workers[0]
    dead.ready, dead.shard, dead.sample = True, logged[0].take(), 9
    crew.look()
    assert crew.workers == [] and logged[1][0][1]["how"] == how and logged[0]._blame[4, 9] == blame


def test_exits_before_the_first_word_come_again(logged):
    crew, _ = watched(logged, 1)
    with pytest.raises(TorchTransientError, match=r"ended with status 1 while it started\. What it said itself"):
        crew.look()
    crew, _ = watched(logged, -9)
    crew.look()
    assert logged[1][-1][1]["how"] == "by SIGKILL"


def test_pipes_that_are_gone():
    made, there = local()
    there.send("one")
    there.close()
    assert list(made.messages()) == ["one"]
    made.send(("stop",))
    made.link.close()
    assert list(made.messages()) == []


@pytest.mark.parametrize("stopped", [True, False])
def test_the_end_of_a_crew(logged, monkeypatch, stopped):
    """Ten seconds for all of them together; then they are killed."""
    clock = SimpleNamespace(now=20.0)
    monkeypatch.setattr(supervisor, "time", SimpleNamespace(monotonic=lambda: clock.now))
    crew, ends = watched(logged, None, None, None)
    processes = [one.process for one in crew.workers]
    for process, now in zip(processes, (23.0, 31.0, 31.0), strict=True):
        process.join = lambda seconds, process=process, now=now: (
            process.done.append(seconds), setattr(clock, "now", now))  # fmt: skip
    crew.close(stopped)
    told = ["terminate"] if stopped else []
    assert [one.done for one in processes] == [[*told, wait, "kill", 10.0] for wait in (10.0, 7.0, 0.0)]
    assert crew.workers == []
    if not stopped:
        assert [end.recv() for end in ends] == [("stop",)] * 3


def test_processes_start_without_interrupts(monkeypatch, tmp_path):
    made, ends = [], []

    class Context:
        @staticmethod
        def Pipe():
            ends.extend(Pipe())
            return ends

        @staticmethod
        def Process(target, args, daemon):
            assert target is worker.work and daemon is True and args[0] is ends[1]
            assert pickle.loads(args[1]).n == 4
            masks = lambda: made.append(signal.pthread_sigmask(signal.SIG_BLOCK, []))  # noqa: E731
            return SimpleNamespace(start=masks)

    monkeypatch.setattr(supervisor.multiprocessing, "get_context", lambda kind: {"spawn": Context}[kind])
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [])
    found = Supervisor(settings_of(tmp_path), 1, None, None).start()
    assert made == [before | {signal.SIGINT}] and signal.pthread_sigmask(signal.SIG_BLOCK, []) == before
    assert found.link is ends[0] and ends[1].closed and not ends[0].closed and not found.ready
