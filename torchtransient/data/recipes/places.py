"""Files that a recipe names: what is in them belongs to the recipe, where they lie does not."""

from __future__ import annotations

import contextlib
import os
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from torchtransient.files.content_key import contents_of
from torchtransient.scene.description import Plain, XmlDescription

# Longer texts name no file.
_MOST_LETTERS = 1024
_DEEPEST = 16


def without_places(plain: Mapping[str, Any]) -> dict[str, Any]:
    """A recipe as plain data, without the folders that its files were in: the same recipe elsewhere is the same one."""
    return {name: _placeless(entry) if name in ("scene", "vary") else entry for name, entry in plain.items()}


def _placeless(value: Any) -> Any:
    if isinstance(value, Mapping):
        # Of a scene that was written by `to_dict`.
        is_scene = set(value) >= {"tree", "folder"}
        return {name: _placeless(entry) for name, entry in value.items() if not (is_scene and name == "folder")}
    if isinstance(value, list):
        return [_placeless(entry) for entry in value]
    if isinstance(value, str) and len(value) < _MOST_LETTERS and os.path.isabs(value):
        return Path(value).name
    return value


def files_of(description: Plain, choices: Iterable[Any]) -> dict[str, str]:
    """Hashes of the files that a scene names, by their names; ``choices``: plain data that may take the place of its
    entries.
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
    """Values of attributes, $names filled in, and files that are included."""
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
