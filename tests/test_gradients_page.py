"""The table of parameters in docs/gradients.md is the one that the renderer asks."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

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
