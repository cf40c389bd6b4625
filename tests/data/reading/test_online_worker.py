"""What a producer of an online data set does with what it is told, and the data set itself, in one process."""

from __future__ import annotations

import pickle
import signal
from collections import deque
from types import SimpleNamespace

import pytest
import torch

import torchtransient as tt
from support import online_recipe
from support.online_recipe import SHAPE, OnlineRecipe, UnpicklableError, arrays_of
from torchtransient.data.reading import online, online_worker
from torchtransient.data.reading.online import OnlineDataset
from torchtransient.data.reading.online_worker import _Line, _Producer, empty_ring, layout_of, produce, said
from torchtransient.errors import SceneError, ShapeError, TorchTransientError

LAYOUT = layout_of(arrays_of(0))
PAUSE = object()


class Talk:
    """A connection whose other end was played before: what was told, with pauses in which nothing is there."""

    def __init__(self, *told, deaf=False):
        self.told, self.said, self.deaf = deque(told), [], deaf

    def poll(self, seconds):
        assert seconds == 0
        if self.told and self.told[0] is PAUSE:
            self.told.popleft()
            return False
        return True

    def recv(self):
        if not self.told:
            raise EOFError
        return self.told.popleft()

    def send(self, message):
        if self.deaf:
            raise OSError
        self.said.append(message)


def test_places_of_the_ring():
    ring = empty_ring(LAYOUT, 5)
    assert {name: tuple(array.shape) for name, array in ring.items()} == {
        "transient": (5, *SHAPE), "depth": (5, 8, 8), "shape": (5, 8, 8),
    }  # fmt: skip
    assert all(array.is_shared() for array in ring.values()) and ring["shape"].dtype == torch.int32
    assert said({"a": ((2, 3), "<f4"), "b": ((), "<i8")}) == "a (2, 3) float32, b () int64"


def ring(capacity=5):
    return ("ring", empty_ring(LAYOUT, capacity))


@pytest.fixture
def producing(monkeypatch):
    """Runs a producer to the end of what it was told; returns what it said."""
    noted = SimpleNamespace(signals=[], closed=0, threads=[])
    monkeypatch.setattr(online_worker.signal, "signal", lambda *given: noted.signals.append(given))
    monkeypatch.setattr("torchtransient.rendering.threads.threads", noted.threads.append)
    monkeypatch.setattr(
        online_recipe.FakeMaker, "close", lambda self: setattr(noted, "closed", noted.closed + 1), raising=True
    )

    def run(recipe, *told, deaf=False):
        talk = Talk(*told, deaf=deaf)
        produce(talk, pickle.dumps((recipe, ())))
        return talk.said

    run.noted = noted
    return run


def test_a_producer_makes_what_it_is_asked_for(producing):
    """All that it was asked for in the maker's order, into the places of the ring; then it listens again."""
    told = ring()
    heard = producing(
        OnlineRecipe(), ("make", 7, 3), ("make", 2, 1), PAUSE, ("make", 4, 0), told, PAUSE, ("make", 9, 4), PAUSE
    )
    assert heard[0] == ("ready",) and heard[2] == ("layout", LAYOUT)
    assert [said[:2] for said in heard if said[0] in ("start", "done")] == [
        (kind, index) for index in (2, 7, 4, 9) for kind in ("start", "done")
    ]
    assert len(heard) == 10 and heard[3][2]["box.filename"] == "2.ply"
    for index, slot in ((2, 1), (7, 3), (4, 0), (9, 4)):
        assert all((array[slot] == index).all() for array in told[1].values())
    noted = producing.noted
    assert noted.signals == [(signal.SIGINT, signal.SIG_IGN)] and (noted.closed, noted.threads) == (1, [1])


def test_a_sample_that_fails_is_told(producing):
    heard = producing(OnlineRecipe(fail=(2,)), ("make", 2, 1), ("make", 3, 2), PAUSE, ring(), PAUSE)
    assert ("failed", 2, "SceneError: sample 2 has no light") in heard
    assert [said[:2] for said in heard if said[0] in ("done", "failed", "start")] == [
        ("start", 2), ("failed", 2), ("start", 3), ("done", 3),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("recipe", "kind", "words"),
    [
        (OnlineRecipe(bug=(2,)), ValueError, "ValueError: sample 2 met a mistake"),
        (OnlineRecipe(unpicklable=(2,)), type(None), "UnpicklableError: cannot be sent"),
        (OnlineRecipe(broken="no such mesh"), SceneError, "SceneError: no such mesh"),
        (OnlineRecipe(odd=(3,)), ShapeError, r"expected transient (1, 16, 8, 8) float32, depth (8, 8) float32"),
    ],
)
def test_what_ends_a_producer_is_told(producing, recipe, kind, words):
    heard = producing(recipe, ("make", 2, 1), ("make", 3, 2), PAUSE, ring(), PAUSE)
    name, error, text = heard[-1]
    assert name == "error" and type(error) is kind and words in text
    if kind is ShapeError:
        assert "got transient (2, 16, 8, 8) float32" in str(error) and "in sample 3" in str(error)
    assert producing.noted.closed == (0 if recipe.broken else 1)
    with pytest.raises(TypeError):
        pickle.loads(pickle.dumps(UnpicklableError(1, 2)))


def test_where_nobody_listens_a_producer_ends(producing):
    """Without a word, its scenes let go of."""
    assert producing(OnlineRecipe(bug=(2,)), deaf=True) == [] and producing.noted.closed == 1
    assert producing(OnlineRecipe(broken="no such mesh"), deaf=True) == []
    assert producing(OnlineRecipe(), ("make", 2, 1), PAUSE)[-1] == ("layout", LAYOUT)


def test_a_producer_that_has_something_to_do_does_not_wait():
    talk = Talk(("make", 2, 1), PAUSE)
    producer = _Producer(_Line(talk), OnlineRecipe().maker())
    producer._listen()
    assert producer._asked == {2: 1} and not talk.told


# --------------------------------------------------------------------------------------------------------- the data set


@pytest.fixture
def stocked(monkeypatch):
    """An online data set whose producers have made four samples."""
    monkeypatch.setattr(online, "Producers", lambda recipe, schedule, capacity, workers, timeout_s: _stock(schedule))

    def _stock(schedule):
        stock.schedule = schedule
        return stock

    stock = SimpleNamespace(start=lambda: None, close=lambda: closed.append(1), draw=lambda: dict(sample), failed=3,
                            waited_s=1.5)  # fmt: skip
    sample, closed = {"transient": torch.ones(2, 3, requires_grad=True), "index": 4}, []
    return SimpleNamespace(stock=stock, sample=sample, closed=closed)


def test_a_transform_of_what_is_drawn(stocked):
    with OnlineDataset(OnlineRecipe(), 8, transform=lambda light: 2 * light, first=5) as data:
        drawn = next(iter(data))
        assert drawn["measurement"].tolist() == [[2.0] * 3] * 2 and not drawn["measurement"].requires_grad
        assert (data.failed, data.waited_s, data.made, data.drawn, data.next_index) == (3, 1.5, 0, 0, 5)
        del stocked.sample["transient"]
        with pytest.raises(ShapeError, match="transform= is for transients, and samples have index"):
            data.draw()
        with pytest.raises(TorchTransientError, match="cannot be pickled"):
            pickle.dumps(data)
        assert stocked.closed == []
    assert stocked.closed == [1]
    assert "measurement" not in OnlineDataset(OnlineRecipe(), 8).draw()


def test_a_loader_with_workers_is_told(stocked, monkeypatch):
    data = OnlineDataset(OnlineRecipe(), 8)
    monkeypatch.setattr(online, "get_worker_info", lambda: SimpleNamespace(id=0))
    with pytest.raises(TorchTransientError, match=r"use DataLoader\(\.\.\., num_workers=0\) and OnlineDataset"):
        next(iter(data))


def test_what_does_not_start_is_closed(stocked):
    def start():
        raise KeyboardInterrupt

    stocked.stock.start = start
    with pytest.raises(KeyboardInterrupt):
        OnlineDataset(OnlineRecipe(), 8)
    assert stocked.closed == [1]


def test_numbers_of_a_data_set(stocked):
    """The smallest of each; no more samples are waited for than there is room."""
    least = OnlineDataset(OnlineRecipe(), 2, workers=1, warm=1, first=0, seed=0, uses=1e-9, timeout_s=1e-9)
    assert least._producers.schedule.warm == 1 and tt.data.OnlineDataset is OnlineDataset
    assert OnlineDataset(OnlineRecipe(), 8, warm=9)._producers.schedule.warm == 8
    assert OnlineDataset(OnlineRecipe(), 8, warm=7, seed=2**70)._producers.schedule.warm == 7
