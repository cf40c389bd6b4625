"""docs/stability.md has every file of tests/stability, and names no other."""

from __future__ import annotations

import re

from support.pages import ROOT, Page


def test_every_hard_case_is_on_the_page():
    named = re.findall(r"`(test_\w+\.py)`", Page("docs/stability.md").text)
    assert set(named) == {path.name for path in (ROOT / "tests" / "stability").glob("test_*.py")}
