"""Docstrings of the package are plain text with backticks; Sphinx wants restructured text. The little in between."""

from __future__ import annotations

import re
from collections.abc import Iterable
from itertools import groupby
from typing import Any

_PAGE = re.compile(r"(?<![\w/`])docs/(\w+)\.md(?![\w`])")
_MARKUP = re.compile(r"^\s*([-*+] |\d+[.)] |\.\. |:\w|\|)")
# What is left as it is (a role, a literal, an emphasis, the mark of a list), and what would be markup by chance.
_SPANS = re.compile(
    r"(?P<kept>:\w[\w:]*:`[^`]*`|``.+?``|`[^`]*`_?|(?<![\w*])\*(?=[^\s*])[^*\n]{0,80}[^\s*]\*(?![\w*])|^[ ]*\* )"
    r"|(?P<star>\*)|(?P<bar>\|)|(?P<tail>(?<=\w)_(?!\w))|(?P<page>" + _PAGE.pattern + ")",
    flags=re.MULTILINE | re.DOTALL,
)


def restructured(lines: Iterable[str], pages: bool = True) -> list[str]:
    """Indented paragraphs become literal blocks, names of pages links to them (``pages``), and no other character is
    markup by chance.
    """
    result: list[str] = []
    for literal, group in groupby(_marked(lines), key=lambda pair: pair[0]):
        text = "\n".join(line for _, line in group)
        result += (text if literal else _SPANS.sub(lambda found: _plain(found, pages), text)).split("\n")
    return result


def _plain(found: re.Match[str], pages: bool) -> str:
    if found["kept"]:
        before, after = found.string[: found.start()][-1:], found.string[found.end() :][:1]
        # Markup ends at a space or a mark; an escaped space is none.
        return ("\\ " if before.isalnum() else "") + found[0] + ("\\ " if after.isalnum() or after == "^" else "")
    if found["page"]:
        return f":doc:`/docs/{found[0].removeprefix('docs/').removesuffix('.md')}`" if pages else found[0]
    return f"\\{found[0]}"


def _marked(lines: Iterable[str]) -> list[tuple[bool, str]]:
    """Lines with whether they are part of a literal block; ``::`` before those that have none."""
    result: list[tuple[bool, str]] = []
    opens = True  # after an empty line
    literal = False
    for line in lines:
        bare, indent = line.strip(), len(line) - len(line.lstrip())
        if not bare:
            opens = True
        elif opens:
            before = [text for _, text in result if text.strip()]
            if before and before[-1].rstrip().endswith("::") and indent:
                literal = True
            elif indent >= 4 and not literal and not _in_a_list(before) and not _MARKUP.match(line):
                result += [(True, "::"), (True, "")]
                literal = True
            elif indent == 0:
                literal = False
            opens = False
        result.append((literal, line))
    return result


def _in_a_list(before: list[str]) -> bool:
    """Whether what is indented belongs to a list item or a directive."""
    outer = next((line for line in reversed(before) if not line.startswith(" ")), "")
    return bool(_MARKUP.match(outer))


def as_restructured(app: Any, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
    """For Sphinx's event ``autodoc-process-docstring``."""
    lines[:] = restructured(lines)
