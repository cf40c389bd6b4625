"""The seeds of a call: one number, one for each batch entry, or what ``torch.func.vmap`` has given to its entries."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass
from typing import Any

import torch

from torchtransient.checks import as_whole, shown
from torchtransient.errors import ShapeError, TorchTransientWarning, UnitError, level_of_user

SEED_RANGE = 2**32


@dataclass(frozen=True)
class Item:
    """One film to fill: which entry of the batch, which sensor, with which seeds."""

    entry: int
    sensor: int
    seed: int
    grad_seed: int


@dataclass(frozen=True)
class Seeding:
    """Which films a call fills, and how their seeds follow from that of the call.

    ``entries``: size of the batch. ``grad_seed``: as that of the renderer.
    """

    sensors: tuple[int, ...]
    entries: int
    grad_seed: int | str | None

    def items(self, seed: Any) -> tuple[Item, ...]:
        """One item for each entry and sensor. ``seed``: a whole number, or one for each entry."""
        per_entry = len(self.sensors)
        if (number := whole_number(seed)) is not None:
            _say_what_counts([number])
            seeds = [mix_seed(number, n) for n in range(self.entries * per_entry)]
        else:
            given = [_each_number(one) for one in seed]
            if len(given) != self.entries:
                raise ShapeError(
                    f"seed: expected one integer, or one for each of {self.entries} batch entries, got {len(given)}."
                )
            _check_apart(given)
            _say_what_counts(given)
            seeds = [mix_seed(s, n) for s in given for n in range(per_entry)]
        return tuple(
            Item(n // per_entry, self.sensors[n % per_entry], value, self._of_gradient(value, n))
            for n, value in enumerate(seeds)
        )

    def _of_gradient(self, seed: int, number: int) -> int:
        if self.grad_seed == "same":
            return seed
        if isinstance(self.grad_seed, int):
            return mix_seed(self.grad_seed, number)
        return mix_seed(seed, 0x5EED)


def _say_what_counts(seeds: list[int]) -> None:
    """Warn of seeds that count as others."""
    beyond = [seed for seed in seeds if not 0 <= seed < SEED_RANGE]
    if beyond:
        warnings.warn(
            f"seed: expected whole numbers from 0 to 2^32 - 1, got {shown(beyond[0])}, which counts as "
            f"{beyond[0] % SEED_RANGE}: seeds count modulo 2^32.",
            TorchTransientWarning,
            stacklevel=level_of_user(),
        )


def _check_apart(seeds: list[int]) -> None:
    """Raise UnitError for seeds that are not the same and count as the same: their renders would have one noise."""
    seen: dict[int, int] = {}
    for seed in seeds:
        other = seen.setdefault(seed % SEED_RANGE, seed)
        if other != seed:
            raise UnitError(f"seed: {other} and {seed} are one seed: seeds count modulo 2^32. Take others.")


def drawn(seed: int | Sequence[int] | torch.Tensor | None) -> tuple[Any, torch.Tensor | None]:
    """The seed of a call as (seed, None), or as (None, tensor) where ``vmap`` has one for each of its entries.

    None draws from torch's generator, under ``vmap`` as its ``randomness`` says. Raises ``UnitError`` where that is
    "error", as it is unless something else is asked for.
    """
    if seed is None:
        try:
            seed = torch.randint(0, SEED_RANGE, (), dtype=torch.int64)
        except RuntimeError as error:
            if "randomness" not in str(error):
                raise
            raise UnitError(
                "seed: under torch.func.vmap a render without a seed would draw random numbers for all entries. Pass "
                "seed=..., which every entry uses, or say what is meant: vmap(..., randomness='same') draws one seed "
                "for all entries, randomness='different' one for each."
            ) from error
    if not isinstance(seed, torch.Tensor) or seed.ndim != 0 or seed.is_floating_point() or seed.dtype == torch.bool:
        return seed, None
    try:
        return int(seed.item()), None
    except RuntimeError:
        # Its number differs from entry to entry of a `vmap`: the autograd function takes it apart.
        return None, seed


def whole_number(seed: Any) -> int | None:
    """A seed as one number; None for a sequence of them. Raises ``UnitError`` for what is neither."""
    number = as_whole(seed)
    if number is not None:
        return number
    try:
        several = len(seed) >= 0 and not isinstance(seed, (str, bytes, Mapping, Set))
    except TypeError:
        several = False
    if not several:
        raise UnitError(f"seed: expected a whole number, or one for each batch entry, got {shown(seed)}.")
    return None


def _each_number(seed: Any) -> int:
    number = as_whole(seed)
    if number is None:
        raise UnitError(f"seed: expected whole numbers, one for each batch entry, got {shown(seed)} among them.")
    return number


def mix_seed(seed: int, number: int) -> int:
    """A 32-bit seed that looks unrelated to ``seed``; 0 leaves it as it is (a splitmix64 step, Steele et al. 2014)."""
    if number == 0:
        return seed % SEED_RANGE
    z = (seed + number * 0x9E3779B97F4A7C15) % 2**64
    z = ((z ^ (z >> 30)) * 0xBF58476D1CE4E5B9) % 2**64
    z = ((z ^ (z >> 27)) * 0x94D049BB133111EB) % 2**64
    return (z ^ (z >> 31)) % SEED_RANGE
