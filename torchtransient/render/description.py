"""What a scene is described by: an XML file or a dictionary, reduced to plain data that can be pickled.

A description is parsed into Mitsuba's intermediate representation (``mitsuba.parser.ParserState``) whenever a scene
is built. It never holds a Mitsuba object: those belong to one variant of one process.
"""

from __future__ import annotations

import os
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from torchtransient import plugins
from torchtransient.errors import SceneError

# Properties of this library's plugins that hold any number of numbers, which Mitsuba only knows as a text: its own
# lists are vectors and colours of three.
_NUMBERS_IN_TEXT = (
    "frequencies", "pulse_opl", "pulse_values", "irf_opl", "irf_values", "decay_opl", "decay_values",
)  # fmt: skip
# Entries of a bitmap or volume that hold pixels, not a transform, even when they happen to be 4 x 4.
_ARRAY_KEYS = ("data", "bitmap", "grid")
# The arrays of a mesh in the dictionary.
_MESH, _MESH_KEYS = "mesh_arrays", ("vertices", "faces")
# The arrays of a scan: three points in a row are no transform.
_SCAN, _SCAN_KEYS = "nlos_capture_meter", ("points", "laser_points")


@dataclass(frozen=True)
class XmlDescription:
    """An XML file: its path, its text at the time of loading, and the values for its ``$parameters``."""

    path: str
    text: str
    parameters: tuple[tuple[str, str], ...]

    @property
    def name(self) -> str:
        """How messages call this scene."""
        return self.path

    def parse(self, config: Any) -> Any:
        """Mitsuba's parser state. The text of the time of loading counts, even if the file has changed or gone
        since.
        """
        import mitsuba as mi

        path = Path(self.path)
        parameters = dict(self.parameters)
        if path.is_file() and path.read_text(encoding="utf-8") == self.text:
            return mi.parser.parse_file(config, self.path, **parameters)
        return mi.parser.parse_string(config, self.text, **parameters)

    @contextmanager
    def resolved_files(self) -> Iterator[None]:
        """Relative file names are looked up beside the XML file first."""
        with _search_path(str(Path(self.path).parent)):
            yield


@dataclass(frozen=True)
class DictDescription:
    """A scene dictionary: strings, numbers, lists, and numpy arrays for transforms and pixels."""

    tree: dict[str, Any]
    folder: str

    @property
    def name(self) -> str:
        """How messages call this scene."""
        return "scene dictionary"

    def parse(self, config: Any) -> Any:
        """Mitsuba's parser state."""
        import mitsuba as mi

        state = mi.parser.parse_dict(config, _to_mitsuba(self.tree, ""))
        for node in state.nodes:
            # Mitsuba learns the kind of a plugin written in Python when it builds it.
            if node.type == mi.ObjectType.Unknown and plugins.kind_of(node.props.plugin_name()) == "shape":
                node.type = mi.ObjectType.Shape
        return state

    @contextmanager
    def resolved_files(self) -> Iterator[None]:
        """Relative file names are looked up in the folder that was current when the scene was loaded."""
        with _search_path(self.folder):
            yield


Description = XmlDescription | DictDescription


@dataclass(frozen=True)
class Pixels:
    """A ``mitsuba.Bitmap`` as plain data: values as stored, and whether they are gamma-encoded."""

    values: np.ndarray
    srgb_gamma: bool

    def to_bitmap(self) -> Any:
        """The bitmap."""
        import mitsuba as mi

        bitmap = mi.Bitmap(self.values)
        bitmap.set_srgb_gamma(self.srgb_gamma)
        return bitmap


def same_description(a: Description, b: Description) -> bool:
    """Whether two descriptions are of one scene: equal values throughout, and files looked up in the same places."""
    if isinstance(a, XmlDescription) or isinstance(b, XmlDescription):
        return a == b
    if not _same(a.tree, b.tree):
        return False
    return a.folder == b.folder or not _names_files(a.tree)


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        # The order counts: it numbers the nameless children.
        return list(a) == list(b) and all(_same(a[key], b[key]) for key in a)
    if isinstance(a, Pixels) and isinstance(b, Pixels):
        return a.srgb_gamma == b.srgb_gamma and _same(a.values, b.values)
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        same_kind = isinstance(a, np.ndarray) and isinstance(b, np.ndarray) and a.dtype == b.dtype
        return same_kind and np.array_equal(a, b, equal_nan=a.dtype.kind in "fc")
    return isinstance(a, bool) is isinstance(b, bool) and bool(a == b)


def _names_files(tree: Mapping[str, Any]) -> bool:
    """Whether a relative file name may stand anywhere in a scene dictionary."""
    return any(
        _names_files(value) if isinstance(value, Mapping) else isinstance(value, str) and "file" in key
        for key, value in tree.items()
    )


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


def describe_xml(path: str | os.PathLike[str], parameters: Mapping[str, Any]) -> XmlDescription:
    """Read an XML scene. Raises ``SceneError`` for a missing, unreadable or malformed file."""
    file = Path(path)
    if not file.is_file():
        kind = "a folder" if file.is_dir() else "no such file"
        raise SceneError(
            f"tt.load: expected the path of an XML scene, got {str(path)!r} ({kind} seen from {os.getcwd()})."
        )
    try:
        text = file.read_text(encoding="utf-8")
        ElementTree.fromstring(text)
    except (OSError, UnicodeDecodeError) as error:
        raise SceneError(f"tt.load: {file} cannot be read as text: {error}.") from error
    except ElementTree.ParseError as error:
        line, column = error.position
        raise SceneError(
            f"tt.load: {file} is not well-formed XML at line {line}, column {column + 1}: {error}."
        ) from error
    values = tuple((key, _xml_value(key, value)) for key, value in sorted(parameters.items()))
    return XmlDescription(str(file.resolve()), text, values)


def _xml_value(key: str, value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, (str, int, float)):
        return str(value)
    raise SceneError(f"tt.load: XML parameter {key!r} must be a string or a number, got {type(value).__name__}.")


def describe_dict(scene: Mapping[str, Any]) -> DictDescription:
    """Reduce a scene dictionary to plain data. Raises ``SceneError`` for entries that cannot be described."""
    tree = _to_plain(scene, "")
    if tree.get("type") != "scene":
        raise SceneError(f"tt.load: expected a dictionary with 'type': 'scene', got 'type': {tree.get('type')!r}.")
    return DictDescription(tree, os.getcwd())


def _to_plain(value: Any, path: str) -> Any:
    """Plain data for ``value``: dictionaries, strings, numbers, lists of numbers, numpy arrays."""
    where = path or "the top level"
    if isinstance(value, Mapping):
        plain = {}
        for key, item in value.items():
            if not isinstance(key, str):
                raise SceneError(f"tt.load: keys must be strings, got {key!r} at {where}.")
            below = f"{path}.{key}" if path else key
            entry = _to_plain(item, below)
            listed = key in _NUMBERS_IN_TEXT and isinstance(entry, (list, np.ndarray))
            plain[key] = _numbers_in_text(entry, below) if listed and _is_ours(value) else entry
        return plain
    if isinstance(value, (bool, int, float, str, Pixels)):
        return value
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if isinstance(value, np.ndarray):
        return value.item() if value.ndim == 0 else np.array(value)
    if isinstance(value, (list, tuple)):
        return _plain_sequence(value, where)
    if hasattr(value, "detach") and hasattr(value, "cpu"):
        return _to_plain(value.detach().cpu().numpy(), path)
    return _plain_mitsuba(value, where)


def _is_ours(node: Mapping[str, Any]) -> bool:
    """Whether a node is of a plugin of this library, or of one that was added to it."""
    return plugins.kind_of(str(node.get("type"))) is not None


def _numbers_in_text(entry: list[Any] | np.ndarray, where: str) -> str:
    array = np.asarray(entry)
    if array.ndim != 1 or array.dtype.kind not in "fiu":
        raise SceneError(
            f"tt.load: expected a list of numbers at {where}, got shape {array.shape} of {array.dtype}. Give one row "
            "of real numbers, or a text of numbers with commas."
        )
    return ", ".join(repr(float(number)) for number in array)


def _plain_sequence(value: list[Any] | tuple[Any, ...], where: str) -> Any:
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        # A spectrum given as (wavelength, value) pairs stays a list; everything else is ragged or not numeric.
        raise SceneError(f"tt.load: the list at {where} is not an array of numbers: {value!r}.") from error
    if array.ndim == 1 or (array.ndim == 2 and array.shape[1] == 2):
        return array.tolist()
    return array


def _plain_mitsuba(value: Any, where: str) -> Any:
    """Mitsuba and Dr.Jit values that have a description: transforms, colours, vectors, tensors, bitmaps."""
    import mitsuba as mi

    if isinstance(value, mi.Bitmap):
        return Pixels(np.array(value), bool(value.srgb_gamma()))
    if "Transform" in type(value).__name__:
        return _plain_transform(value, where)
    module = type(value).__module__
    if module.startswith(("drjit", "mitsuba")) and not isinstance(value, mi.Object):
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


def _double_transform() -> Any:
    """Mitsuba's scalar transform in double precision, which has no public name in single precision variants."""
    import mitsuba as mi

    properties = mi.Properties()
    properties["transform"] = mi.ScalarTransform4f()
    return type(properties["transform"])


def _to_mitsuba(value: Any, key: str) -> Any:
    """The dictionary that Mitsuba reads, for the active variant."""
    import mitsuba as mi

    if isinstance(value, dict):
        special = {_MESH: (_MESH_KEYS, _mesh_rows), _SCAN: (_SCAN_KEYS, _scan_points)}
        keys, convert = special.get(str(value.get("type")), ((), _to_mitsuba))
        return {name: (convert if name in keys else _to_mitsuba)(item, name) for name, item in value.items()}
    if isinstance(value, Pixels):
        return value.to_bitmap()
    if isinstance(value, np.ndarray):
        if key == "bitmap":
            return mi.Bitmap(np.ascontiguousarray(value, dtype=np.float32))
        if key not in _ARRAY_KEYS and value.shape == (4, 4):
            return _double_transform()(value)
        if key not in _ARRAY_KEYS and value.shape == (3, 3):
            return mi.ScalarTransform3f(value)
        if value.ndim == 1:
            return value.tolist()
        return mi.TensorXf(np.ascontiguousarray(value, dtype=np.float32))
    return value


def _scan_points(value: Any, key: str) -> Any:
    """Points (..., 3) as an array of three dimensions, which nothing else is."""
    import mitsuba as mi

    array = np.asarray(value)
    if array.dtype.kind not in "fiu" or array.ndim < 1 or array.shape[-1] != 3:
        got = f"shape {array.shape} of {array.dtype}"
        raise SceneError(f"{_SCAN}: expected {key} as points, an array (N, 3) or (H, W, 3), got {got}.")
    return mi.TensorXf(np.ascontiguousarray(array, dtype=np.float32).reshape(1, -1, 3))


def _mesh_rows(value: Any, key: str) -> Any:
    """Vertices or faces in one row: an array of three rows Mitsuba would take for a colour or a point."""
    import mitsuba as mi

    if not isinstance(value, np.ndarray) or value.ndim != 2 or value.shape[1] != 3 or value.dtype.kind not in "fiu":
        got = f"shape {value.shape} of {value.dtype}" if isinstance(value, np.ndarray) else type(value).__name__
        raise SceneError(f"{_MESH}: expected {key} as rows of three numbers, an array (N, 3), got {got}.")
    return mi.TensorXd(np.ascontiguousarray(value, dtype=np.float64).reshape(1, -1))
