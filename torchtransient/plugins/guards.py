"""Guards of what must not be cut in two: delayed signals, a paused garbage collector, interrupts below C++.

A method call on Mitsuba's objects is compiled for all objects alive at that moment. When a scene is freed in the middle
of a trace, two calls in one kernel are compiled for different numbers of objects, and where this changes "several" to
"one" Dr.Jit 1.5 (LLVM) writes the same function twice: the compiler refuses, and the process is aborted. Scenes are
freed by Python's garbage collector at any time, and by other threads: :func:`no_collection` keeps them.
"""

from __future__ import annotations

import gc
import re
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

# Mitsuba hands on the printed traceback of a plugin that it builds, and not the exception.
_PRINTED = re.compile(r"^(KeyboardInterrupt|SystemExit)\b(?:: (\d+)$)?", re.MULTILINE)


def chain_of(error: BaseException, handled: BaseException | None = None) -> list[BaseException]:
    """Return an exception and its causes, the root last, hidden contexts (``from None``) included.

    Args:
        error: the exception.
        handled: exception that was handled at the call, where the chain ends: a call in an ``except`` block did not
            fail because of it.
    """
    found = [error]
    while (below := found[-1].__cause__ or found[-1].__context__) is not None and below not in found:
        if below is handled:
            break
        found.append(below)
    return found


def interrupt_behind(error: BaseException, handled: BaseException | None = None) -> BaseException | None:
    """Return the interrupt, or other exception that is no ``Exception``, that caused an error; None without one.

    Args:
        error, handled: the exception, and the one that was handled at the call or None, see :func:`chain_of`.
    """
    chain = chain_of(error, handled)
    own = next((cause for cause in reversed(chain) if not isinstance(cause, Exception)), None)
    if own is not None:
        return own
    printed = next((found for cause in chain if (found := _PRINTED.search(str(cause)))), None)
    if printed is None:
        return None
    if printed[1] == "KeyboardInterrupt":
        return KeyboardInterrupt()
    return SystemExit(int(printed[2]) if printed[2] else 1)


# Signals that people handle in Python; asking for all that there are takes longer than a short call.
_NAMES = (
    "INT", "TERM", "ALRM", "HUP", "QUIT", "USR1", "USR2", "VTALRM", "PROF", "XCPU", "CONT", "CHLD", "WINCH", "BREAK",
)  # fmt: skip
_SIGNALS = tuple(getattr(signal, f"SIG{name}") for name in _NAMES if hasattr(signal, f"SIG{name}"))


@contextmanager
def interrupts_wait() -> Iterator[None]:
    """Delay Python's handlers of signals (Ctrl-C, alarms, a scheduler's SIGTERM) to the end of the block.

    For changes of the process that must not be left half made. Each handler is called once, as signals that wait in the
    system are. Without effect outside of the main thread, where Python runs no handlers.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    found = ((number, signal.getsignal(number)) for number in _SIGNALS)
    handlers: dict[int, Any] = {number: handler for number, handler in found if callable(handler)}
    came: list[tuple[int, Any]] = []
    try:
        for number in handlers:
            signal.signal(number, lambda number, frame: came.append((number, frame)))
        yield
    finally:
        with ExitStack() as waiting:
            for number, frame in dict(came).items():
                waiting.callback(handlers[number], number, frame)  # each of them, also where another one raises
            _put_back_handlers(list(handlers.items()))


def _put_back_handlers(left: list[tuple[int, Any]]) -> None:
    try:
        while left:
            signal.signal(*left[-1])
            left.pop()
    finally:
        if left:  # one of those put back has raised
            _put_back_handlers(left)


def ensure_restored(put_back: Callable[[], object]) -> None:
    """Call a function that puts settings back, once more if an interrupt cuts it off.

    For ``finally`` blocks. Only a second Ctrl-C within the same call can leave a scene with the settings of that call.

    Args:
        put_back: function that may run twice.
    """
    try:
        put_back()
    except BaseException:
        put_back()
        raise


# ------------------------------------------------------------------------------------------- no collection in a trace

# Reentrant: freeing objects runs finalizers that free others.
_lock = threading.RLock()
# Blocks under way in all threads, whether the first of them stopped the collector, and objects to free after the last.
_blocks = 0
_stopped = False
_waiting: list[Any] = []


@contextmanager
def no_collection() -> Iterator[None]:
    """Hold back the garbage collector and :func:`release_when_safe` in every thread. May be nested, or a decorator."""
    global _blocks, _stopped
    with _lock:
        _blocks += 1
        if gc.isenabled():
            gc.disable()
            _stopped = True
    try:
        yield
    finally:
        with _lock:
            _blocks -= 1
            if not _blocks:
                _waiting.clear()
                if _stopped:
                    _stopped = False
                    gc.enable()


def release_when_safe(contents: list[Any]) -> None:
    """Empty a list that holds the last references to Mitsuba objects: now, or after the last :func:`no_collection`.

    Args:
        contents: the list, which is changed.
    """
    with _lock:
        if _blocks:
            _waiting.extend(contents)
        contents.clear()
