"""Scenes as plain data that can be pickled: an XML file, or a dictionary of numbers, texts and arrays.

A description is parsed into Mitsuba's list of nodes (``mitsuba.parser.ParserState``) whenever a scene is built. Objects
of Mitsuba, which belong to one variant of one process, become data where that is possible (:mod:`.objects`).
"""

from __future__ import annotations

import os
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from torchtransient import plugins
from torchtransient.checks import check_special, path_of, shown
from torchtransient.errors import SceneError, StorageError
from torchtransient.plugins.dictionaries import NUMBERS_IN_TEXT, Pixels, Voxels, is_ours, numbers_in_text, parsed
from torchtransient.scene.checks import MOST_LEVELS
from torchtransient.scene.motions import BodyMotion, place_motions
from torchtransient.scene.objects import Description, LoadedObject, LoadedScene, describe_object, objects_inside

# Files in files: Mitsuba takes fewer.
_MOST_INCLUDES = 16


@dataclass(frozen=True)
class XmlDescription(Description):
    """XML file: path, text at the time of loading, and values of its ``$parameters``.

    Args:
        path: path of the file.
        text: its text at the time of loading.
        parameters: names and values of its ``$parameters``.
        motions: velocities of bodies, in place of described ones.
    """

    path: str
    text: str
    parameters: tuple[tuple[str, str], ...]
    motions: tuple[BodyMotion, ...] = ()

    @property
    def name(self) -> str:
        """Path of the file."""
        return self.path

    def parse(self, config: Any) -> Any:
        """Return Mitsuba's parser state of the text at the time of loading; the file may have changed since.

        Args:
            config: ``mitsuba.parser.ParserConfig`` of the variant.
        """
        import mitsuba as mi

        path = Path(self.path)
        parameters = dict(self.parameters)
        if path.is_file() and path.read_text(encoding="utf-8") == self.text:
            state = mi.parser.parse_file(config, self.path, **parameters)
        else:
            state = mi.parser.parse_string(config, self.text, **parameters)
        place_motions(state, self.motions)
        return state

    @contextmanager
    def resolved_files(self) -> Iterator[None]:
        """Look relative file names up beside the XML file first."""
        with _search_path(str(Path(self.path).parent)):
            yield


@dataclass(frozen=True)
class DictDescription(Description):
    """Scene dictionary as plain data: strings, numbers, lists, and numpy arrays for transforms and pixels.

    Args:
        tree: the dictionary.
        folder: folder that was current when the scene was loaded.
        motions: velocities of bodies, in place of described ones.
    """

    tree: dict[str, Any]
    folder: str
    motions: tuple[BodyMotion, ...] = ()

    @property
    def name(self) -> str:
        """Name of the scene in messages."""
        return "scene dictionary"

    @property
    def objects(self) -> tuple[Any, ...]:
        """Loaded objects of Mitsuba in the dictionary, which have no description."""
        return objects_inside(self.tree)

    def parse(self, config: Any) -> Any:
        """Return Mitsuba's parser state.

        Args:
            config: ``mitsuba.parser.ParserConfig`` of the variant.
        """
        import mitsuba as mi

        state = parsed(config, self.tree)
        kinds = {"shape": mi.ObjectType.Shape, "sampler": mi.ObjectType.Sampler, "texture": mi.ObjectType.Texture}
        for node in state.nodes:
            # Mitsuba learns the kind of a plugin written in Python when it builds it.
            if node.type == mi.ObjectType.Unknown:
                node.type = kinds.get(plugins.kind_of(node.props.plugin_name()) or "", node.type)
        place_motions(state, self.motions)
        return state

    @contextmanager
    def resolved_files(self) -> Iterator[None]:
        """Look relative file names up in the folder that was current when the scene was loaded."""
        with _search_path(self.folder):
            yield


# Descriptions that can be parsed, and all of them.
Plain = XmlDescription | DictDescription
SceneDescription = Plain | LoadedScene


@contextmanager
def _search_path(folder: str) -> Iterator[None]:
    import mitsuba as mi

    before = mi.file_resolver()
    resolver = mi.FileResolver(before)
    resolver.prepend(folder)

    mi.set_file_resolver(resolver)
    try:
        yield
    finally:
        mi.set_file_resolver(before)


# ------------------------------------------------------------------------------------------------------------ equality


def same_description(a: SceneDescription, b: SceneDescription) -> bool:
    """Return whether two descriptions are of one scene: equal values, and files looked up in the same places.

    Args:
        a, b: the descriptions.
    """
    if isinstance(a, LoadedScene) and isinstance(b, LoadedScene):
        return a.scene is b.scene
    if not isinstance(a, DictDescription) or not isinstance(b, DictDescription):
        return a == b
    if a.motions != b.motions or not _same(a.tree, b.tree):
        return False
    return a.folder == b.folder or not _names_files(a.tree)


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        # The order counts: it numbers the nameless children.
        return list(a) == list(b) and all(_same(a[key], b[key]) for key in a)
    if isinstance(a, LoadedObject) and isinstance(b, LoadedObject):
        return a.value is b.value
    if isinstance(a, Pixels) and isinstance(b, Pixels):
        return (a.srgb_gamma, a.pixel_format) == (b.srgb_gamma, b.pixel_format) and _same(a.values, b.values)
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        same_kind = isinstance(a, np.ndarray) and isinstance(b, np.ndarray) and a.dtype == b.dtype
        return same_kind and np.array_equal(a, b, equal_nan=a.dtype.kind in "fc")
    return isinstance(a, bool) is isinstance(b, bool) and bool(a == b)


def _names_files(tree: Mapping[str, Any]) -> bool:
    """Return whether a relative file name may stand anywhere in a scene dictionary."""
    return any(
        _names_files(value) if isinstance(value, Mapping) else isinstance(value, str) and "file" in key
        for key, value in tree.items()
    )


# ----------------------------------------------------------------------------------------------------------- XML files


def describe_xml(path: str | os.PathLike[str], parameters: Mapping[str, Any]) -> XmlDescription:
    """Read an XML scene.

    Args:
        path: path of the file.
        parameters: values of its ``$name`` parameters, strings or numbers.

    Raises:
        SceneError: for a missing, unreadable or malformed file, and other values.
    """
    try:
        file = path_of(path, "tt.load")
    except StorageError as error:
        raise SceneError(str(error)) from None
    if not file.is_file():
        kind = "a folder" if file.is_dir() else "a device or a pipe" if file.exists() else "no such file"
        raise SceneError(
            f"tt.load: expected the path of an XML scene, got {str(path)!r} ({kind} seen from {os.getcwd()})."
        )
    try:
        text = file.read_text(encoding="utf-8")
        _check_levels(text, _Levels(file, parameters))
    except (OSError, UnicodeDecodeError) as error:
        raise SceneError(f"tt.load: {file} cannot be read as text: {error}.") from error
    except ElementTree.ParseError as error:
        line, column = error.position
        raise SceneError(
            f"tt.load: {file} is not well-formed XML at line {line}, column {column + 1}: {error}."
        ) from error
    values = tuple((key, _xml_value(key, value)) for key, value in sorted(parameters.items()))
    return XmlDescription(str(file.resolve()), text, values)


class _Levels:
    """Target of an XML parser that counts levels, through included files: Mitsuba recurses into each on its stack."""

    def __init__(self, file: Path, given: Mapping[str, Any], level: int = 0, includes: int = 0):
        self.file, self.given, self.level, self.includes = file, dict(given), level, includes

    def start(self, tag: str, attributes: Mapping[str, str]) -> None:
        """Count the element, and look into a file that it includes."""
        self.level += 1
        if tag == "default":
            self.given.setdefault(attributes.get("name", ""), attributes.get("value", ""))
        if tag == "include":
            self._check_include(attributes.get("filename", ""))
        if self.level > 2 * MOST_LEVELS:  # a node of the last level may hold a transform of several parts
            raise SceneError(
                f"tt.load: {self.file}: expected elements at most {2 * MOST_LEVELS} levels deep, got more at <{tag}>."
            )

    def end(self, tag: str) -> None:
        """Leave the element."""
        self.level -= 1

    def _check_include(self, name: str) -> None:
        """Check an included file: Mitsuba opens devices too, and waits for the other end of a pipe."""
        for parameter in sorted(self.given, key=len, reverse=True):
            name = name.replace(f"${parameter}", str(self.given[parameter]))
        path = self.file.parent / name
        check_special(path, f"tt.load: {self.file}: <include>", SceneError)
        if self.includes < _MOST_INCLUDES:
            inner = _Levels(path, self.given, self.level, self.includes + 1)
            with suppress(OSError, UnicodeDecodeError, ElementTree.ParseError):  # which Mitsuba names, with the line
                _check_levels(path.read_text(encoding="utf-8"), inner)


def _check_levels(text: str, levels: _Levels) -> None:
    parser = ElementTree.XMLParser(target=levels)
    parser.feed(text)
    parser.close()


def _xml_value(key: str, value: Any) -> str:
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, (str, int, float)):
        return str(value)
    raise SceneError(f"tt.load: XML parameter {key!r} must be a string or a number, got {type(value).__name__}.")


# -------------------------------------------------------------------------------------------------------- dictionaries


def describe_dict(scene: Mapping[str, Any]) -> DictDescription:
    """Reduce a scene dictionary to plain data.

    Args:
        scene: the dictionary.

    Raises:
        SceneError: for entries that cannot be described.
    """
    tree = _to_plain(scene, "", MOST_LEVELS)
    if tree.get("type") != "scene":
        raise SceneError(f"tt.load: expected a dictionary with 'type': 'scene', got 'type': {tree.get('type')!r}.")
    return DictDescription(tree, os.getcwd())


def _to_plain(value: Any, path: str, levels: int) -> Any:
    """Return plain data for a value: dictionaries ``levels`` deep, strings, numbers, lists of numbers, numpy arrays."""
    where = path or "the top level"
    if isinstance(value, Mapping):
        if levels == 0:
            raise SceneError(
                f"tt.load: expected dictionaries inside of dictionaries at most {MOST_LEVELS} deep, got more at "
                f"{shown(path)}. Does one hold itself?"
            )
        plain = {}
        for key, item in value.items():
            if not isinstance(key, str):
                raise SceneError(f"tt.load: keys must be strings, got {key!r} at {where}.")
            below = f"{path}.{key}" if path else key
            entry = _to_plain(item, below, levels - 1)
            listed = key in NUMBERS_IN_TEXT and isinstance(entry, (list, np.ndarray))
            plain[key] = numbers_in_text(entry, below) if listed and is_ours(value) else entry
        return plain
    if isinstance(value, (bool, int, float, str, Pixels, Voxels, LoadedObject)):
        return value
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if isinstance(value, np.ndarray):
        return value.item() if value.ndim == 0 else np.array(value)
    if isinstance(value, (list, tuple)):
        return _plain_sequence(value, where)
    if value is None:
        raise SceneError(f"tt.load: expected a value at {where}, got None. Leave the entry out for Mitsuba's default.")
    if hasattr(value, "detach") and hasattr(value, "cpu"):
        return _to_plain(value.detach().cpu().numpy(), path, levels)
    return _plain_mitsuba(value, where)


def _plain_sequence(value: list[Any] | tuple[Any, ...], where: str) -> Any:
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        # A spectrum given as (wavelength, value) pairs stays a list; everything else is ragged or not numeric.
        raise SceneError(f"tt.load: the list at {where} is not an array of numbers: {shown(value)}.") from error
    if array.ndim == 1 or (array.ndim == 2 and array.shape[1] == 2):
        return array.tolist()
    return array


def _plain_mitsuba(value: Any, where: str) -> Any:
    """Return plain data for a value of Mitsuba or Dr.Jit; objects without a description stay as they are."""
    import drjit as dr
    import mitsuba as mi

    if isinstance(value, mi.Bitmap):
        return Pixels.of(value)
    if isinstance(value, mi.Object):
        return describe_object(value, where)
    if "Transform" in type(value).__name__:
        return _plain_transform(value, where)
    if dr.is_tensor_v(value) and value.ndim > 1:
        return np.array(value)
    module = type(value).__module__
    if module.startswith(("drjit", "mitsuba")):
        try:
            array = np.array(value, dtype=np.float64)
        except (TypeError, ValueError, RuntimeError) as error:
            raise SceneError(
                f"tt.load: the {type(value).__name__} at {where} cannot be described as an array."
            ) from error
        array = array.reshape(array.shape[:-1]) if array.ndim == 2 and array.shape[-1] == 1 else array
        if array.size == 1:
            return float(array.reshape(-1)[0])
        return array.tolist() if array.ndim == 1 else array
    raise SceneError(
        f"tt.load: the {type(value).__name__} at {where} cannot be described, and a scene must be rebuilt in "
        "other variants and processes. Give its dictionary, transforms as 4x4 arrays or Mitsuba transforms, pixels "
        "as arrays, meshes as files."
    )


def _plain_transform(value: Any, where: str) -> np.ndarray:
    matrix = np.array(value.matrix, dtype=np.float64)
    if matrix.ndim == 3 and matrix.shape[-1] == 1:
        matrix = matrix[..., 0]
    if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1]:
        raise SceneError(f"tt.load: expected one transform at {where}, got matrices of shape {matrix.shape}.")
    return matrix
