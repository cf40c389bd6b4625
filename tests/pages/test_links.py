"""Every page is two clicks from the README, no link leads nowhere, and what is said to be there is there."""

from __future__ import annotations

import re

from support.pages import ROOT, Page, all_pages, page_of
from support.sweeps import together

PAGES = all_pages()
README, INDEX = Page("README.md"), Page("docs/index.md")


@together("page", PAGES, repr)
def test_links_lead_somewhere(page):
    for link, (path, anchor) in page.targets().items():
        assert path.exists(), f"{page}: {link}"
        assert path.is_relative_to(ROOT), f"{page}: {link} leads out of the repository"
        if anchor and path.suffix == ".md":
            assert anchor in page_of(path).anchors(), f"{page}: {link}"


def leads_to(page):
    return {path for path, _ in page.targets().values() if path.suffix == ".md"}


def test_every_page_is_two_clicks_from_the_readme():
    first = leads_to(README)
    second = first.union(*(leads_to(page_of(path)) for path in first))
    assert {page.path for page in PAGES} - second == set()


def test_the_index_has_every_page_in_one_place():
    """The site's tree is made of it."""
    listed = [path for path, _ in INDEX.targets().values() if path.suffix == ".md"]
    assert len(set(listed)) == len(listed)
    assert {page.path for page in PAGES} - set(listed) <= {README.path, INDEX.path}


def test_the_readme_is_short():
    assert README.path.stat().st_size <= 10_000


@together("page", PAGES, repr)
def test_scripts_that_are_named_exist(page):
    for script in set(re.findall(r"\b((?:benchmarks|docs|training_examples)/\w+\.py)", page.text)):
        assert (ROOT / script).is_file(), f"{page}: {script}"


def test_commands_that_are_named_exist():
    from torchtransient.cli.main import COMMANDS

    shown = re.findall(r"^torchtransient ([a-z]+)", "\n".join(b for p in PAGES for b in p.blocks("sh")), re.MULTILINE)
    table = re.findall(r"^\| `torchtransient ([a-z]+)", Page("docs/commands.md").text, re.MULTILINE)
    assert {"doctor", "render", "cost", "demo"} <= {*shown, *table} <= set(COMMANDS)
    assert set(table) == set(COMMANDS)
