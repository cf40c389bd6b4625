"""What Mitsuba says of a mistake, as one line."""

from __future__ import annotations

import re

_MOST = 600
_TRACEBACK = re.compile(r"Traceback \(most recent call last\):\n(?:[ \t].*\n)*")
_PLACE_IN_SOURCE = re.compile(r"\[\w+\.(?:cpp|h):\d+\] ")


def one_line(error: BaseException) -> str:
    """The message of an error without Python's tracebacks, which Mitsuba prints into it, and without places in its
    sources.
    """
    words = " ".join(_PLACE_IN_SOURCE.sub("", _TRACEBACK.sub("", str(error))).split())
    return words if len(words) <= _MOST else f"{words[: _MOST - 3]}..."
