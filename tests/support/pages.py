"""The pages of the documentation, and their blocks of Python: what a page shows is run here as it stands.

A block is run unless its first line says why it cannot be: ``# not run: needs two GPUs``. The blocks of a page share
their names, in the order that they stand in, as a reader would type them.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
NOT_RUN = "# not run: "

_FENCED = re.compile(r"^(```+)[^\n]*\n.*?^\1 *$", flags=re.DOTALL | re.MULTILINE)
_CODE = re.compile(r"`+[^`\n]+`+")
_LINK = re.compile(r"\]\(([^)\s]+)(?:\s+\"[^\"]*\")?\)")
_TITLE = re.compile(r"^(#+) +(.*?) *$", flags=re.MULTILINE)


class Page:
    """A page by its place in the repository: ``Page("docs/nlos.md")``."""

    def __init__(self, place: str) -> None:
        self.place = place
        self.path = ROOT / place

    def __repr__(self) -> str:
        return self.place

    @cached_property
    def text(self) -> str:
        return self.path.read_text(encoding="utf-8")

    def blocks(self, language: str) -> list[str]:
        """All blocks of a language, those that are not run included."""
        return re.findall(rf"^```{language}\n(.*?)^```", self.text, flags=re.DOTALL | re.MULTILINE)

    def programs(self) -> list[tuple[int, str]]:
        """(number, code) of the blocks of Python that are run."""
        return [(n, code) for n, code in enumerate(self.blocks("python")) if not code.startswith(NOT_RUN)]

    def run(
        self, names: dict[str, Any] | None = None, smaller: Mapping[str, str] | None = None
    ) -> Iterator[tuple[int, str]]:
        """Run one block after the other in ``names``; yields (number, code as it stands) after each of them.

        ``smaller``: regular expressions and what stands in their place, which make what the page shows small. Each has
        to be found on the page.
        """
        names = {} if names is None else names
        smaller = smaller or {}
        for pattern in smaller:
            assert re.search(pattern, self.text), f"{self}: {pattern!r} does not stand there any more"
        for number, code in self.programs():
            shown = code
            for pattern, small in smaller.items():
                code = re.sub(pattern, small, code)
            exec(compile(code, f"{self.place}, block {number}", "exec"), names)
            yield number, shown

    def names(self, smaller: Mapping[str, str] | None = None, **given: Any) -> dict[str, Any]:
        """What stands there after every block has run."""
        found: dict[str, Any] = dict(given)
        for _ in self.run(found, smaller):
            pass
        return found

    @cached_property
    def prose(self) -> str:
        """The page without its blocks and code."""
        return _CODE.sub("", _FENCED.sub("", self.text))

    def links(self) -> set[str]:
        """Links to files, pages and titles of this repository, as they are written."""
        return {link for link in _LINK.findall(self.prose) if "://" not in link and not link.startswith("mailto:")}

    def anchors(self) -> set[str]:
        """Anchors of the titles, as git hosts make them."""
        found: set[str] = set()
        for _, title in _TITLE.findall(_FENCED.sub("", self.text)):
            shown = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", title)
            name = re.sub(r"[^\w\- ]", "", shown.lower()).replace(" ", "-")
            again = (f"{name}-{count}" for count in range(1, 100))
            found.add(name if name not in found else next(each for each in again if each not in found))
        return found

    def targets(self) -> dict[str, tuple[Path, str]]:
        """Every link with the file that it leads to and the anchor in it, empty where there is none."""
        result = {}
        for link in self.links():
            file, _, anchor = link.partition("#")
            result[link] = ((self.path.parent / file).resolve() if file else self.path, anchor)
        return result


def page_of(path: Path) -> Page:
    return Page(path.relative_to(ROOT).as_posix())


def all_pages() -> list[Page]:
    """The README, the changelog, every page of docs/, and that of the benchmarks."""
    there = [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted(DOCS.glob("*.md")), ROOT / "benchmarks" / "README.md"]
    return [page_of(path) for path in there]
