"""What an interrupt becomes when it comes while Python code runs below C++: a ``RuntimeError`` that names it."""

from __future__ import annotations

import re

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
