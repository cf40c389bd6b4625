"""YAML files as checked plain data: sections whose entries are taken by name and kind."""

from __future__ import annotations

import contextlib
import difflib
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from torchtransient.array_files.plain_texts import safe_loader, text_of_file, yaml_data, yaml_package
from torchtransient.checks import path_of, shown, some_of
from torchtransient.errors import SceneError

_MISSING = object()


def read_yaml(source: str | Path, who: str) -> tuple[dict[str, Any], Path]:
    """Read the mapping of a YAML file by PyYAML's safe loader; nothing is executed.

    Args:
        source: path of a file, a folder that holds one of its name, or a text with a line break: YAML itself.
        who: subject of messages.

    Returns:
        The mapping, and the folder of the file (of a text the current one).

    Raises:
        MissingPackageError: without PyYAML.
        StorageError: for a missing file and for other texts than YAML.
        SceneError: for anything but a mapping, and a name that stands twice in one.
    """
    yaml = yaml_package(who)

    class Loader(safe_loader(yaml)):  # type: ignore[misc]  # the package has no types
        """Safe loader that refuses a name that stands twice."""

        def construct_mapping(self, node: Any, deep: bool = False) -> Any:
            own = [key for key, _ in node.value if key.tag != "tag:yaml.org,2002:merge"]
            names = [self.construct_object(key, deep=True) for key in own]
            twice = [str(name) for number, name in enumerate(names) if name in names[:number]]
            if twice:
                line = node.start_mark.line + 1
                raise SceneError(f"{who}: {some_of(twice, 100)} stands twice in the mapping at line {line}; keep one.")
            return super().construct_mapping(node, deep)

    text, folder = _text(source, who)
    data = yaml_data(text, who, yaml, Loader)
    if not isinstance(data, dict):
        raise SceneError(f"{who}: expected names and values, 'name: value' in each line, got {type(data).__name__}.")
    return data, folder


def _text(source: str | Path, who: str) -> tuple[str, Path]:
    if isinstance(source, str) and "\n" in source:
        return source, Path.cwd()
    path = path_of(source, who)
    if os.path.isdir(path):
        # y-tal's experiments are folders that hold a file of their name.
        path = path / f"{path.resolve().name}.yaml"
    return text_of_file(path, who), path.resolve().parent


class Section:
    """Mapping whose entries are taken by name. Wrong entries raise a SceneError that names them.

    Every method takes the name of an entry and the default for one that is missing or null, which is returned as it is;
    without a default a missing entry is a SceneError.

    Args:
        data: the mapping.
        where: place in the file, for messages.
        known: all names that may stand there; another one is an error that names the nearest of them.
    """

    def __init__(self, data: Any, where: str, known: Iterable[str]):
        self.where = where
        if not isinstance(data, Mapping):
            raise SceneError(f"{where}: expected names and values, got {shown(data)}.")
        names = list(known)
        for name in data:
            if name not in names:
                close = difflib.get_close_matches(str(name), names, n=1, cutoff=0.5)
                hint = f"Did you mean {close[0]!r}? " if close else ""
                raise SceneError(f"{where}: unknown entry {shown(name)}. {hint}Known ones are {some_of(names)}.")
        self.data = data

    def __contains__(self, name: str) -> bool:
        return self.data.get(name) is not None

    def get(self, name: str, default: Any = _MISSING) -> Any:
        """Return an entry as it is."""
        value = self.data.get(name)
        if value is not None:
            return value
        if default is _MISSING:
            raise SceneError(f"{self.where}: expected an entry '{name}', which is missing.")
        return default

    def number(self, name: str, default: Any = _MISSING) -> Any:
        """Return a finite number."""
        value = self.get(name, default)
        return value if name not in self else as_number(value, self._at(name))

    def whole(self, name: str, default: Any = _MISSING, least: int | None = 1) -> Any:
        """Return a whole number, at least ``least`` unless that is None."""
        value = self.get(name, default)
        if name not in self:
            return value
        number = as_number(value, self._at(name))
        if number != round(number) or (least is not None and number < least):
            bound = "" if least is None else f" of at least {least}"
            raise SceneError(f"{self._at(name)}: expected a whole number{bound}, got {shown(value)}.")
        return int(number)

    def flag(self, name: str, default: bool) -> bool:
        """Return true or false."""
        value = self.get(name, default)
        if not isinstance(value, bool):
            raise SceneError(f"{self._at(name)}: expected true or false, got {shown(value)}.")
        return value

    def text(self, name: str, default: Any = _MISSING) -> Any:
        """Return a text."""
        value = self.get(name, default)
        if name in self and not isinstance(value, str):
            raise SceneError(f"{self._at(name)}: expected a text, got {shown(value)}.")
        return value

    def choice(self, name: str, choices: Sequence[str], default: Any = _MISSING) -> Any:
        """Return one of the texts ``choices``."""
        value = self.get(name, default)
        if value not in choices:
            raise SceneError(f"{self._at(name)}: expected one of {some_of(choices)}, got {shown(value)}.")
        return value

    def numbers(self, name: str, counts: Sequence[int]) -> list[float]:
        """Return a list of finite numbers, as many as one of ``counts``."""
        value = self.get(name)
        if not isinstance(value, list) or len(value) not in counts:
            words = " or ".join(map(str, counts))
            raise SceneError(f"{self._at(name)}: expected a list of {words} numbers, got {shown(value)}.")
        return [as_number(entry, self._at(name)) for entry in value]

    def _at(self, name: str) -> str:
        return f"{self.where}: {name}"


def as_number(value: Any, where: str) -> float:
    """Return a finite number, also of a text, since YAML 1.1 reads 1e-3 as one.

    Args:
        value: entry of a YAML file.
        where: place of the entry, for messages.

    Raises:
        SceneError: for anything else.
    """
    number = math.nan
    if isinstance(value, int | float | str) and not isinstance(value, bool):
        with contextlib.suppress(ValueError, OverflowError):
            number = float(value)
    if not math.isfinite(number):
        raise SceneError(f"{where}: expected a finite number, got {shown(value)}.")
    return number


def file_beside(name: str, folders: Sequence[Path], where: str) -> Path:
    """Return the path of a file in the first of some folders that has it.

    Args:
        name: name of the file.
        folders: folders in the order in which they are searched.
        where: place of the entry, for messages.

    Raises:
        SceneError: if none has it.
    """
    for folder in folders:
        path = folder / name
        if os.path.isfile(path):
            return path.resolve()
    looked = ", ".join(f"'{folder}'" for folder in dict.fromkeys(folders))
    raise SceneError(f"{where}: no file '{name}' in {looked}. Give a path from the folder of the YAML file.")
