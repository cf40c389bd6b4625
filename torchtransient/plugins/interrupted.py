"""What an interrupt becomes when it comes while Python code runs below C++: a ``RuntimeError`` that names it."""

from __future__ import annotations

import re

# Mitsuba hands on the printed traceback of a plugin that it builds, and not the exception.
_PRINTED = re.compile(r"^KeyboardInterrupt\b", re.MULTILINE)


def chain_of(error: BaseException, handled: BaseException | None = None) -> list[BaseException]:
    """An exception and its causes, the first reason last; without what was ``handled`` where it was raised: a call
    in somebody's ``except`` block has not failed of the error that the block is for.
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
    if own is None and any(_PRINTED.search(str(cause)) for cause in chain):
        return KeyboardInterrupt()
    return own
