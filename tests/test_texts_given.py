"""What is no text where one of a few is expected: an error of one sentence where it is given."""

from __future__ import annotations

import re
import warnings
from functools import partial

import numpy as np
import pytest
import torch

import torchtransient as tt
from support.number_case import capture
from support.number_cases import CASES, SLOW
from support.refused import complaint
from support.sweeps import together
from test_public_names import found, members_of, public_names, signature_of
from tools.small_room import COLOUR, VARIANT, make_room
from torchtransient.errors import TorchTransientError

NO_TEXT = [[], {}, np.array(["x", "y"]), np.array([1.0, 2.0]), torch.ones(2), object(), b"x", ["box"],
           np.array("box"), ("a",), 1.5, [None]]  # fmt: skip
# What is a text of any kind, for messages, or is not looked at in a single process.
LEFT = ("data.PixelMap.nearest(name)", "units.near_seconds(name)", "units.near_seconds(where)",
        "training.ranks(backend)", "Gate(kind)", "Pulse(kind)", "data.Shard.read(name)")  # fmt: skip


def options():
    """(name of a case, argument) of all that takes a text alone, or nothing."""
    keys = {(getattr(case.call, "__module__", ""), getattr(case.call, "__qualname__", "")): name
            for name, case in CASES.items() if name not in SLOW}  # fmt: skip
    seen = set()
    for name in public_names():
        for inner in (found(name), *members_of(found(name)).values()):
            key = getattr(inner, "__module__", ""), getattr(inner, "__qualname__", "")
            for argument, one in dict(signature_of(inner)).items():
                of_text = re.fullmatch(r"(str|Literal\[.*\])( \| None)?", str(one.annotation))
                if key in keys and of_text and f"{keys[key]}({argument})" not in (*LEFT, *seen):
                    seen.add(f"{keys[key]}({argument})")
                    yield keys[key], argument


@together("entry", list(options()), name=lambda entry: f"{entry[0]}({entry[1]})")
def test_what_is_no_text(entry):
    name, argument = entry
    refuse(partial(CASES[name]), argument, CASES[name].errors)


def refuse(call, argument, errors=TorchTransientError, taken=()):
    wrong = []
    for value in NO_TEXT:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            was_taken, said = complaint(partial(call, **{argument: value}), errors, value)
        if was_taken and not any(value is one or (type(value) is type(one) and not len(value)) for one in taken):
            wrong.append(f"{value!r} is taken")
        wrong += [said] if said else []
    assert not wrong, "; ".join(wrong)


@pytest.fixture(scope="module")
def scene():
    return tt.load(make_room(), variant=VARIANT)


# Lists of nothing are lists.
EMPTY = ([], {})


@pytest.mark.parametrize(
    ("argument", "taken"),
    [("temporal_filter", ()), ("effects", ()), ("sampler", ()), ("physics", ()), ("grad_seed", ()),
     ("parameters", EMPTY)],
)  # fmt: skip
def test_options_of_renderers(scene, argument, taken):
    made = partial(tt.TransientRenderer, scene, **({} if argument == "parameters" else {"parameters": [COLOUR]}), spp=1)
    refuse(made, argument, taken=taken)


def test_options_of_a_variation(scene):
    renderer = tt.TransientRenderer(scene, parameters=[COLOUR], spp=1)
    for argument in ("sampler", "temporal_filter"):
        refuse(renderer.variation, argument)
    refuse(renderer.has_slope_for, "keys", taken=EMPTY)
    with pytest.raises(tt.errors.UnknownKeyError, match="wall"):
        renderer.has_slope_for(["wall"])
    assert renderer.has_slope_for([COLOUR]) and renderer.has_slope_for([])


@pytest.mark.parametrize(
    "argument", ["outputs", "parameters", "time_axis", "max_depth", "variant", "integrator", "temporal_filter"]
)
def test_options_of_a_plan(scene, argument):
    settings = {} if argument == "time_axis" else {"time_axis": "scene"}
    refuse(partial(tt.plan, scene, pilot=False, **settings), argument, taken=EMPTY if argument == "parameters" else ())
    for name in ("nonsense", ""):
        with pytest.raises(TorchTransientError):
            tt.plan(scene, pilot=False, **{**settings, argument: [name] if argument == "parameters" else name})


def test_options_of_everything_else(tmp_path):
    for argument in ("source", "target", "reseed"):
        refuse(partial(tt.wrap, lambda x: x), argument)
    refuse(partial(tt.load, make_room()), "variant")
    refuse(partial(tt.nlos.read_capture, tmp_path / "none.h5"), "format")
    refuse(partial(tt.nlos.write_capture, tmp_path / "some.h5", capture()), "format")
    refuse(partial(tt.nlos.reconstruct, capture()), "method")
    assert not list(tmp_path.iterdir())
