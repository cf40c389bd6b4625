"""Whole numbers as people have them: those of other libraries are right, what is none is an error, the rest says so."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import torch

import torchtransient as tt
from support.sweeps import together
from tools.small_room import COLOUR, make_room
from tools.small_room import VARIANT as VARIANT
from torchtransient.errors import TorchTransientError, TorchTransientWarning

WHOLE = [np.array(3), torch.tensor(3, dtype=torch.uint8)]
NONE = [1.5, "3", True, torch.tensor(3.0)]

CALLS = {
    "spp": lambda n: tt.TransientRenderer(make_room(), spp=n).spp,
    "spp of a call": lambda n: tt.render(make_room(), spp=n, seed=0).stats.spp,
    "max_depth": lambda n: tt.TransientRenderer(make_room(), max_depth=n)._options.max_depth,
    "max_depth of a plan": lambda n: tt.plan(make_room(), max_depth=n, pilot=False).max_depth,
    "grad_seed": lambda n: tt.TransientRenderer(make_room(), grad_seed=n).grad_seed,
    "seed": lambda n: tt.render(make_room(), spp=1, seed=n).stats.seeds[0],
    "seed of poses": lambda n: over_time(seed=n).stats.seeds[2],
    "one seed of several": lambda n: tt.render(make_room(), spp=1, seed=[n]).stats.seeds[0],
    "batch_spp": lambda n: tolerance(batch_spp=n).spp,
    "seed of passes": lambda n: tolerance(seed=n, batch_spp=1).state.sums.seed,
    "one sensor of several": lambda n: tt.TransientRenderer(room_of_four(), sensors=[n])._sensors[0],
}


def tolerance(**settings):
    return tt.TransientRenderer(make_room()).to_tolerance(rtol=0.5, max_seconds=1e-9, progress=False, **settings)


def over_time(**settings):
    renderer = tt.TransientRenderer(make_room(), ["box.to_world"], spp=1)
    return tt.over_time(renderer, {"box": tt.Motion()}, tt.Exposure(1e-3), **settings)


def room_of_four():
    room = make_room()
    return room | {f"sensor_{n}": room["sensor"] for n in range(3)}


@pytest.mark.parametrize("call", CALLS)
def test_whole_numbers_of_other_libraries(call):
    for value in WHOLE:
        found = CALLS[call](value)
        assert found == 3 and type(found) is int
    for value in NONE:
        with pytest.raises(TorchTransientError, match=r"expected .*(number|integer|index)") as failure:
            CALLS[call](value)
        assert "\n" not in str(failure.value)


@together("seed, counts_as", [(2**32, 0), (-1, 2**32 - 1), (10**30, 10**30 % 2**32)])
def test_seeds_that_count_as_others_say_so(seed, counts_as):
    renderer = tt.TransientRenderer(make_room(), spp=1)
    for given in (seed, [seed]):
        with pytest.warns(TorchTransientWarning, match=rf"counts as {counts_as}: seeds count modulo 2\^32"):
            assert renderer(seed=given).stats.seeds == (counts_as,)
    with warnings.catch_warnings():
        warnings.simplefilter("error", TorchTransientWarning)
        renderer(seed=counts_as)


# ----------------------------------------------------------------------------------------------- values of parameters


def test_values_of_every_library():
    renderer = tt.TransientRenderer(make_room(), [COLOUR], spp=1)
    expected = renderer({COLOUR: torch.tensor([0.5, 0.25, 0.75])}, seed=0).transient
    row = [0.5, 0.25, 0.75]
    half = torch.tensor(0.5, requires_grad=True)
    for value in (row, np.array(row, ">f8"), np.array(row, np.longdouble), np.array(row, object), [half, *row[1:]]):
        assert torch.equal(renderer({COLOUR: value}, seed=0).transient, expected)
    out = renderer({COLOUR: [[half, 0.25, 0.75], [0.5, half, 0.75]]}, seed=0).transient
    assert torch.autograd.grad(out.sum(), half)[0] > 0 and torch.equal(out[0], expected)
