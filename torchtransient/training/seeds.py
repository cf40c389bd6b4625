"""Random numbers of a run as a function of its seed, the step and the sample, whoever computes them."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass

import torch

from torchtransient.checks import count
from torchtransient.errors import UnitError

_BITS = 2**32


@dataclass(frozen=True)
class Seeds:
    """Seeds of the renders of a run, and generators of its noise.

    They depend on the run's ``seed``, the step and the number of the sample, not on the rank, the number of ranks, the
    place in a batch or earlier draws: 1 and 2 ranks render the same sample with the same random numbers, and a run that
    is resumed at a step goes on as one that was not stopped. ::

        seeds = tt.training.Seeds(0)
        out = renderer(values, seed=seeds(step, batch["index"]))
        counts = sensor(out.transient, generator=seeds.generator(step, ranks.rank))

    Within a step, different numbers have different seeds, and equal ones the same: where a number can come twice in a
    step, give the samples' places in the batch (``Batches.places``) for their numbers. Seeds are a permutation of the
    32-bit numbers (Even and Mansour 1997, with the integer hash of C. Wellons), whose keys are a hash of seed and step
    (BLAKE2b). Between steps equal seeds are as rare as of random numbers, 2^-32 a pair.

    Args:
        seed: whole number from 0 on.
        purpose: tells apart several draws of a run, the two renders of an unbiased loss for instance:
            ``Seeds(0, "second render")``.

    Raises:
        UnitError: for other seeds.
    """

    seed: int
    purpose: str = "render"

    def __post_init__(self) -> None:
        object.__setattr__(self, "seed", count("Seeds: seed", self.seed, 0, UnitError, None))

    def __call__(self, step: int, samples: Iterable[int] | torch.Tensor) -> list[int]:
        """Return one seed for each sample, as ``renderer(..., seed=)`` takes them.

        Args:
            step: number of the step.
            samples: numbers in the data set from 0 to 2^32 - 1, or a tensor (B,) of them.

        Raises:
            UnitError: for other numbers.
        """
        first, second, third = self._keys(step)
        return [_permuted(_permuted(n ^ first) ^ second) ^ third for n in _numbers(samples)]

    def generator(self, step: int, sample: int = 0, device: torch.device | str = "cpu") -> torch.Generator:
        """Return a generator of torch for the other draws of a step, sensor noise for instance.

        Noise that one generator makes for a whole batch depends on how the batch is divided among ranks.

        Args:
            step: number of the step.
            sample: number of the one sample that it is for; or the rank, so that ranks draw different numbers.
            device: device of the generator.

        Raises:
            UnitError: for other numbers.
        """
        number = count("Seeds: sample", sample, 0, UnitError)
        digest = self._digest(step, f"generator/{number}")
        # torch takes 64 bits; the sign stays clear for what stores seeds as int64.
        return torch.Generator(device).manual_seed(int.from_bytes(digest[:8], "little") >> 1)

    def _keys(self, step: int) -> tuple[int, int, int]:
        digest = self._digest(step, "samples")
        first, second, third = (int.from_bytes(digest[n : n + 4], "little") for n in (0, 4, 8))
        return first, second, third

    def _digest(self, step: int, what: str) -> bytes:
        number = count("Seeds: step", step, 0, UnitError)
        return hashlib.blake2b(f"{self.seed}/{number}/{what}/{self.purpose}".encode(), digest_size=16).digest()


def _numbers(samples: Iterable[int] | torch.Tensor) -> list[int]:
    listed = samples.tolist() if isinstance(samples, torch.Tensor) else samples
    return [count("Seeds: sample", n, 0, UnitError, _BITS - 1) for n in listed]


def _permuted(x: int) -> int:
    """A permutation of the 32-bit numbers: `lowbias32` (C. Wellons 2018, "Prospecting for hash functions")."""
    x = ((x ^ (x >> 16)) * 0x7FEB352D) % _BITS
    x = ((x ^ (x >> 15)) * 0x846CA68B) % _BITS
    return x ^ (x >> 16)
