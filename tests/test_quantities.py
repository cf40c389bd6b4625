"""Numbers as people give them, to everything that needs no renderer: what is none is an error of one line."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from support.sweeps import together
from torchtransient.axes import FrequencyAxis, TimeAxis
from torchtransient.checks import shown
from torchtransient.errors import MissingPackageError, ShapeError, TorchTransientError, UnitError, UnknownKeyError
from torchtransient.gates import Gate
from torchtransient.pulses import Pulse, transform

GATE, PULSE, AXIS = Gate.gaussian(3.0, 1.0), Pulse.gaussian(1.0), TimeAxis(0.0, 1.0, 3)
ROWS = [[1.0, 2.0, 3.0], [0.0, 1.0, 0.0]]
# (call, what it takes), each of which is replaced by something else; one number: test_numbers_given.py.
SEVERAL_NUMBERS = {
    "Gate.tabulated": (Gate.tabulated, ROWS),
    "Gate.value": (GATE.value, [1.0]),
    "Pulse.tabulated": (Pulse.tabulated, ROWS),
    "Pulse.tabulated_s": (Pulse.tabulated_s, [[1e-9, 2e-9, 3e-9], ROWS[1]]),
    "Pulse.cumulative": (PULSE.cumulative, [1.0]),
    "transform": (lambda frequencies: transform(PULSE, frequencies), [[1.0]]),
    "bin_index": (AXIS.bin_index, [1.0]),
}
DATE, SPAN = np.datetime64(3, "ns"), np.timedelta64(3, "ns")
NONE = [True, np.bool_(True), None, "x", "3", b"3", 1j, np.complex64(1), torch.tensor(1.0 + 0j), DATE, SPAN, {},
        object(), [1, [2]], np.array([DATE]), np.array(["3"]), math.nan]  # fmt: skip


@pytest.mark.parametrize("name", SEVERAL_NUMBERS)
def test_what_is_no_list_of_numbers(name):
    call, good = SEVERAL_NUMBERS[name]
    call(*good)
    hidden = np.ma.array([0.0, 1.0, 2.0], mask=[False, True, False])
    for place in range(len(good)):
        for bad in [*NONE[2:-1], hidden, 10**400]:
            given = [*good]
            given[place] = bad
            with pytest.raises((UnitError, ShapeError), match="expected"):
                call(*given)


def test_numbers_of_every_library():
    for number in (np.float32(2), np.float16(2), np.int8(2), np.array(2), torch.tensor(2.0), 2):
        assert Gate.rectangular(1.0, number).end_opl == TimeAxis(0.0, number, 1).bin_width_opl == 2.0
        assert Pulse.gaussian(number).width_opl == FrequencyAxis(number).frequencies[0] == 2.0
    for row in (np.array(ROWS[0], ">f8"), torch.tensor(ROWS[0]), range(1, 4)):
        assert Gate.tabulated(row, ROWS[1]).opl == Pulse.tabulated(row, ROWS[1]).opl == (1.0, 2.0, 3.0)
        assert AXIS.bin_index(row).tolist() == [1, 2, 3]


def test_so_many_gates_and_frequencies_are_never_made():
    for count in (1e300, 10**400, 2**24 + 1, -1):
        with pytest.raises(ShapeError, match="expected a whole number of at"):
            GATE.sequence(1.0, count)
        with pytest.raises(ShapeError, match="expected a whole number of at"):
            FrequencyAxis.uniform(1.0, 1.0, count)
    with pytest.raises(ShapeError, match="num_bins"):
        TimeAxis(0.0, 1.0, 10**400)


@together("gate", [Gate.rectangular(0.0, 1.0), GATE, Gate.tabulated(*ROWS)])
def test_gates_of_numbers_that_are_none(gate):
    with np.errstate(all="raise"):
        found = gate.value([math.nan, -math.inf, math.inf, 1e300, -1e300])
    np.testing.assert_array_equal(found, [math.nan, 0, 0, 0, 0])


def test_messages_are_one_line():
    assert "\n" not in shown(torch.ones(2, 2))
    for kind in (TorchTransientError, UnitError, UnknownKeyError):
        assert str(kind(f"got {np.eye(2)}.")) == "got [[1. 0.] [0. 1.]]."
    error = MissingPackageError("a\nb", name="c")
    assert (str(error), error.name) == ("a b", "c")
