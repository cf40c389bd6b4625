"""Materials of y-tal's scene files as Mitsuba dictionaries."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from typing import Any

from torchtransient.errors import SceneError
from torchtransient.files.yaml_files import Section, as_number

_VALUES = ("float", "integer", "boolean", "string", "rgb", "spectrum")
_PLUGINS = ("bsdf", "texture")


def material(data: Any, where: str) -> dict[str, Any]:
    """The BSDF of an entry `material`: `id: white`, `id: copper` with `alpha`, or `id: custom` with XML as `text`.

    Raises SceneError for other ids, and for XML that is more than nested BSDFs, textures and values.
    """
    identity = data.get("id") if isinstance(data, Mapping) else None
    if identity == "white":
        Section(data, where, ("id",))
        return {"type": "diffuse", "reflectance": {"type": "rgb", "value": [1.0, 1.0, 1.0]}}
    if identity == "copper":
        alpha = Section(data, where, ("id", "alpha")).number("alpha")
        return {"type": "roughconductor", "material": "Cu", "distribution": "beckmann", "alpha": alpha}
    if identity == "custom":
        return _of_xml(Section(data, where, ("id", "text")).text("text"), where)
    raise SceneError(f"{where}: expected id: white, copper or custom, got {identity!r}.")


def _of_xml(text: str, where: str) -> dict[str, Any]:
    if "<!" in text.replace("<!--", ""):
        # No entity is defined in a material: one that is would be unfolded while it is read.
        raise SceneError(f"{where}: expected the XML of one <bsdf>, got a declaration '<!...'.")
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise SceneError(f"{where}: expected the XML of one <bsdf>, got what cannot be read: {error}.") from error
    if root.tag != "bsdf":
        raise SceneError(f"{where}: expected the XML of one <bsdf>, got <{root.tag}>.")
    return _plugin(root, where)


def _plugin(element: ElementTree.Element, where: str) -> dict[str, Any]:
    if "type" not in element.attrib:
        raise SceneError(f"{where}: <{element.tag}> has no type.")
    plugin: dict[str, Any] = {"type": element.attrib["type"]}
    for number, child in enumerate(element):
        name = child.attrib.get("name", f"{child.tag}_{number}")
        if child.tag in _PLUGINS:
            plugin[name] = _plugin(child, where)
        elif child.tag in _VALUES and "name" in child.attrib and "value" in child.attrib:
            plugin[name] = _value(child.tag, child.attrib["value"], f"{where}: {name}")
        else:
            raise SceneError(
                f"{where}: <{child.tag}> in a material is not supported; expected {', '.join(_PLUGINS)} and values "
                f"({', '.join(_VALUES)}) with a name and a value."
            )
    return plugin


def _value(kind: str, text: str, where: str) -> Any:
    if kind == "string":
        return text
    if kind == "boolean":
        if text not in ("true", "false"):
            raise SceneError(f"{where}: expected true or false, got {text!r}.")
        return text == "true"
    if kind == "rgb":
        numbers = [as_number(word, where) for word in text.replace(",", " ").split()]
        if len(numbers) not in (1, 3):
            raise SceneError(f"{where}: expected one or three numbers, got {text!r}.")
        return {"type": "rgb", "value": numbers * (3 // len(numbers))}
    if kind == "spectrum":
        return spectrum(text, where)
    number = as_number(text, where)
    return int(number) if kind == "integer" else number


def spectrum(text: str, where: str) -> Any:
    """A spectrum as text: one number, or wavelengths in nm with values, "400:1, 700:2". Returns a number or pairs."""
    words = text.replace(",", " ").split()
    if len(words) == 1 and ":" not in words[0]:
        return as_number(words[0], where)
    pairs = [word.split(":") for word in words]
    if len(pairs) < 2 or any(len(pair) != 2 for pair in pairs):
        raise SceneError(f"{where}: expected one number or 'wavelength:value, ...', got {text!r}.")
    return {"type": "spectrum", "value": [(as_number(a, where), as_number(b, where)) for a, b in pairs]}
