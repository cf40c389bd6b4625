"""Checks of the arguments of renderers: values and settings."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import torch
from torch import nn
from torch.nn.utils import parametrize

from torchtransient.checks import as_whole, is_one_of, shown, text
from torchtransient.errors import ArgumentError, ShapeError, UnitError, UnknownKeyError
from torchtransient.rendering.films import FilmLayout, film_of_arguments
from torchtransient.scene.parameters import unknown_key
from torchtransient.scene.values import as_float, fit_shape

# What samplers count with has 32 bits, and a depth of all ones stands for no limit.
MOST_SAMPLES, MOST_DEPTH = 2**32 - 1, 2**32 - 2
TEMPORAL_FILTERS = ("auto", "box", "tent", "gaussian")


def checked_samples(name: str, value: int | None) -> int | None:
    """Return a number of samples per pixel, or None.

    Args:
        name: name of the argument, for messages.
        value: the argument of a user.

    Raises:
        UnitError: for anything but a positive whole number of at most ``MOST_SAMPLES``, or None.
    """
    if value is None:
        return None
    number = as_whole(value)
    if number is None or number < 1:
        raise UnitError(f"{name}: expected a positive integer or None, got {shown(value)}.")
    if number > MOST_SAMPLES:
        raise UnitError(
            f"{name}: expected at most {MOST_SAMPLES} samples, got {shown(value)}. Average several renders of "
            "different seeds."
        )
    return number


def checked_depth(value: Any) -> int | None:
    """Return a ``max_depth``, or None.

    Args:
        value: the argument of a user.

    Raises:
        ArgumentError: for anything but a whole number from -1 (no limit) on, or None.
    """
    if value is None:
        return None
    number = as_whole(value)
    if number is None or not -1 <= number <= MOST_DEPTH:
        raise ArgumentError(
            f"max_depth: expected an integer of at least -1 (no limit) and at most 2^32 - 2, got {shown(value)}."
        )
    return number


def checked_filter(name: str) -> str:
    """Return the name of a temporal filter, or "auto".

    Args:
        name: the argument of a user.

    Raises:
        ArgumentError: for other values.
    """
    if not is_one_of(name, TEMPORAL_FILTERS):
        raise ArgumentError(f"temporal_filter: expected one of {', '.join(TEMPORAL_FILTERS)}, got {shown(name)}.")
    return name


def checked_sampler(name: Any) -> str | None:
    """Return the plugin name of a sampler, "scene", or None.

    Args:
        name: the argument of a user.

    Raises:
        ArgumentError: for other types.
    """
    return None if name is None else text("sampler", name, "the plugin name of a sampler, 'scene', or None")


def checked_keys(keys: Any, known: Sequence[str] | None = None) -> tuple[str, ...]:
    """Return keys of parameters as a tuple.

    Args:
        keys: list of keys, or mapping from them.
        known: keys of the renderer, None to leave unknown ones to the scene.

    Raises:
        ArgumentError: for a text and for values without a length.
        UnknownKeyError: for keys that are not among ``known``.
    """
    with contextlib.suppress(TypeError):
        if not isinstance(keys, (str, bytes)):
            found = tuple(keys)
            unknown = [key for key in found if known is not None and not is_one_of(key, known)]
            if unknown:
                raise UnknownKeyError(unknown_key(str(unknown[0]), list(known or ()), "the renderer"))
            return found
    got = f"a string; write [{keys!r}]" if isinstance(keys, str) else shown(keys)
    raise ArgumentError(f"parameters: expected a list of keys, got {got}.")


def checked_grad_seed(value: int | str | None) -> int | str | None:
    """Return a seed of derivatives: None, "same" or an integer.

    Args:
        value: the argument of a user.

    Raises:
        ArgumentError: for other values.
    """
    if value is None or (isinstance(value, str) and value == "same"):
        return value
    number = as_whole(value)
    if number is None:
        raise ArgumentError(f"grad_seed: expected None, 'same' or an integer, got {shown(value)}.")
    return number


def sensor_list(sensors: int | Sequence[int] | str, count: int) -> tuple[tuple[int, ...], bool]:
    """Return the indices of the sensors to render.

    Args:
        sensors: an index, several, or "all".
        count: number of sensors of the scene.

    Returns:
        The indices, not checked against ``count``, and True if outputs have a dimension of sensors.

    Raises:
        ArgumentError: for other values.
    """
    if isinstance(sensors, str) and sensors == "all":
        return tuple(range(count)), True
    array = getattr(sensors, "ndim", None) == 1
    if not array and (number := as_whole(sensors)) is not None:
        return (number,), False
    given: Any = sensors
    listed = array or (isinstance(given, Sequence) and not isinstance(given, (str, bytes)))
    indices = [as_whole(sensor) for sensor in given] if listed else []
    whole = tuple(index for index in indices if index is not None)
    if not whole or len(whole) < len(indices):
        raise ArgumentError(f"sensors: expected an index, a list of indices or 'all', got {shown(sensors)}.")
    return whole, True


def torch_names(keys: Sequence[str]) -> dict[str, str]:
    """Return names that torch allows for parameters, by key: slashes in place of dots.

    Args:
        keys: keys of parameters.

    Raises:
        ArgumentError: for keys that are given twice, or would have one name.
    """
    names = {key: key.replace(".", "/") for key in keys}
    if len(set(names.values())) != len(keys):
        raise ArgumentError(
            f"parameters: every key once, and no two keys that differ only in '.' and '/', got {list(keys)}."
        )
    return names


def requested_film(film: Any, named: Mapping[str, Any]) -> FilmLayout | None:
    """Return the film of a call, None to keep the scene's.

    Args:
        film: the argument ``film``: a layout, or None.
        named: the arguments that choose a film by its settings (``time_axis``, ``frequencies``, ``gates``).

    Raises:
        ArgumentError: for several films, and for other objects.
    """
    found = film_of_arguments(named)
    if film is None:
        return found
    if found is not None:
        raise ArgumentError(f"film, {', '.join(named)}: a film measures one thing; give one of them.")
    if not isinstance(film, FilmLayout):
        raise ArgumentError(
            f"film: expected a film such as Histogram(axis) of torchtransient.rendering.films, got {film!r}."
        )
    return film


def checked_values(values: Any) -> dict[str, Any]:
    """Return the values of a call by key.

    Args:
        values: the argument of a user.

    Raises:
        ArgumentError: for anything but a mapping, most likely a seed.
    """
    if values is not None and not isinstance(values, Mapping):
        raise ArgumentError(
            f"values: expected a mapping from keys to values, got {type(values).__name__}; write {{key: value}}, and a "
            "seed as seed=0."
        )
    return dict(values or {})


class Values(Mapping[str, nn.Parameter]):
    """Parameters of a renderer by their Mitsuba keys. Setting one writes into it, as ``load_state_dict`` does.

    The value of a key with a parametrization is computed at each access: setting it writes the numbers behind it, and
    operations in place on it (``clamp_``, ``fill_``, ``copy_``) are lost.

    Args:
        module: the renderer.
        names: name of the torch parameter of each key.
    """

    def __init__(self, module: nn.Module, names: Mapping[str, str]):
        self._module, self._names = module, names

    def __getitem__(self, key: str) -> nn.Parameter:
        if key not in self._names:
            raise UnknownKeyError(
                f"this renderer has no parameter {key!r}; it was made with parameters={list(self._names)}. Keys are "
                "given to TransientRenderer(..., parameters=[...])."
            )
        found: nn.Parameter = getattr(self._module, self._names[key])
        return found

    def __setitem__(self, key: str, value: Any) -> None:
        parameter = self[key]
        given, batched = fit_shape(key, as_float(key, value, parameter.device.type), tuple(parameter.shape))
        if batched:
            raise ShapeError(
                f"value of {key!r}: expected shape {tuple(parameter.shape)}, got {tuple(given.shape)}: a parameter has "
                "no batch; pass batches to the call, renderer({key: values})."
            )
        with torch.no_grad():
            if parametrize.is_parametrized(self._module, self._names[key]):
                setattr(self._module, self._names[key], given)  # torch's property: the numbers behind it
            else:
                parameter.copy_(given)

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)

    def __repr__(self) -> str:
        return repr(dict(self))
