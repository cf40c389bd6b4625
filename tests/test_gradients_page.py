"""docs/gradients.md has the table that the renderer asks, docs/gradients_table.md every case that is measured."""

from __future__ import annotations

import re
import runpy
import sys
from pathlib import Path

import mitsuba as mi
import pytest

from support.gradient_cases.all_cases import ALL_CASES

VARIANT = "llvm_ad_rgb"
DOCS = Path(__file__).parent.parent / "docs"


@pytest.mark.slow
def test_table_is_up_to_date(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["make_gradients_page.py", "--check"])
    level = mi.log_level()
    try:
        assert runpy.run_path(str(DOCS / "make_gradients_page.py"))["main"]() == 0, capsys.readouterr().err
    finally:
        mi.set_log_level(level)


def test_every_case_is_in_the_table_of_measured_gradients():
    """In the row of its parameter; the numbers are those of the script's last run."""
    table = (DOCS / "gradients_table.md").read_text(encoding="utf-8")
    rows = dict(re.findall(r"^\| ([^|]+) \| [^|]+ \| ([^|]*:[^|]*) \|", table, re.MULTILINE))
    there = {row: re.findall(r"(?:^|<br>)(\w+):", cell) for row, cell in rows.items()}
    wanted: dict[str, list[str]] = {}
    for case in ALL_CASES:
        wanted.setdefault(case.row, []).append(case.name)
    del there["parameter"]  # the head
    assert there == wanted
