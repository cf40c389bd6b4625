"""What an interrupt becomes when it comes while Python code runs below C++: a ``RuntimeError`` that names it."""

from __future__ import annotations

import re

# Mitsuba hands on the printed traceback of a plugin that it builds, and not the exception.
_PRINTED = re.compile(r"^KeyboardInterrupt\b", re.MULTILINE)


def chain_of(error: BaseException) -> list[BaseException]:
    """An exception and its causes, the first reason last."""
    found = [error]
    while (below := found[-1].__cause__ or found[-1].__context__) is not None and below not in found:
        found.append(below)
    return found


def interrupt_behind(error: BaseException) -> BaseException | None:
    """The interrupt (or another exception that is no ``Exception``) that an error came of, None where it did not."""
    chain = chain_of(error)
    own = next((cause for cause in reversed(chain) if not isinstance(cause, Exception)), None)
    if own is None and any(_PRINTED.search(str(cause)) for cause in chain):
        return KeyboardInterrupt()
    return own
