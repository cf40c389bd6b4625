"""Samples that are rendered while they are used: none torn, none used too often, nothing left behind."""

from __future__ import annotations

import gc
import itertools
import math
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from torch.utils.data import DataLoader

from support.marks import long_rows
from support.online_recipe import SHAPE, OnlineRecipe
from torchtransient.data import OnlineDataset
from torchtransient.data.online import Schedule
from torchtransient.errors import PhysicsWarning, SceneError, ShapeError, StorageError, TorchTransientError, UnitError

TESTS = Path(__file__).parents[2]


def index_of(sample):
    """The number of a sample, all of whose parts say the same."""
    index = sample["index"]
    for name in ("transient", "depth", "shape"):
        assert (sample[name] == index).all(), f"sample {index} is torn"
    assert sample["values"]["wall.reflectance"][0] == index
    assert sample["values"]["box.filename"] == f"{index % 3}.ply"
    return index


def draws(data, count):
    """The numbers of so many samples."""
    return [index_of(data.draw()) for _ in range(count)]


def running(pids):
    """Which of the producers that have left their numbers are still there."""
    found = []
    for path in Path(pids).iterdir():
        try:
            state = Path(f"/proc/{path.name}/stat").read_text().rsplit(")", 1)[1].split()[0]
        except FileNotFoundError:
            continue
        if state != "Z":
            found.append(int(path.name))
    return found


def gone(pids, seconds=10.0):
    until = time.monotonic() + seconds
    while running(pids) and time.monotonic() < until:
        time.sleep(0.05)
    return not running(pids)


def shared():
    """Shared memory under a name: torch's has none once it is in use."""
    return {path.name for path in Path("/dev/shm").iterdir() if "torch" in path.name or "psm_" in path.name}


# ------------------------------------------------------------------------------------------------------- schedule


def simulate(uses, capacity, speed, draws=4000, producers=2, warm=4):
    """A trainer and producers that make ``speed`` samples a draw: what was drawn, and the longest reuse."""
    schedule = Schedule(capacity, producers, uses, warm, first=0, seed=0)
    content, open_orders, used, budget = {}, [], Counter(), 0.0

    def give_orders():
        for n in range(producers):
            while (order := schedule.order(n)) is not None:
                open_orders.append(order)
        return open_orders

    while schedule.drawn < draws:
        budget += speed
        while give_orders() and (budget >= 1 or not schedule.can_draw()):
            budget = max(budget - 1, 0.0)
            order = open_orders.pop(0)
            content[schedule.finished(order.index)] = order.index
        assert schedule.can_draw(), "a trainer and producers wait for each other"
        slot = schedule.draw()
        assert slot not in {order.slot for order in open_orders}
        used[content[slot]] += 1
        assert schedule.drawn <= uses * schedule.made
    return schedule, used


RINGS = list(itertools.product([0.01, 0.2, 5.0], [2, 3, 64], [0.5, 1.0, 5.0, 20.0]))


@pytest.mark.parametrize(("speed", "capacity", "uses"), long_rows(RINGS, RINGS[::9]))
def test_mean_use_is_bounded(uses, capacity, speed):
    schedule, used = simulate(uses, capacity, speed, warm=min(4, capacity))
    mean = schedule.drawn / schedule.made
    assert mean <= uses
    # No more is made than is used, but for what is in the ring.
    assert schedule.made <= schedule.drawn / uses + capacity + 2
    assert sum(used.values()) == 4000


def test_uses_of_a_full_ring_are_what_was_asked_for():
    schedule, used = simulate(5.0, 64, 5.0, draws=20000)
    settled = [used[index] for index in range(100, 3000)]
    assert abs(sum(settled) / len(settled) - 5.0) < 0.2
    assert schedule.drawn / schedule.made > 4.7


@pytest.mark.parametrize(("capacity", "producers", "each"), [(64, 2, 8), (4096, 2, 64), (4, 3, 1)])
def test_a_quarter_of_a_full_ring_is_rendered_and_the_rest_is_drawn(capacity, producers, each):
    """Producers share it: one sample each at least, 64 at most."""
    schedule = Schedule(capacity, producers, uses=math.inf, warm=1, first=0, seed=0)
    for _ in range(capacity):
        schedule.finished(schedule.order(0).index)
    ordered = [order.slot for n in range(producers) for order in iter(lambda n=n: schedule.order(n), None)]
    assert len(ordered) == producers * each
    # The probability that 20 draws a place leave one out is below 1e-5.
    assert {schedule.draw() for _ in range(20 * capacity)} == set(range(capacity)) - set(ordered)


# -------------------------------------------------------------------------------------------------- whole data sets


@pytest.mark.slow
def test_samples_are_whole_and_come_from_the_recipe(tmp_path):
    before = shared()
    recipe = OnlineRecipe(pids=str(tmp_path), group=3)
    with OnlineDataset(recipe, capacity=16, workers=2, uses=2.0, warm=8, first=100) as data:
        kept = [data.draw()]
        while len(kept) < 400 or len(list(tmp_path.iterdir())) < 2:
            kept.append(data.draw())
        # Tensors are the caller's own: later draws leave them, and what is done to them leaves the ring.
        seen = [index_of(sample) for sample in kept]
        kept[-1]["transient"].fill_(-1.0)
        draws(data, 60)
        assert [index_of(sample) for sample in kept[:-1]] == seen[:-1] and not kept[0]["transient"].is_shared()
        assert data.drawn == len(seen) + 60 <= 2 * data.made
        # Without a hole but for what is being made.
        assert set(seen) <= set(range(100, 100 + data.made + 16)) and min(seen) < 116
        assert len(set(seen)) > 150
        assert kept[0]["transient"].shape == SHAPE and kept[0]["shape"].dtype == torch.int32
    assert gone(tmp_path) and len(list(tmp_path.iterdir())) == 2
    assert shared() <= before
    with pytest.raises(TorchTransientError, match="closed"):
        data.draw()
    assert index_of(kept[0]) >= 100


def test_loader_makes_batches():
    """After a warning of the light that the window misses."""
    recipe = OnlineRecipe(late=(3,))
    with OnlineDataset(recipe, capacity=16, warm=4, transform=lambda x: x.sum(1)) as data:
        loader = DataLoader(data, batch_size=8, num_workers=0)
        with pytest.warns(PhysicsWarning, match="more than 1% in 1 of"):
            next(iter(loader))
        for _, batch in zip(range(5), loader, strict=False):
            assert batch["transient"].shape == (8, *SHAPE) and batch["index"].shape == (8,)
            assert (batch["depth"][:, 0, 0] == batch["index"]).all()
            assert (batch["outside"].sum(1) == 0.75 * (batch["index"] == 3)).all()
            assert len(batch["values"]["box.filename"]) == 8
            assert (batch["measurement"][:, 0, 0, 0] == 16 * batch["index"]).all()
        with pytest.raises(TorchTransientError, match="num_workers=0"):
            next(iter(DataLoader(data, batch_size=2, num_workers=1, multiprocessing_context="fork")))
        assert index_of(data.draw()) >= 0  # the fork has not ended the producers


@pytest.mark.slow
def test_threads_draw_together():
    with OnlineDataset(OnlineRecipe(), capacity=8, workers=2, uses=3.0, warm=2) as data, ThreadPoolExecutor(4) as pool:
        assert all(pool.map(lambda _: index_of(data.draw()) >= 0, range(400))) and data.drawn == 400


# ---------------------------------------------------------------------------------------------------- what goes wrong


@pytest.mark.slow
@pytest.mark.parametrize(
    ("recipe", "error", "words"),
    [
        ({"bug": (5,)}, ValueError, "sample 5 met a mistake"),
        ({"unpicklable": (0,)}, TorchTransientError, "UnpicklableError: cannot be sent"),
        ({"broken": "no such mesh"}, SceneError, "no such mesh"),
        ({"odd": (3,)}, ShapeError, "same names, shapes and types"),
        ({"fail": tuple(range(100))}, TorchTransientError, "16 samples failed one after another, .*has no light"),
    ],
)
@pytest.mark.filterwarnings("ignore:OnlineDataset. sample")
def test_errors_of_producers_are_raised(tmp_path, recipe, error, words):
    """Again and again, with the traceback of the producer; no process is left."""
    data = OnlineDataset(OnlineRecipe(**recipe, pids=str(tmp_path)), capacity=8, uses=1.0, warm=1)
    for _ in range(2):
        with pytest.raises(error, match=words) as caught:
            draws(data, 100)
        assert "bug" not in recipe or "online_recipe.py" in str(caught.value.__cause__)
    assert gone(tmp_path)


@pytest.mark.slow
def test_samples_that_fail_are_left_out():
    recipe = OnlineRecipe(fail=(2, 3, 7))
    with OnlineDataset(recipe, capacity=8, workers=2, uses=1.0, warm=1) as data:
        with pytest.warns(UserWarning, match="sample 2 is left out: SceneError: sample 2 has no light"):
            seen = set(draws(data, 60))
        assert data.failed == 3 and not seen & {2, 3, 7} and len(seen) > 20


@pytest.mark.slow
def test_producers_killed_from_outside_are_started_again(tmp_path):
    recipe = OnlineRecipe(seconds=0.005, pids=str(tmp_path))
    with OnlineDataset(recipe, capacity=16, workers=2, uses=1.0, warm=4) as data:
        draws(data, 4)
        os.kill(running(tmp_path)[0], signal.SIGKILL)
        with pytest.warns(UserWarning, match="another one takes its place"):
            seen = draws(data, 200)
        until = time.monotonic() + 60
        while len(running(tmp_path)) < 2 and time.monotonic() < until:
            seen += draws(data, 1)
        assert len(running(tmp_path)) == 2
    assert gone(tmp_path) and len(set(seen)) > 80


@pytest.mark.slow
def test_a_sample_that_ends_its_producer_twice_is_an_error(tmp_path):
    data = OnlineDataset(OnlineRecipe(die=(2,), pids=str(tmp_path)), capacity=8, uses=1.0, warm=1)
    twice = pytest.raises(TorchTransientError, match="rendered sample 2, 2 times now")
    with data, pytest.warns(UserWarning, match="takes its place"), twice:
        draws(data, 100)
    assert gone(tmp_path)


@pytest.mark.slow
def test_a_producer_that_hangs_is_an_error(tmp_path):
    data = OnlineDataset(OnlineRecipe(hang=(1,), pids=str(tmp_path)), capacity=8, uses=1.0, warm=1, timeout_s=120.0)
    data.draw()
    # From here on: how long a process takes to start is the machine's.
    data._producers._timeout_s = 1.0
    with data, pytest.raises(TorchTransientError, match=r"no news .* for 1 s, at work on samples 1"):
        draws(data, 100)
    assert gone(tmp_path)


@pytest.mark.slow
def test_more_than_the_shared_memory_is_an_error(monkeypatch):
    needed = 1024 * 4 * (math.prod(SHAPE) + 2 * 8 * 8)
    monkeypatch.setattr("shutil.disk_usage", lambda path: SimpleNamespace(free=needed - 1))
    with OnlineDataset(OnlineRecipe(), capacity=1024) as data, pytest.raises(StorageError, match="shared memory"):
        data.draw()


@pytest.mark.parametrize(
    "wrong",
    [{"capacity": 1}, {"workers": 0}, {"uses": 0.0}, {"uses": float("nan")}, {"first": -1}, {"timeout_s": -1.0}],
)
def test_mistakes_start_nothing(wrong, tmp_path):
    with pytest.raises(UnitError, match=next(iter(wrong))):
        OnlineDataset(OnlineRecipe(pids=str(tmp_path)), **wrong)
    assert not list(tmp_path.iterdir())


# ---------------------------------------------------------------------------------------------------- nothing is left


@pytest.mark.slow
def test_forgotten_data_sets_leave_nothing(tmp_path):
    data = OnlineDataset(OnlineRecipe(pids=str(tmp_path)), capacity=8, warm=1)
    loader = iter(DataLoader(data, batch_size=2))
    next(loader)
    assert running(tmp_path)
    del data, loader
    gc.collect()
    assert gone(tmp_path)


SCRIPT = """
import os, signal, sys, time
sys.path.insert(0, {tests!r})
from support.online_recipe import OnlineRecipe
from torchtransient.data import OnlineDataset

if __name__ == "__main__":
    # A shell starts what it puts behind with interrupts ignored, which children inherit.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    data = OnlineDataset(OnlineRecipe(pids={pids!r}, hang=(40,)), capacity=16, uses=1.0, warm=1)
    data.draw()
    print("drawn", flush=True)
    {end}
"""
ENDS = {
    "exception": ("raise ValueError('mine')", 1),
    "killed": ("os.kill(os.getpid(), signal.SIGKILL)", -9),
    "interrupt while it waits": ("[data.draw() for _ in range(1000)]", None),
}


@pytest.mark.slow
@pytest.mark.parametrize("end", ENDS)
def test_the_end_of_the_interpreter_leaves_nothing(end, tmp_path):
    before = shared()
    pids = tmp_path / "pids"
    pids.mkdir()
    line, code = ENDS[end]
    script = tmp_path / "train.py"
    script.write_text(SCRIPT.format(tests=str(TESTS), pids=str(pids), end=line))
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(TESTS.parent), str(TESTS)])}
    process = subprocess.Popen(
        [sys.executable, str(script)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment,
        start_new_session=True,
    )  # fmt: skip
    assert process.stdout.readline() == "drawn\n"
    if code is None:
        time.sleep(0.5)
        os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert gone(pids)
    if code is None:
        # One trace, of the trainer: producers do not hear Ctrl-C.
        assert errors.count("KeyboardInterrupt") == 1 and process.returncode in (1, -2, 130)
    else:
        assert process.returncode == code
    assert shared() <= before
