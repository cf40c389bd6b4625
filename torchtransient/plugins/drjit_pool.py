"""Dr.Jit's threads, and the lock that keeps calls apart: state of the process, which is the same for every variant."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import drjit as dr

from torchtransient.errors import VariantError

# One lock for everything that touches Mitsuba: the variant, the scenes' parameters and Dr.Jit's graph are shared state.
engine_lock = threading.RLock()

_process = {"parent_was_rendering": False}

# The process that has changed Dr.Jit's pool: its threads do not come along in a fork, and waiting for them never ends.
_pool = {"of": 0}


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
    dr.set_thread_count(count)


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
        try:
            set_drjit_threads(2)
            yield
        finally:
            set_drjit_threads(before)
