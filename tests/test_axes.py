"""The time axis: its borders, which bin a length belongs to, what it refuses."""

from __future__ import annotations

import itertools
import pickle
from fractions import Fraction

import numpy as np
import pytest
import torch

from torchtransient.axes import FrequencyAxis, RateAxis, TimeAxis, fast_length
from torchtransient.errors import UnitError
from torchtransient.units import SPEED_OF_LIGHT

AXIS = TimeAxis(start_opl=3.5, bin_width_opl=0.02, num_bins=300)
SMOOTH = sorted(2**a * 3**b * 5**c for a, b, c in itertools.product(range(13), range(8), range(6)))


def test_edges_and_centres():
    assert AXIS.edges_opl.shape == (301,)
    assert AXIS.centers_opl.shape == (300,)
    assert AXIS.edges_opl.dtype == AXIS.centers_s.dtype == torch.float64
    assert AXIS.edges_opl[0].item() == 3.5
    assert AXIS.edges_opl[-1].item() == pytest.approx(9.5, abs=1e-14)
    assert AXIS.end_opl == AXIS.edges_opl[-1].item()
    torch.testing.assert_close(AXIS.centers_opl, (AXIS.edges_opl[:-1] + AXIS.edges_opl[1:]) / 2, rtol=1e-15, atol=0)


def test_edges_do_not_drift():
    axis = TimeAxis(1000.0, 0.003, 1_000_000)
    exact = Fraction(1000) + 999_999 * Fraction(0.003)
    assert abs(Fraction(axis.edges_opl[999_999].item()) - exact) < Fraction(1, 2**41)  # two roundings at 4 km


def test_seconds():
    axis = TimeAxis.from_seconds(start_s=1e-8, bin_width_s=1e-11, num_bins=7)
    assert axis.start_opl == pytest.approx(2.99792458, rel=1e-15)
    assert axis.start_s == pytest.approx(1e-8, rel=1e-15)
    assert axis.bin_width_s == pytest.approx(1e-11, rel=1e-15)
    torch.testing.assert_close(axis.centers_s * SPEED_OF_LIGHT, axis.centers_opl, rtol=1e-15, atol=0)
    torch.testing.assert_close(axis.edges_s, 1e-8 + 1e-11 * torch.arange(8, dtype=torch.float64), rtol=1e-14, atol=0)


WRONG_UNITS = {
    "a picosecond in microseconds": lambda: TimeAxis.from_seconds(0.0, 1e-6, 128),
    "a start in picoseconds": lambda: TimeAxis.from_seconds(-500.0, 50e-12, 128),
    "100 ns as metres": lambda: TimeAxis(0.0, 99e-9, 128),
    "megahertz, negative": lambda: FrequencyAxis.from_hertz([-80.0]),
    "hertz as cycles per metre": lambda: FrequencyAxis([20e6]),
    "a step in hertz": lambda: FrequencyAxis.uniform(0.0, 10e6, 3),
}


@pytest.mark.parametrize("make", WRONG_UNITS.values(), ids=WRONG_UNITS)
def test_numbers_of_another_unit_are_told(make):
    with pytest.raises(UnitError, match=r"expected .* got .*(from_seconds|in metres|from_hertz|are \d+e)"):
        make()


def test_every_edge_starts_its_bin():
    edges = AXIS.edges_opl
    assert torch.equal(AXIS.bin_index(edges), torch.arange(301))
    below = torch.nextafter(edges, torch.tensor(-torch.inf, dtype=torch.float64))
    assert torch.equal(AXIS.bin_index(below), torch.arange(301) - 1)


def test_index_of_numbers_and_outside():
    assert AXIS.bin_index(3.51).item() == 0
    assert AXIS.bin_index(3.49999).item() == -1
    assert AXIS.bin_index(-torch.inf).item() == -1
    assert AXIS.bin_index(torch.inf).item() == 300
    got = AXIS.bin_index(torch.tensor([[3.5, 4.0], [9.49, 12.0]], dtype=torch.float32))
    assert got.dtype == torch.int64
    assert got.tolist() == [[0, 25], [299, 300]]


def test_equal_hashable_picklable_frozen():
    same = TimeAxis(np.float64(3.5), torch.tensor(0.02, dtype=torch.float64), np.int32(300))
    assert same == AXIS
    assert len({same, AXIS}) == 1
    assert pickle.loads(pickle.dumps(AXIS)) == AXIS
    assert type(same.start_opl) is float
    assert type(same.num_bins) is int
    with pytest.raises(AttributeError):
        AXIS.start_opl = 1.0


def test_frequencies_and_wavelengths():
    assert FrequencyAxis.uniform(1.5, -0.5, 4, start_opl=2.0) == FrequencyAxis((1.5, 1.0, 0.5, 0.0), 2.0)
    axis = FrequencyAxis.uniform(0.0, 0.25, 5)
    assert axis.num_frequencies == 5 and axis.frequencies == (0.0, 0.25, 0.5, 0.75, 1.0)
    assert axis.per_metre.dtype == axis.hertz.dtype == torch.float64
    assert axis.wavelengths_opl.tolist() == [float("inf"), 4.0, 2.0, pytest.approx(4 / 3), 1.0]
    modulation = FrequencyAxis.from_hertz([20e6, 100e6], start_opl=1.0)
    torch.testing.assert_close(modulation.hertz, torch.tensor([20e6, 100e6], dtype=torch.float64), rtol=1e-15, atol=0)
    assert modulation.wavelengths_opl[1].item() == pytest.approx(2.99792458)
    assert modulation.start_opl == 1.0 and "start_opl=1" in repr(modulation)


@pytest.mark.parametrize("multiple", [1, 2, 7])
def test_the_next_length_of_small_factors(multiple):
    """Beside the list of all products of 2, 3 and 5."""
    for least in (*range(1, 700), 4097, 4375):
        assert fast_length(least, multiple) == next(multiple * n for n in SMOOTH if multiple * n >= least)


def test_rates():
    axis = RateAxis(-2.0, 0.25, 16)
    assert axis.edges.dtype == axis.centers.dtype == torch.float64
    assert axis.edges[0].item() == -2.0 and axis.edges[-1].item() == axis.end == 2.0
    torch.testing.assert_close(axis.centers, (axis.edges[:-1] + axis.edges[1:]) / 2, rtol=1e-15, atol=0)
    assert pickle.loads(pickle.dumps(axis)) == axis == RateAxis(torch.tensor(-2.0), np.float32(0.25), np.int64(16))
    assert len({axis, RateAxis(-2, 0.25, 16), RateAxis(-2, 0.25, 17)}) == 2
