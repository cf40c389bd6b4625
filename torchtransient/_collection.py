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
_traces = 0
_was_enabled = False
_kept: list[Any] = []


@contextmanager
def no_collection() -> Iterator[None]:
    """No garbage collection and no :func:`let_go` inside, in any thread. May be nested; also a decorator."""
    global _traces, _was_enabled
    with _lock:
        if _traces == 0:
            _was_enabled = gc.isenabled()
            gc.disable()
        _traces += 1
    try:
        yield
    finally:
        with _lock:
            _traces -= 1
            if _traces == 0:
                _kept.clear()
                if _was_enabled:
                    gc.enable()


def let_go(contents: list[Any]) -> None:
    """Empty a list that holds the last references to objects of Mitsuba: now, or when no thread traces any more."""
    with _lock:
        if _traces:
            _kept.extend(contents)
        contents.clear()
