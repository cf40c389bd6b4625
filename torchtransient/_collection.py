"""Python's garbage collector rests while a kernel is traced.

A method call on Mitsuba's objects is compiled for all objects alive at that moment. When the collector frees a scene
in the middle of a trace, two calls in one kernel are compiled for different numbers of objects, and where this changes
"several" to "one" Dr.Jit 1.5 (LLVM) writes the same function twice: the compiler refuses, and the process is aborted.
"""

from __future__ import annotations

import gc
import threading
from collections.abc import Iterator
from contextlib import contextmanager

_lock = threading.Lock()
_resting = 0
_was_enabled = False


@contextmanager
def no_collection() -> Iterator[None]:
    """No collection of reference cycles inside, in any thread. May be nested; also a decorator."""
    global _resting, _was_enabled
    with _lock:
        if _resting == 0:
            _was_enabled = gc.isenabled()
            gc.disable()
        _resting += 1
    try:
        yield
    finally:
        with _lock:
            _resting -= 1
            if _resting == 0 and _was_enabled:
                gc.enable()
