"""docs/recompilation.md: its block does what it says, and its table has the verdicts of a run."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from support.pages import Page

ROOT = Path(__file__).parents[2]
RECOMPILATION = Page("docs/recompilation.md")
PAGE = RECOMPILATION.text
VARIANT = "llvm_ad_mono"


def rows_of_the_page():
    """Verdicts by what changes."""
    lines = PAGE.split("| what changes |")[1].split("\n\n")[0].splitlines()[2:]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    return {name: tuple(verdict) for name, *verdict, _ms in rows}


def cases():
    """Names of the benchmark's cases, without importing it: it is a script of its own process."""
    text = (ROOT / "benchmarks" / "_recompilation_cases.py").read_text(encoding="utf-8")
    body = text.split("CASES: ")[1].split("\n}\n")[0]
    return re.findall(r'^    "(.*?)": ', body, flags=re.MULTILINE)


def test_the_page_has_every_case():
    assert list(rows_of_the_page())[:-2] == cases()
    assert len(cases()) > 20


def test_other_samples_are_traced_once_more():
    names = RECOMPILATION.names()
    kinds = [tuple(how.split(":")[0] for how in both) for both in names["said"]]
    assert kinds == [(how, how) for how in ("traced", "recorded", "launched", "launched", "traced")]


@pytest.mark.soak
def test_the_verdicts_are_those_of_a_run(tmp_path):
    report = tmp_path / "report.json"
    command = [sys.executable, str(ROOT / "benchmarks" / "recompilation.py"), "--smoke", "--json", str(report)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=550)
    assert done.returncode == 0, done.stderr[-3000:]
    found = json.loads(report.read_text(encoding="utf-8"))["cases"]
    page = rows_of_the_page()
    assert list(found) == list(page)
    for name, row in found.items():
        verdict = [row["render"], row["derivative"], str(row["compiled"] or "none"), str(row["steps"])]
        assert tuple(verdict) == page[name], name
