"""Whole numbers as people have them: those of other libraries are right, what is none is an error, the rest says so."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import torch

import torchtransient as tt
from support.sweeps import together
from torchtransient.errors import ArgumentError, ShapeError, TorchTransientError, TorchTransientWarning, UnitError
from torchtransient.testing.small_room import COLOUR, make_room

WHOLE = [np.int64(3), np.uint8(3), np.array(3), torch.tensor(3), torch.tensor(3, dtype=torch.uint8)]
NONE = [0.5, 1.5, float("nan"), "x", "3", True, np.bool_(True), torch.tensor(True), 1j, [], {}, b"3", torch.tensor(3.0)]
HUGE = [2**32, 10**30, -(10**30)]
CALLS = {
    "spp": lambda n: tt.TransientRenderer(make_room(), spp=n).spp,
    "spp_grad": lambda n: tt.TransientRenderer(make_room(), spp_grad=n).spp_grad,
    "spp of a call": lambda n: tt.render(make_room(), spp=n, seed=0).stats.spp,
    "samples_drawn": lambda n: tt.TransientRenderer(make_room()).samples_drawn(n),
    "max_depth": lambda n: tt.TransientRenderer(make_room(), max_depth=n)._options.max_depth,
    "max_depth of a plan": lambda n: tt.plan(make_room(), max_depth=n, pilot=False).max_depth,
    "grad_seed": lambda n: tt.TransientRenderer(make_room(), grad_seed=n).grad_seed,
    "seed": lambda n: tt.render(make_room(), spp=1, seed=n).stats.seeds[0],
    "one seed of several": lambda n: tt.render(make_room(), spp=1, seed=[n]).stats.seeds[0],
    "sensor": lambda n: tt.TransientRenderer(room_of_four(), sensors=n)._sensors[0],
    "one sensor of several": lambda n: tt.TransientRenderer(room_of_four(), sensors=[n])._sensors[0],
}


def room_of_four():
    room = make_room()
    return room | {f"sensor_{n}": room["sensor"] for n in range(3)}


@pytest.mark.parametrize("call", CALLS)
def test_whole_numbers_of_other_libraries(call):
    for value in WHOLE:
        found = CALLS[call](value)
        assert found == 3 and type(found) is int


@pytest.mark.parametrize("call", CALLS)
def test_what_is_no_whole_number(call):
    for value in NONE:
        if (call == "seed" and isinstance(value, dict | bytes)) or (value == "x" and "plan" in call):
            continue
        with pytest.raises(TorchTransientError, match=r"expected .*(number|integer|index)") as failure:
            CALLS[call](value)
        assert "\n" not in str(failure.value)


@pytest.mark.parametrize("call", [name for name in CALLS if "seed" not in name])
def test_numbers_beyond_what_kernels_count_with(call):
    for value in HUGE:
        with pytest.raises(TorchTransientError, match=r"expected|the scene has") as failure:
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


def test_arrays_of_sensors():
    for sensors in (np.array([0, 2]), torch.tensor([0, 2])):
        assert tt.TransientRenderer(room_of_four(), sensors=sensors)._sensors == (0, 2)


@together(
    "options",
    [{"spp": "12"}, {"spp": 12}, {"spp": [1.5]}, {"spp": [2**32]}, {"repeats": 1.5}, {"reference_spp": "x"},
     {"spp": []}, {"seed": 1.5}, {"seed": "x"}],
)
def test_costs_of_accuracy(options):
    renderer = tt.TransientRenderer(make_room(), spp=1)
    with pytest.raises(UnitError, match="expected"):
        tt.cost_of_accuracy(renderer, **({"spp": [1, 2], "reference_spp": None} | options), progress=False)


def test_vmap_over_nothing():
    renderer = tt.TransientRenderer(make_room(), [COLOUR], spp=1)
    with pytest.raises(ShapeError, match=r"at least one entry under torch\.func\.vmap, got none"):
        torch.func.vmap(lambda x: renderer({COLOUR: x}, seed=0).transient)(torch.zeros(0, 3))


def test_depths_are_bounded_by_what_stands_for_no_limit():
    assert CALLS["max_depth"](2**32 - 2) == 2**32 - 2
    with pytest.raises(ArgumentError, match=r"at most 2\^32 - 2, got 4294967295\."):
        CALLS["max_depth"](2**32 - 1)
