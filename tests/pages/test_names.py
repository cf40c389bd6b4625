"""What pages name is there: `tt.sensing.Compose`, `torchtransient.rendering.labels`, `tests/integrators/test_x.py`."""

from __future__ import annotations

import pkgutil
import re

from support.pages import ROOT, Page, all_pages
from support.recipes import recipes
from support.sweeps import together

# Pages name files by their place below whatever folder they speak of.
FILES = [path.relative_to(ROOT).as_posix() for top in ROOT.iterdir() if not top.name.startswith(".") and top.is_dir()
         and top.name != "build" for path in top.rglob("*.*")]  # fmt: skip
# Files that the examples of docs/contributing.md make, in a copy of the repository.
MADE = [step.file for recipe in recipes(Page("docs/contributing.md")) for step in recipe.steps if step.new]
MODULES = {file.removeprefix("torchtransient").removesuffix(".py").replace("/", ".") for file in MADE}
PAGES = [page for page in all_pages() if page.place != "CHANGELOG.md"]  # it speaks of what was


def dotted_names(text):
    names = re.findall(r"(?<![\w/.\"'])(?:tt|torchtransient)((?:\.[A-Za-z]\w*)+)", text)
    return sorted({name for name in names if not name.endswith((".py", ".md"))})


@together("page", PAGES, repr)
def test_names_are_there(page):
    gone = []
    for name in set(dotted_names(page.text)) - MODULES:
        try:
            pkgutil.resolve_name("torchtransient" + name)
        except (AttributeError, ImportError):
            gone.append(f"tt{name}")
    assert gone == []


@together("page", PAGES, repr)
def test_files_are_there(page):
    named = set(re.findall(r"`((?:\w+/)+[\w]+\.(?:py|sh|md|json))`", page.text))
    assert sorted(file for file in named if not any(f"/{path}".endswith(f"/{file}") for path in [*FILES, *MADE])) == []
