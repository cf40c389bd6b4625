"""Scene dictionaries of plain data, and what Mitsuba reads in their place.

The dictionaries of this library hold transforms, pixels and meshes as numpy arrays: they need no variant and can be
pickled. Mitsuba's own ``mi.load_dict`` refuses arrays, so :func:`take_arrays` lets it take them as ``tt.load`` does.
"""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from torchtransient.errors import SceneError
from torchtransient.plugins._registry import kind_of
from torchtransient.plugins.guards import interrupt_behind

# Properties of this library's plugins that hold any number of numbers, which Mitsuba only knows as a text: its own
# lists are vectors and colours of three.
NUMBERS_IN_TEXT = (
    "frequencies", "pulse_opl", "pulse_values", "irf_opl", "irf_values", "decay_opl", "decay_values",
)  # fmt: skip
# Entries of bitmaps, volumes and ellipsoids that hold arrays, not a transform, even when they happen to be 4 x 4.
_ARRAY_KEYS = ("data", "bitmap", "grid", "centers", "scales", "quaternions", "opacities")
# The arrays of a mesh in the dictionary.
_MESH, _MESH_KEYS = "mesh_arrays", {"vertices": 3, "faces": 3, "normals": 3, "texcoords": 2}
# The arrays of a scan: three points in a row are no transform.
_SCAN, _SCAN_KEYS = "nlos_capture_meter", ("points", "laser_points")


@dataclass(frozen=True)
class Pixels:
    """Plain data of a ``mitsuba.Bitmap``: values as stored, whether they are gamma-encoded, and the name of the pixel
    format, empty for the default of the number of channels.
    """

    values: np.ndarray
    srgb_gamma: bool
    pixel_format: str = ""

    @classmethod
    def of(cls, bitmap: Any) -> Pixels:
        """Return a bitmap as plain data."""
        values, given = np.array(bitmap), bitmap.pixel_format()
        pixel_format = "" if mi.Bitmap(values).pixel_format() == given else str(given).rsplit(".", 1)[-1]
        return cls(values, bool(bitmap.srgb_gamma()), pixel_format)

    def to_mitsuba(self) -> Any:
        """Return the ``mitsuba.Bitmap``."""
        pixel_format = getattr(mi.Bitmap.PixelFormat, self.pixel_format) if self.pixel_format else None
        bitmap = mi.Bitmap(self.values, pixel_format)
        bitmap.set_srgb_gamma(self.srgb_gamma)
        return bitmap


@dataclass(frozen=True)
class Voxels:
    """Plain data of a ``mitsuba.VolumeGrid``: the bytes of its file, which has the values and the box that they fill,
    and the largest value as the grid reports it.
    """

    file: bytes
    maximum: float

    @classmethod
    def of(cls, grid: Any) -> Voxels:
        """Return a grid as plain data."""
        stream = mi.MemoryStream()
        grid.write(stream)
        return cls(bytes(stream.raw_buffer()), float(grid.max()))

    def to_mitsuba(self) -> Any:
        """Return the ``mitsuba.VolumeGrid``."""
        stream = mi.MemoryStream()
        stream.write(self.file)
        stream.seek(0)
        grid = mi.VolumeGrid(stream)
        grid.set_max(self.maximum)
        return grid


def is_ours(node: Mapping[str, Any]) -> bool:
    """Return True if a node is of a plugin of this library, or of one that was added to it.

    Args:
        node: dictionary of a plugin, with ``type``.
    """
    return kind_of(str(node.get("type"))) is not None


def numbers_in_text(entry: Any, where: str) -> str:
    """Return a list of numbers as the text that plugins of this library read.

    Args:
        entry: real numbers, (N,).
        where: place in the scene, for messages.

    Raises:
        SceneError: for anything but one row of real numbers.
    """
    array = np.asarray(entry)
    if array.ndim != 1 or array.dtype.kind not in "fiu":
        raise SceneError(
            f"tt.load: expected a list of numbers at {where}, got shape {array.shape} of {array.dtype}. Give one row "
            "of real numbers, or a text of numbers with commas."
        )
    return ", ".join(repr(float(number)) for number in array)


def _for_mitsuba(value: Any, key: str = "") -> Any:
    """Return the dictionary that Mitsuba reads, for the active variant; values that Mitsuba accepts stay as they are.
    """
    if isinstance(value, Mapping):
        return {name: _entry(value, name, item) for name, item in value.items()}
    if hasattr(value, "to_mitsuba"):  # pixels, voxels, objects
        return value.to_mitsuba()
    if isinstance(value, np.ndarray):
        return _array(value, key)
    return value


def _entry(node: Mapping[str, Any], name: str, item: Any) -> Any:
    kind = str(node.get("type"))
    if dr.is_array_v(item):  # Mitsuba's own, which stays
        return item
    if kind == _MESH and name in _MESH_KEYS:
        return _mesh_rows(item, name)
    if kind == _SCAN and name in _SCAN_KEYS:
        return _scan_points(item, name)
    if kind == "gridvolume" and name == "grid" and isinstance(item, np.ndarray):
        return mi.VolumeGrid(np.ascontiguousarray(item, dtype=np.float32))
    if name in NUMBERS_IN_TEXT and isinstance(item, list | tuple | np.ndarray) and is_ours(node):
        return numbers_in_text(item, name)
    return _for_mitsuba(item, name)


def _array(value: np.ndarray, key: str) -> Any:
    if key == "bitmap":
        return mi.Bitmap(np.ascontiguousarray(value, dtype=np.float32))
    if key not in _ARRAY_KEYS and value.shape == (4, 4):
        return double_transform()(value)
    if key not in _ARRAY_KEYS and value.shape == (3, 3):
        return mi.ScalarTransform3f(value)
    if value.ndim == 1:
        return value.tolist()
    return value.item() if value.ndim == 0 else mi.TensorXf(np.ascontiguousarray(value, dtype=np.float32))


def parsed(config: Any, tree: Mapping[str, Any]) -> Any:
    """Return Mitsuba's parser state of a dictionary.

    Tensors enter with one row and get their own once the parser keeps them: an array of three rows Mitsuba tries as a
    point and as two kinds of colours first, and nanobind prints a line on stderr for each.

    Args:
        config: ``mi.parser.ParserConfig``.
        tree: scene or plugin as nested dictionaries, plain data.
    """
    kept: list[tuple[Any, Any]] = []
    state = mi.parser.parse_dict(config, _with_one_row(_for_mitsuba(tree), kept))
    for entered, tensor in kept:
        entered.__init__(tensor)
    return state


def _with_one_row(value: Any, kept: list[tuple[Any, Any]]) -> Any:
    """Return a dictionary with stand-ins for tensors of three rows; ``kept`` gets the pairs of both."""
    if isinstance(value, dict):
        return {name: _with_one_row(item, kept) for name, item in value.items()}
    if dr.is_tensor_v(value) and value.ndim > 1 and value.shape[0] == 3:
        kept.append((type(value)(0, (1,) * value.ndim), value))
        return kept[-1][0]
    return value


def double_transform() -> Any:
    """Return Mitsuba's class of scalar transforms in double precision.

    It has no public name in single precision variants.
    """
    properties = mi.Properties()
    properties["transform"] = mi.ScalarTransform4f()
    return type(properties["transform"])


def _scan_points(value: Any, key: str) -> Any:
    """Points (..., 3) as an array of three dimensions, which nothing else is."""
    array = np.asarray(value)
    if array.dtype.kind not in "fiu" or array.ndim < 1 or array.shape[-1] != 3:
        got = f"shape {array.shape} of {array.dtype}"
        raise SceneError(f"{_SCAN}: expected {key} as points, an array (N, 3) or (H, W, 3), got {got}.")
    return mi.TensorXf(np.ascontiguousarray(array, dtype=np.float32).reshape(1, -1, 3))


def _mesh_rows(value: Any, key: str) -> Any:
    """Vertices or faces in one row: an array of three rows Mitsuba would take for a colour or a point."""
    columns = _MESH_KEYS[key]
    if isinstance(value, np.ndarray) and value.ndim == 2 and value.shape[0] == 1 and value.shape[1] % columns == 0:
        value = value.reshape(-1, columns)
    if (
        not isinstance(value, np.ndarray)
        or value.ndim != 2
        or value.shape[1] != columns
        or value.dtype.kind not in "fiu"
    ):
        got = f"shape {value.shape} of {value.dtype}" if isinstance(value, np.ndarray) else type(value).__name__
        words = {2: "two", 3: "three"}[columns]
        raise SceneError(f"{_MESH}: expected {key} as rows of {words} numbers, an array (N, {columns}), got {got}.")
    return mi.TensorXd(np.ascontiguousarray(value, dtype=np.float64).reshape(1, -1))


def take_arrays() -> None:
    """Let ``mi.load_dict`` take the dictionaries of this library. Other dictionaries are taken as before;
    repeating this has no effect.
    """
    if not hasattr(mi.load_dict, "takes_arrays"):
        mi.load_dict = _taking_arrays(mi.load_dict)


def _taking_arrays(load_dict: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(load_dict)
    def taking_arrays(*args: Any, **options: Any) -> Any:
        if args and isinstance(args[0], dict):
            args = (_for_mitsuba(args[0]), *args[1:])
        elif isinstance(options.get("dict"), dict):
            options["dict"] = _for_mitsuba(options["dict"])
        handled = sys.exc_info()[1]
        try:
            return load_dict(*args, **options)
        except RuntimeError as error:
            interrupt = interrupt_behind(error, handled)
            if interrupt is None:
                raise
            raise interrupt from None

    taking_arrays.takes_arrays = True  # type: ignore[attr-defined]
    return taking_arrays
