"""Syntax trees of the package's files, which several test files read."""

from __future__ import annotations

import ast
import functools
from collections.abc import Iterator
from pathlib import Path


@functools.cache
def syntax_of(path: Path) -> ast.Module:
    """The syntax tree of a file, which nothing changes meanwhile."""
    return ast.parse(path.read_text(encoding="utf-8"))


def statements(tree: ast.AST) -> Iterator[ast.AST]:
    """Nodes of a syntax tree without its expressions, which are nine nodes of ten and hold no statements."""
    for node in ast.iter_child_nodes(tree):
        if not isinstance(node, ast.expr | ast.arguments):
            yield node
            yield from statements(node)
