"""What a checkpoint keeps of a state: numbers, texts, tensors without their graph, and what holds them."""

from __future__ import annotations

from collections import OrderedDict

import numpy as np
import pytest
import torch
from torch import nn

from support.sweeps import together
from torchtransient.errors import StorageError
from torchtransient.training.plain_state import plain


def test_tensors_are_kept_without_their_graph():
    leaf = torch.arange(3.0, requires_grad=True)
    for given in (leaf, leaf * 2, nn.Parameter(torch.ones(2))):
        found = plain(given, "state")
        assert torch.equal(found, given) and not found.requires_grad and type(found) is torch.Tensor
    nested = plain({"a": [leaf * 2, (leaf,)]}, "state")
    assert not nested["a"][0].requires_grad and not nested["a"][1][0].requires_grad
    with pytest.raises(StorageError, match=r"state has no shape yet: run the lazy module once before"):
        plain(nn.LazyLinear(3).weight, "state")


@together("order", ["<", ">"])
@together("kind", ["i2", "i4", "i8", "u2", "u4", "u8", "f2", "f4", "f8", "c8", "c16", "?", "i1", "u1"])
def test_arrays_are_tensors_of_their_own(order, kind):
    given = np.array([0, 1, 3], np.dtype(order + kind) if len(kind) > 1 and kind[1] != "1" else kind)
    found = plain(given, "state")
    expected = given.astype(given.dtype.newbyteorder("="))
    assert isinstance(found, torch.Tensor) and np.array_equal(found.numpy(), expected)
    given[:] = 0
    assert np.array_equal(found.numpy(), expected)
    assert plain(expected[1], "state") == 1 and not isinstance(plain(expected[1], "state"), np.generic)


def test_what_is_no_data():
    kept = plain(OrderedDict([("b", 1), ("a", (2, [None, "c"]))]), "state")
    assert isinstance(kept, OrderedDict) and list(kept.items()) == [("b", 1), ("a", (2, [None, "c"]))]
    for wrong in (object(), np.array(["a"]), np.array([object()]), lambda: 1):
        with pytest.raises(StorageError, match=r"save_checkpoint: .*state\['a'\]"):
            plain({"a": wrong}, "state")
