"""The entries of every sensing module: those of the ``entries_*`` modules beside this one."""

import importlib
from pathlib import Path

import pytest

_MODULES = sorted(path.stem for path in Path(__file__).parent.glob("entries_*.py"))
ENTRIES = [entry for name in _MODULES for entry in importlib.import_module(f"support.sensing.{name}").ENTRIES]
each = pytest.mark.parametrize("entry", ENTRIES, ids=lambda e: e.name)
