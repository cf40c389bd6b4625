"""Interrupts inside of Mitsuba and Dr.Jit arrive as what they are, and leave nothing changed behind them.

An exception that a signal raises while Python code runs below C++ (a loop that is traced, the constructor of a plugin)
comes out as a ``RuntimeError`` that names it, and would be taken for an error of the scene.
"""

from __future__ import annotations

import signal
import sys
import threading
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from torchtransient.plugins.interrupted import chain_of, interrupt_behind
from torchtransient.plugins.unfinished import afterwards


@contextmanager
def interrupts_pass() -> Iterator[None]:
    """Raise the interrupt that ended what is inside, in place of the error that C++ has made of it."""
    interrupt, handled = None, sys.exc_info()[1]
    try:
        yield
    except Exception as error:
        interrupt = interrupt_behind(error, handled)
        if interrupt is None:
            raise
        clear_frames(error, handled)
        raise interrupt from None
    finally:
        # The frame that raises is in the traceback of what it raises: together they would stay until they are
        # collected, and the scene with them.
        del interrupt, handled


@contextmanager
def interrupts_wait() -> Iterator[None]:
    """Let signals that Python handles (control and C, alarms, the ends that schedulers announce) wait until what is
    inside is done: for changes of the process that would be left half made. Other threads than the main one are never
    interrupted.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    found = ((number, signal.getsignal(number)) for number in signal.valid_signals())
    handlers: dict[int, Any] = {number: handler for number, handler in found if callable(handler)}
    came: list[tuple[int, Any]] = []
    try:
        for number in handlers:
            signal.signal(number, lambda number, frame: came.append((number, frame)))
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        for number, frame in dict(came).items():
            handlers[number](number, frame)


def clear_frames(error: BaseException, handled: BaseException | None = None) -> None:
    """Let go of what the frames of a traceback hold: Dr.Jit would run into what is attached, and build calls into
    plugins of scenes that nobody uses any more. ``handled``: as :func:`chain_of`.
    """
    for cause in chain_of(error, handled):
        traceback.clear_frames(cause.__traceback__)


# Mitsuba's level of messages while it is changed: an interrupt may come between a change and its end.
_before: dict[str, Any] = {}


@contextmanager
def quiet() -> Iterator[None]:
    """Mitsuba warns of gradients through parameters it does not list as differentiable; which ones are right is
    in our own table. To be called under the engine lock.
    """
    import mitsuba as mi

    if "level" in _before:
        yield
        return
    with afterwards(put_back_log_level):
        _before["level"] = mi.logger().log_level()
        mi.logger().set_log_level(mi.LogLevel.Error)
        yield


def put_back_log_level() -> None:
    """Mitsuba's level of messages as it was before :func:`quiet`; nothing where that has been done."""
    import mitsuba as mi

    if "level" in _before:
        mi.logger().set_log_level(_before["level"])
        _before.clear()
