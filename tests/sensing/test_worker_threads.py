"""Threads that draw side by side: each works alone, the process keeps its number, and forks begin anew."""

from __future__ import annotations

import multiprocessing

import pytest
import torch

from torchtransient.sensing.draws import in_threads


@pytest.fixture(params=[1, 2, 3])
def threads(request):
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)


def side_by_side(job, number):
    return in_threads(lambda k, own: job(k), [(k,) for k in range(number)], None)


def of_thread(_):
    return torch.get_num_threads()


def test_what_fails_in_a_thread_fails_outside(threads):
    def fail(k):
        raise KeyError(k)

    with pytest.raises(KeyError):
        side_by_side(fail, 4)
    assert side_by_side(of_thread, 2) == [1] * 2


def _in_child(queue):
    queue.put(side_by_side(of_thread, 2))


@pytest.mark.slow
def test_forks_begin_anew(threads):
    side_by_side(of_thread, 4)
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
    assert side_by_side(modes, 4) == [(False, False)] * 4
    with torch.inference_mode():
        assert side_by_side(modes, 4) == [(True, False)] * 4
    assert side_by_side(modes, 4) == [(False, False)] * 4
