"""Checks of what captures are asked for with: counts, samples and seeds, the same for every route to a capture."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import torch
from torch import nn

from torchtransient.checks import as_whole, shown
from torchtransient.errors import ArgumentError, SceneError
from torchtransient.rendering.job import SEED_RANGE, draw_seed
from torchtransient.sensing import Device


def checked_seed(who: str, value: Any) -> int:
    """A seed. Those that samplers cannot tell from others are refused: they have 32 bits. Raises ArgumentError."""
    number = as_whole(value)
    if number is None or not 0 <= number < SEED_RANGE:
        raise ArgumentError(
            f"{who}: seed: expected a whole number from 0 to {SEED_RANGE - 1}, got {shown(value)}. Others would count "
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
    _, of_each_entry = draw_seed(value)
    if of_each_entry is None:
        checked_seed(who, value)


def check_sensor(who: str, sensor: Any, generator: Any = None) -> None:
    """Raise ArgumentError unless ``sensor`` can take a transient and ``generator`` draw its noise, or they are None."""
    if not isinstance(sensor, nn.Module | Device | None):
        raise ArgumentError(f"{who}: expected sensor as a module or device of tt.sensing, got {shown(sensor)}.")
    if not isinstance(generator, torch.Generator | None):
        raise ArgumentError(f"{who}: expected generator as a torch.Generator or None, got {shown(generator)}.")


def keys_and_values(who: str, name: str, given: Any) -> dict[str, Any]:
    """Parameters by key, of a mapping or a list of keys. Raises SceneError for what is neither."""
    listed = isinstance(given, Iterable) and not isinstance(given, (str, bytes)) and not hasattr(given, "dtype")
    keys = list(given) if listed else [given]
    if not listed or not all(isinstance(key, str) for key in keys):
        raise SceneError(f"{who}: {name}: expected keys of scene.parameters(), or values by key, got {shown(given)}.")
    return dict(given) if isinstance(given, Mapping) else dict.fromkeys(keys)

