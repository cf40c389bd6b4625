"""The recipes of docs/contributing.md: their tables of files, and their blocks carried out on a copy of the repository.

The first line of a block says where it goes: ``# FILE (new)`` is the file as it stands, ``# FILE, in NAME`` an entry in
the largest list, tuple or dictionary of what is called NAME there, below imports that it needs, or a row at the end of
the first table below the heading NAME of a page; ``# FILE`` alone, lines at its end.
"""

from __future__ import annotations

import ast
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from support.pages import Page

_HEAD = re.compile(r"^## (An? [^\n:]+): (\d+) files?\n(.*?)(?=^## |\Z)", re.DOTALL | re.MULTILINE)
_ROW = re.compile(r"^\| (\d+) \| (.+?) \| (.+?) \| ?(.*?) ?\|$", re.MULTILINE)
_BLOCK = re.compile(r"^```(?:python|text)\n# ([^\n]*)\n(.*?)^```", re.DOTALL | re.MULTILINE)
_PLACE = re.compile(r"`((?:[\w.]+/)+[\w.]*)`")


@dataclass(frozen=True)
class Step:
    """A block: its ``file``, the ``name`` that it is an entry of, whether the file is ``new``, and the ``text``."""

    file: str
    text: str
    new: bool = False
    name: str = ""

    def carry_out(self, root: Path) -> None:
        """Write it into a copy of the repository."""
        path = root / self.file
        if self.new:
            assert not path.exists(), f"{self.file} is there already: give the example another name"
            path.write_text(self.text, encoding="utf-8")
            return
        source = path.read_text(encoding="utf-8")
        changed = _with_row if path.suffix == ".md" else with_entry
        path.write_text(changed(source, self.name, self.text) if self.name else source + self.text, encoding="utf-8")


@dataclass(frozen=True)
class Row:
    """A file of a recipe: the ``places`` that its cell names, whether one of them is ``new``, and the ``tests`` that
    fail without it.
    """

    places: tuple[str, ...]
    new: bool
    tests: tuple[str, ...]


@dataclass(frozen=True)
class Recipe:
    """A section of the page: what is added, how many files it says it takes, its table and its blocks."""

    title: str
    count: int
    rows: tuple[Row, ...]
    steps: tuple[Step, ...]

    def __str__(self) -> str:
        return self.title


def recipes(page: Page) -> list[Recipe]:
    """The recipes of a page, in its order."""
    found = []
    for title, count, text in _HEAD.findall(page.text):
        rows = [
            Row(tuple(_PLACE.findall(place)), "new" in place, tuple(re.findall(r"`(tests/[\w/.:]+)`", without)))
            for _, place, _, without in _ROW.findall(text)
        ]
        found.append(Recipe(title, int(count), tuple(rows), tuple(_step(*block) for block in _BLOCK.findall(text))))
    return found


def _step(head: str, text: str) -> Step:
    file, _, name = head.partition(", in ")
    return Step(file.removesuffix(" (new)"), text, file.endswith(" (new)"), name)


def with_entry(source: str, name: str, text: str) -> str:
    """The source of a module with an entry at the end of the largest display of what is called ``name`` in it: of the
    dictionaries for one with a key, of the lists and tuples for others.
    """
    lines = text.splitlines()
    imports = [f"{line}\n" for line in lines if line.startswith("from ")]
    entry = "\n".join(line for line in lines if f"{line}\n" not in imports)
    display = max(displays(source, name, _kind(entry)), key=_size)
    rows = source.splitlines(keepends=True)
    # the columns of a syntax tree count bytes
    line = rows[display.end_lineno - 1].encode()
    before = "".join(rows[: display.end_lineno - 1]) + line[: display.end_col_offset - 1].decode()
    after = line[display.end_col_offset - 1 :].decode() + "".join(rows[display.end_lineno :])
    comma = "" if before.rstrip().endswith(",") else ","
    changed = f"{before.rstrip()}{comma}\n{entry},\n{after}".splitlines(keepends=True)
    place = next(
        node.lineno - 1
        for node in ast.parse(source).body
        if isinstance(node, ast.Import | ast.ImportFrom) and getattr(node, "module", "") != "__future__"
    )
    return "".join([*changed[:place], *imports, *changed[place:]])


def _with_row(source: str, heading: str, row: str) -> str:
    before, head, section = source.partition(f"\n## {heading}\n")
    assert head, f"no section is called {heading}"
    start = re.search(r"^\|(?:-+\|)+\n(?:\|.*\n)*", section, re.MULTILINE)
    assert start, f"no table is in {heading}"
    return f"{before}{head}{section[: start.end()]}{row}{section[start.end() :]}"


def _kind(entry: str) -> Any:
    try:
        display = ast.parse(f"{{{entry}}}", mode="eval").body
    except SyntaxError as error:
        raise AssertionError(f"expected one entry of a list, a tuple or a dictionary, got {entry!r}") from error
    return ast.Dict if isinstance(display, ast.Dict) else ast.List | ast.Tuple


def displays(source: str, name: str, kind: Any) -> list[Any]:
    """Every display of a kind that is written out in what is called ``name`` at the top of a module."""
    for node in ast.parse(source).body:
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        if name == getattr(node, "name", "") or any(getattr(target, "id", "") == name for target in targets):
            found = [inner for inner in ast.walk(node) if isinstance(inner, kind)]
            # the values of `return a, b` are a tuple as well
            return [inner for inner in found if (ast.get_source_segment(source, inner) or " ")[0] in "([{"]
    raise AssertionError(f"nothing is called {name}")


def _size(display: Any) -> int:
    return len(display.keys if isinstance(display, ast.Dict) else display.elts)
