"""Rounded mantissas bit by bit, against exact arithmetic; counts in the smallest type."""

from __future__ import annotations

import math
import tarfile
from fractions import Fraction

import numpy as np
import pytest

from support.stored_samples import AXIS, sample, write
from torchtransient.data import Shard, TransientDataset, export_web_dataset
from torchtransient.data.shard_format import counts_of, rounded_mantissa
from torchtransient.errors import StorageError


def nearest(value, bits, least):
    """A number with `bits` bits behind the first one, half to even, by fractions. ``least``: exponent of denormals."""
    if not np.isfinite(value) or value == 0:
        return value
    x = abs(Fraction(float(value)))
    exponent = max(least, math.frexp(float(value))[1] - 1)
    step = Fraction(2) ** (exponent - bits)
    return float(np.copysign(float(round(x / step) * step), value))  # round of fractions is half to even


@pytest.mark.parametrize(("dtype", "whole", "least"), [(np.float32, np.uint32, -126), (np.float64, np.uint64, -1022)])
def test_against_fractions(dtype, whole, least):
    rng = np.random.default_rng(0)
    size = np.dtype(dtype).itemsize
    raw = rng.integers(0, 2 ** (8 * size), 4000, dtype=whole, endpoint=False).view(dtype)
    normal = np.concatenate([rng.normal(size=2000), 10.0 ** rng.uniform(-30, 30, 500)]).astype(dtype)
    # Halves between two numbers that stay, and their neighbours; numbers of one bit.
    cut = {4: 13, 8: 42}[size]
    one = np.array([1], dtype).view(whole)
    halves = (np.arange(64, dtype=whole) * whole(1 << (cut - 1)) + one).view(dtype)
    near = np.concatenate([np.nextafter(halves, dtype(0)), np.nextafter(halves, dtype(9))])
    tiny = np.arange(0, 1 << 16, 97, dtype=whole).view(dtype)
    x = np.concatenate([raw, normal, halves, near, tiny, np.array([0.0, -0.0, np.inf, -np.inf], dtype)])
    x = x[~np.isnan(x)]
    found = rounded_mantissa(x)
    with np.errstate(over="ignore"):
        expected = np.array([nearest(value, 10, least) for value in x]).astype(dtype)
    assert np.array_equal(found, expected) and np.array_equal(np.signbit(found), np.signbit(x))
    assert not (found.view(whole) & whole((1 << cut) - 1)).any()


def test_not_a_number_and_the_largest():
    x = np.array([0x7F800001, 0x7FFFFFFF, 0xFF800001, 0x7FC00000], np.uint32).view(np.float32)
    assert np.isnan(rounded_mantissa(x)).all() and rounded_mantissa(x).tobytes() == x.tobytes()
    assert np.isposinf(rounded_mantissa(np.array([np.finfo(np.float32).max])))[0]


def test_error_and_shapes():
    x = np.random.default_rng(0).gamma(1, size=(3, 40, 50)).astype(np.float32)
    before, part = x.copy(), x[:, ::2]
    found = rounded_mantissa(part)
    assert found.shape == (3, 20, 50) and np.all(np.abs(found - part) <= part * 2.0**-11)
    z = (x + 1j * x[::-1]).astype(np.complex64)
    both = rounded_mantissa(z)
    assert np.array_equal(both.real, rounded_mantissa(z.real)) and np.array_equal(both.imag, rounded_mantissa(z.imag))
    assert np.array_equal(x, before)


@pytest.mark.parametrize(
    ("values", "dtype"), [([0, 255], "u1"), ([0, 256], "u2"), ([65535], "u2"), ([65536], "u4"), ([2.0**32], "u8")]
)
def test_counts(values, dtype):
    for kind in (np.float64, np.int64):
        found = counts_of(np.array(values, kind), "x")
        assert found.dtype.str[1:] == dtype and np.array_equal(found, values)


@pytest.mark.parametrize("value", [0.5, -1, np.nan, np.inf, 2.0**64, 1j])
def test_what_are_no_counts(value):
    with pytest.raises(StorageError, match="expected counts"):
        counts_of(np.array([1, value]), "x")


def test_labels_are_never_rounded(tmp_path):
    made = sample(0)
    made.arrays["measurement"] = made.arrays["transient"] * np.float32(1.3)
    made.arrays["phasor"] = (made.arrays["transient"][:, :3] * (1 + 0.3j)).astype(np.complex64)
    with Shard(write(tmp_path / "a.h5", [made], "rounded")) as shard:
        for name, array in made.arrays.items():
            found, measured = shard.read(name, 0), name in ("transient", "measurement", "phasor")
            assert np.array_equal(found, rounded_mantissa(array) if measured else array)
            assert shard.encoding(name) == ("rounded" if measured else "exact")
            assert found.dtype == array.dtype and np.array_equal(found, array) != measured


def test_what_a_film_of_ones_own_measures_is_rounded(tmp_path):
    """Under the name that the header says, and nothing that only sounds like it."""
    made = sample(0)
    made.arrays["moments"], made.arrays["phasor"] = made.arrays.pop("transient"), made.arrays["depth"] * 1.7
    about = {"measures": "moments", "axis": {**AXIS, "num_bins": 256}}
    path = write(tmp_path / "a.h5", [made], "rounded", about=about)
    with Shard(path) as shard:
        assert {name for name in shard.names if shard.encoding(name) == "rounded"} == {"moments"}
        assert np.array_equal(shard.read("moments", 0), rounded_mantissa(made.arrays["moments"]))
    data = TransientDataset(path, window=slice(3, 9), pixels=(slice(0, 2), slice(0, 3)))
    assert data[0]["moments"].shape == (1, 6, 2, 3) and data[0]["phasor"].shape == (2, 3)
    (tar,) = export_web_dataset(path, tmp_path, progress=False)
    with tarfile.open(tar) as file:
        assert [name for name in file.getnames() if name.endswith(".zst")] == ["00000000.moments.npy.zst"]


def test_counts_of_a_shard(tmp_path):
    samples = [sample(i, counts=True) for i in range(3)]
    samples[0].arrays["measurement"][0, 0, 0, 0] = 70_000
    with Shard(write(tmp_path / "a.h5", samples, "counts")) as shard:
        assert shard.dtype("measurement") == "float32" and shard.dtype("measurement", as_stored=True) == "uint32"
        for row in range(3):
            assert np.array_equal(shard.read("measurement", row), samples[row].arrays["measurement"])
    samples[1].arrays["measurement"][0, 3, 2, 1] = 0.5
    with pytest.raises(StorageError, match=r"sample 1: 'measurement': expected counts, .* got 0.5"):
        write(tmp_path / "a.h5", samples, "counts")
    with pytest.raises(StorageError, match="measurement of a sensor"):
        write(tmp_path / "b.h5", [sample(0)], "counts")
