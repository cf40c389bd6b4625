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
from torchtransient.plugins.unfinished import afterwards

# One lock for everything that touches Mitsuba: the variant, the scenes' parameters and Dr.Jit's graph are shared state.
# Calls take it through `rendering.variant.at_work`, which makes good what interrupts have left; where it is taken
# alone, calls inside do not.
engine_lock = threading.RLock()

_process = {"parent_was_rendering": False}

# Id of the process that has set the size of Dr.Jit's pool, 0 for none: the threads do not come along in a fork, and
# waiting for them never ends.
_pool = {"of": 0}

# Seconds between two attempts to wake threads that were told to end, and how many attempts are made.
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
    """Set the number of Dr.Jit's threads without the hang of ``dr.set_thread_count``. The engine lock is held, and
    nothing of Dr.Jit's is running.

    Where a worker falls asleep just as it is told to end, nanothread (of Dr.Jit 1.5) waits for it for ever: once in
    some 250,000 changes. A task that is submitted meanwhile wakes it. ``dr.set_thread_count`` holds the interpreter's
    lock, which would stop the thread that submits: so the pool is shrunk through ctypes.
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
    """Submit a task that does nothing, again and again until ``ended`` is let go; not for ever, since an interrupt may
    prevent that it is.
    """
    for _ in range(MOST_WAKES):
        if ended.acquire(timeout=WAKE_S):
            return
        # one unit of work, no function, always in a thread of the pool, no profile
        task = library.task_submit_dep(None, None, 0, 1, None, None, 0, None, 1, 0)
        library.task_release(task)


@functools.cache
def _nanothread() -> Any:
    """Dr.Jit's pool of threads, which Python does not offer whole; None where it is not found, and where its functions
    may be others than those of Dr.Jit 1.5: look at nanothread.h again then.
    """
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
    taking part: a pool that is the calling thread alone never gets to them. Also on machines of one core. An interrupt
    may leave two threads until the next call.
    """
    with engine_lock:
        before = dr.thread_count()
        if before > 1:
            yield
            return

        def as_before() -> None:
            if dr.thread_count() == 2:  # and nobody has set others meanwhile
                set_drjit_threads(before)

        with afterwards(as_before):
            set_drjit_threads(2)
            yield
