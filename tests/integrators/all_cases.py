"""Every gradient case of the matrix: those of ``gradient_cases`` and of the ``cases_*`` modules beside it."""

import importlib
from pathlib import Path

from gradient_cases import CASES

_MODULES = sorted(path.stem for path in Path(__file__).parent.glob("cases_*.py"))
ALL_CASES = [*CASES, *(case for name in _MODULES for case in importlib.import_module(name).CASES)]
