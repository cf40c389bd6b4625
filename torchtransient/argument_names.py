"""Python's errors about arguments, said of what was called rather than of what it calls."""

from __future__ import annotations

import difflib
import inspect
import re
import types
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

Class = TypeVar("Class", bound=type[Any])


@contextmanager
def arguments_of(name: str, function: Callable[..., Any], given: Collection[str] = ()) -> Iterator[None]:
    """A TypeError of calling ``function`` with wrong arguments is said of ``name``, with the arguments there are, those
    aside that ``name`` itself has ``given``. For functions that hand their ``**options`` on.
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


def own_init(cls: Class) -> Class:
    """A class whose inherited ``__init__`` bears its own name, which is what Python's errors about arguments print."""
    inherited = cls.__init__
    function = types.FunctionType(
        inherited.__code__, inherited.__globals__, inherited.__name__, inherited.__defaults__, inherited.__closure__
    )
    function.__kwdefaults__, function.__annotations__ = inherited.__kwdefaults__, inherited.__annotations__
    function.__doc__, function.__module__ = inherited.__doc__, cls.__module__
    function.__qualname__ = f"{cls.__qualname__}.__init__"
    cls.__init__ = function
    return cls
