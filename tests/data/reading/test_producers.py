"""Producers of an online data set as their trainer sees them, message by message, in one process."""

from __future__ import annotations

import math
import os
import signal
import types
import warnings
from multiprocessing import Pipe
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from support.online_recipe import OnlineRecipe, arrays_of
from torchtransient.data.reading import online_producers
from torchtransient.data.reading.online import OnlineDataset
from torchtransient.data.reading.online_producers import Producers, _check_memory, _interrupts_held_back, _Worker
from torchtransient.data.reading.online_schedule import Schedule
from torchtransient.data.reading.online_worker import layout_of, produce
from torchtransient.errors import (
    PhysicsWarning,
    ShapeError,
    StorageError,
    TorchTransientError,
    TorchTransientWarning,
)

LAYOUT = layout_of(arrays_of(0))


def values(index):
    return {"wall.reflectance": np.float32([index, 0.5]), "box.filename": f"{index}.ply"}


class Process:
    """What stands for a process: it notes what is done to it."""

    def __init__(self, exitcode=0, stubborn=False):
        self.exitcode, self.stubborn, self.done = exitcode, stubborn, []

    def terminate(self):
        self.done.append("terminate")

    def kill(self):
        self.stubborn = False
        self.done.append("kill")

    def join(self, seconds=None):
        self.done.append(seconds)

    def is_alive(self):
        return self.stubborn


class Played(Producers):
    """Producers whose other ends the test holds; ``told``: what they were told to make, by their number."""

    def __init__(self, capacity=8, workers=1, uses=2.0, warm=1, timeout_s=5.0, first=0, exitcode=-9):
        schedule = Schedule(capacity, workers, uses, warm, first, 0)
        super().__init__(OnlineRecipe(), schedule, capacity, workers, timeout_s)
        self.ends, self.told, self.exitcode = [], [], exitcode

    def _started(self):
        here, there = Pipe()
        self.ends.append(there)
        return _Worker(Process(self.exitcode), here)

    def _say(self, worker, *message):
        self.told.append((self._workers.index(worker), *message))

    def makes(self, worker, *indices, outside=(0.0, 0.0)):
        """A producer makes samples, and says so."""
        for index in indices:
            self.ends[worker].send(("start", index))
            if self._layout is None:
                self.ends[worker].send(("layout", LAYOUT))
                self._listen(0.0)
            slot = self.schedule.orders[index].slot
            for name, array in arrays_of(index).items():
                self._ring[name][slot, ...] = torch.from_numpy(array)
            self.ends[worker].send(("done", index, values(index), outside))


@pytest.fixture
def played():
    made = []

    def make(**settings):
        made.append(Played(**settings))
        made[-1].start()
        return made[-1]

    yield make
    for one in made:
        one.close()
        for end in one.ends:
            end.close()


@pytest.fixture
def clock(monkeypatch):
    found = SimpleNamespace(now=50.0)
    # Theirs alone: connections wait by the same clock.
    monkeypatch.setattr(online_producers, "time", SimpleNamespace(monotonic=lambda: found.now))
    return found


# --------------------------------------------------------------------------------------------------------- the trainer


def test_a_draw_is_what_a_producer_has_written(played):
    data = played(first=3)
    assert data.told == [(0, "make", 3, 0), (0, "make", 4, 1)]
    data.makes(0, 3)
    assert data.told[2][:2] == (0, "ring") and data.told[2][2] is data._ring
    sample = data.draw()
    assert (sample["index"], data.schedule.drawn, data.waited_s) == (3, 1, 0.0)
    assert set(sample) == {*LAYOUT, "values", "outside", "index"}
    for name, array in arrays_of(3).items():
        assert sample[name].dtype == torch.from_numpy(array).dtype and (sample[name] == 3).all()
    assert sample["values"]["wall.reflectance"].tolist() == [3, 0.5] and sample["values"]["box.filename"] == "3.ply"
    # One more place is ordered for the one that was made.
    assert data.told[3:] == [(0, "make", 5, 2)]
    sample["transient"].fill_(-1)
    sample["values"]["wall.reflectance"].fill_(-1)
    again = data.draw()
    assert (again["transient"] == 3).all() and again["values"]["wall.reflectance"][0] == 3
    data.makes(0, 4, 5)
    assert {data.draw()["index"] for _ in range(4)} <= {3, 4, 5} and data.schedule.made == 3


def test_light_outside_of_the_window_is_said_before_the_first_draw(played):
    data = played(warm=4, uses=math.inf)
    for index in range(4):
        data.makes(0, index, outside=(0.25, 0.5) if index == 3 else (0.0, 0.0))
        data._listen(0.0)
    with pytest.warns(PhysicsWarning, match=r"OnlineDataset: .* more than 1% in 1 of 4 samples, 18\.75% on av"):
        drawn = [data.draw()]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        drawn += [data.draw() for _ in range(6)]
    assert {tuple(one["outside"].tolist()) for one in drawn if one["index"] == 3} <= {(0.25, 0.5)}
    assert {tuple(one["outside"].tolist()) for one in drawn if one["index"] < 3} <= {(0.0, 0.0)}


def test_a_trainer_waits_for_samples(played, clock, monkeypatch):
    """Until there is one that may be used; news of any kind begin the time anew."""
    data = played(timeout_s=5.0, uses=1.0)
    listen, seconds = Producers._listen, []

    def waits(self, wait):
        seconds.append(wait)
        if wait:
            clock.now += 4.0
        if len(seconds) == 3:
            data.ends[0].send(("start", 0))
        if len(seconds) == 4:
            data.makes(0, 0)
        return listen(self, 0.0)

    monkeypatch.setattr(Played, "_listen", waits)
    assert data.draw()["index"] == 0 and data.waited_s == pytest.approx(4.0 * seconds.count(1.0))
    assert seconds[:4] == [0.0, 1.0, 1.0, 1.0] and seconds.count(1.0) >= 3


@pytest.mark.parametrize(("busy", "words"), [([], r"\(none\)"), ([0], "0"), ([0, 1], "0, 1")])
def test_producers_of_whom_nothing_is_heard(played, clock, monkeypatch, busy, words):
    data = played(workers=2, timeout_s=5.0)
    for number in busy:
        data.ends[number].send(("start", number))
    times = []

    def waits(self, wait):
        times.append(clock.now)
        clock.now += 2.5 if wait else 0.0
        return Producers._listen(self, 0.0)

    monkeypatch.setattr(Played, "_listen", waits)
    words = rf"no news of 2 producers for 5 s, at work on samples {words}\. If samples take so long, set timeout_s"
    for _ in range(2):
        # The same again, whoever asks.
        with pytest.raises(TorchTransientError, match=words):
            data.draw()
    # Five seconds are no more than five seconds.
    assert times == [50.0, 50.0, 52.5, 55.0] and data._closed


def test_samples_that_fail_are_left_out(played):
    """Their places are free; sixteen in a row are an error, with one that is made in between they are not."""
    data = played(uses=math.inf)
    data.makes(0, 0)
    data._listen(0.0)
    data.schedule.uses = 2.0
    for n in range(1, 16):
        data.ends[0].send(("failed", n, "SceneError: no light"))
        with pytest.warns(TorchTransientWarning, match=f"sample {n} is left out: SceneError: no light"):
            data._listen(0.0)
    assert data.failed == 15 and sorted(data.schedule.orders) == [16, 17]
    data.makes(0, 16)
    data._listen(0.0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for n in range(17, 32):
            data.ends[0].send(("failed", n, "SceneError: no light"))
            data._listen(0.0)
    assert data.failed == 30
    data.ends[0].send(("failed", 32, "SceneError: dark"))
    with pytest.raises(TorchTransientError, match="16 samples failed one after another, the last one, 32: Sc"):
        data.draw()
    assert data.failed == 31


def test_exceptions_of_a_producer(played):
    """They are raised as they are, or told where they cannot be sent."""
    for sent, kind, words in (
        (ValueError("a mistake"), ValueError, "a mistake"),
        (None, TorchTransientError, "a producer failed: KeyError: 'last'"),
        (KeyboardInterrupt(), TorchTransientError, "a producer failed: KeyError: 'last'"),
    ):
        data = played()
        data.ends[0].send(("error", sent, "first line\nKeyError: 'last'\n"))
        for _ in range(2):
            with pytest.raises(kind, match=words) as caught:
                data.draw()
            assert "first line" in str(caught.value.__cause__)


def test_interrupts_close_without_being_raised_again(played, monkeypatch):
    data = played()
    monkeypatch.setattr(Played, "_listen", lambda self, wait: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        data.draw()
    with pytest.raises(TorchTransientError, match="it is closed; make a new one"):
        data.draw()


def test_samples_of_one_recipe_are_alike(played):
    data = played(workers=2)
    for number in (0, 1):
        data.ends[number].send(("layout", LAYOUT))
        data._listen(0.0)
    assert [told[:2] for told in data.told if told[1] == "ring"] == [(0, "ring"), (1, "ring")]
    data.ends[0].send(("layout", LAYOUT | {"depth": ((4, 8), "<f4")}))
    with pytest.raises(ShapeError, match=r"depth \(8, 8\) float32, shape .*, got .*depth \(4, 8\) float32"):
        data.draw()


@pytest.mark.parametrize(
    ("exitcode", "how"), [(-9, "by signal 9"), (1, "with exit code 1"), (0, "with exit code 0"), (None, "code None")]
)
def test_a_producer_that_never_spoke(played, exitcode, how):
    data = played(exitcode=exitcode)
    process = data._workers[0].process
    data.ends[0].close()
    with pytest.raises(TorchTransientError, match=f"a producer ended .*{how} before it could say anything; .*__main__"):
        data.draw()
    assert process.done[0] == "terminate"


def test_a_producer_that_ends_is_replaced(played):
    """Its samples are made by the next one; what others make stays theirs. Twice over one sample is an error."""
    data = played(workers=2)
    assert data.told == [(0, "make", 0, 0), (1, "make", 1, 1)]
    data.ends[0].send(("start", 0))
    data.ends[0].close()
    with pytest.warns(TorchTransientWarning, match="ended by signal 9 while it rendered sample 0; another one ta"):
        data._listen(0.0)
    assert len(data.ends) == 3 and data.told[2:] == [(0, "make", 0, 2)] and not data._workers[0].ready
    data.ends[2].send(("start", 0))
    data.ends[2].close()
    with pytest.raises(TorchTransientError, match=r"while it rendered sample 0, 2 times now\. Signal 9 is most likely"):
        data.draw()


def test_a_producer_that_ends_between_samples(played):
    data = played()
    for end in range(3):
        data.ends[end].send(("ready",))
        data.ends[end].close()
        if end < 2:
            with pytest.warns(TorchTransientWarning, match="ended by signal 9 between two samples; another one"):
                data._listen(0.0)
    with pytest.raises(TorchTransientError, match="between two samples, 3 times now"):
        data._listen(0.0)


def test_done_is_between_two_samples(played):
    data = played(capacity=16)
    data.makes(0, 0)
    data.ends[0].send(("start", 1))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        data.ends[0].send(("failed", 1, "why"))
        data._listen(0.0)
    assert data._workers[0].rendering is None and data._workers[0].ready
    data.ends[0].send(("start", 2))
    data._listen(0.0)
    assert data._workers[0].rendering == 2
    assert data._listen(0.0) is False


def test_what_is_said_to_nobody(played):
    """That a producer has ended is found when it is listened to."""
    data = played()
    data.ends[0].close()
    Producers._say(data, data._workers[0], "make", 7, 0)


def test_another_process_leaves_it_alone(played):
    data = played()
    data._pid = os.getpid() + 1
    with pytest.raises(TorchTransientError, match="belongs to the process that made it, and this one was forked"):
        data.draw()
    assert not data._closed
    data.close()
    assert not data._closed and data._workers
    data._pid = os.getpid()
    processes = [worker.process for worker in data._workers]
    data.close()
    data.close()
    assert data._closed and not data._workers and [one.done[0] for one in processes] == ["terminate"]


def test_producers_have_two_seconds_to_end(played, clock):
    """All of them together; then they are killed."""
    data = played(workers=3)
    first, second, third = (worker.process for worker in data._workers)
    second.stubborn = True
    first.join = lambda seconds: (first.done.append(seconds), setattr(clock, "now", 51.5))
    second.join = lambda seconds=None: (second.done.append(seconds), setattr(clock, "now", 53.0))
    data.close()
    assert first.done == ["terminate", 2.0] and second.done == ["terminate", 0.5, "kill", None]
    assert third.done == ["terminate", 0.0]


def test_processes_that_do_not_start(monkeypatch):
    """Nothing of them stays open."""
    ends = []

    class Context:
        @staticmethod
        def Pipe():
            ends.extend(Pipe())
            return ends

        @staticmethod
        def Process(**settings):
            assert settings["daemon"] is True and settings["target"] is produce and settings["args"][0] is ends[1]
            return SimpleNamespace(start=start)

    def start():
        assert signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, [])
        raise OSError("no more processes")

    monkeypatch.setattr(online_producers.multiprocessing, "get_context", lambda kind: {"spawn": Context}[kind])
    with pytest.raises(OSError, match="no more processes"):
        OnlineDataset(OnlineRecipe(), capacity=4)
    assert all(end.closed for end in ends)


def test_interrupts_are_held_back(monkeypatch):
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [])
    with _interrupts_held_back():
        assert signal.pthread_sigmask(signal.SIG_BLOCK, []) == before | {signal.SIGINT}
    assert signal.pthread_sigmask(signal.SIG_BLOCK, []) == before
    monkeypatch.setattr(online_producers, "signal", types.SimpleNamespace())
    with _interrupts_held_back():
        assert signal.pthread_sigmask(signal.SIG_BLOCK, []) == before


def test_shared_memory_has_to_hold_the_ring(monkeypatch, tmp_path):
    """Here 4 samples of 2 x 3 numbers of four bytes and 5 of eight, 64 bytes each."""
    layout = {"transient": ((2, 3), "<f4"), "depth": ((5,), "<f8")}
    free = SimpleNamespace(free=256)
    monkeypatch.setattr(online_producers.shutil, "disk_usage", lambda place: free)
    monkeypatch.setattr(online_producers, "_SHARED", tmp_path)
    _check_memory(layout, 4)
    words = r"5 samples of 6\.1e-05 MiB need 2\.98e-07 GiB of shared memory, .* has 2\.38e-07 GiB\. .*capacity \(3\)"
    with pytest.raises(StorageError, match=words):
        _check_memory(layout, 5)
    monkeypatch.setattr(online_producers, "_SHARED", tmp_path / "nowhere")
    _check_memory(layout, 5)
