"""Workers of a run: shards are handed out, silent workers end, and samples over which workers die are named."""

from __future__ import annotations

from collections import deque
from types import SimpleNamespace

import pytest

from torchtransient.data.crew import DIED, MEASURING, MOST_IN_A_ROW, MOST_OF_A_SHARD, Crew, Ledger, Member, SampleBar
from torchtransient.errors import TorchTransientError


class Worker(Member):
    def __init__(self):
        super().__init__()
        self.tasks, self.ended = [], False

    def send(self, task):
        self.tasks.append(task)

    def end(self):
        self.ended = True


class Played(Crew):
    """Crew with a script: functions of the crew, one for each poll."""

    def __init__(self, ledger, workers=2, timeout_s=None, script=()):
        super().__init__(SimpleNamespace(), workers, ledger, timeout_s)
        self.script, self.started = deque(script), []

    def start(self):
        self.started.append(Worker())
        return self.started[-1]

    def poll(self):
        self.script.popleft()(self)

    def close(self, stopped):
        pass

    def says(self, number, *message):
        self.receive(self.started[number], *message)


@pytest.fixture
def clock(monkeypatch):
    found = SimpleNamespace(now=1000.0)
    monkeypatch.setattr("time.monotonic", lambda: found.now)
    return found


@pytest.fixture
def ledger():
    return Ledger(2, lambda *words, **facts: None, SampleBar(0, 0, shown=False))


@pytest.mark.parametrize(
    ("samples", "timeout_s", "limit"),
    [
        ([], None, 600),  # the first sample compiles
        ([], 7.0, 7),
        ([3.0, 3.0], None, 120),
        ([50.0, 10.0], None, 300),  # 30 times the slowest of the samples behind the first
    ],
)
def test_silent_workers_end(clock, ledger, samples, timeout_s, limit):
    """Their shard is made by another worker, without the sample at which they were silent if that goes on."""
    ledger.retries = 0
    # A poll takes less than two seconds: longer gaps are those of a process that was stopped.
    second = [lambda c: setattr(clock, "now", clock.now + 1.0)]
    steps = [lambda c: c.says(0, "ready")]
    for index, seconds in enumerate(samples):
        steps += [lambda c, n=index: c.says(0, "begin", 4, n), *second * int(seconds)]
        steps += [lambda c, n=index: c.says(0, "end", 4, n, None)]
    alive = []
    steps += [lambda c: c.says(0, "begin", 4, 5), *second * limit, lambda c: alive.append(not c.started[0].ended)]
    steps += [*second, lambda c: c.says(1, "ready"), lambda c: c.says(1, "wrote", 4, 3, 1, 9)]
    crew = Played(ledger, 1, timeout_s, steps)
    crew.make([4], {})
    assert alive == [True] and crew.started[0].ended and not crew.started[1].ended
    assert crew.started[1].tasks[0][3] == {5: DIED} and ledger.restarts == 1


def test_a_run_that_was_stopped_takes_no_worker_for_a_silent_one(clock, ledger):
    steps = [
        lambda c: c.says(0, "ready"), lambda c: c.says(0, "begin", 4, 5),
        lambda c: setattr(clock, "now", clock.now + 5000.0), lambda c: c.says(0, "wrote", 4, 1, 0, 9),
    ]  # fmt: skip
    crew = Played(ledger, 1, 7.0, steps)
    crew.make([4], {})
    assert not crew.started[0].ended and ledger.restarts == 0


def test_workers_that_never_start(ledger):
    """Ten in a row are an error, and so is one that will not start again."""

    def dies(crew, for_good=False):
        crew.remove(crew.workers[0], "by test", own_fault=False, for_good=for_good)

    crew = Played(ledger, 1, script=[dies] * 10)
    with pytest.raises(TorchTransientError, match="a worker ended by test while it started"):
        crew.make([4], {})
    assert len(crew.started) == 10
    crew = Played(ledger, 1, script=[lambda c: dies(c, for_good=True)])
    with pytest.raises(TorchTransientError, match="while it started"):
        crew.make([5], {})
    assert len(crew.started) == 1


@pytest.mark.parametrize(("own_fault", "deaths"), [(True, 3), (False, 6)])
def test_a_sample_over_which_workers_die(ledger, own_fault, deaths):
    """Crashes count twice as much as kills, which may come from outside."""
    ledger.add([0, 1])
    for death in range(deaths):
        assert ledger.skip(0) == {} and ledger.suspects(0) == ([5] if death else [])
        assert ledger.take() == 0
        ledger.lost(0, 5, "by test", own_fault)
    assert ledger.skip(0) == {5: DIED} and ledger.suspects(0) == [] and list(ledger.waiting) == [0, 1]
    assert ledger.restarts == deaths


def test_a_sample_that_is_made_is_not_to_blame(ledger):
    ledger.add([0, 1])
    for _ in range(10):
        for made, other in ((5, 6), (6, 5)):
            assert ledger.take() == 0
            ledger.ended(0, made, None)
            ledger.lost(0, other, "by test", own_fault=False)
    assert ledger.skip(0) == {} and ledger.suspects(0) == [5]


def test_deaths_without_end(ledger):
    """Of one shard while its file is written, of workers without a shard, and before the first sample."""
    ledger.add([0])
    for _ in range(MOST_OF_A_SHARD):
        ledger.take()
        ledger.ended(0, 5, None)
        ledger.lost(0, None, "by test", own_fault=True)
    with pytest.raises(TorchTransientError, match=rf"{MOST_OF_A_SHARD + 1} workers died over shard 0.*the same call"):
        ledger.lost(0, None, "by test", own_fault=True)
    other = Ledger(2, ledger.log, ledger.bar)
    for _ in range(MOST_IN_A_ROW):
        other.lost(None, None, "by test", own_fault=False)
    with pytest.raises(TorchTransientError, match="one after another"):
        other.lost(None, None, "by test", own_fault=False)
    first = Ledger(2, ledger.log, ledger.bar)
    first.add([MEASURING])
    for _ in range(2):
        first.take()
        first.lost(MEASURING, None, "by test", own_fault=True)
    with pytest.raises(TorchTransientError, match="3 workers died before the first samples were made"):
        first.lost(MEASURING, None, "by test", own_fault=True)
