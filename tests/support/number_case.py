"""One callable with right arguments, and how wrong ones are put in their place; things that they are made of."""

from __future__ import annotations

import contextlib
import functools
import inspect
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import torch

import torchtransient as tt
from support.capture_files import grids, made
from tools.small_room import make_room
from torchtransient.errors import TorchTransientError

# Right numbers of options that are None by default.
OPTIONS = {
    "dim": -3,
    "floor": 0.1,
    "dead_bins": 2.0,
    "creation_cost_opl": 0.5,
    "value_range": 20.0,
    "timeout_s": 10.0,
    "shard": (0, 1),
    "row": 3,
    "column": 1,
    "albedo": 0.5,
    "second_size": 0.3,
    "limits": (2.0, 3.0),
    "bounces": (3,),
    "noise_seed": 3,
    "margin": 0.01,
}


class Case:
    """``call(**given)`` with arguments in the place of those of ``base``; ``errors``: what wrong ones raise."""

    def __init__(self, call: Callable[..., Any], *places: Any, errors: Any = TorchTransientError, **base: Any) -> None:
        own = {p.name: p.default for p in inspect.signature(call).parameters.values()}
        self.call, self.places, self.errors = call, places, errors
        # Numbers that stand in the signature are right.
        self.base = {**{name: value for name, value in own.items() if is_number(value)}, **base}

    def __call__(self, **given: Any) -> Any:
        return self.call(*self.places, **{**self.base, **given})

    def number(self, argument: str) -> Any:
        """The number of the base; of several the first; None for none."""
        value = self.base.get(argument)
        value = OPTIONS.get(argument) if value is None else value
        while isinstance(value, list | tuple) and value:
            value = value[0]
        return value if is_number(value) else None

    def in_place(self, argument: str, number: Any) -> Any:
        """Another number, among the others where there are several."""
        value = self.base.get(argument)
        return _replaced(OPTIONS.get(argument) if value is None else value, number)


def _replaced(value: Any, number: Any) -> Any:
    if isinstance(value, list | tuple):
        return type(value)([_replaced(value[0], number), *value[1:]])
    return number


def is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


@functools.cache
def capture(kind="confocal", size=(4, 4)):
    return made(grids(size=size)[kind], axis=tt.TimeAxis(2.0, 0.2, 32))


@functools.cache
def folder() -> Path:
    return Path(tempfile.mkdtemp())


@functools.cache
def recipe():
    return tt.data.Recipe(make_room(), vary={"box.bsdf.reflectance.value": tt.data.Uniform(0.1, 0.9)}, spp=1)


class Table:
    """A data set of four samples."""

    def __len__(self):
        return 4

    def __getitem__(self, number):
        return {"transient": torch.ones(1, 8, 4, 4), "index": number}


class Stream(torch.utils.data.IterableDataset):
    """Of the same."""

    def __iter__(self):
        return iter([Table()[n] for n in range(4)])


def noisy(x, generator=None):
    """As a sensor."""
    return x


def capture_volume():
    grid = tt.nlos.VoxelGrid.before(capture().scan, [0.8, 0.9, 1.0], size=3)
    return tt.nlos.HiddenVolume(torch.rand(1, 3, 3, 3), grid, "fk")


class _EnoughError(Exception):
    """All numbers were checked."""


def until(place: str, function: Callable[..., Any]) -> Callable[..., Any]:
    """A function that ends where it calls the one at ``place``."""

    @functools.wraps(function)
    def checked(*arguments: Any, **given: Any) -> None:
        with mock.patch(place, side_effect=_EnoughError), contextlib.suppress(_EnoughError):
            function(*arguments, **given)

    return checked


def entered(context: Callable[..., Any]) -> Callable[..., Any]:
    """A context manager as a function that goes in and out."""

    @functools.wraps(context)
    def through(**given: Any) -> None:
        with context(**given):
            pass

    return through


def listed(generator: Callable[..., Any]) -> Callable[..., Any]:
    """A generator as a function that takes everything from it."""

    @functools.wraps(generator)
    def taken(*arguments: Any, **given: Any) -> list[Any]:
        return list(generator(*arguments, **given))

    return taken
