"""Recipes as plain data: what JSON and YAML can hold, and back.

A distribution is a mapping of its name alone: ``{uniform: {low: 0.05, high: 0.9}}``, or shorter ``{uniform: [0.05,
0.9]}``. Arrays of up to 64 numbers are nested lists; larger ones, and pixels, are their bytes in base64.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np
import torch

from torchtransient.axes import FrequencyAxis, TimeAxis
from torchtransient.capture import Scan
from torchtransient.data.recipes.distribution import Distribution
from torchtransient.data.recipes.distributions import Choice, LogUniform, Normal, Scale, Uniform
from torchtransient.data.recipes.poses import Compose, LookAt, Offset, Turn
from torchtransient.errors import SceneError
from torchtransient.files.plain_data import plain, restored
from torchtransient.gates import Gate
from torchtransient.pulses import Pulse
from torchtransient.quantities import shown
from torchtransient.render.description import Pixels

DISTRIBUTIONS: dict[str, type[Distribution]] = {
    made.name: made for made in (Uniform, LogUniform, Normal, Choice, Scale, Turn, Offset, LookAt, Compose)
}
_MOST_LISTED = 64
# Keys of mappings that stand for what JSON does not have.
_PIXELS, _SCAN, _DISTRIBUTION = "__pixels__", "__scan__", "__distribution__"
_POINTS = ("sensor_points", "laser_points", "sensor_origin", "laser_origin", "sensor_normals", "laser_normals")


def written(value: Any) -> Any:
    """Plain data for numbers, texts, lists, mappings, arrays, transforms, pixels, scans and distributions. Raises
    SceneError for other things.
    """
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, Distribution):
        return {value.name: {name: written(entry) for name, entry in value.entries().items()}}
    if isinstance(value, Mapping):
        return {str(name): written(entry) for name, entry in value.items()}
    if isinstance(value, Pixels):
        return {_PIXELS: plain(value.values, None, "pixels"), "srgb_gamma": value.srgb_gamma}
    if isinstance(value, Scan):
        return {_SCAN: written_scan(value)}
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


def read(value: Any, folder: Any = None) -> Any:
    """What :func:`written` made plain data of; lists stay lists. ``folder`` is not looked at."""
    if isinstance(value, Mapping):
        if _PIXELS in value:
            return Pixels(restored(dict(value[_PIXELS]), {}), bool(value.get("srgb_gamma", False)))
        if set(value) == {_SCAN}:
            return read_scan(value[_SCAN])
        if set(value) == {"__numbers__", "dtype", "shape"}:
            return restored(dict(value), {})
        return {name: read(entry, folder) for name, entry in value.items()}
    return [read(entry, folder) for entry in value] if isinstance(value, list) else value


def read_distribution(where: str, value: Any) -> Distribution:
    """A distribution from its plain form, or itself. Raises SceneError that says what is known."""
    if isinstance(value, Distribution):
        return value
    known = ", ".join(DISTRIBUTIONS)
    if not isinstance(value, Mapping) or len(value) != 1:
        raise SceneError(
            f"{where}: expected a distribution, {{uniform: [0, 1]}} for instance, got {shown(value)}. Known ones are "
            f"{known}."
        )
    name, given = next(iter(value.items()))
    made = DISTRIBUTIONS.get(str(name))
    if made is None:
        raise SceneError(f"{where}: unknown distribution {name!r}. Known ones are {known}.")
    fields = [entry for entry in made.__dataclass_fields__ if entry not in ("name", "short")]
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
        raise SceneError(f"{where}: {name}: unknown entry {unknown[0]!r}. Known ones are {', '.join(fields)}.")
    nested = {entry: _nested(f"{where}: {name}", entry, content) for entry, content in arguments.items()}
    try:
        return made(**nested)
    except TypeError as error:
        raise SceneError(f"{where}: {name}: {error}. Its entries are {', '.join(fields)}.") from error


def _nested(where: str, entry: str, content: Any) -> Any:
    """Distributions inside of others."""
    if entry == "steps" and isinstance(content, list):
        return [read_distribution(where, step) for step in content]
    if entry in ("origin", "target") and isinstance(content, Mapping):
        return read_distribution(where, content)
    return read(content)


def written_scan(scan: Scan) -> dict[str, Any]:
    """A scan with all its points, as plain data."""
    points = {name: getattr(scan, name) for name in _POINTS}
    return {
        "kind": scan.kind,
        "first_and_last_leg": scan.first_and_last_leg,
        "wall": plain(scan.wall, None, "wall"),
        **{name: plain(tensor, None, name) for name, tensor in points.items() if tensor is not None},
    }


def read_scan(data: Mapping[str, Any]) -> Scan:
    """What :func:`written_scan` made."""
    found = {name: restored(data[name], {}) for name in data}
    points = {name: torch.from_numpy(np.asarray(found[name])) for name in _POINTS if name in found}
    return Scan(
        str(found["kind"]), **points, first_and_last_leg=bool(found["first_and_last_leg"]), wall=found.get("wall")
    )


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
