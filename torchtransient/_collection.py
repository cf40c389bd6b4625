"""No Mitsuba object is freed while a kernel is traced.

A method call on Mitsuba's objects is compiled for all objects alive at that moment. When a scene is freed in the middle
of a trace, two calls in one kernel are compiled for different numbers of objects, and where this changes "several" to
"one" Dr.Jit 1.5 (LLVM) writes the same function twice: the compiler refuses, and the process is aborted. Scenes are
freed by Python's garbage collector at any time, and by other threads.
"""

from __future__ import annotations

import gc
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

# Reentrant: freeing objects runs finalizers that free others.
_lock = threading.RLock()
# The blocks under way: (thread or 0, token); whether the collector was running when the first of them stopped it; what
# `let_go` was given meanwhile. An interrupt may come between any two lines: what it leaves undone here is done by the
# next block that ends.
_traces: list[tuple[int, object]] = []
_stopped = False
_kept: list[Any] = []


@contextmanager
def no_collection(of_call: bool = False) -> Iterator[None]:
    """No garbage collection and no :func:`let_go` inside, in any thread. May be nested; also a decorator. ``of_call``:
    it is in a call (``rendering.variant.at_work``), and forgotten when that has ended.
    """
    global _stopped
    trace = threading.get_ident() if of_call else 0, object()
    try:
        with _lock:
            _traces.append(trace)
            if gc.isenabled():
                _stopped = True
                gc.disable()
        yield
    finally:
        with _lock:
            if trace in _traces:
                _traces.remove(trace)
            _go_on()


def forget_traces() -> None:
    """To be called where this thread is in no call. Forgets blocks of calls that an interrupt has cut off at their end:
    each would keep the collector stopped until its traceback is let go of.
    """
    with _lock:
        _traces[:] = [trace for trace in _traces if trace[0] != threading.get_ident()]
        _go_on()


def _go_on() -> None:
    """Where no thread traces any more: free what was kept, and let the collector work."""
    global _stopped
    if _traces:
        return
    _kept.clear()
    if _stopped:
        gc.enable()
        _stopped = False


def let_go(contents: list[Any]) -> None:
    """Empty a list that holds the last references to objects of Mitsuba: now, or when no thread traces any more."""
    with _lock:
        if _traces:
            _kept.extend(contents)
        contents.clear()
