"""What is of a wrong type, everywhere: an error of one sentence where it is given, or a right result."""

from __future__ import annotations

import inspect
import warnings
from functools import partial

import numpy as np
import pytest
import torch

import torchtransient as tt
from support.fake_recipe import FakeRecipe
from support.number_case import Table, recipe
from support.refused import complaint
from support.sweeps import together
from support.type_cases import TYPE_CASES
from test_public_names import found, members_of, public_names, signature_of
from torchtransient.errors import ArgumentError, ShapeError

ROOMS = ("Pulse", "pulses", "vis", "data", "losses", "metrics", "training")
NOTHING = object()  # of no use to anybody
WRONG = [None, 5, "x", b"x", [], {}, NOTHING, True, [None], [5], {"a": 5}, np.ones((2, 3)), np.array(5),
         np.array(["x"]), torch.ones(2, 3) > 0, len]  # fmt: skip
# What takes anything, or is looked at later, and why.
ANYTHING = {
    "data.generate(folder)": "its case ends before", "data.export_web_dataset(where)": "its case ends before",
    "data.export_web_dataset(folder)": "its case ends before",
}  # fmt: skip
# What hands a value on to a function of the user's, whose errors are its own.
HANDED_ON = {
    "losses.measurement_consistency(volume)": "an operator of the case", "training.accumulate(loss_of)": "a function",
}  # fmt: skip
# Without a case, and why.
LEFT = {
    "data.Generated", "data.Sample", "training.Checkpoint",  # results
    "training.worker_init",  # called by torch
    "data.scene_labels", "data.label_names", "data.material_names",  # rendering/test_labels.py
    *(f"data.{kind}.draw" for kind in ("Affine", "Crop", "Flip", "Operation", "QuarterTurn", "Distribution", "Choice",
      "LogUniform", "Normal", "Scale", "Uniform", "Compose", "LookAt", "Offset", "Turn")),  # given by the library
    *(f"data.{name}" for name in ("Shard.shape", "Shard.time_axis", "Shard.dtype", "Shard.encoding",
      "ShardWriter.put", "ShardWriter.fail")),
}  # fmt: skip


@pytest.fixture(autouse=True)
def _beside_the_library(tmp_path, monkeypatch):
    """Names of files are texts, too."""
    monkeypatch.chdir(tmp_path)


def required(call):
    """The arguments that a function or class cannot do without."""
    either = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    return [p.name for p in signature_of(call).values() if p.default is p.empty and p.kind not in either and
            p.name != "self"]  # fmt: skip


def key_of(call):
    return getattr(call, "__module__", ""), getattr(call, "__qualname__", "")


def test_all_that_takes_something_is_tried():
    tried, missing = {key_of(case.call) for case in TYPE_CASES.values()}, set()
    for name in public_names():
        for member, inner in {"": found(name), **members_of(found(name))}.items():
            full = f"{name}.{member}".rstrip(".")
            if name.split(".")[0] in ROOMS and member != "forward" and required(inner) and key_of(inner) not in tried:
                missing.add(full)
    assert missing == LEFT, "give it right arguments in support/type_cases.py"


ARGUMENTS = [
    (name, p.name)
    for name, case in TYPE_CASES.items()
    if name.split(".")[0] in ROOMS
    for p in inspect.signature(case.call).parameters.values()
    if p.default is p.empty and p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)
]


@pytest.mark.slow
@together("entry", ARGUMENTS, name=lambda entry: f"{entry[0]}({entry[1]})")
def test_what_is_of_a_wrong_type(entry):
    name, argument = entry
    case, place = TYPE_CASES[name], f"{name}({argument})"
    names = list(inspect.signature(case.call).parameters)
    wrong = []
    for value in [] if place in HANDED_ON else WRONG:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            taken, said_wrong = complaint(partial(case.by_name, {argument: value}, names), case.errors, value)
        if taken and value is NOTHING and place not in ANYTHING:
            wrong.append("object() is taken")
        wrong += [said_wrong] if said_wrong else []
    assert not wrong, "; ".join(wrong)


@together("make", [
    (lambda: tt.data.RecipeDataset(5, 5)), (lambda: tt.data.OnlineDataset(5)),
    (lambda: tt.data.OnlineDataset(FakeRecipe)), (lambda: tt.data.RecipeDataset(recipe(), 5, transform=5)),
    (lambda: tt.data.OnlineDataset(FakeRecipe(), transform=5)), (lambda: tt.data.SpatialFilter(5)),
    (lambda: tt.training.Batches(4, 2).loader(5)), (lambda: tt.training.Batches(4, 2).loader(Table)),
    (lambda: tt.data.Augmented("abcd", tt.data.Augment(tt.data.Flip()))),
    (lambda: tt.vis.Frames(3, 5)),
])  # fmt: skip
def test_what_would_fail_later_is_refused_at_once(make):
    with pytest.raises(ArgumentError):
        make()


def test_arrays_are_light_as_tensors_are():
    light = torch.rand(3, 4, 2, 5, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    image, axis = light[:, 1], tt.TimeAxis(1.0, 0.5, 4)
    for function, given in (
        (tt.vis.exposure_of, image), (tt.vis.tone_map, image), (lambda x: tt.vis.peak_time(x, axis), light),
    ):  # fmt: skip
        np.testing.assert_array_equal(np.asarray(function(given.numpy())), np.asarray(function(given)))
    with pytest.raises(ShapeError, match=r"tone_map: expected real numbers, got torch\.complex64"):
        tt.vis.tone_map(torch.ones(1, 2, 3, dtype=torch.complex64))
