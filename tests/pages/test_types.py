"""The blocks of Python on the pages pass a type checker, as a script of a user's would."""

from __future__ import annotations

import re
import subprocess
import sys

import pytest

from support.pages import ROOT, Page, all_pages

# What blocks of a page, one behind the other in one file, say twice and leave without types; packages without types;
# stubs of Mitsuba, in which seeds are arrays and `mi.ad` is bare; films measure one thing, so that what they do not
# measure is None (`docs/torch_layer.md`); a `sum` of tensors might be the 0 that it begins with.
ACCEPTED = re.compile(
    r"\[(assignment|var-annotated|import-untyped|import-not-found|no-redef|no-untyped-(def|call)|no-any-return|type-arg|"
    r"misc|untyped-decorator)\]|UInt32|\"Adam\"|\bNone\b| note:|\"float\" has no attribute \"backward\""
)
# Pieces of patterns, not programs.
PIECES = {"contributing"}


@pytest.fixture(scope="module")
def said(tmp_path_factory):
    """What `mypy --strict` says of a file for every page, and of two scripts: lines by file."""
    folder = tmp_path_factory.mktemp("types")
    pages = [page for page in all_pages() if page.blocks("python") and page.path.stem not in PIECES]
    sources = {re.sub(r"\W", "_", page.place) + ".py": "\n".join(page.blocks("python")) for page in pages}
    first, *_, last = Page("docs/torch_layer.md").blocks("python")
    assert "layer.values[" in last
    script = "".join(line for line in first.splitlines(True) if re.match("import|scene = ", line)) + last
    sources |= {"script.py": script, "wrong.py": f"{script}layer.values = 3\nlayer.vales\n"}
    for name, code in sources.items():
        (folder / name).write_text(code)
    options = ["--strict", "--follow-imports=silent", "--cache-dir", str(folder / "cache"), "--config-file", ""]
    done = subprocess.run(
        [sys.executable, "-m", "mypy", *options, *sources],
        cwd=folder, env={"MYPYPATH": str(ROOT), "PATH": ""}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert f"checked {len(sources)} source files" in done.stdout, done.stdout + done.stderr
    return {name: [x for x in done.stdout.splitlines() if x.startswith(f"{name}:")] for name in sources}


@pytest.mark.soak
def test_blocks_of_pages(said):
    """No argument of the library is refused that it takes when it runs."""
    pages = {name: lines for name, lines in said.items() if name not in ("script.py", "wrong.py")}
    assert len(pages) > 20
    assert [line for lines in pages.values() for line in lines if not ACCEPTED.search(line)] == []


@pytest.mark.slow
def test_the_section_on_types_is_strict(said):
    assert said["script.py"] == []
    assert len(said["wrong.py"]) == 2
