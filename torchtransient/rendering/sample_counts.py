"""Numbers of samples per pixel that samplers round, as stratified ones do."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

from torchtransient.errors import TorchTransientWarning
from torchtransient.rendering.interrupts import quiet
from torchtransient.rendering.physics import level_of_user


class SampleCounts(dict[int, int]):
    """Numbers that a sampler takes, by those that are asked for."""

    def of(self, asked: int, taken: Callable[[int], int]) -> int:
        """The number for one that is asked for, with a warning at the first time that it is another one. ``taken``
        asks the sampler.
        """
        if asked not in self:
            self[asked] = taken(asked)
            if self[asked] != asked:
                warnings.warn(
                    f"spp={asked} is rounded to {self[asked]}, a number of samples that the scene's sampler can draw.",
                    TorchTransientWarning,
                    stacklevel=level_of_user(),
                )
        return self[asked]


def samples_taken(sampler: Any, count: int | None) -> int:
    """Set a sampler's number of samples, None for its own, and return what it has made of it. Mitsuba's message that
    it rounds is held back: it comes at every call. Under the engine lock.
    """
    with quiet():
        if count is not None:
            sampler.set_sample_count(count)
    return int(sampler.sample_count())
