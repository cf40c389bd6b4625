"""The entries of every sensing module: those of the ``entries_*`` modules beside this one."""

import importlib
from pathlib import Path

from support.sweeps import together

_MODULES = sorted(path.stem for path in Path(__file__).parent.glob("entries_*.py"))
ENTRIES = [entry for name in _MODULES for entry in importlib.import_module(f"support.sensing.{name}").ENTRIES]
each = together("entry", ENTRIES, lambda entry: entry.name)
