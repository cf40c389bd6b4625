"""The site of the documentation: what is made of docstrings and of the index, and the whole of it without a warning."""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys
import time

import pytest

import torchtransient as tt
from support.pages import DOCS, ROOT, Page, all_pages

SITE = DOCS / "site"


def module(name):
    """A module of docs/site, which is no package."""
    specification = importlib.util.spec_from_file_location(f"site_{name}", SITE / f"{name}.py")
    found = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(found)
    return found


@pytest.mark.parametrize(
    ("plain", "wanted"),
    [
        ("(*batch, 3) and *words* of `x`s", "(\\*batch, 3) and *words* of `x`\\ s"),
        ("|S| of llvm_ad_ in `llvm_ad_`", "\\|S\\| of llvm_ad\\_ in `llvm_ad_`"),
        ("see docs/nlos.md, `docs/nlos.md`", "see :doc:`/docs/nlos`, `docs/nlos.md`"),
        ("`a\nb` * c", "`a\nb` \\* c"),
        ("text\n\n    code * |x|\n\nmore *", "text\n\n::\n\n    code * |x|\n\nmore \\*"),
        ("text::\n\n    code *\n", "text::\n\n    code *\n"),
        ("- an item\n\n    of a list", "- an item\n\n    of a list"),
    ],
)
def test_docstrings_are_plain_text(plain, wanted):
    assert module("docstrings").restructured(plain.split("\n")) == wanted.split("\n")


def test_the_reference_has_every_public_name():
    reference = module("reference")
    rooms = reference.rooms()
    assert {"", "sensing", "losses", "nlos", "data", "vis", "errors"} <= set(rooms)
    described: dict[int, str] = {}
    pages = {name: reference.page_of(name, found, described) for name, found in rooms.items()}
    for room in ("losses", "sensing", "nlos"):
        for name, value in vars(getattr(tt, room)).items():
            if name[0] != "_" and callable(value) and value.__module__.startswith("torchtransient"):
                shown = rf"^\.\. auto\w+:: {name}$|^- :py:obj:`{name} <torchtransient\."
                assert re.search(shown, pages[room], re.MULTILINE), f"tt.{room}.{name}"
    for name in ("TransientRenderer", "load", "render", "plan"):
        assert f":: {name}\n" in pages[""]


def test_the_tree_has_every_page():
    sys.path.insert(0, str(SITE))
    try:
        tree = module("build").tree(Page("docs/index.md").text)
    finally:
        sys.path.remove(str(SITE))
    entries = set(re.findall(r"^([\w/]+)$", tree, re.MULTILINE))
    wanted = {page.place.removesuffix(".md") for page in all_pages()} - {"README"}
    assert wanted <= entries <= wanted | {"gallery/index", "reference/index"}


@pytest.mark.soak
def test_it_is_built_without_a_warning(tmp_path):
    """With every page, every example, and links that lead somewhere."""
    begin = time.monotonic()
    command = [sys.executable, str(SITE / "build.py"), "--output", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=550)
    assert done.returncode == 0, f"{done.stderr[-3000:]} after {time.monotonic() - begin:.0f} s"
    html = tmp_path / "html"
    for page in all_pages():
        place = "index" if page.place == "README.md" else page.place.removesuffix(".md")
        assert (html / f"{place}.html").is_file(), page
    scripts = [path for path in (ROOT / "training_examples").glob("*.py") if "__main__" in path.read_text("utf-8")]
    assert len(scripts) > 15
    for script in scripts:
        assert (html / "gallery" / f"{script.stem}.html").is_file(), script
    assert "poisson_nll" in (html / "reference" / "losses.html").read_text(encoding="utf-8")
    sections = (html / "reference" / "torchtransient.html").read_text(encoding="utf-8")
    assert all(title in sections for title in ("Parameters", "Returns", "Raises"))
