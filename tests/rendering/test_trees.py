"""Structures that are taken apart and put together again, what cannot be, and results of several runs."""

from __future__ import annotations

import dataclasses
from collections import OrderedDict, namedtuple
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest
import torch

from torchtransient.errors import ShapeError
from torchtransient.rendering.replay import Call, Returned, TensorLeaf, _equal
from torchtransient.rendering.surroundings import entries_of
from torchtransient.rendering.trees import LEAF, Tree, taken_apart

Pair = namedtuple("Pair", ["first", "second"])


class Own(list):
    """A list with an attribute."""


class Sorted(dict):
    """A dictionary with an attribute."""


@dataclasses.dataclass(frozen=True)
class Frozen:
    a: object
    b: object


class Struct:
    DRJIT_STRUCT: ClassVar = {"x": float, "y": float}

    def __init__(self):
        self.x, self.y, self.note = 1, 2, "kept"


def with_note(given):
    given.note = "kept"
    return given


@pytest.mark.parametrize(
    ("given", "leaves"),
    [
        ([1, (2, 3)], [1, 2, 3]), ((), []), ({"b": 1, "a": [2]}, [1, 2]), (Pair(1, [2, 3]), [1, 2, 3]),
        (with_note(Own([1, 2])), [1, 2]), (with_note(Sorted(b=1, a=2)), [1, 2]), (Frozen(1, {"c": 2}), [1, 2]),
        (Struct(), [1, 2]), (OrderedDict(b=1, a=2), [1, 2]), (torch.return_types.max((1, 2)), [1, 2]), (7, [7]),
        (Frozen, [Frozen]), (None, [None]),
    ],
)  # fmt: skip
def test_structures_of_every_kind(given, leaves):
    """Of the same class, with the same names in the same order, and with what else they hold."""
    tree, found = taken_apart(given)
    assert found == leaves and all(type(a) is type(b) for a, b in zip(found, leaves, strict=True))
    assert tree == taken_apart(given)[0]
    again = tree.put_together(iter([leaf if isinstance(leaf, type) or leaf is None else 10 * leaf for leaf in leaves]))
    assert type(again) is type(given)
    assert taken_apart(again)[0] == tree
    assert taken_apart(again)[1] == [leaf if isinstance(leaf, type) or leaf is None else 10 * leaf for leaf in leaves]
    assert getattr(again, "note", None) == getattr(given, "note", None)
    assert taken_apart(given)[1] == leaves, "what was taken apart has changed"


def test_structures_are_told_apart():
    given = [1, 2], (1, 2), {"a": 1, "b": 2}, {"b": 1, "a": 2}, [1, [2]], Pair(1, 2), 1
    trees = [taken_apart(one)[0] for one in given]
    assert all((a == b) == (i == j) for i, a in enumerate(trees) for j, b in enumerate(trees))
    tree, found = taken_apart([1, (2, 3)], is_leaf=lambda part: isinstance(part, tuple))
    assert found == [1, (2, 3)] and tree == Tree(list, (), (LEAF, LEAF))


def test_structures_that_cannot_be_made_again():
    class Single(dict):
        def __copy__(self):
            raise TypeError("there is one")

    with pytest.raises(ShapeError, match=r"a Single cannot be made again with other fields: there is one\. Expected"):
        taken_apart(Single(a=1))

    class Closed:
        DRJIT_STRUCT: ClassVar = {"x": float}
        __slots__ = ()
        x = 1

    tree, leaves = taken_apart(Closed())
    with pytest.raises(ShapeError, match=r"a Closed cannot hold a float as its field 'x': .*Expected lists"):
        tree.put_together(iter([2.5]))
    assert leaves == [1]


def test_entries_of_containers():
    one = SimpleNamespace(a=1, b=2)
    assert entries_of([1, 2]) == entries_of((1, 2)) == entries_of({"a": 1, "b": 2}) == entries_of(one) == (1, 2)
    assert entries_of("ab") == entries_of(3) == entries_of(np.ones(2)) == ()
    weights = [torch.nn.Parameter(torch.ones(n)) for n in (1, 2)]
    held = entries_of(torch.nn.ParameterList(weights))
    assert all(a is b for a, b in zip(held, weights, strict=True))
    assert entries_of(torch.nn.ParameterDict({"a": weights[1]}))[0] is weights[1]


# ---------------------------------------------------------------------------------------------- results of several runs


def result_of(*runs, tensors=("t0", "t1")):
    returned = []
    for one in runs:
        tree, leaves = taken_apart(one, lambda part: isinstance(part, TensorLeaf))
        returned.append(Returned(tree, tuple(leaves)))
    return Call.result(SimpleNamespace(returned=returned, name="f"), tensors)


def test_entries_of_a_vmap_return_the_same():
    """The same structure, and what is no array is equal."""
    first, second = TensorLeaf(0), TensorLeaf(1)
    assert result_of({"x": second, "n": 3, "y": [first]}) == {"x": "t1", "n": 3, "y": ["t0"]}
    assert result_of((first, "a"), (first, "a"), (first, "a")) == ("t0", "a")
    for runs in (((first, 3), (first, 4)), ((first, 3), (first, 3), (first, 4)), ((first, 3), [first, 3]),
                 ((first, 3), (first, first)), ((first,), (first, first))):  # fmt: skip
        with pytest.raises(ShapeError, match=r"f: under torch\.func\.vmap every entry must return the same"):
            result_of(*runs)


def test_what_is_equal():
    class Odd:
        def __eq__(self, other):
            raise ValueError("no truth")

        __hash__ = None

    odd, several = Odd(), np.array([1, 2])
    assert _equal(3, 3.0) and _equal(odd, odd) and _equal(several, several) and _equal(None, None)
    assert not _equal(3, 4) and not _equal(odd, Odd()) and not _equal(several, several.copy()) and not _equal(None, 3)


# --------------------------------------------------------------------------------------------------- what was read back


