"""What is passed to a renderer, at the edges of what is taken. No scene is built."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import nn

import torchtransient as tt
from torchtransient.errors import ArgumentError, DeviceError, ShapeError, UnitError, UnknownKeyError
from torchtransient.rendering.arguments import (
    Values,
    checked_depth,
    checked_filter,
    checked_grad_seed,
    checked_samples,
    checked_values,
    requested_film,
    sensor_list,
    torch_names,
)
from torchtransient.rendering.films import Histogram
from torchtransient.scene.values import as_float, fit_shape

NO_NUMBERS = "expected a torch tensor, an array, a list of numbers or a number, all of them real, got "


def test_numbers_of_samples():
    assert checked_samples("spp", None) is None
    assert [checked_samples("spp", n) for n in (1, np.int64(7), 2**32 - 1)] == [1, 7, 4294967295]
    with pytest.raises(UnitError, match="spp: expected at most 4294967295 samples, got 4294967296"):
        checked_samples("spp", 2**32)
    for wrong in (0, -3, 2.5, "4", True):
        with pytest.raises(UnitError, match="spp: expected a positive integer or None"):
            checked_samples("spp", wrong)


def test_depths():
    assert checked_depth(None) is None
    assert [checked_depth(n) for n in (-1, 0, 5, 2**32 - 2)] == [-1, 0, 5, 4294967294]
    for wrong in (-2, 2**32 - 1, 1.5, "5", False):
        with pytest.raises(ArgumentError, match=r"max_depth: expected an integer of at least -1 .* at most 2\^32 - 2"):
            checked_depth(wrong)


def test_filters_and_seeds_of_gradients():
    assert [checked_filter(name) for name in ("auto", "box", "tent", "gaussian")] == ["auto", "box", "tent", "gaussian"]
    with pytest.raises(ArgumentError, match="expected one of auto, box, tent, gaussian, got 'round'"):
        checked_filter("round")
    assert [checked_grad_seed(seed) for seed in (None, "same", np.int32(4), 0)] == [None, "same", 4, 0]
    for wrong in ("other", 1.5, True):
        with pytest.raises(ArgumentError, match="expected None, 'same' or an integer"):
            checked_grad_seed(wrong)


def test_sensors():
    """One by its number has no dimension of its own, a list of one has."""
    assert sensor_list("all", 3) == ((0, 1, 2), True)
    for one in (2, np.int64(2), torch.tensor(2), np.array(2)):
        assert sensor_list(one, 3) == ((2,), False)
    for several in ([2, 0], (np.int64(2), 0), np.array([2, 0]), torch.tensor([2, 0]), range(2, -1, -2)):
        assert sensor_list(several, 3) == ((2, 0), True)
    assert sensor_list(np.array([2]), 3) == ((2,), True)
    for wrong in ([], "2", b"2", [1, 0.5], [None], 1.5, None, {0: 1}, np.zeros((1, 2), int)):
        with pytest.raises(ArgumentError, match="expected an index, a list of indices or 'all'"):
            sensor_list(wrong, 3)


def test_names_that_torch_allows():
    assert torch_names(["a.b", "c"]) == {"a.b": "a/b", "c": "c"}
    for wrong in (["a", "a"], ["a.b", "a/b"]):
        with pytest.raises(ArgumentError, match="every key once"):
            torch_names(wrong)


@pytest.mark.parametrize(
    "value",
    [
        [1, 2.5], (1.0, 2.5), np.array([1.0, 2.5]), torch.tensor([1.0, 2.5], dtype=torch.float64),
        [torch.tensor(1.0), 2.5], [np.float32(1), torch.tensor(2.5)],
    ],
)  # fmt: skip
def test_numbers_of_every_library(value):
    found = as_float("k", value, "cpu")
    assert found.dtype == torch.float32 and found.tolist() == [1.0, 2.5]


def test_values_are_copies_of_arrays_and_gradients_pass_tensors():
    array = np.arange(3.0, dtype=np.float32)
    array.flags.writeable = False
    found = as_float("k", array, "cpu")
    found += 1
    assert array.tolist() == [0, 1, 2]
    leaf = torch.ones(2, dtype=torch.float64, requires_grad=True)
    as_float("k", [leaf[0], leaf[1] * 2], "cpu").sum().backward()
    assert leaf.grad.tolist() == [1, 2]
    assert as_float("k", np.array([1, 2], np.uint8), "cpu").tolist() == [1, 2]


@pytest.mark.parametrize(
    ("value", "error", "words"),
    [
        (None, ShapeError, "expected numbers, got None. Leave the key out"),
        (1j, ShapeError, NO_NUMBERS + "1j"),
        (True, ShapeError, NO_NUMBERS + "True"),
        ("abc", ShapeError, NO_NUMBERS + "'abc'"),
        ([[1, 2], [3]], ShapeError, NO_NUMBERS + r"\[\[1, 2\], \[3\]\]"),
        ([torch.ones(2), torch.ones(3)], ShapeError, "expected tensors that can be stacked, got others"),
        (torch.eye(2).to_sparse(), ShapeError, "expected a dense tensor, got layout torch.sparse_coo"),
        (
            torch.ones(2, device="meta"),
            DeviceError,
            "expected a tensor on 'cpu', where the scene's variant computes, got",
        ),
    ],
)
def test_what_are_no_values(value, error, words):
    with pytest.raises(error, match=rf"value of 'k': {words}"):
        as_float("k", value, "cpu")


@pytest.mark.parametrize(
    ("given", "shape", "fitted", "batched"),
    [
        ((3,), (3,), (3,), False), ((5, 3), (3,), (5, 3), True), ((), (), (), False), ((4,), (), (4,), True),
        ((2, 3), (2, 3), (2, 3), False), ((7, 2, 3), (2, 3), (7, 2, 3), True),
        # Mitsuba's flat lists of vertices.
        ((6,), (2, 3), (2, 3), False), ((7, 6), (2, 3), (7, 2, 3), True),
    ],
)  # fmt: skip
def test_shapes_that_fit(given, shape, fitted, batched):
    value = torch.arange(float(np.prod(given, dtype=int))).reshape(given)
    found, several = fit_shape("k", value, shape)
    assert (tuple(found.shape), several) == (fitted, batched)
    assert torch.equal(found.flatten(), value.flatten())


@pytest.mark.parametrize(
    ("given", "shape", "batch"),
    [
        ((2,), (3,), r"\(B, 3\)"), ((3, 5), (3,), r"\(B, 3\)"), ((1, 1, 3), (3,), r"\(B, 3\)"), ((1, 1), (), r"\(B,\)"),
        ((5,), (2, 3), r"\(B, 2, 3\)"), ((6, 7), (2, 3), r"\(B, 2, 3\)"), ((3, 2), (2, 3), r"\(B, 2, 3\)"),
        ((24,), (2, 3, 4), r"\(B, 2, 3, 4\)"), ((5, 24), (2, 3, 4), r"\(B, 2, 3, 4\)"),
    ],
)  # fmt: skip
def test_shapes_that_do_not_fit(given, shape, batch):
    with pytest.raises(ShapeError, match=rf"'k': expected shape .*, or {batch} with a batch, got"):
        fit_shape("k", torch.zeros(given), shape)


def test_films():
    axis = tt.TimeAxis(0.0, 1.0, 3)
    assert requested_film(None, {"time_axis": None}) is None
    assert requested_film(None, {"time_axis": axis}) == requested_film(Histogram(axis), {}) == Histogram(axis)
    with pytest.raises(ArgumentError, match="film, time_axis, gates: a film measures one thing"):
        requested_film(Histogram(axis), {"time_axis": axis, "gates": None})
    with pytest.raises(ArgumentError, match=r"expected a film such as Histogram\(axis\)"):
        requested_film(axis, {})


def test_values_of_a_call():
    given = {"a": 1}
    assert checked_values(None) == {} and checked_values(given) == given and checked_values(given) is not given
    with pytest.raises(ArgumentError, match="expected a mapping from keys to values, got int"):
        checked_values(5)


def test_parameters_by_their_keys():
    module = nn.Module()
    module.register_parameter("a/b", nn.Parameter(torch.zeros(2, 3)))
    values = Values(module, {"a.b": "a/b"})
    assert list(values) == ["a.b"] and len(values) == 1 and values["a.b"] is module.get_parameter("a/b")
    values["a.b"] = np.arange(6.0)
    assert values["a.b"].tolist() == [[0, 1, 2], [3, 4, 5]] and values["a.b"].requires_grad
    with pytest.raises(UnknownKeyError, match=r"has no parameter 'c'; it was made with parameters=\['a\.b'\]"):
        values["c"]
    with pytest.raises(ShapeError, match=r"'a\.b': expected shape \(2, 3\), got \(4, 2, 3\): a parameter has no batch"):
        values["a.b"] = torch.zeros(4, 2, 3)
