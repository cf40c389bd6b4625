"""Recipes as plain data: what JSON and YAML can hold, and back.

A distribution is a mapping of its name alone: ``{uniform: {low: 0.05, high: 0.9}}``, or shorter ``{uniform: [0.05,
0.9]}``. Arrays of up to 64 numbers are nested lists; larger ones, pixels and grids are their bytes in base64.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping
from dataclasses import asdict
from dataclasses import fields as entries_of
from typing import Any

import numpy as np
import torch

from torchtransient.axes import FrequencyAxis, TimeAxis
from torchtransient.capture import Scan
from torchtransient.checks import short_message, shown
from torchtransient.data.recipes import distributions as distributions
from torchtransient.data.recipes import poses as poses
from torchtransient.data.recipes.distribution import Distribution
from torchtransient.errors import SceneError
from torchtransient.files.plain_data import plain, restored, scan_data, scan_from_data
from torchtransient.gates import Gate
from torchtransient.plugins.dictionaries import Pixels, Voxels
from torchtransient.pulses import Pulse

_MOST_LISTED = 64
# Keys of mappings that stand for what JSON does not have.
_PIXELS, _VOXELS, _SCAN, _DISTRIBUTION = "__pixels__", "__voxels__", "__scan__", "__distribution__"


def written(value: Any) -> Any:
    """Plain data for numbers, texts, lists, mappings, arrays, transforms, pixels, scans and distributions. Raises
    SceneError for other things.
    """
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, Distribution):
        value.check_kind()
        return {value.name: {name: written(entry) for name, entry in value.entries().items()}}
    if isinstance(value, Mapping):
        return {str(name): written(entry) for name, entry in value.items()}
    if isinstance(value, Pixels):
        said = {"pixel_format": value.pixel_format} if value.pixel_format else {}
        return {_PIXELS: plain(value.values, None, "pixels"), "srgb_gamma": value.srgb_gamma, **said}
    if isinstance(value, Voxels):
        return {_VOXELS: base64.b64encode(value.file).decode("ascii"), "maximum": value.maximum}
    if isinstance(value, Scan):
        return {_SCAN: scan_data(value)}
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, list | tuple | range):
        return [written(entry) for entry in value]
    if isinstance(value, torch.Tensor):
        value = value.detach().cpu().numpy()
    array = np.asarray(getattr(value, "matrix", value))
    if array.dtype.kind not in "biufc":
        raise SceneError(f"recipe: expected numbers, texts, lists, mappings or arrays, got {shown(value)}.")
    if array.size <= _MOST_LISTED and array.dtype.kind != "c":
        return array.tolist()
    return plain(array, None, "recipe")


def read(value: Any) -> Any:
    """What :func:`written` made plain data of; lists stay lists."""
    if isinstance(value, Mapping):
        if _PIXELS in value:
            pixels, gamma = restored(dict(value[_PIXELS]), {}), bool(value.get("srgb_gamma", False))
            return Pixels(pixels, gamma, str(value.get("pixel_format", "")))
        if _VOXELS in value:
            return Voxels(base64.b64decode(value[_VOXELS]), float(value["maximum"]))
        if set(value) == {_SCAN}:
            return scan_from_data(value[_SCAN])
        if set(value) == {"__numbers__", "dtype", "shape"}:
            return restored(dict(value), {})
        return {name: read(entry) for name, entry in value.items()}
    return [read(entry) for entry in value] if isinstance(value, list) else value


def read_distribution(where: str, value: Any) -> Distribution:
    """A distribution from its plain form, or itself. Raises SceneError that says what is known."""
    if isinstance(value, Distribution):
        value.check_kind()
        return value
    known = ", ".join(Distribution.known)
    if not isinstance(value, Mapping) or len(value) != 1:
        raise SceneError(
            f"{where}: expected a distribution, tt.data.Uniform(0, 1) or {{uniform: [0, 1]}} for instance, got "
            f"{shown(value)}. Known ones are {known}."
        )
    name, given = next(iter(value.items()))
    made = Distribution.known.get(str(name))
    if made is None:
        raise SceneError(
            f"{where}: unknown distribution {name!r}. Known ones are {known}; one of your own is known once its module "
            "is imported."
        )
    fields = [entry.name for entry in entries_of(made)]
    if isinstance(given, Mapping):
        arguments = {str(entry): content for entry, content in given.items()}
    elif len(made.short) == 1:
        arguments = {made.short[0]: given}
    elif isinstance(given, list) and len(given) == len(made.short):
        arguments = dict(zip(made.short, given, strict=True))
    else:
        wanted = f"[{', '.join(made.short)}] or a mapping of {', '.join(fields)}"
        raise SceneError(f"{where}: {name}: expected {wanted}, got {shown(given)}.")
    unknown = [entry for entry in arguments if entry not in fields]
    if unknown:
        raise SceneError(f"{where}: {name}: unknown entry {shown(unknown[0])}. Known ones are {', '.join(fields)}.")
    nested = {entry: _nested(f"{where}: {name}", content) for entry, content in arguments.items()}
    try:
        return made(**nested)
    except TypeError as error:
        raise SceneError(f"{where}: {name}: {short_message(error)}. Its entries are {', '.join(fields)}.") from error


def _nested(where: str, content: Any) -> Any:
    """Distributions inside of others: mappings of the name of one alone."""
    if isinstance(content, Mapping) and len(content) == 1 and next(iter(content)) in Distribution.known:
        return read_distribution(where, content)
    if isinstance(content, list) and any(isinstance(entry, Mapping | list) for entry in content):
        return [_nested(where, entry) for entry in content]
    return read(content)


def written_axis(axis: TimeAxis | None) -> dict[str, Any] | None:
    """A time axis as its three numbers."""
    return None if axis is None else asdict(axis)


def written_frequencies(axis: FrequencyAxis | None) -> dict[str, Any] | None:
    """Frequencies in cycles per metre, and their start."""
    if axis is None:
        return None
    return {"per_metre": [float(number) for number in axis.per_metre], "start_opl": axis.start_opl}


def read_frequencies(data: Any) -> FrequencyAxis | None:
    """What :func:`written_frequencies` made, or a list of cycles per metre."""
    if data is None or isinstance(data, FrequencyAxis):
        return data
    if isinstance(data, Mapping):
        return FrequencyAxis(tuple(data["per_metre"]), data.get("start_opl", 0.0))
    return FrequencyAxis(tuple(data))


def written_shape(shape: Gate | Pulse | None) -> dict[str, Any] | None:
    """A gate or a pulse as its fields."""
    return None if shape is None else asdict(shape)


def read_pulse(data: Any) -> Pulse | None:
    """What :func:`written_shape` made of a pulse."""
    return Pulse(**_tuples(data)) if isinstance(data, Mapping) else data


def read_gate(data: Any) -> Gate:
    """What :func:`written_shape` made of a gate."""
    return Gate(**_tuples(data)) if isinstance(data, Mapping) else data


def _tuples(data: Mapping[str, Any]) -> dict[str, Any]:
    return {name: tuple(entry) if isinstance(entry, list) else entry for name, entry in data.items()}
