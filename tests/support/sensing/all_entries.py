"""The entries of every sensing module: those of the ``entries_*`` modules beside this one."""

import importlib
from pathlib import Path

from support.sweeps import together

_MODULES = sorted(path.stem for path in Path(__file__).parent.glob("entries_*.py"))
ENTRIES = [entry for name in _MODULES for entry in importlib.import_module(f"support.sensing.{name}").ENTRIES]
each = together("entry", ENTRIES, lambda entry: entry.name)
# Detectors whose mean follows trains of detections, or is put together of other ones': half of what derivatives of all
# entries take. Each has derivatives in a file of its own.
LONG = {
    "Afterpulsing-several", "AfterpulsingSPAD-dead-time", "StreakCamera", "CoincidencePixel-weights", "FreeRunningSPAD",
    "PixelGroups", "CoincidencePixel", "ImpulseResponse-composed",
}  # fmt: skip
each_quick = together("entry", [e for e in ENTRIES if e.name not in LONG], lambda entry: entry.name)
each_long = together("entry", [e for e in ENTRIES if e.name in LONG], lambda entry: entry.name)
