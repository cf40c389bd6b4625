"""The random numbers that a function draws by itself, drawn again when it is replayed."""

from __future__ import annotations

import random
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch


@dataclass(frozen=True)
class Generators:
    """States of the generators that everybody shares: torch's of the CPU, NumPy's old one, Python's."""

    of_torch: torch.Tensor
    of_numpy: Any
    of_python: Any

    @classmethod
    def now(cls) -> Generators:
        """The present states."""
        return cls(torch.get_rng_state(), np.random.get_state(), random.getstate())  # noqa: NPY002

    def set(self) -> None:
        """Make these the present states."""
        torch.set_rng_state(self.of_torch)
        np.random.set_state(self.of_numpy)  # noqa: NPY002
        random.setstate(self.of_python)

    @contextmanager
    def again(self) -> Iterator[None]:
        """These states inside, and afterwards those that were there before."""
        before = Generators.now()
        try:
            self.set()
            yield
        finally:
            before.set()
