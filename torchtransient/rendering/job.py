"""Job of a call: all its settings but the tensors; seeds and numbers of samples."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from typing import Any

import torch

from torchtransient.checks import as_whole, shown
from torchtransient.errors import ShapeError, TorchTransientWarning, UnitError, level_of_user
from torchtransient.rendering.error_bars import BatchErrors
from torchtransient.scene.edits import BuildOptions
from torchtransient.scene.load import Scene
from torchtransient.scene.physics import PhysicsWatch
from torchtransient.scene.pilot import DepthBound
from torchtransient.scene.variant import quiet

SEED_RANGE = 2**32


@dataclass(frozen=True)
class Item:
    """One film to fill.

    Args:
        entry: entry of the batch.
        sensor: index of the sensor.
        seed, grad_seed: seeds of the render and of its derivatives.
    """

    entry: int
    sensor: int
    seed: int
    grad_seed: int


@dataclass(frozen=True)
class Seeding:
    """Films of a call, and how their seeds follow from the call's.

    Args:
        sensors: indices of the sensors.
        entries: size of the batch.
        grad_seed: seed of derivatives, as the renderer takes it.
    """

    sensors: tuple[int, ...]
    entries: int
    grad_seed: int | str | None

    def items(self, seed: Any) -> tuple[Item, ...]:
        """Return one item for each entry and sensor.

        Args:
            seed: a whole number, or one for each entry.
        """
        per_entry = len(self.sensors)
        if (number := whole_number(seed)) is not None:
            warn_of_range([number])
            seeds = [mix_seed(number, n) for n in range(self.entries * per_entry)]
        else:
            given = [_each_number(one) for one in seed]
            if len(given) != self.entries:
                raise ShapeError(
                    f"seed: expected one integer, or one for each of {self.entries} batch entries, got {len(given)}."
                )
            _check_distinct(given)
            warn_of_range(given)
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


@dataclass(frozen=True)
class RunLog:
    """Report of one render, item by item.

    Args:
        items: films that were filled.
        seconds: wall time.
        integrator: plugin name.
        spp: samples per pixel that were drawn.
        energy_before, energy_after: light before and after the window.
        energy_total: all light.
        recorded: how each call was made: launched, recorded, or the reason why it was traced.
        max_depth: bound on the depth of the integrator's paths, -1 for no limit, None for an integrator without one.
        sampler: plugin name.
    """

    items: tuple[Item, ...]
    seconds: float
    integrator: str
    spp: int
    energy_before: tuple[float, ...]
    energy_after: tuple[float, ...]
    energy_total: tuple[float, ...]
    recorded: tuple[str, ...]
    max_depth: int | None = None
    sampler: str = ""


@dataclass(frozen=True)
class RenderJob:
    """Settings of a call: everything but its tensors. Immutable but for ``at_call`` and the two logs.

    Args:
        scene, options, keys: the scene, options of its build, and keys of the values.
        items: films to fill, empty where the seed is known later; ``seeding`` makes them then.
        batched: truth value of each key, whether its tensor has a leading batch dimension.
        spp, spp_grad: samples per pixel of the render and of its derivatives.
        temporal_filter: temporal filter of the films; None for the scene's.
        watch: warns of unphysical values.
        needs: truth value of each key, whether a derivative by its tensor is wanted.
        bound: bound on the depth; None for the scene's.
        boundary, spp_boundary: whether derivatives have the boundary term, and its samples per pixel; None for the
            integrator's.
        sampler: plugin name, "scene" or "auto"; None for the integrator's, or "auto".
        progress: called with the fraction that is done.
        freeze: whether calls are recorded.
        errors: request for error bars, and where they are put; None for none.
        at_call: values of a shared scene at the call.
        log: a report of each render; under ``vmap`` a call is several.
        derivative_log: how the calls of its derivatives were made.
    """

    scene: Scene
    options: BuildOptions
    keys: tuple[str, ...]
    items: tuple[Item, ...]
    seeding: Seeding
    batched: tuple[bool, ...]
    spp: int
    spp_grad: int
    temporal_filter: str | None
    watch: PhysicsWatch
    needs: tuple[bool, ...] = ()
    bound: DepthBound | None = None
    boundary: bool = True
    spp_boundary: int | None = None
    sampler: str | None = None
    progress: Callable[[float], None] | None = None
    freeze: bool = True
    errors: BatchErrors | None = None
    at_call: list[Mapping[str, Any]] = field(default_factory=list)
    log: list[RunLog] = field(default_factory=list)
    derivative_log: list[str] = field(default_factory=list)

    def seeded(self, seed: torch.Tensor | None) -> RenderJob:
        """Return the job with the items of a seed that is known inside of ``vmap`` only; itself for None."""
        return self if seed is None else replace(self, items=self.seeding.items(int(seed.item())))


# ------------------------------------------------------------------------------------------------------------ seeds


def warn_of_range(seeds: list[int]) -> None:
    """Warn of seeds that count as others.

    Args:
        seeds: seeds of a call.
    """
    beyond = [seed for seed in seeds if not 0 <= seed < SEED_RANGE]
    if beyond:
        warnings.warn(
            f"seed: expected whole numbers from 0 to 2^32 - 1, got {shown(beyond[0])}, which counts as "
            f"{beyond[0] % SEED_RANGE}: seeds count modulo 2^32.",
            TorchTransientWarning,
            stacklevel=level_of_user(),
        )


def _check_distinct(seeds: list[int]) -> None:
    """Raise UnitError for seeds that are not the same and count as the same: their renders would have one noise."""
    seen: dict[int, int] = {}
    for seed in seeds:
        other = seen.setdefault(seed % SEED_RANGE, seed)
        if other != seed:
            raise UnitError(f"seed: {other} and {seed} are one seed: seeds count modulo 2^32. Take others.")


def draw_seed(seed: int | Sequence[int] | torch.Tensor | None) -> tuple[Any, torch.Tensor | None]:
    """Return the seed of a call, drawn from torch's generator for None.

    Args:
        seed: one seed, one for each batch entry, or None; under ``vmap`` None follows its ``randomness``.

    Returns:
        (seed, None), or (None, tensor) where ``vmap`` has a seed for each of its entries.

    Raises:
        UnitError: for None under ``vmap`` with ``randomness="error"``, its default.
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
    """Return a seed as one number; None for a sequence.

    Args:
        seed: the argument of a user.

    Raises:
        UnitError: for anything else.
    """
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
    """Return a 32-bit seed that looks unrelated to ``seed``; for number 0 ``seed`` itself, modulo 2^32.

    Args:
        seed: seed of a call.
        number: number of the stream.

    A step of splitmix64 (Steele et al. 2014).
    """
    if number == 0:
        return seed % SEED_RANGE
    z = (seed + number * 0x9E3779B97F4A7C15) % 2**64
    z = ((z ^ (z >> 30)) * 0xBF58476D1CE4E5B9) % 2**64
    z = ((z ^ (z >> 27)) * 0x94D049BB133111EB) % 2**64
    return (z ^ (z >> 31)) % SEED_RANGE


# ------------------------------------------------------------------------------------------------ numbers of samples


def rounded_count(spp: int, known: dict[int, int], count: Callable[[int], int]) -> int:
    """Return the number of samples that a sampler draws for ``spp``, and warn once where it differs.

    Args:
        spp: samples per pixel that are asked for.
        known: numbers that were found before, by ``spp``; this one is added.
        count: function of ``spp`` that asks the sampler.
    """
    if spp not in known:
        known[spp] = count(spp)
        if known[spp] != spp:
            warnings.warn(
                f"spp={spp} is rounded to {known[spp]}, a number of samples that the scene's sampler can draw.",
                TorchTransientWarning,
                stacklevel=level_of_user(),
            )
    return known[spp]


def samples_drawn(sampler: Any, count: int | None) -> int:
    """Set a sampler's number of samples, None for its own, and return the number that it draws.

    Args:
        sampler: built sampler.
        count: samples per pixel, or None.

    Mitsuba's message that it rounds is held back: it comes at every call. Under the engine lock.
    """
    with quiet():
        if count is not None:
            sampler.set_sample_count(count)
    return int(sampler.sample_count())
