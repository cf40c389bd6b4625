"""Interrupts at chosen moments: where the interpreter looks for signals, at the beginning of a function and after a
call of compiled code.
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable
from typing import Any

# Signals that are delayed (`plugins.guards.interrupts_wait`) reach nothing: the first of their handlers is
# replaced first and put back last.
WAITING = "interrupts_wait"


def signals_wait() -> bool:
    return WAITING in getattr(signal.getsignal(signal.SIGINT), "__qualname__", "")


PLACES = ("/torchtransient/", "contextlib")


def moments_of(job: Callable[[], Any], at: int = -1) -> list[tuple[str, str]]:
    """The moments at which an interrupt may reach the library in a ``job``, as (file, function); a
    ``KeyboardInterrupt`` is raised at number ``at``.
    """
    seen: list[tuple[str, str]] = []

    def profile(frame, event, arg):
        name = frame.f_code.co_filename
        if event in ("call", "c_return") and any(place in name for place in PLACES) and not signals_wait():
            seen.append((name.rsplit("/", 1)[-1], frame.f_code.co_name))
            if len(seen) - 1 == at:
                sys.setprofile(None)
                raise KeyboardInterrupt

    before = sys.getprofile()
    sys.setprofile(profile)
    try:
        job()
    finally:
        sys.setprofile(before)
    return seen
