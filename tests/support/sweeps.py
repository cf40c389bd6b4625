"""One test over many values: a test of its own for each costs more than what the cheap ones check."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Iterable

import pytest


def together(names: str, values: Iterable, name: Callable = str) -> Callable:
    """``pytest.mark.parametrize`` in one test: every value is tried, and those that fail are said with their errors.

    For checks that take no fixture that is made anew for each test, and that skip nothing.
    """
    arguments, values = [n.strip() for n in names.split(",")], list(values)
    if not values:
        raise ValueError(f"together: expected one or more values of {names}, got none.")

    def decorate(check: Callable) -> Callable:
        @functools.wraps(check)
        def swept(**given):
            failed = {}
            for value in values:
                own = dict(zip(arguments, value if len(arguments) > 1 else (value,), strict=True))
                try:
                    check(**given, **own)
                except (Exception, pytest.fail.Exception) as error:  # noqa: BLE001 - said beside those of the others
                    failed[name(value)] = error
            if failed:
                lines = [f"{value}: {type(error).__name__}: {error}" for value, error in failed.items()]
                first = next(iter(failed.values()))
                raise AssertionError("\n".join([f"{len(failed)} of {len(values)} do not hold:", *lines])) from first

        parameters = inspect.signature(check).parameters.values()
        swept.__signature__ = inspect.Signature([p for p in parameters if p.name not in arguments])
        return swept

    return decorate
