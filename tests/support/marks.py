"""Which rows of a table of tests are in the default set."""

from __future__ import annotations

import itertools

import pytest


def long(values, quick, soaked=()):
    """Parameters of a test, of which those that are not ``quick`` are run with the slow ones, or by the soak."""
    values = list(values)
    if not all(value in values for value in (*quick, *soaked)):
        raise ValueError(f"long: expected all of {quick} and {soaked} to be among {values}.")

    def marks(value):
        return [] if value in quick else [pytest.mark.soak if value in soaked else pytest.mark.slow]

    return [pytest.param(value, marks=marks(value)) for value in values]


def long_rows(rows, quick):
    """Likewise rows of several values each."""
    rows, quick = list(rows), list(quick)
    if not all(row in rows for row in quick):
        raise ValueError(f"long_rows: expected all of {quick} to be among {rows}.")
    return [pytest.param(*row, marks=[] if row in quick else [pytest.mark.slow]) for row in rows]


def long_pairs(first, second, quick):
    """Likewise every pair of two values; every value is in one that is ``quick``."""
    first, second = list(first), list(second)
    if {a for a, _ in quick} != set(first) or {b for _, b in quick} != set(second):
        raise ValueError(f"long_pairs: expected all of {first} and of {second} to be in quick pairs, got {quick}.")
    pairs = itertools.product(first, second)
    return [pytest.param(*pair, marks=[] if pair in quick else [pytest.mark.slow]) for pair in pairs]
