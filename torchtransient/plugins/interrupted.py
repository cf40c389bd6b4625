"""What an interrupt becomes when it comes while Python code runs below C++, a ``RuntimeError`` that names it; and how
interrupts wait where nothing may be left half made.
"""

from __future__ import annotations

import re
import signal
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

# Mitsuba hands on the printed traceback of a plugin that it builds, and not the exception.
_PRINTED = re.compile(r"^(KeyboardInterrupt|SystemExit)\b(?:: (\d+)$)?", re.MULTILINE)


def chain_of(error: BaseException, handled: BaseException | None = None) -> list[BaseException]:
    """An exception and what caused it, the root last, hidden contexts (``from None``) included. It ends before
    ``handled``, what was being handled at the call: a call in an ``except`` block did not fail because of it.
    """
    found = [error]
    while (below := found[-1].__cause__ or found[-1].__context__) is not None and below not in found:
        if below is handled:
            break
        found.append(below)
    return found


def interrupt_behind(error: BaseException, handled: BaseException | None = None) -> BaseException | None:
    """The interrupt (or another exception that is no ``Exception``) that an error came of, None where it did not.
    ``handled``: as :func:`chain_of`.
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
    """Delay the handlers of signals set in Python (Ctrl-C, alarms, a scheduler's SIGTERM) until the block is done: for
    changes of the process that must not be left half made. Each is called once, as signals that wait in the system are.
    Does nothing in other threads than the main one, where Python runs no handlers.
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
