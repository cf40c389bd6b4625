"""Samples by number, and generators that belong to them: the same draws whoever reads a sample."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchtransient.checks import count, function, shown
from torchtransient.errors import UnitError


class Epochs:
    """A data set that knows which epoch it is read in; workers of a DataLoader that stay are told."""

    def __init__(self) -> None:
        self._epoch = torch.zeros((), dtype=torch.int64).share_memory_()  # type: ignore[no-untyped-call]

    @property
    def epoch(self) -> int:
        """The epoch whose draws are read by number."""
        return int(self._epoch)

    def set_epoch(self, epoch: int) -> None:
        """Choose the draws of ``seed`` of what is read from now on; call it before a loader is iterated over. Raises
        UnitError.
        """
        self._epoch.fill_(count(f"{type(self).__name__}: epoch", epoch, 0, UnitError))


def sample_number(what: str, number: Any, size: int) -> int:
    """The place of sample ``number`` of ``size``, counted from the end where it is negative. Raises IndexError, as
    loops over a data set expect it, for all others and for what is no whole number.
    """
    try:
        found = count(what, number, -size)
    except ValueError:
        found = size
    if not found < size:
        raise IndexError(f"{what}: expected a number from 0 to {size - 1}, got {shown(number)}.")
    return found % size


def outside_tensor(shares: Any) -> Tensor:
    """(2,) float64: shares of a sample's light before and after the window."""
    return torch.tensor([float(share) for share in shares], dtype=torch.float64)


def checked_seed(what: str, seed: Any) -> int | None:
    """A seed from zero on, or None. Raises UnitError."""
    return None if seed is None else count(f"{what}: seed", seed, 0, UnitError, None)


def sample_generator(what: str, seed: int | None, number: int, epoch: Any = None, *more: int) -> torch.Generator | None:
    """The generator of one sample in one epoch, None being 0; none without a seed. Raises UnitError for others."""
    places = [] if epoch is None else [count(f"{what}: epoch", epoch, 0, UnitError)]
    if seed is None:
        return None
    key = np.random.SeedSequence([seed, number, *places, *more])
    return torch.Generator().manual_seed(int(key.generate_state(1, np.uint64)[0] >> np.uint64(1)))


def checked_transform(what: str, transform: Any) -> Callable[..., Any] | None:
    """A function of transients, or None. Raises ArgumentError."""
    return None if transform is None else function(f"{what}: transform", transform, "transients, as sensors are")


def takes_generator(transform: Any) -> bool:
    """Whether a transform can draw from a generator that it is given."""
    called = transform.forward if isinstance(transform, torch.nn.Module) else transform
    try:
        return "generator" in inspect.signature(called).parameters
    except (TypeError, ValueError):
        return False


def transformed(transform: Callable[..., Any], transient: Tensor, generator: torch.Generator | None) -> Any:
    """What a transform makes of a transient, without gradients; ``generator``: None for torch's own."""
    with torch.no_grad():
        return transform(transient) if generator is None else transform(transient, generator=generator)
