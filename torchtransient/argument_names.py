"""Python's errors about arguments under the name of the function that the user called."""

from __future__ import annotations

import difflib
import inspect
import re
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def arguments_of(name: str, function: Callable[..., Any], given: Collection[str] = ()) -> Iterator[None]:
    """Raise a TypeError about the arguments of ``function`` under another name, with the names of its arguments.

    For functions that hand their ``**options`` on; ``given``: arguments that such a function passes itself.
    """
    try:
        yield
    except TypeError as error:
        head = f"{function.__qualname__}() "
        if not str(error).startswith(head):
            raise
        known = [n for n in inspect.signature(function).parameters if n not in ("self", "kwargs", *given)]
        wrong = re.search(r"unexpected keyword argument '(\w+)'", str(error))
        near = difflib.get_close_matches(wrong[1], known, 1) if wrong else []
        hint = f" Did you mean {near[0]!r}?" if near else ""
        says = str(error).removeprefix(head)
        raise TypeError(f"{name}() {says}.{hint} Its other arguments are {', '.join(known)}.") from None
