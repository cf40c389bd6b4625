"""docs/gradients.md has the table that the renderer asks, docs/gradients_table.md every case that is measured."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

from support.gradient_cases.all_cases import ALL_CASES

DOCS = Path(__file__).parent.parent / "docs"


def test_table_is_up_to_date():
    run = subprocess.run(
        [sys.executable, str(DOCS / "make_gradients_page.py"), "--check"],
        capture_output=True,
        text=True,
        timeout=300,
        env={**os.environ, "PYTHONPATH": str(DOCS.parent)},
    )
    assert run.returncode == 0, run.stderr


def test_every_case_is_in_the_table_of_measured_gradients():
    """In the row of its parameter, with the state that the case has; the numbers are those of the script's last run."""
    table = (DOCS / "gradients_table.md").read_text(encoding="utf-8")
    rows = dict(re.findall(r"^\| ([^|]+) \| [^|]+ \| ([^|]*:[^|]*) \|", table, re.MULTILINE))
    states = dict(re.findall(r"^\| ([^|]+) \| ([^|]+) \| [^|]*:[^|]* \|", table, re.MULTILINE))
    there = {row: re.findall(r"(?:^|<br>)(\w+):", cell) for row, cell in rows.items()}
    wanted: dict[str, list[str]] = {}
    for case in ALL_CASES:
        wanted.setdefault(case.row, []).append(case.name)
        assert case.support in states[case.row], case.name
    del there["parameter"]  # the head
    assert there == wanted
