"""Workers of a run: sizes of shards, attempts at samples, reasons of failures; silent workers end, and samples over
which workers die are named.
"""

from __future__ import annotations

from collections import deque
from types import SimpleNamespace

import numpy as np
import pytest

import torchtransient as tt
from torchtransient.data import Sample
from torchtransient.data.crew import DIED, MEASURING, MOST_IN_A_ROW, MOST_OF_A_SHARD, Crew, Ledger, Member, SampleBar
from torchtransient.data.run_settings import RunSettings, samples_per_shard
from torchtransient.data.shard_making import ShardMaker, raised, reason_of
from torchtransient.errors import SceneError, StorageError, TorchTransientError, UnitError

MB = 2**20


@pytest.mark.parametrize(
    ("n", "sample_bytes", "expected"),
    [
        (10_000, 4 * MB, 40),  # 250 files of 160 MB
        (1000, 4 * MB, 15),  # 67 files of 60 MB: at least 64
        (100_000, 4 * MB, 64),  # never more than 256 MB
        (2000, 4 * MB, 16),  # 64 MB
        (50, 4 * MB, 1), (10_000, 1000, 156), (10, 1000 * MB, 1), (64, 0, 1),
    ],
)  # fmt: skip
def test_sizes(n, sample_bytes, expected):
    assert samples_per_shard(n, sample_bytes) == expected


class Making:
    """A recipe whose samples fail as often as ``failing`` says; it is its own maker."""

    def __init__(self, failing=(), error=0.25, answers=lambda index: index):
        self.failing, self.error, self.answers = dict(failing), error, answers
        self.asked, self.makers = [], 0

    def maker(self):
        self.makers += 1
        return self

    def sample(self, index):
        self.asked.append(index)
        if self.failing.get(index, 0) > 0:
            self.failing[index] -= 1
            raise UnitError(f"sample {index} is bad")
        return Sample(self.answers(index), 1, arrays={"transient": np.full((1, 2, 3, 5), index, np.float32)})

    def standard_error(self, index):
        if isinstance(self.error, Exception):
            raise self.error
        return self.error

    def order(self, indices):
        return sorted(indices, reverse=True)

    def about(self):
        return {"spp": 4}

    def key(self):
        return "key"

    def to_dict(self):
        return {}

    def close(self):
        pass


@pytest.fixture
def made(tmp_path):
    """Makes a shard of three samples, or measures: (result, messages)."""

    def run(recipe, shard=0, retries=1, skip=(), first=(), about=None):
        settings = RunSettings(recipe, str(tmp_path), 5, "exact", "none", retries)
        sent = []

        def say(*message):
            sent.append(message)

        maker = ShardMaker(settings)
        if shard is None:
            return maker.measure(range(5), say, dict(skip)), sent
        described = {"about": about or {"spp": 4}, "per_shard": 3, "recipe": {}}
        return maker.make(shard, described, say, dict(skip), first), sent

    with tt.threads(1):
        yield run


BAD = "UnitError: sample {} is bad"


def of(sent, *kinds):
    return [one if one[0] != "traced" else one[:3] for one in sent if one[0] in kinds]


def test_attempts_at_samples(made):
    """In a scene that is built anew; the traceback of the first failure is sent once."""
    recipe = Making({1: 1})
    (samples, failed, _), sent = made(recipe)
    assert (samples, failed) == (3, 0) and recipe.asked == [2, 1, 1, 0] and recipe.makers == 2
    assert of(sent, "traced", "retry") == [("traced", 0, 1), ("retry", 0, 1, BAD.format(1))]
    # Samples under another number are failures.
    assert made(Making(answers=lambda index: index + 1), retries=0)[0][:2] == (3, 3)


def test_suspects_come_first(made, tmp_path):
    """Then the maker's order; samples that are given up or fail have their rows."""
    recipe = Making({3: 9})
    result, sent = made(recipe, 1, retries=0, skip={4: "given up"}, first=[4])
    assert result == (2, 2, (tmp_path / "shard-000001.h5").stat().st_size) and recipe.asked == [3]
    assert of(sent, "begin", "end", "closing") == [
        ("end", 1, 4, "given up"), ("begin", 1, 3), ("end", 1, 3, BAD.format(3)), ("closing", 1),
    ]  # fmt: skip
    recipe = Making()
    made(recipe, first=[1])
    assert recipe.asked == [1, 2, 0]
    with pytest.raises(StorageError, match="spp"):
        made(Making(), about={"spp": 8})


def test_the_first_sample_that_can_be_made_is_measured(made):
    found, sent = made(Making({1: 9}), None, retries=0, skip={0: "given up"})
    assert (found.sample_bytes, found.about, found.standard_error) == (120, {"spp": 4}, 0.25)
    assert [one[2] for one in of(sent, "begin")] == [1, 2, 2]
    for error in (UnitError("no"), float("nan"), float("inf")):
        assert made(Making(error=error), None)[0].standard_error is None
    with pytest.raises(SceneError, match=r"none of the samples 0 to 4 .* The last one: UnitError: sample 4 is bad$"):
        made(Making(dict.fromkeys(range(5), 9)), None)


def test_reasons_are_the_same_everywhere():
    error = ValueError("in /home/one/two/file.ply,\n at <object 0x7fa301385210>: 0x12 and a/b")
    assert reason_of(error) == "ValueError: in file.ply, at <object 0x...>: 0x12 and a/b"
    error = SceneError('At dictionary node: "/srv/of b/c/mesh.ply": I/O error, of 3/4 in a/b.ply')
    assert reason_of(error).endswith('mesh.ply": I/O error, of 3/4 in a/b.ply') and "/srv" not in reason_of(error)
    assert len(reason_of(ValueError("x" * 600))) == 500


def test_errors_travel_as_texts():
    for kind, expected in (
        ("UnitError", UnitError), ("StorageError", StorageError), ("PermissionError", StorageError),
        ("KeyError", TorchTransientError), ("annotations", TorchTransientError),
    ):  # fmt: skip
        assert type(raised(kind, "bad")) is expected


# ----------------------------------------------------------------------------------------------------------- their crew


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


@pytest.mark.parametrize("seconds", [2.25, 5000.0])
def test_a_run_that_was_stopped_takes_no_worker_for_a_silent_one(clock, ledger, seconds):
    """A poll takes less than two seconds."""
    steps = [
        lambda c: c.says(0, "ready"), lambda c: c.says(0, "begin", 4, 5),
        lambda c: setattr(clock, "now", clock.now + seconds), lambda c: c.says(0, "wrote", 4, 1, 0, 9),
    ]  # fmt: skip
    crew = Played(ledger, 1, 2.1, steps)
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
    ledger.waiting.extend([0, 1])
    for death in range(deaths):
        assert ledger.skip(0) == {} and ledger.suspects(0) == ([5] if death else [])
        assert ledger.take() == 0
        ledger.lost(0, 5, "by test", own_fault)
    assert ledger.skip(0) == {5: DIED} and ledger.suspects(0) == [] and list(ledger.waiting) == [0, 1]
    assert ledger.restarts == deaths


def test_a_sample_that_is_made_is_not_to_blame(ledger):
    ledger.waiting.extend([0, 1])
    for _ in range(10):
        for made, other in ((5, 6), (6, 5)):
            assert ledger.take() == 0
            ledger.ended(0, made, None)
            ledger.lost(0, other, "by test", own_fault=False)
    assert ledger.skip(0) == {} and ledger.suspects(0) == [5]


def test_deaths_without_end(ledger):
    """Of one shard while its file is written, of workers without a shard, and before the first sample."""
    ledger.waiting.extend([0])
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
    first.waiting.extend([MEASURING])
    for _ in range(2):
        first.take()
        first.lost(MEASURING, None, "by test", own_fault=True)
    with pytest.raises(TorchTransientError, match="3 workers died before the first samples were made"):
        first.lost(MEASURING, None, "by test", own_fault=True)
