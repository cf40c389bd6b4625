"""YAML and JSON as plain data, whoever wrote them: nothing is executed, nothing is expanded beyond what a text can say
itself, and whatever is wrong is a StorageError of one line.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from torchtransient.checks import check_special, path_of
from torchtransient.errors import StorageError, TorchTransientError

MOST_LEVELS = 100
# Of a text with fewer characters, which aliases may repeat.
_NODES = 2**16
_LETTERS = 160
# Of a message that repeats what a file says: all of it, or its beginning and its end.
_MOST, _BEGINNING, _END = 360, 220, 120
_WITHOUT_POINT = re.compile(r"[-+]?[0-9]+[eE][-+]?[0-9]+")
# Of a message of Mitsuba: what Python's tracebacks and places in C++ look like, and the longest that is repeated.
_TRACEBACK = re.compile(r"Traceback \(most recent call last\):\n(?:[ \t].*\n)*")
_PLACE_IN_SOURCE = re.compile(r"\[\w+\.(?:cpp|h):\d+\] ")
_LONGEST = 600
# What PyYAML's constructors and Python's own parsers raise of texts that are something else.
_WRONG = (ValueError, TypeError, LookupError, ArithmeticError, AttributeError, RecursionError, MemoryError)


def said_in_short(error: BaseException) -> str:
    """What an error of another package says, in no more than a line."""
    said = " ".join(str(error).split()).rstrip(".") or type(error).__name__
    return said if len(said) <= _LETTERS else f"{said[: _LETTERS - 3]}..."


def some_of(names: Any, letters: int = 240) -> str:
    """Names in a message: as many as there is place for, and how many more there are."""
    names = [name if len(name) <= 60 else f"{name[:57]}..." for name in map(str, names)]
    text = ", ".join(names)
    if len(text) <= letters:
        return text
    kept = text[:letters].rpartition(", ")[0] or text[:letters]
    left = len(names) - kept.count(", ") - 1
    return f"{kept} and {left} more"


def text_of_file(path: Any, what: str) -> str:
    """The text of a file in UTF-8. Raises StorageError where there is none, and for devices and pipes, which may have
    no end.
    """
    check_special(path_of(path, what), what)
    try:
        return Path(path).read_text(encoding="utf-8")
    except (OSError, ValueError, TypeError) as error:
        said = said_in_short(error)
        raise StorageError(f"{what}: expected a text, but '{str(path)[:200]}' cannot be read: {said}.") from error


def json_data(text: str | bytes, what: str) -> Any:
    """The data of a JSON text. Raises StorageError."""
    try:
        return json.loads(text)
    except _WRONG as error:
        raise StorageError(f"{what}: expected JSON, got what cannot be read: {said_in_short(error)}.") from error


def line_of(text: str) -> str:
    """A text as one line, its beginning and its end where it is long."""
    line = " ".join(text.split())
    return line if len(line) <= _MOST else f"{line[:_BEGINNING]} ... {line[-_END:]}"


@contextmanager
def told_shortly(what: str) -> Iterator[None]:
    """Errors of the library that repeat what a file says, as long as it is, cut to a line; errors of the disk, where a
    file names others, as StorageError.
    """
    try:
        yield
    except TorchTransientError as error:
        said = str(error)
        if len(said) <= _MOST and "\n" not in said:
            raise
        raise type(error)(line_of(said)) from error
    except OSError as error:
        raise StorageError(f"{what}: a file that it names cannot be read: {said_in_short(error)}.") from error


def yaml_data(text: str, what: str, yaml: Any, loader: Any = None, most_nodes: int | None = None) -> Any:
    """The data of a YAML text, with 1e-10 as a number. ``yaml``: the package. ``loader``: one of its safe loaders.

    Raises StorageError for what is no YAML, for more than 100 levels, and for more nodes than ``most_nodes``, by
    default as many as the text has characters and 65536 at least, once aliases are written out; the library's own
    errors pass.
    """
    loader = loader or safe_loader(yaml)
    try:
        _check_events(yaml, text, what, most_nodes or max(_NODES, len(text)))
        return yaml.load(text, Loader=reads_exponents(type("Loader", (loader,), {})))
    except TorchTransientError:
        raise
    except yaml.YAMLError as error:
        raise StorageError(f"{what}: expected YAML, got what cannot be read{_place(error)}.") from error
    except _WRONG as error:
        raise StorageError(f"{what}: expected YAML, got what cannot be read: {said_in_short(error)}.") from error


def safe_loader(yaml: Any) -> Any:
    """A loader of PyYAML that makes plain data alone; the one in C where it is there."""
    return getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def reads_exponents(loader: Any) -> Any:
    """A class of PyYAML's loaders, changed so that plain 1e-10 is a number, as in JSON and YAML 1.2; a quoted one stays
    a text. PyYAML, after YAML 1.1, takes it for a text, since it has no point.
    """
    loader.add_implicit_resolver("tag:yaml.org,2002:float", _WITHOUT_POINT, list("-+0123456789"))
    return loader


def _place(error: Any) -> str:
    """Where a text is no YAML, and why."""
    mark, problem = getattr(error, "problem_mark", None), getattr(error, "problem", None)
    if mark is None or problem is None:
        return f": {said_in_short(error)}"
    context = getattr(error, "context", None)
    said = f"{context}: {problem}" if context else str(problem)
    return f" in line {mark.line + 1}, column {mark.column + 1}: {said_in_short(ValueError(said))}"


def _check_events(yaml: Any, text: str, what: str, most: int) -> None:
    """Count nodes as aliases repeat them, and levels, before anything is built."""
    sizes: list[int] = [0]
    anchors: dict[str, int] = {}
    names: list[str | None] = [None]
    for event in yaml.parse(text, Loader=safe_loader(yaml)):
        if isinstance(event, yaml.AliasEvent):
            sizes[-1] += anchors.get(event.anchor, 1)
        elif isinstance(event, yaml.ScalarEvent):
            sizes[-1] += 1
            if event.anchor is not None:
                anchors[event.anchor] = 1
        elif isinstance(event, yaml.CollectionStartEvent):
            sizes.append(1)
            names.append(event.anchor)
        elif isinstance(event, yaml.CollectionEndEvent):
            size, name = sizes.pop(), names.pop()
            sizes[-1] += size
            if name is not None:
                anchors[name] = size
        if len(sizes) > MOST_LEVELS or sizes[-1] > most:
            raise StorageError(f"{what}: expected YAML of at most {most:,} nodes and {MOST_LEVELS} levels, got more.")


def one_line(error: BaseException) -> str:
    """Return the message of an error of Mitsuba as one line, without tracebacks and places in its sources."""
    words = " ".join(_PLACE_IN_SOURCE.sub("", _TRACEBACK.sub("", str(error))).split())
    return words if len(words) <= _LONGEST else f"{words[: _LONGEST - 3]}..."
