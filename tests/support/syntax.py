"""Syntax trees of the package's files, which several test files read."""

from __future__ import annotations

import ast
import functools
from pathlib import Path


@functools.cache
def syntax_of(path: Path) -> ast.Module:
    """The syntax tree of a file, which nothing changes meanwhile."""
    return ast.parse(path.read_text(encoding="utf-8"))
