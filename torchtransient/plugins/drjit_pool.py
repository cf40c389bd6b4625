"""Dr.Jit's threads, and the lock that keeps calls apart: state of the process, which is the same for every variant."""

from __future__ import annotations

import ctypes
import functools
import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import drjit as dr

from torchtransient.errors import VariantError
from torchtransient.plugins.unfinished import afterwards

# One lock for everything that touches Mitsuba: the variant, the scenes' parameters and Dr.Jit's graph are shared state.
engine_lock = threading.RLock()

_process = {"parent_was_rendering": False}

# The process that has changed Dr.Jit's pool: its threads do not come along in a fork, and waiting for them never ends.
_pool = {"of": 0}

# Seconds that threads may take to end before they are woken, and how often they are.
WAKE_S, MOST_WAKES = 0.1, 600


def _mark_fork() -> None:
    """Runs in the child of a fork: Dr.Jit's threads did not come along, and waiting for them would never end."""
    mitsuba = sys.modules.get("mitsuba")
    active = None if mitsuba is None else mitsuba.variant()
    if active is not None and not active.startswith("scalar"):
        _process["parent_was_rendering"] = True


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_mark_fork)


def check_process() -> None:
    """Raise ``VariantError`` in a forked child whose parent had a JIT variant active."""
    if _process["parent_was_rendering"]:
        raise VariantError(
            "this process was forked from one in which Mitsuba was already rendering, and Dr.Jit does not survive a "
            "fork. Expected a fresh process: use multiprocessing.get_context('spawn'), or DataLoader(..., "
            "multiprocessing_context='spawn')."
        )


def set_drjit_threads(count: int) -> None:
    """Let Dr.Jit compute with so many threads; the engine lock is held. Raises ``VariantError`` in a forked child."""
    check_process()
    if _pool["of"] not in (0, os.getpid()):
        raise VariantError(
            "threads: this process was forked from one that had set Dr.Jit's threads, which did not come along. "
            "Expected a fresh process: use multiprocessing.get_context('spawn'), or set them in the child alone."
        )
    _pool["of"] = os.getpid()
    dr.sync_thread()
    resize_pool(count)


def resize_pool(count: int) -> None:
    """``dr.set_thread_count``, which waits for ever for a thread that falls asleep while it is told to end.

    Once in a hundred thousand times nanothread (of Dr.Jit 1.5) neither sees that the thread sleeps nor lets it see that
    it is to end. A task that is submitted meanwhile wakes it: so another Python thread has to run, which
    ``dr.set_thread_count`` would keep waiting with the interpreter's lock.
    """
    library = _nanothread()
    if library is None or count >= dr.thread_count():
        dr.set_thread_count(count)
        return
    ended = threading.Event()
    helper = threading.Thread(target=_wake, args=(library, ended), name="torchtransient wakes Dr.Jit", daemon=True)
    try:
        helper.start()
        library.pool_set_size(None, count, 1)
    finally:
        ended.set()
        if helper.ident is not None:
            helper.join()
    if dr.thread_count() != count:  # a nanothread that counts otherwise
        dr.set_thread_count(count)


def _wake(library: Any, ended: threading.Event) -> None:
    """Submit a task that does nothing, again and again until the pool has its size; not for ever, should an interrupt
    come in before that is told.
    """
    for _ in range(MOST_WAKES):
        if ended.wait(WAKE_S):
            return
        task = library.task_submit_dep(None, None, 0, 1, None, None, 0, None, 1, 0)
        library.task_release(task)


@functools.cache
def _nanothread() -> Any:
    """Dr.Jit's pool of threads, which Python does not offer whole; None where it is not found."""
    path = next(Path(dr.__file__).parent.glob("*nanothread*"), None)
    try:
        library = None if path is None else ctypes.CDLL(str(path))
        if library is not None:
            pointer, number, flag = ctypes.c_void_p, ctypes.c_uint32, ctypes.c_int
            library.pool_set_size.argtypes = [pointer, number, flag]
            library.pool_set_size.restype = None
            library.task_submit_dep.argtypes = [
                pointer, pointer, number, number, pointer, pointer, number, pointer, flag, flag
            ]  # fmt: skip
            library.task_submit_dep.restype = pointer
            library.task_release.argtypes = [pointer]
            library.task_release.restype = None
    except (OSError, AttributeError):
        return None
    return library


@contextmanager
def threads_for_files() -> Iterator[None]:
    """Hold the engine lock with at least two threads of Dr.Jit: for blocks in which Mitsuba may read or write pictures.

    Mitsuba (3.9 at least) submits the blocks of an OpenEXR file to Dr.Jit's pool and waits on a semaphore, without
    taking part: a pool that is the calling thread alone never gets to them. Also on machines of one core.
    """
    with engine_lock:
        before = dr.thread_count()
        if before > 1:
            yield
            return
        with afterwards(lambda: set_drjit_threads(before)):
            set_drjit_threads(2)
            yield
