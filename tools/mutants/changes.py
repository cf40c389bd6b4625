"""Single changes of a source text by fixed operators: a sign, a factor, a term, a bound, a check, an axis.

Every change replaces one stretch of the text, so that what is left of a file stays as it was written. Left alone are
annotations, docstrings, the words of messages and what only shows an object.
"""

from __future__ import annotations

import ast
import random
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

SIGNS = {ast.Add: "-", ast.Sub: "+"}
FACTORS = {ast.Mult: "/", ast.Div: "*"}
TERMS = (ast.Add, ast.Sub, ast.BitAnd, ast.BitOr)
TURNED = {ast.Lt: ">=", ast.LtE: ">", ast.Gt: "<=", ast.GtE: "<", ast.Eq: "!=", ast.NotEq: "==", ast.Is: "is not",
          ast.IsNot: "is", ast.In: "not in", ast.NotIn: "in"}  # fmt: skip
BOUNDS = {ast.Lt: "<=", ast.LtE: "<", ast.Gt: ">=", ast.GtE: ">"}
EXTREMES = {"minimum": "maximum", "maximum": "minimum", "min": "max", "max": "min", "amin": "amax", "amax": "amin"}
LIMITED = {"clip", "clamp", "clamp_min", "clamp_max"}
AXES = {"axis", "dim", "dims", "axes"}
CONVERSIONS = {"seconds_to_opl", "opl_to_seconds", "near_seconds", "deg2rad", "rad2deg", "radians", "degrees",
               "deg_to_rad", "rad_to_deg"}  # fmt: skip
CONSTANTS = {"pi", "SPEED_OF_LIGHT", "C", "FWHM_PER_STDDEV"}
NOT_LOOKED_AT = {"__repr__", "__str__", "to_string", "extra_repr"}
WORDS = {"warn", "warning", "print", "echo"}


@dataclass(frozen=True)
class Change:
    """``text`` in place of the bytes ``start`` to ``end`` of a file."""

    operator: str
    path: str
    line: int
    start: int
    end: int
    text: str

    def apply(self, source: bytes) -> bytes:
        """The source with the change."""
        return source[: self.start] + self.text.encode() + source[self.end :]


class _Finder:
    def __init__(self, path: str, source: bytes) -> None:
        self.path, self.source, self.found = path, source, []
        self._starts = [0]
        for line in source.splitlines(keepends=True):
            self._starts.append(self._starts[-1] + len(line))

    def span(self, node: ast.AST) -> tuple[int, int]:
        return (
            self._starts[node.lineno - 1] + node.col_offset,
            self._starts[node.end_lineno - 1] + node.end_col_offset,
        )

    def text(self, node: ast.AST) -> str:
        start, end = self.span(node)
        return self.source[start:end].decode()

    def add(self, operator: str, node: ast.AST, text: str) -> None:
        start, end = self.span(node)
        self.found.append(Change(operator, self.path, node.lineno, start, end, text))

    # -------------------------------------------------------------------------------------------------- the walk

    def visit(self, node: ast.AST) -> None:
        if isinstance(node, ast.FunctionDef) and node.name in NOT_LOOKED_AT:
            return
        if isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING"):
            return
        if isinstance(node, ast.Raise):
            self.add("check skipped", node, "pass")
            return
        if isinstance(node, ast.JoinedStr | ast.Assert):
            return
        if isinstance(node, ast.Call) and _name(node.func) in WORDS:
            return
        self.changes_of(node)
        for name, child in ast.iter_fields(node):
            if name in {"annotation", "returns", "decorator_list", "type_params"}:
                continue
            for one in child if isinstance(child, list) else [child]:
                if isinstance(one, ast.AST):
                    self.visit(one)

    def changes_of(self, node: ast.AST) -> None:
        if isinstance(node, ast.BinOp):
            self._of_binary(node)
        elif isinstance(node, ast.UnaryOp):
            self._of_unary(node)
        elif isinstance(node, ast.BoolOp):
            self._of_boolean(node)
        elif isinstance(node, ast.Compare) and len(node.ops) == 1:
            self._of_comparison(node)
        elif isinstance(node, ast.AugAssign):
            self.add("term dropped", node, "pass")
        elif isinstance(node, ast.Call):
            self._of_call(node)
        elif isinstance(node, ast.Slice | ast.Subscript):
            self._of_slice(node)
        elif isinstance(node, ast.If | ast.While | ast.IfExp):
            self.add("comparison", node.test, f"(not ({self.text(node.test)}))")

    def _of_binary(self, node: ast.BinOp) -> None:
        a, b, kind = self.text(node.left), self.text(node.right), type(node.op)
        if any(isinstance(side, ast.Constant) and isinstance(side.value, str) for side in (node.left, node.right)):
            return
        if any(isinstance(side, ast.List | ast.Tuple | ast.Dict | ast.JoinedStr) for side in (node.left, node.right)):
            return
        if kind in SIGNS:
            self.add("sign", node, f"({a} {SIGNS[kind]} {b})")
        if kind in FACTORS:
            self.add("factor", node, f"({a} {FACTORS[kind]} {b})")
            self.add("factor", node, f"(1.25 * ({self.text(node)}))")
            self.add("term dropped", node, f"({a})")
            if kind is ast.Mult:
                self.add("term dropped", node, f"({b})")
        if kind in TERMS:
            self.add("term dropped", node, f"({a})")
            if kind is not ast.Sub:
                self.add("term dropped", node, f"({b})")
        if kind is ast.Pow and isinstance(node.right, ast.Constant):
            self.add("factor", node, f"({a})")

        if kind in FACTORS:
            for side in (node.left, node.right):
                if isinstance(side, ast.Constant) and type(side.value) in (int, float):
                    self.add("unit factor", side, repr(side.value * 2 if side.value else 1))
                elif isinstance(side, ast.Attribute | ast.Name) and _name(side) in CONSTANTS:
                    self.add("unit factor", side, f"(2 * {self.text(side)})")

    def _of_unary(self, node: ast.UnaryOp) -> None:
        inner = self.text(node.operand)
        if isinstance(node.op, ast.USub) and not isinstance(node.operand, ast.Constant):
            self.add("sign", node, f"({inner})")
        elif isinstance(node.op, ast.Not | ast.Invert):
            self.add("comparison", node, f"({inner})")

    def _of_boolean(self, node: ast.BoolOp) -> None:
        word = " and " if isinstance(node.op, ast.And) else " or "
        for k in range(len(node.values)):
            kept = node.values[:k] + node.values[k + 1 :]
            self.add("term dropped", node, f"({word.join(map(self.text, kept))})")

    def _of_comparison(self, node: ast.Compare) -> None:
        kind = type(node.ops[0])
        a, b = self.text(node.left), self.text(node.comparators[0])
        if kind in BOUNDS:
            self.add("bound", node, f"({a} {BOUNDS[kind]} {b})")
        if kind in TURNED:
            self.add("comparison", node, f"({a} {TURNED[kind]} {b})")

    def _of_call(self, node: ast.Call) -> None:
        name = _name(node.func)
        arguments = [self.text(argument) for argument in node.args]
        owner = node.func.value if isinstance(node.func, ast.Attribute) else None
        if name == "detach":
            self.add("detach dropped", node, f"({arguments[0] if arguments else self.text(owner)})")
        if name in EXTREMES:
            self.add("bound", node.func, self.text(node.func)[: -len(name)] + EXTREMES[name])
        if name in LIMITED:
            module = isinstance(owner, ast.Name) and owner.id in {"np", "torch", "dr"}
            self.add("bound", node, f"({arguments[0] if module else self.text(owner)})")
        if name in {"select", "where"} and len(arguments) == 3:
            self.add("comparison", node, f"{self.text(node.func)}({arguments[0]}, {arguments[2]}, {arguments[1]})")
            self.add("check skipped", node, f"({arguments[1]})")
        if name in CONVERSIONS and arguments:
            self.add("unit factor", node, f"({arguments[0]})")
        if name == "range" and len(node.args) == 1:
            self.add("bound", node, f"range({arguments[0]} - 1)")
        if name in {"abs", "exp", "log", "sqrt", "square", "cos", "sin"} and len(arguments) == 1:
            self.add("factor", node, f"({arguments[0]})")
        for keyword in node.keywords:
            if keyword.arg in AXES:
                self._axis(keyword.value)
        if name in {"sum", "mean", "cumsum", "flip", "argmax", "softmax"} and owner is not None and node.args:
            self._axis(node.args[-1])

    def _axis(self, node: ast.AST) -> None:
        try:
            value = ast.literal_eval(node)
        except ValueError:
            return
        if type(value) is int:
            self.add("axis", node, f"{value - 1 if value else 1}")
        elif isinstance(value, tuple) and value and all(type(one) is int for one in value):
            self.add("axis", node, f"{value[:-1]}")

    def _of_slice(self, node: ast.Slice | ast.Subscript) -> None:
        for part in (node.lower, node.upper) if isinstance(node, ast.Slice) else (node.slice,):
            try:
                value = ast.literal_eval(part) if part is not None else None
            except ValueError:
                continue
            if type(value) is int:
                self.add("bound", part, f"{value + 1}")


def _name(function: ast.AST) -> str:
    return function.attr if isinstance(function, ast.Attribute) else getattr(function, "id", "")


def in_file(path: str, source: bytes) -> list[Change]:
    """Every change of one file, in the order of the text."""
    finder = _Finder(path, source)
    tree = ast.parse(source)
    for node in tree.body:
        finder.visit(node)
    return sorted(set(finder.found), key=lambda change: (change.start, change.end, change.text))


def drawn(root: Path, files: list[Path], seed: int) -> Iterator[Change]:
    """Changes in random order, without repetition: an operator out of those that are left, then one of its changes."""
    generator = random.Random(seed)
    kinds: dict[str, list[Change]] = {}
    for path in files:
        for change in in_file(path.relative_to(root).as_posix(), path.read_bytes()):
            kinds.setdefault(change.operator, []).append(change)
    while kinds:
        operator = generator.choice(sorted(kinds))
        changes = kinds[operator]
        change = changes.pop(generator.randrange(len(changes)))
        if not changes:
            del kinds[operator]
        if _can_be_read(change.apply((root / change.path).read_bytes())):
            yield change


def _can_be_read(source: bytes) -> bool:
    try:
        ast.parse(source)
    except SyntaxError:
        return False
    return True
