"""Threads that draw side by side, each of which works alone.

Operations of torch take several threads of their own for large tensors. In a thread beside others that makes more
threads than cores, which wait for each other: the same draws then take up to four times the processor time. The
threads here do every operation by themselves.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import torch

Result = TypeVar("Result")

_LOCK = threading.Lock()
_POOLS: dict[int, ThreadPoolExecutor] = {}
_OWN = threading.local()


def _alone() -> None:
    torch.get_num_threads()  # a first look takes over the number of the process, which would undo the next line
    torch.set_num_threads(1)
    _OWN.works_alone = True


def _forget() -> None:
    """In a forked process: the threads stayed behind, and somebody may have held the lock."""
    global _LOCK
    _LOCK = threading.Lock()
    _POOLS.clear()
    _OWN.works_alone = False


os.register_at_fork(after_in_child=_forget)


def _pool(threads: int) -> ThreadPoolExecutor:
    with _LOCK:
        if threads not in _POOLS:
            pool, all_there = ThreadPoolExecutor(threads), threading.Barrier(threads)

            def begin(_: int) -> None:
                _alone()
                all_there.wait()

            before = torch.get_num_threads()
            try:
                list(pool.map(begin, range(threads)))
            except BaseException:
                all_there.abort()  # those that did start would wait for the others, and the process for them
                raise
            finally:
                # the number of a thread is also that of the process, until it is set again
                torch.set_num_threads(before)
            _POOLS[threads] = pool
        return _POOLS[threads]


def side_by_side(job: Callable[..., Result], *arguments: Sequence[Any]) -> list[Result]:
    """`job` of the first of all `arguments`, of the second, ..., by as many threads as `torch.get_num_threads()` says.

    Every job runs in the caller's inference and grad mode. The threads are kept for later calls. Called from one of
    them, or where no more threads can be had (as at the end of the interpreter), it does everything in the caller's.
    """
    threads = min(torch.get_num_threads(), len(arguments[0]))
    if threads < 2 or getattr(_OWN, "works_alone", False):
        return list(map(job, *arguments))
    inferring, watched = torch.is_inference_mode_enabled(), torch.is_grad_enabled()

    def run(*given: Any) -> Result:
        # modes are per thread, and what was made in inference mode can only be written to in it
        with torch.inference_mode(inferring), torch.set_grad_enabled(watched):
            return job(*given)

    try:
        pending = [_pool(threads).submit(run, *given) for given in zip(*arguments, strict=True)]
    except RuntimeError:
        return list(map(job, *arguments))
    return [one.result() for one in pending]
