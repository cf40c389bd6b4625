"""How workers are driven: who is handed what, and for how long nobody hears of a worker before it is given up."""

from __future__ import annotations

from collections import deque
from types import SimpleNamespace

import pytest

from torchtransient.data.generation import crew as crews
from torchtransient.data.generation.crew import Crew, Member
from torchtransient.data.generation.generate import (
    Generated,
    _check_choices,
    _check_recipe,
    _check_timeout,
    _size,
    _whole_pair,
)
from torchtransient.data.generation.ledger import MEASURING, Ledger
from torchtransient.data.generation.ray_engine import RayCrew
from torchtransient.data.generation.run_log import RunLog, SampleBar
from torchtransient.errors import ArgumentError, SceneError, TorchTransientError, UnitError


class Worker(Member):
    def __init__(self):
        super().__init__()
        self.tasks, self.ended = [], False

    def send(self, task):
        self.tasks.append(task)

    def end(self):
        self.ended = True


class Played(Crew):
    """``script``: what happens at each look, functions of the crew."""

    def __init__(self, ledger, workers=2, timeout_s=None, script=()):
        super().__init__(SimpleNamespace(), workers, ledger, timeout_s)
        self.script, self.started, self.closed = deque(script), [], None

    def start(self):
        self.started.append(Worker())
        return self.started[-1]

    def look(self):
        self.script.popleft()(self)

    def close(self, stopped):
        self.closed = stopped


@pytest.fixture
def clock(monkeypatch):
    found = SimpleNamespace(now=1000.0)
    monkeypatch.setattr(crews.time, "monotonic", lambda: found.now)
    return found


@pytest.fixture
def logged(tmp_path):
    """A ledger, and what it logs."""
    lines = []
    log = RunLog(tmp_path)
    ledger = Ledger(2, lambda *words, **facts: lines.append((*words, facts)), SampleBar(0, 0, shown=False))
    log.close()
    return ledger, lines


def ready(crew, *numbers):
    for n in numbers:
        crew.heard(crew.started[n], "ready")


def test_shards_are_handed_to_who_is_ready(clock, logged):
    """As many workers as there is work for, each with one shard at a time and what is known of it."""
    ledger, _ = logged
    held = []
    ledger.skipped[4] = {9: "why"}
    steps = [
        lambda c: ready(c, 1),
        lambda c: (c.heard(c.started[1], "begin", 4, 8), held.append(c.started[1].shard)),
        lambda c: (c.heard(c.started[1], "end", 4, 8, None), c.heard(c.started[1], "wrote", 4, 1, 0, 50)),
        lambda c: c.heard(c.started[1], "wrote", 5, 2, 1, 70),
        lambda c: c.heard(c.started[1], "wrote", 6, 2, 0, 90),
    ]
    with Played(ledger, 2, script=steps) as crew:
        crew.make([4, 5, 6], {"about": 1})
    assert len(crew.started) == 2 and crew.closed is False and held == [4]
    assert crew.started[1].tasks == [
        ("shard", 4, {"about": 1}, {9: "why"}, []), ("shard", 5, {"about": 1}, {}, []),
        ("shard", 6, {"about": 1}, {}, []),
    ]  # fmt: skip
    assert not crew.started[0].tasks and (ledger.samples, ledger.bytes) == (4, 210)
    one = Played(ledger, 5, script=[lambda c: ready(c, 0), lambda c: c.heard(c.started[0], "wrote", 7, 1, 0, 1)])
    one.make([7], {})
    assert len(one.started) == 1


def test_measuring(clock, logged):
    ledger, _ = logged
    told, held = SimpleNamespace(), []
    steps = [
        lambda c: ready(c, 0),
        lambda c: (held.append(c.started[0].shard), c.heard(c.started[0], "measured", told)),
    ]
    crew = Played(ledger, 3, script=steps)
    assert crew.measure(range(5)) is told and len(crew.started) == 1 and held == [MEASURING]
    assert crew.started[0].tasks == [("measure", range(5), {})]
    silent = Played(
        ledger, 1, script=[lambda c: ready(c, 0), lambda c: c.heard(c.started[0], "wrote", MEASURING, 0, 0, 0)]
    )
    with pytest.raises(TorchTransientError, match="no sample was measured"):
        silent.measure(range(5))


def test_what_is_logged_of_workers(clock, logged):
    ledger, lines = logged
    crew = Played(ledger)
    crew.workers.append(worker := crew.start())
    worker.shard, worker.sample, worker.warm = 3, 17, True
    crew.heard(worker, "retry", 3, 17, "why")
    assert worker.warm is False
    crew.heard(worker, "traced", 3, 17, "lines")
    with pytest.raises(TorchTransientError, match="too much"):
        crew.heard(worker, "fatal", "UnitError", "too much", "lines")
    crew.heard(worker, "closing", 3)
    assert worker.sample is None
    assert lines == [
        ("retry", {"shard": 3, "sample": 17, "reason": "why"}),
        ("traceback", {"shard": 3, "sample": 17, "trace": "lines"}),
        ("error", {"shard": 3, "sample": 17, "error": "UnitError: too much", "trace": "lines"}),
    ]


def busy(crew, *, warm=False, sample=5, ready=True):
    crew.workers.append(worker := crew.start())
    worker.ready, worker.warm, worker.shard, worker.sample = ready, warm, 0, sample
    crew.ledger.take()
    return worker


@pytest.mark.parametrize(
    ("state", "timeout_s", "slowest", "limit"),
    [
        ({"ready": False, "sample": None}, 7.0, 0.0, 600),
        ({"sample": None}, 7.0, 100.0, 600),
        ({}, 7.0, 100.0, 7),
        ({}, None, 3.0, 600),
        ({}, None, 30.0, 900),
        ({"warm": True}, None, 3.0, 120),
        ({"warm": True}, None, 10.0, 300),
    ],
)
def test_silence(clock, logged, state, timeout_s, slowest, limit):
    """Until it is ready, or has finished a file, and in its first sample ten minutes; later 30 times the slowest."""
    ledger, lines = logged
    ledger.add([0])
    crew = Played(ledger, timeout_s=timeout_s)
    worker = busy(crew, **state)
    crew._slowest = slowest
    clock.now += limit
    crew._looked = clock.now
    crew._end_hung()
    assert crew.workers == [worker] and not worker.ended
    clock.now += 0.25
    crew._end_hung()
    assert crew.workers == [] and worker.ended
    assert lines[0] == ("death", {"shard": 0, "sample": worker.sample, "how": f"by no sign of life for {limit:.0f} s"})


def test_who_has_nothing_to_do_may_be_silent(clock, logged):
    crew = Played(logged[0])
    busy(crew).shard = None
    clock.now += 1e4
    crew._looked = clock.now
    crew._end_hung()
    assert len(crew.workers) == 1


@pytest.mark.parametrize(("away", "buried"), [(2.0, True), (2.001, False)])
def test_nobody_is_to_blame_for_what_was_not_heard(clock, logged, away, buried):
    """This process was stopped: two seconds, or four looks, without one."""
    logged[0].add([0])
    crew = Played(logged[0])
    worker = busy(crew)
    clock.now += 700
    crew._looked = clock.now - away
    crew._end_hung()
    assert worker.ended == buried and crew._looked == clock.now
    if not buried:
        assert worker.heard == clock.now


def test_the_slowest_sample_of_those_that_were_warm(clock, logged):
    logged[0].add([0])
    crew = Played(logged[0])
    worker = busy(crew)
    for seconds, slowest in ((50.0, 0.0), (4.0, 4.0), (3.0, 4.0), (6.0, 6.0)):
        crew.heard(worker, "begin", 0, 5)
        clock.now += seconds
        crew.heard(worker, "end", 0, 5, None)
        assert crew._slowest == slowest and worker.sample is None and worker.warm
    crew.heard(worker, "begin", 0, 5)
    clock.now += 90
    crew.heard(worker, "end", 0, 6, None)
    assert crew._slowest == 6 and worker.heard == clock.now


def test_starts_that_come_to_nothing(clock, logged):
    """Ten in a row, or one that says so; a start that comes to something begins anew."""
    crew = Played(logged[0])
    crew.hint = "Look there."
    for _ in range(9):
        crew.workers.append(crew.start())
        crew.bury(crew.workers[0], "by test", own_fault=False)
    crew.workers.append(crew.start())
    crew.heard(crew.workers[0], "ready")
    crew.bury(crew.workers[0], "by test", own_fault=False)
    for number in range(10):
        crew.workers.append(crew.start())
        if number < 9:
            crew.bury(crew.workers[0], "by test", own_fault=False)
    with pytest.raises(TorchTransientError, match=r"a worker ended by test while it started\. Look there\."):
        crew.bury(crew.workers[0], "by test", own_fault=False)
    other = Played(logged[0])
    other.workers.append(other.start())
    with pytest.raises(TorchTransientError, match="while it started"):
        other.bury(other.workers[0], "by test", own_fault=False, for_good=True)


def test_engines_say_what_a_worker_is():
    for method, arguments in ((Member.send, [()]), (Member.end, [])):
        with pytest.raises(NotImplementedError):
            method(Member(), *arguments)


def test_a_crew_that_is_stopped(logged):
    with pytest.raises(KeyError), Played(logged[0]) as crew:
        raise KeyError
    assert crew.closed is True


def test_actors_wait_for_their_processor():
    """For ever where others are at work, an hour for the first one."""
    for workers, patience in (([], 3600), ([False], 3600), ([False, True], float("inf"))):
        crew = SimpleNamespace(workers=[SimpleNamespace(ready=one) for one in workers])
        assert RayCrew.patience_to_start(crew) == patience


# -------------------------------------------------------------------------------------------------------- what is said


def test_what_a_run_has_done():
    done = Generated("set", samples=30, failed=2, kept=5, shards=4, bytes=2_500_000, seconds=12.0, restarts=1)
    assert str(done) == (
        "set: 30 samples in 4 shards, 2.5 MB; 2 failed; 5 were there; 1 worker replaced; 12.0 s, 2.5 samples a second"
    )
    nothing = Generated("set", samples=0, failed=0, kept=0, shards=0, bytes=0, seconds=0.0, restarts=3)
    assert str(nothing) == "set: 0 samples in 0 shards, 0 bytes; 3 workers replaced; 0.0 s"
    assert nothing.samples_per_second != nothing.samples_per_second


@pytest.mark.parametrize(
    ("count", "words"), [(999, "999 bytes"), (1000, "1 kB"), (25_000_000, "25 MB"), (1_234_000_000_000, "1234 GB")]
)
def test_sizes(count, words):
    assert _size(count) == words


def test_choices_that_do_not_go_together():
    """An address is that of a cluster; a recipe makes samples, and pickles."""
    recipe = SimpleNamespace(maker=len, key=len, to_dict=len, device=None)
    _check_choices("exact", "none", "ray", "host:1", recipe)
    for arguments, error, words in (
        (
            ("exact", "none", "local", "host:1", recipe),
            UnitError,
            r"address='host:1' is for engine='ray', got engine='lo",
        ),
        (("exact", "none", "remote", None, recipe), ArgumentError, "expected engine to be one of"),
        (("counts", "none", "local", None, recipe), SceneError, "of recipes with a device; give one"),
        (
            ("exact", "none", "local", None, SimpleNamespace(maker=len, key=len, to_dict=lambda: 1)),
            SceneError,
            "pickles",
        ),
    ):
        with pytest.raises(error, match=words):
            _check_choices(*arguments)


def test_a_recipe_is_expected():
    with pytest.raises(ArgumentError, match=r"expected a recipe, with maker\(\), got"):
        _check_recipe(object(), "folder")
    recipe = SimpleNamespace(maker=len, key=len, to_dict=len)
    with pytest.raises(ArgumentError, match="expected a recipe and then a folder, got the recipe behind 'folder'"):
        _check_recipe("folder", recipe)
    _check_recipe(recipe, "folder")


def test_shares_and_limits():
    assert _whole_pair((0, 1)) == (0, 1) and _whole_pair([2, 3]) == (2, 3)
    for wrong in ((3, 3), (-1, 2), (0, 0), (1,), 2, (0.5, 2)):
        with pytest.raises(UnitError, match=r"shard=\(i, k\) with 0 <= i < k"):
            _whole_pair(wrong)
    for timeout_s in (None, 0.5, 1e9):
        _check_timeout(timeout_s)
    for timeout_s in (0, -1.0, True, "all"):
        with pytest.raises(UnitError, match="expected timeout_s to be a number"):
            _check_timeout(timeout_s)
