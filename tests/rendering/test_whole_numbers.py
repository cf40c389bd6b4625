"""Whole numbers as people have them: those of other libraries are right, what is none is an error, the rest says so."""

from __future__ import annotations

import warnings

import mitsuba as mi
import numpy as np
import pytest
import torch

import torchtransient as tt
from support.sweeps import together
from tools.small_room import COLOUR, VARIANT, make_room
from torchtransient.errors import ArgumentError, ShapeError, TorchTransientError, TorchTransientWarning, UnitError
from torchtransient.nlos.scene import _range as bounces_of
from torchtransient.rendering.cameras import camera_of
from torchtransient.rendering.labels import scene_labels
from torchtransient.sensing.itof.codes import phase_steps

WHOLE = [np.int64(3), np.array(3), torch.tensor(3, dtype=torch.uint8)]
NONE = [1.5, float("nan"), "x", "3", True, torch.tensor(True), 1j, [], {}, torch.tensor(3.0)]
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
    "seed of poses": lambda n: over_time(seed=n).stats.seeds[2],
    "spp of poses": lambda n: over_time(spp=n, seed=0).stats.spp,
    "one seed of several": lambda n: tt.render(make_room(), spp=1, seed=[n]).stats.seeds[0],
    "batch_spp": lambda n: tolerance(batch_spp=n).spp,
    "seed of passes": lambda n: tolerance(seed=n, batch_spp=1).state.sums.seed,
    "sensor": lambda n: tt.TransientRenderer(room_of_four(), sensors=n)._sensors[0],
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


@pytest.mark.filterwarnings("ignore:.*(quantized|nested) tensor")
def test_values_that_are_no_numbers():
    renderer = tt.TransientRenderer(make_room(), [COLOUR], spp=1)
    ones = torch.ones(3)
    wrong = [
        np.array(["2020"] * 3, "datetime64[s]"), ["0.5"] * 3, np.array(["1"] * 3), [10**400] * 3, [True] * 3,
        np.ma.array([0.5] * 3, mask=[False, True, False]), torch.nested.nested_tensor([ones, ones]), ones.to_sparse(),
        torch.quantize_per_tensor(ones, 0.1, 0, torch.qint8), [ones[0], "x", 1.0], [ones, ones[:2]], [1j] * 3,
    ]  # fmt: skip
    for value in wrong:
        with pytest.raises(ShapeError, match="expected") as failure:
            renderer({COLOUR: value}, seed=0)
        assert "\n" not in str(failure.value)


# --------------------------------------------------------------------------------------------------- calls of others


def confocal(size):
    return tt.nlos.Scan.grid(tt.nlos.Wall.plane(1.0, 1.0), size, kind="confocal")


def spot(n):
    scan = tt.nlos.Scan.grid(tt.nlos.Wall.plane(1.0, 1.0), 4, kind="exhaustive")
    return bool(np.array_equal(scan.single((n, 0)).laser_points, scan.single((3, 0)).laser_points)) * int(n)


def passes(n):
    return tt.nlos.DiffusionDeconvolution(confocal(2), time_axis=AXIS, thickness=0.025, passes=n).passes


def counted(n):
    with tt.threads(n) as found:
        return found.drjit


def seed_of_a_function(n):
    mi.set_variant(VARIANT)
    seeds = []

    def function(seed, x):
        seeds.append(seed)
        return x * 2

    tt.wrap(function, reseed="seed")(n, torch.ones(1))
    return seeds[0]


def samples_of_labels(n):
    renderer = tt.TransientRenderer(make_room(), spp=1)
    found = scene_labels(renderer, names=("depth",), average=True, samples=n)["depth"]
    return int(n) * torch.equal(found, scene_labels(renderer, names=("depth",), average=True, samples=4)["depth"])


AXIS, DEVICE = tt.TimeAxis(0.0, 0.1, 8), tt.sensing.device("mpd_spad_like")
STAGE = [stage["kind"] for stage in DEVICE.stages].index("PhotonBudget")
# (call, a number that it takes): the call gives that number back.
OTHERS = {
    "grid": (lambda n: confocal(n).sensor_shape[0], 3),
    "grid of two": (lambda n: confocal((1, n)).sensor_shape[0], 3),
    "laser": (spot, 3),
    "passes": (passes, 2),
    "threads": (counted, 2),
    "phase steps": (lambda n: len(phase_steps(n)), 3),
    "seed of a function": (seed_of_a_function, 3),
    "bounces": (lambda n: bounces_of([2, n])[1], 3),
    "samples of labels": (samples_of_labels, 4),
    "sensor of a camera": (lambda n: camera_of(tt.TransientRenderer(room_of_four()), sensor=n) and int(n), 1),
    "stage": (lambda n: (DEVICE.changed(n, cycles=7) == DEVICE.changed("PhotonBudget", cycles=7)) * int(n), STAGE),
}
# Others are refused by these in test_numbers_given.py.
SWEPT = {"grid", "laser", "passes", "threads", "bounces"}


@pytest.mark.parametrize("name", OTHERS)
def test_whole_numbers_of_other_libraries_in_other_calls(name):
    call, good = OTHERS[name]
    for kind in (np.int64, np.array, torch.tensor):
        assert call(kind(good)) == good
    if name in SWEPT:
        return
    for bad in (True, 1.5, torch.tensor(1.5), "3", 1j, [[1]]):
        with pytest.raises(TorchTransientError, match="expected") as failure:
            call(bad)
        assert "\n" not in str(failure.value)


def test_seeds_of_64_bits_and_without_an_order():
    renderer = tt.TransientRenderer(make_room(), [COLOUR], spp=1)
    x = torch.full((2, 3), 0.5)
    large = torch.tensor([3, 2**63 + 3], dtype=torch.uint64)
    with pytest.warns(TorchTransientWarning, match="counts as 3"):
        assert renderer(seed=large[1]).stats.seeds == (3,)
    with pytest.raises(UnitError, match="are one seed"):
        renderer({COLOUR: x}, seed=large)
    with pytest.warns(TorchTransientWarning, match="counts as 3"):
        found = torch.func.vmap(lambda x, seed: renderer({COLOUR: x}, seed=seed).transient)(x, large)
    assert torch.equal(found[0], found[1])
    with pytest.raises(UnitError, match="or one for each batch entry"):
        renderer({COLOUR: x}, seed={1, 2})
