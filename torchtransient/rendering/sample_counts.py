"""Numbers of samples per pixel that samplers round, as stratified ones do."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

from torchtransient.errors import TorchTransientWarning, level_of_user
from torchtransient.rendering.interrupts import quiet


def rounded_count(asked: int, known: dict[int, int], drawn: Callable[[int], int]) -> int:
    """Return the number of samples that a sampler draws for one that is asked for, with a warning at the first time
    that it is another one. ``known``: numbers that were found before, to which this one is added; ``drawn`` asks the
    sampler.
    """
    if asked not in known:
        known[asked] = drawn(asked)
        if known[asked] != asked:
            warnings.warn(
                f"spp={asked} is rounded to {known[asked]}, a number of samples that the scene's sampler can draw.",
                TorchTransientWarning,
                stacklevel=level_of_user(),
            )
    return known[asked]


def samples_taken(sampler: Any, count: int | None) -> int:
    """Set a sampler's number of samples, None for its own, and return what it has made of it. Mitsuba's message that
    it rounds is held back: it comes at every call. Under the engine lock.
    """
    with quiet():
        if count is not None:
            sampler.set_sample_count(count)
    return int(sampler.sample_count())
