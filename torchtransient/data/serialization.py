"""Recipes as plain data that JSON and YAML can hold, and the files that they name.

A distribution is a mapping of its name alone: ``{uniform: {low: 0.05, high: 0.9}}``, or shorter ``{uniform: [0.05,
0.9]}``. Arrays of up to 64 numbers are nested lists; larger ones, pixels and grids are their bytes in base64.
"""

from __future__ import annotations

import base64
import contextlib
import os
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from dataclasses import fields as entries_of
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch

from torchtransient.axes import FrequencyAxis
from torchtransient.capture import Scan
from torchtransient.checks import short_message, shown
from torchtransient.data import poses as poses
from torchtransient.data.distributions import Distribution
from torchtransient.errors import SceneError
from torchtransient.files.content_key import contents_of
from torchtransient.files.plain_data import plain, restored, scan_data, scan_from_data
from torchtransient.gates import Gate
from torchtransient.plugins.dictionaries import Pixels, Voxels
from torchtransient.pulses import Pulse
from torchtransient.scene.description import Plain, XmlDescription

_MOST_LISTED = 64
Record = TypeVar("Record", Pulse, Gate)
# Keys of mappings for values that JSON does not have.
_PIXELS, _VOXELS, _SCAN = "__pixels__", "__voxels__", "__scan__"


def written(value: Any) -> Any:
    """Return plain data for a value.

    Args:
        value: numbers, texts, lists, mappings, arrays, transforms, pixels, scans and distributions.

    Returns:
        Plain data.

    Raises:
        SceneError: for other values.
    """
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, Distribution):
        value.check_kind()
        return {value.name: {name: written(entry) for name, entry in value.entries().items()}}
    if isinstance(value, Mapping):
        return {str(name): written(entry) for name, entry in value.items()}
    if isinstance(value, Pixels):
        pixel_format = {"pixel_format": value.pixel_format} if value.pixel_format else {}
        return {_PIXELS: plain(value.values, None, "pixels"), "srgb_gamma": value.srgb_gamma, **pixel_format}
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
    """Restore a value from plain data; lists stay lists.

    Args:
        value: result of :func:`written`.

    Returns:
        The value.
    """
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
    """Restore a distribution.

    Args:
        where: key for messages.
        value: plain data or a distribution.

    Returns:
        Distribution.

    Raises:
        SceneError: for unknown names and entries.
    """
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


def record_fields(record: Any) -> Any:
    """Return the fields of an axis, a pulse, chirps, or of each of several gates.

    Args:
        record: dataclass, a row of such, or None.

    Returns:
        Fields by name, a list of such, or None.
    """
    if record is None:
        return None
    if isinstance(record, FrequencyAxis):
        return {"per_metre": [float(number) for number in record.per_metre], "start_opl": record.start_opl}
    return [asdict(one) for one in record] if isinstance(record, list | tuple) else asdict(record)


def read_record(kind: type[Record], data: Any) -> Record | None:
    """Restore a record from its fields.

    Args:
        kind: ``Pulse`` or ``Gate``.
        data: fields by name, a record, or None.

    Returns:
        The record, or None.
    """
    if not isinstance(data, Mapping):
        return data  # type: ignore[no-any-return]
    fields: dict[str, Any] = {name: tuple(entry) if isinstance(entry, list) else entry for name, entry in data.items()}
    return kind(**fields)


def read_frequencies(data: Any) -> FrequencyAxis | None:
    """Restore frequencies.

    Args:
        data: result of :func:`record_fields`, or a list of cycles per metre.

    Returns:
        Frequencies, or None.
    """
    if data is None or isinstance(data, FrequencyAxis):
        return data
    if isinstance(data, Mapping):
        return FrequencyAxis(tuple(data["per_metre"]), data.get("start_opl", 0.0))
    return FrequencyAxis(tuple(data))


# Most letters of a file's name.
_MOST_LETTERS = 1024
_DEEPEST = 16


def without_places(plain: Mapping[str, Any]) -> dict[str, Any]:
    """Return a recipe without the folders of its files: the same recipe elsewhere is equal.

    Args:
        plain: plain data of a recipe.

    Returns:
        Plain data.
    """
    return {name: _placeless(entry) if name in ("scene", "vary") else entry for name, entry in plain.items()}


def _placeless(value: Any) -> Any:
    if isinstance(value, Mapping):
        # A scene as `to_dict` writes it.
        is_scene = set(value) >= {"tree", "folder"}
        return {name: _placeless(entry) for name, entry in value.items() if not (is_scene and name == "folder")}
    if isinstance(value, list):
        return [_placeless(entry) for entry in value]
    if isinstance(value, str) and len(value) < _MOST_LETTERS and os.path.isabs(value):
        return Path(value).name
    return value


def files_of(description: Plain, choices: Iterable[Any]) -> dict[str, str]:
    """Return the hashes of the files that a scene names.

    Args:
        description: description of the scene.
        choices: plain data that may take the place of its entries.

    Returns:
        Hashes by name.
    """
    if isinstance(description, XmlDescription):
        folder = Path(description.path).parent
        found = _of_xml(description.text, folder, dict(description.parameters), _DEEPEST)
    else:
        folder = Path(description.folder)
        found = _of_data(description.tree, folder)
    for choice in choices:
        found |= _of_data(choice, folder)
    return found


def _of_data(content: Any, folder: Path) -> dict[str, str]:
    found: dict[str, str] = {}
    inside = content.values() if isinstance(content, Mapping) else content if isinstance(content, list) else ()
    for entry in inside:
        found |= _of_data(entry, folder)
    return found | _of_text(content, folder) if isinstance(content, str) else found


def _of_text(text: str, folder: Path) -> dict[str, str]:
    if not 0 < len(text) < _MOST_LETTERS:
        return {}
    sha = contents_of(folder / text)
    return {Path(text).name if os.path.isabs(text) else text: sha} if sha else {}


def _of_xml(text: str, folder: Path, parameters: Mapping[str, str], deepest: int) -> dict[str, str]:
    """Files in the values of attributes, with $names filled in, and in files that are included."""
    found: dict[str, str] = {}
    given = dict(parameters)
    try:
        elements = list(ElementTree.fromstring(text).iter())
    except ElementTree.ParseError:
        return found
    for element in elements:
        if element.tag == "default":
            given.setdefault(element.get("name", ""), element.get("value", ""))
    for element in elements:
        for value in element.attrib.values():
            # The longest name first, as $mesh stands in $mesh_of_cup.
            for name in sorted(given, key=len, reverse=True):
                value = value.replace(f"${name}", given[name])
            here = _of_text(value, folder)
            found |= here
            if here and element.tag == "include" and deepest:
                with contextlib.suppress(OSError, UnicodeDecodeError):
                    inner = (folder / value).read_text(encoding="utf-8")
                    # Names in it are looked up beside the scene, as Mitsuba does, and beside itself.
                    for place in {folder, (folder / value).parent}:
                        found |= _of_xml(inner, place, given, deepest - 1)
    return found
