"""Mutation runs: draws repeat, and the rooms are files that exist."""

from __future__ import annotations

import ast

from tools.mutants import changes, rooms
from torchtransient import units


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
