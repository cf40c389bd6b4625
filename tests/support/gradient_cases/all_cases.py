"""Every gradient case of the matrix: those of the ``cases_*`` modules beside this one."""

import importlib
from pathlib import Path

_MODULES = sorted(path.stem for path in Path(__file__).parent.glob("cases_*.py"))
ALL_CASES = [case for name in _MODULES for case in importlib.import_module(f"support.gradient_cases.{name}").CASES]
