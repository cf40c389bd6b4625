"""The operators of a mutation run: what each of them makes of a line, what is left alone, and that draws repeat."""

from __future__ import annotations

import ast

import pytest

from tools.mutants import changes, rooms
from torchtransient import units


@pytest.mark.parametrize(
    ("line", "operator", "expected"),
    [
        ("a + b", "sign", {"(a - b)"}),
        ("-a", "sign", {"(a)"}),
        ("a * b", "factor", {"(a / b)", "(1.25 * (a * b))"}),
        ("a ** 2", "factor", {"(a)"}),
        ("2 * a", "unit factor", {"4 * a"}),
        ("seconds_to_opl(t)", "unit factor", {"(t)"}),
        ("a + b", "term dropped", {"(a)", "(b)"}),
        ("a and b and c", "term dropped", {"(b and c)", "(a and c)", "(a and b)"}),
        ("a < b", "bound", {"(a <= b)"}),
        ("a < b", "comparison", {"(a >= b)"}),
        ("x.clamp(0, 1)", "bound", {"(x)"}),
        ("torch.minimum(a, b)", "bound", {"torch.maximum(a, b)"}),
        ("not a", "comparison", {"(a)"}),
        ("dr.select(m, a, b)", "comparison", {"dr.select(m, b, a)"}),
        ("dr.select(m, a, b)", "check skipped", {"(a)"}),
        ("dr.detach(a)", "detach dropped", {"(a)"}),
        ("a.detach()", "detach dropped", {"(a)"}),
        ("x.sum(dim=-3)", "axis", {"x.sum(dim=-4)"}),
        ("if a:\n    raise ValueError(a + b)", "check skipped", {"if a:\n    pass"}),
        ("a += b", "term dropped", {"pass"}),
    ],
)
def test_operators(line, operator, expected):
    source = line.encode()
    found = [change for change in changes.in_file("x.py", source) if change.operator == operator]
    assert {change.apply(source).decode() for change in found} == expected


@pytest.mark.parametrize(
    "line",
    ['def f():\n    """a + b"""', "x: a | b = 1", "raise ValueError(a + b)", "warnings.warn(a + b)", 'f"{a + b}"',
     "def __repr__(self):\n    return a + b", '"a" + b', "if TYPE_CHECKING:\n    a = b + c"],
)  # fmt: skip
def test_what_is_left_alone(line):
    found = {change.operator for change in changes.in_file("x.py", line.encode())}
    assert found <= {"check skipped"}


def test_draws_repeat_and_every_change_can_be_read():
    path = rooms.Path(units.__file__)
    draws = [[*changes.drawn(path.parent, [path], seed)] for seed in (1, 1, 2)]
    assert draws[0] == draws[1] != draws[2] and len(draws[0]) == len(set(draws[0])) > 10
    source = path.read_bytes()
    for change in draws[0]:
        assert ast.dump(ast.parse(change.apply(source))) != ast.dump(ast.parse(source)), change


def test_rooms_are_files_that_exist():
    root = rooms.Path(__file__).parents[2]
    for name, room in rooms.ROOMS.items():
        assert room.files(root) and room.test_files(root), name
