"""Lengths that transforms are fast at."""

from __future__ import annotations

import itertools

import pytest

from torchtransient.transform_bins import fast_length

SMOOTH = sorted(2**a * 3**b * 5**c for a, b, c in itertools.product(range(13), range(8), range(6)))


@pytest.mark.parametrize("multiple", [1, 2, 7])
def test_the_next_length_of_small_factors(multiple):
    """Beside the list of all products of 2, 3 and 5."""
    for least in (*range(1, 700), 4097, 4375):
        assert fast_length(least, multiple) == next(multiple * n for n in SMOOTH if multiple * n >= least)
