"""docs/contributing.md: its recipes take as many files as they say, and the files and tests that they name are there.

Its examples pass those tests in a copy of the repository; with one place left out its tests fail.
"""

from __future__ import annotations

import ast
import os
import re
import shutil
import subprocess
import sys

import pytest

from support.pages import ROOT, Page
from support.recipes import recipes, with_entry

PAGE = Page("docs/contributing.md")
RECIPES = recipes(PAGE)
each = pytest.mark.parametrize("recipe", RECIPES, ids=str)
WHOLE = [recipe for recipe in RECIPES if recipe.steps]
# Of a recipe whose first file is that of another one.
LATER = {step.file for recipe in WHOLE for step in recipe.steps}


def names_in(file):
    return {node.name for node in ast.parse((ROOT / file).read_text(encoding="utf-8")).body if hasattr(node, "name")}


def test_every_recipe_is_there():
    assert [str(recipe) for recipe in RECIPES] == [
        "A loss", "A sensor effect", "A law of delays", "A reconstruction operator", "A layout of capture files",
        "A BSDF", "A parameter with a gradient", "A connection strategy",
    ]  # fmt: skip
    assert len(re.findall(r"^## .*files?$", PAGE.text, re.MULTILINE)) == len(RECIPES)


@each
def test_it_takes_as_many_files_as_it_says(recipe):
    """A row for each; where the example is on the page, a block for each row, which stands in that file."""
    assert len(recipe.rows) == recipe.count
    if not recipe.steps:
        return
    written = [step.file for step in recipe.steps]
    own = [row.places[0] for row in recipe.rows if row.places[0] in written]
    others = [row.places[0] for row in recipe.rows if row.places[0] not in written]
    assert own == written and all(place in LATER for place in others)
    assert [step.new for step in recipe.steps] == [row.new for row in recipe.rows if row.places[0] in written]


@each
def test_places_are_there(recipe):
    made = {step.file for other in RECIPES for step in other.steps if step.new}
    for row in recipe.rows:
        assert row.places
        for place in row.places:
            assert (ROOT / place).exists() != (place in made), place
            assert (ROOT / place).parent.is_dir(), place


def test_everything_else_that_is_named_is_there():
    made = {step.file for recipe in RECIPES for step in recipe.steps}
    folders = "tests|tools|torchtransient|docs|benchmarks"
    for place in set(re.findall(rf"`((?:{folders})/[\w/.*]+)(?:::\w+)?`", PAGE.text)) - made:
        assert any(True for _ in ROOT.glob(place)), place
    for file, name in re.findall(r"(tests/[\w/.]+\.py)::(\w+)", PAGE.text):
        assert name in names_in(file), f"{file}::{name}"
    make = (ROOT / "Makefile").read_text(encoding="utf-8")
    for goal in re.findall(r"`make (?!_)([a-z-]+)", PAGE.text):
        assert re.search(rf"^{goal}:", make, re.MULTILINE), goal


@pytest.mark.slow
@pytest.mark.parametrize("recipe", WHOLE, ids=str)
def test_examples_are_python(recipe):
    """Blocks as they stand, and files with their entries, which come once."""
    for step in recipe.steps:
        if step.file.endswith(".py") and step.new:
            ast.parse(step.text)
        elif step.name and step.file.endswith(".py"):
            source = (ROOT / step.file).read_text(encoding="utf-8")
            changed = with_entry(source, step.name, step.text)
            ast.parse(changed)
            assert step.text not in source
            added = "".join(step.text.splitlines())
            assert len(bare(changed)) == len(bare(source)) + len(bare(added))


def bare(source):
    """Without what an entry may change beside itself."""
    return re.sub(r"[\s,]", "", source)


# ------------------------------------------------------------------------------------------------------ carried out


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """What is copied: package, tests and pages."""
    folder = tmp_path_factory.mktemp("plain")
    left_out = shutil.ignore_patterns("__pycache__", "images", "measured", "site")
    for name in ("torchtransient", "tests", "tools", "docs"):
        shutil.copytree(ROOT / name, folder / name, ignore=left_out)
    for name in ("pyproject.toml", "README.md", "CHANGELOG.md"):
        shutil.copy(ROOT / name, folder / name)
    return folder


def outcomes(root, tests):
    """(verdicts of tests as `file::name` without parameters, and of files that cannot be read; the output)."""
    environment = {**os.environ, "PYTHONPATH": str(root), "OMP_NUM_THREADS": "1"}
    options = ["-q", "-rA", "-p", "no:cacheprovider", "--continue-on-collection-errors", "--tb=short", "-W", "ignore"]
    # Files, and words: pytest runs nothing at all where one of the tests that it is asked for is not there.
    files = sorted({test.split("::")[0] for test in tests})
    words = sorted({test.split("::")[1] for test in tests if "::" in test})
    run = subprocess.run(
        [sys.executable, "-m", "pytest", *options, *files, "-k", " or ".join(words) or "none_at_all"], cwd=root,
        env=environment, capture_output=True, text=True, timeout=500,
    )  # fmt: skip
    verdicts: dict[str, set[str]] = {}
    for verdict, name in re.findall(r"^(PASSED|FAILED|ERROR) (tests/[\w/.]+(?:::\w+)?)", run.stdout, re.MULTILINE):
        verdicts.setdefault(name, set()).add(verdict)
    return verdicts, run.stdout + run.stderr


def failed(test, verdicts):
    """Whether it has run and failed, or its file cannot be read."""
    return "ERROR" in verdicts.get(test.split("::")[0], ()) or "FAILED" in verdicts.get(test, ())


def copy_without(plain, folder, left_out):
    """A copy with the steps of all recipes but those left out."""
    shutil.copytree(plain, folder)
    for recipe in WHOLE:
        for step in recipe.steps:
            if step not in left_out:
                step.carry_out(folder)
    return folder


NAMED = sorted({test for recipe in WHOLE for row in recipe.rows for test in row.tests})
# With them the example alone, of what runs over lists.
ALSO = {
    "tests/losses/test_every_loss.py": "log and cosh or every_loss",
    "tests/reconstruction/test_operator_contract.py": "nearest or left_out",
    "tests/sensing/test_contract.py": "LensShading or even or every_effect",
    "tests/sensing/test_afterpulse_laws.py": "even or every_law",
    "tests/files/captures/test_layouts.py": "another or every_layout",
    "tests/integrators/test_gradients.py": "dust or second_sample",
}


@pytest.mark.slow
def test_with_every_place_the_examples_pass(plain, tmp_path):
    root = copy_without(plain, tmp_path / "whole", ())
    tests = [test for test in NAMED if "::" in test]
    verdicts, said = outcomes(root, tests)
    assert all(verdicts.get(test) == {"PASSED"} for test in tests), said[-6000:]
    for file, words in ALSO.items():
        _, said = outcomes(root, [f"{file}::{words}"])
        assert re.search(r"^\d+ passed", said, re.MULTILINE) and " failed" not in said, said[-6000:]


ROUNDS = max(len(recipe.steps) for recipe in WHOLE) - 1


@pytest.mark.slow
@pytest.mark.parametrize("turn", range(1, ROUNDS + 1))
def test_with_a_place_left_out_its_tests_fail(plain, tmp_path, turn):
    """One of every recipe at a time: their tests are others."""
    left_out = {recipe.steps[turn]: recipe for recipe in WHOLE if turn < len(recipe.steps)}
    verdicts, said = outcomes(copy_without(plain, tmp_path / "part", left_out), NAMED)
    for step, recipe in left_out.items():
        (row,) = (row for row in recipe.rows if row.places[0] == step.file)
        assert row.tests, f"{recipe}: say which test fails without {step.file}"
        assert all(failed(test, verdicts) for test in row.tests), f"{step.file}: {said[-6000:]}"
    # Of recipes that are whole, all pass.
    others = {test for recipe in WHOLE if turn >= len(recipe.steps) for row in recipe.rows for test in row.tests}
    others -= {test for recipe in left_out.values() for row in recipe.rows for test in row.tests}
    assert all(verdicts.get(test) == {"PASSED"} for test in others if "::" in test), said[-6000:]
