"""What takes a number, everywhere: those of every library are right, what is none is an error of one sentence."""

from __future__ import annotations

import math
import re
import warnings
from fractions import Fraction
from functools import partial

import numpy as np
import pytest
import torch

from support.number_case import is_number
from support.number_cases import CASES, LEFT, SLOW
from support.refused import complaint
from support.sweeps import together
from test_public_names import found, members_of, public_names, signature_of

NAN, INF = math.nan, math.inf
MANY = [torch.tensor([1.5, 2.5]), np.array([1.5, 2.5])]
DATES = [np.datetime64(3, "ns"), np.timedelta64(3, "ns"), np.array([np.datetime64(3, "ns")])]
NONE = ["x", "3", b"3", True, np.bool_(True), torch.tensor(True), 1j, np.complex128(1j), torch.tensor(1j), [], {},
        *DATES, object(), [1, [2]], np.array(["3"]), np.ma.masked, np.ma.array(1, mask=True)]  # fmt: skip
NO_WHOLE = [*NONE, 0.5, 1.5, NAN, INF, 1e300, torch.tensor(1.5), np.float64(NAN), 10**30, -(10**30), 2**64, *MANY]
# Whole numbers that may be negative, nothing, or larger than others, and real ones without an end, by their argument.
BELOW = {"dim", "stokes_dim", "turns", "max_depth", "laser", "frame", "row", "column", "number"}
ZERO = BELOW | {
    "seed", "noise_seed", "epoch", "step", "rank", "first", "offset", "crop_offset", "gap", "subdivide", "level",
    "retries", "index", "sample", "workers", "sensors", "which", "pixels", "pixel", "bins", "count", "batches", "shard",
}  # fmt: skip
LARGE = {"seed", "noise_seed"}
WITHOUT_END = {"TimeAxis.bin_index(opl)", "data.Normal(low)", "data.Normal(high)", "data.OnlineDataset(uses)",
               "data.OnlineDataset(timeout_s)", "data.generate(timeout_s)",
               "training.Ranks.mean(value)", "data.PixelMap.nearest(fill)", "units.near_seconds(limit_s)",
               "vis.FitMonitor.step(loss)"}  # fmt: skip
NO_NUMBER = {"training.Ranks.mean(value)", "data.PixelMap.nearest(fill)", "vis.FitMonitor.step(loss)"}
NO_REAL = [*NONE, NAN, torch.tensor(NAN), np.float64(NAN)]
ENDLESS = [INF, -INF, np.float64(INF), 10**400]
WHOLE = [np.int64, np.uint8, np.array, torch.tensor, lambda n: torch.tensor(n, dtype=torch.uint8)]
REAL = [np.float32, np.float64, np.array, torch.tensor, lambda x: torch.tensor(x, dtype=torch.float64), Fraction]


def takes():
    """(name, argument, what is written of its type) of all that takes numbers; names of one object once."""
    seen = set()
    for name in public_names():
        value = found(name)
        for member, inner in {"": value, **members_of(value)}.items():
            key = getattr(inner, "__module__", ""), getattr(inner, "__qualname__", "")
            for argument, one in dict(signature_of(inner)).items():
                said = str(one.annotation)
                if re.search(r"\b(int|float)\b", said) and (*key, argument) not in seen:
                    seen.add((*key, argument))
                    yield f"{name}.{member}".rstrip("."), key, argument, said


def key_of(call):
    return getattr(call, "__module__", ""), getattr(call, "__qualname__", "")


KEYS = {key_of(case.call): name for name, case in CASES.items()}
# (name of the case, argument, type) of everything that has a case.
ARGUMENTS = [(KEYS[key], argument, said) for _, key, argument, said in takes() if key in KEYS]
TRIED = [entry for entry in ARGUMENTS if CASES[entry[0]].number(entry[1]) is not None]
QUICK = [entry for entry in TRIED if entry[0] not in SLOW]
WHOLES, REALS = ([e for e in QUICK if bool(re.search(r"\bint\b", e[2])) is whole] for whole in (True, False))
of_one = {"name": lambda entry: f"{entry[0]}({entry[1]})"}


def test_every_argument_that_is_a_number_is_tried():
    tried = {(name, argument) for name, argument, _ in TRIED}
    missing = {
        f"{name}({argument})": said
        for name, key, argument, said in takes()
        if (KEYS.get(key), argument) not in tried and not re.fullmatch("|".join(LEFT), f"{name}({argument})")
    }
    assert not missing, "give it a right value in support/number_cases.py"


def refusals(entry, values):
    """Values that are taken, or refused otherwise than by one typed sentence."""
    name, argument, said = entry
    case, wrong = CASES[name], []
    for value in values:
        if value is None and "None" in said:
            continue
        taken, said_wrong = complaint(partial(case, **{argument: case.in_place(argument, value)}), case.errors, value)
        wrong += [f"{value!r} is taken"[:80]] if taken else [said_wrong] if said_wrong else []
    return wrong


def wrong_values(entry):
    name, argument, said = entry
    place = f"{name}({argument})"
    if re.search(r"\bint\b", said):
        values = [v for v in NO_WHOLE if not (argument in LARGE and is_number(v) and v >= 2**64 and v != INF)]
        return [*values, *([] if argument in BELOW else [-1]), *([] if argument in ZERO else [0]), None]
    values = [*NO_REAL, *([] if place in WITHOUT_END else ENDLESS), None]
    several = re.search(r"Tensor|Numbers|Iterable|Any", said)  # of which nothing, or a tensor of NaN, may be given
    loose = [v for v in values if several and (v is None or isinstance(v, list | dict | torch.Tensor))]
    return [v for v in values if not any(v is one for one in loose) and not (place in NO_NUMBER and v != v)]


def check_wrong(entry):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        wrong = refusals(entry, wrong_values(entry))
    if wrong:
        raise AssertionError("; ".join(wrong))


def check_right(entry, makers=None):
    name, argument, said = entry
    case = CASES[name]
    number = case.number(argument)
    for make in makers or (WHOLE if re.search(r"\bint\b", said) else REAL):
        if make in (WHOLE[1], WHOLE[4]) and not 0 <= number < 256:
            continue
        case(**{argument: case.in_place(argument, make(number))})


@pytest.mark.slow
@together("entry", WHOLES, **of_one)
def test_what_is_no_whole_number(entry):
    check_wrong(entry)


@pytest.mark.slow
@together("entry", REALS, **of_one)
def test_what_is_no_real_number(entry):
    check_wrong(entry)


@pytest.mark.slow
@together("entry", QUICK, **of_one)
def test_numbers_of_other_libraries(entry):
    check_right(entry)


@pytest.mark.slow
@together("entry", [entry for entry in TRIED if entry[0] in SLOW], **of_one)
def test_numbers_of_what_is_slow(entry):
    check_wrong(entry)
    check_right(entry)
