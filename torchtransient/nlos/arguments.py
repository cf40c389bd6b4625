"""Checks of what captures are asked for with: counts, samples and seeds, the same for every route to a capture."""

from __future__ import annotations

import operator
from typing import Any

from torchtransient.errors import SceneError, UnitError
from torchtransient.render.arguments import samples
from torchtransient.render.seeds import SEED_RANGE

# What samplers count with has 32 bits.
MOST_SAMPLES = 2**32 - 1


def checked_count(who: str, name: str, value: Any) -> int:
    """A whole number of at least 1. Raises SceneError."""
    number = _whole(value)
    if number is None or number < 1:
        raise SceneError(f"{who}: {name}: expected a whole number of at least 1, got {value!r}.")
    return number


def checked_samples(who: str, value: Any) -> int | None:
    """Samples of a sensor point, or None. Raises UnitError."""
    if samples("spp", value) is not None and value > MOST_SAMPLES:
        raise UnitError(f"{who}: spp: expected at most {MOST_SAMPLES} samples, got {value}. Add up several captures.")
    return None if value is None else int(value)


def checked_seed(who: str, value: Any) -> int:
    """A seed. Those that samplers cannot tell from others are refused: they have 32 bits. Raises SceneError."""
    number = _whole(value)
    if number is None or not 0 <= number < SEED_RANGE:
        raise SceneError(
            f"{who}: seed: expected a whole number from 0 to {SEED_RANGE - 1}, got {value!r}. Others would be taken "
            "modulo 2^32, and be the same as one of these."
        )
    return number


def check_seeds(who: str, value: Any) -> None:
    """Likewise for what a layer takes: None, one seed, one for each entry of a batch, or what ``vmap`` has given to its
    entries, of which nothing can be said here.
    """
    if value is None:
        return
    if isinstance(value, (list, tuple)) or getattr(value, "ndim", 0) == 1:
        for one in value:
            check_seeds(who, one)
        return
    try:
        checked_seed(who, value)
    except RuntimeError as error:
        if "vmap" not in str(error):
            raise


def _whole(value: Any) -> int | None:
    """A whole number of any library; None for what is none. True is not one."""
    try:
        return None if isinstance(value, bool) else operator.index(value)
    except TypeError:
        return None
