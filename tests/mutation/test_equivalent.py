"""Changes that are called equivalent are changes of lines that are there."""

from __future__ import annotations

from pathlib import Path

import torchtransient
from mutation import equivalent


def test_every_entry_is_of_lines_of_its_file():
    root = Path(torchtransient.__file__).parents[1]
    known = equivalent.proofs()
    assert known
    gone = []
    for path, change in known:
        lines = (root / path).read_text(encoding="utf-8").splitlines()
        removed = [line[1:] for line in change.splitlines() if line.startswith("-")]
        if not removed or not any(lines[k : k + len(removed)] == removed for k in range(len(lines))):
            gone.append((path, change))
    assert not gone
