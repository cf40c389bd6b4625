"""Dr.Jit's pool of threads and the lock that keeps calls apart: both belong to the process, whatever the variant."""

from __future__ import annotations

import ctypes
import functools
import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import drjit as dr

from torchtransient.errors import VariantError

# One lock for everything that touches Mitsuba: the variant, the scenes' parameters and Dr.Jit's graph are shared state.
engine_lock = threading.RLock()

_process = {"parent_was_rendering": False}

# Process id of the last change of the pool's size, 0 for none: threads do not come along in a fork, and waiting for
# them never ends.
_pool = {"process": 0}

# Seconds between two attempts to wake threads that were told to end, and how many attempts are made.
WAKE_S, MOST_WAKES = 0.1, 600


def _mark_fork() -> None:
    """Mark the child of a fork whose parent rendered: it lacks Dr.Jit's threads, and would wait for them for ever."""
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
    """Set the number of Dr.Jit's threads, under the engine lock.

    Args:
        count: threads, at least 1; the calling one is among them.

    Raises:
        VariantError: in a child that was forked from a process that had set them.
    """
    check_process()
    if _pool["process"] not in (0, os.getpid()):
        raise VariantError(
            "threads: this process was forked from one that had set Dr.Jit's threads, which did not come along. "
            "Expected a fresh process: use multiprocessing.get_context('spawn'), or set them in the child alone."
        )
    _pool["process"] = os.getpid()
    dr.sync_thread()
    resize_pool(count)


def resize_pool(count: int) -> None:
    """Set the number of Dr.Jit's threads without the hang of ``dr.set_thread_count``.

    Call under the engine lock, while no kernel runs. If a worker falls asleep just as the pool shrinks, nanothread (of
    Dr.Jit 1.5) waits for it for ever: once in some 250,000 changes, and a process of one thread shrinks its pool after
    every file (:func:`threads_for_files`). A task that is submitted meanwhile wakes the worker. ``dr.set_thread_count``
    holds the interpreter's lock, which would stop the thread that submits: so the pool is shrunk through ctypes.

    Args:
        count: threads, at least 1.
    """
    library = _nanothread()
    # At the interpreter's end no thread begins any more, and its start would be waited for.
    if library is None or count >= dr.thread_count() or sys.is_finalizing():
        dr.set_thread_count(count)
        return
    ended = threading.Lock()  # whose methods no interrupt can cut off: those of an event are Python's
    ended.acquire()
    helper = threading.Thread(target=_wake, args=(library, ended), name="torchtransient wakes Dr.Jit", daemon=True)
    try:
        with suppress(RuntimeError):  # no more threads can be had
            helper.start()
        if helper.ident is None:
            dr.set_thread_count(count)
        else:
            library.pool_set_size(None, count, 1)  # start_parked: of no effect here
    finally:
        ended.release()
        if helper.ident is not None:  # an interrupt may have kept it from starting
            helper.join()
    if dr.thread_count() != count:  # another copy of the library than Dr.Jit's, or one that counts otherwise
        dr.set_thread_count(count)


def _wake(library: Any, ended: threading.Lock) -> None:
    """Submit empty tasks until ``ended`` is released, at most ``MOST_WAKES``: an interrupt may prevent the release."""
    for _ in range(MOST_WAKES):
        if ended.acquire(timeout=WAKE_S):
            return
        # one unit of work, no function, always in a thread of the pool, no profile
        task = library.task_submit_dep(None, None, 0, 1, None, None, 0, None, 1, 0)
        library.task_release(task)


@functools.cache
def _nanothread() -> Any:
    """Library of Dr.Jit's pool; None if not found, or of another Dr.Jit than 1.5, whose nanothread.h may differ."""
    if not dr.__version__.startswith("1.5."):
        return None
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
    taking part: a pool that is the calling thread alone never gets to them, on machines of one core too.
    """
    with engine_lock:
        before = dr.thread_count()
        if before > 1:
            yield
            return

        try:
            set_drjit_threads(2)
            yield
        finally:
            if dr.thread_count() == 2:  # the block has set no other number
                set_drjit_threads(before)
