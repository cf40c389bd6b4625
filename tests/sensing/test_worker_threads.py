"""Threads that draw side by side: each works alone, the process keeps its number, and forks begin anew."""

from __future__ import annotations

import multiprocessing
import subprocess
import sys

import pytest
import torch

from torchtransient import sensing
from torchtransient.sensing.draws import parallel_map


@pytest.fixture(params=[1, 2, 3])
def threads(request):
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)


def of_thread(_):
    return torch.get_num_threads()


def test_what_fails_in_a_thread_fails_outside(threads):
    def fail(k):
        raise KeyError(k)

    with pytest.raises(KeyError):
        parallel_map(fail, range(4))
    assert parallel_map(of_thread, range(2)) == [1] * 2


def _in_child(queue):
    queue.put(parallel_map(of_thread, range(2)))


@pytest.mark.slow
def test_forks_begin_anew(threads):
    parallel_map(of_thread, range(4))
    context = multiprocessing.get_context("fork")
    queue = context.SimpleQueue()
    child = context.Process(target=_in_child, args=(queue,))
    child.start()
    child.join(30)
    alive = child.is_alive()
    if alive:
        child.terminate()
    assert not alive
    assert queue.get() == [1, 1]


def modes(_):
    return torch.is_inference_mode_enabled(), torch.is_grad_enabled()


def test_threads_are_in_the_mode_of_the_caller(threads):
    assert parallel_map(modes, range(4)) == [(False, True)] * 4
    with torch.no_grad():
        assert parallel_map(modes, range(4)) == [(False, False)] * 4
    with torch.inference_mode():
        assert parallel_map(modes, range(4)) == [(True, False)] * 4
    assert parallel_map(modes, range(4)) == [(False, True)] * 4


@pytest.mark.slow
@pytest.mark.parametrize(
    "sensor",
    [sensing.SynchronousSPAD(50), sensing.ShotNoise(), sensing.Crosstalk(0.05), sensing.Afterpulsing(
        0.1, 1e-9, 0, bin_width_s=1e-10, period_s=1e-7, background=1.0
    )],
    ids=lambda sensor: type(sensor).__name__,
)  # fmt: skip
def test_large_images_are_drawn_in_inference_mode(threads, sensor):
    light = torch.full((1, 32, 64, 65), 0.05 if "rate" in sensor.takes else 1.0)
    expected = sensor.sample(light, torch.Generator().manual_seed(3))
    with torch.inference_mode():
        assert torch.equal(sensor.sample(light, torch.Generator().manual_seed(3)), expected)
        assert torch.equal(sensor.sample(light.clone(), torch.Generator().manual_seed(3)), expected)


_AT_THE_END = """
import atexit, sys, threading
import torch
torch.set_num_threads(2)
from torchtransient.sensing.draws import parallel_map
assert parallel_map(int, "12") == [1, 2]
def late():
    threading.main_thread().join()
    print(parallel_map(int, "34"), flush=True)
threading.Thread(target=late).start()
atexit.register(lambda: print(parallel_map(int, "56"), flush=True))
"""


@pytest.mark.slow
def test_draws_while_the_interpreter_ends():
    ran = subprocess.run([sys.executable, "-c", _AT_THE_END], capture_output=True, text=True, timeout=60)
    assert (ran.returncode, ran.stdout.split("\n")[:2]) == (0, ["[3, 4]", "[5, 6]"]), ran.stderr
