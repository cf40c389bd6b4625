"""Interrupts inside of Mitsuba and Dr.Jit arrive as what they are, and leave nothing changed behind them.

An exception that a signal raises while Python code runs below C++ (a loop that is traced, the constructor of a plugin)
comes out as a ``RuntimeError`` that names it, and would be taken for an error of the scene. Recognised are
``KeyboardInterrupt`` and whatever else is no ``Exception``.

Four things guard against interrupts: :func:`interrupts_pass` raises those that C++ has disguised,
``plugins.interrupted.interrupts_wait`` delays them for changes that must not be left half made, ``afterwards`` is
for changes that can be put back later, and ``forget_traces`` for the collector.
"""

from __future__ import annotations

import functools
import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, ParamSpec, TypeVar

from torchtransient.plugins.interrupted import chain_of, interrupt_behind
from torchtransient.plugins.unfinished import afterwards

_P = ParamSpec("_P")
_R = TypeVar("_R")


@contextmanager
def interrupts_pass() -> Iterator[None]:
    """Raise the interrupt that ended what is inside, in place of the error that C++ has made of it."""
    # Taken before the block: a call in somebody's except block has not failed because of what is handled there.
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


def ends_frames(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Let the frames of a call end with it where an interrupt has ended it. One that comes at the beginning of a
    block's ``__exit__`` leaves its generator waiting for as long as somebody keeps the traceback
    (``sys.last_traceback``, notebooks), and with it the lock, the variant and all that was to be put back.
    """

    @functools.wraps(function)
    def call(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        handled = sys.exc_info()[1]
        try:
            return function(*args, **kwargs)
        except Exception:
            raise
        except BaseException as interrupt:
            clear_frames(interrupt, handled)
            raise
        finally:
            del handled

    return call


def clear_frames(error: BaseException, handled: BaseException | None = None) -> None:
    """Let go of what the frames of a traceback hold: Dr.Jit would run into what is attached, and build calls into
    plugins of scenes that nobody uses any more. ``handled``: as :func:`chain_of`.
    """
    for cause in chain_of(error, handled):
        traceback.clear_frames(cause.__traceback__)


# Mitsuba's level of messages before :func:`quiet`, while it is changed. No local variable: it may be put back by a
# later call.
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
        if mi.logger().log_level() == mi.LogLevel.Error:  # which nobody has changed meanwhile
            mi.logger().set_log_level(_before["level"])
        _before.clear()
