"""Checks of a parsed scene: mistakes that Mitsuba crashes of, never ends with, or renders wrongly without a word."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

import numpy as np

from torchtransient.checks import check_special, shown
from torchtransient.errors import SceneError
from torchtransient.plugins.mitsuba_compat import mesh_faces
from torchtransient.plugins.properties import count_bad, numbers_of, refuse
from torchtransient.scene.nodes import children, is_film, node_kind
from torchtransient.scene.objects import LoadedScene

# Nodes inside of nodes, references counted. Kernels hold a call inside of a call for each, and the time to build them
# grows with a power of their number: 16 take seconds.
MOST_LEVELS = 32
# Nodes of a surface, medium or light, each as often as it is reached: a two-sided surface reaches its inside twice, a
# blend of twice the same surface as well.
MOST_EXPANDED = 256
_EXPANDED = ("BSDF", "Texture", "Volume", "PhaseFunction", "Medium", "Emitter")
_REACHED_TWICE = ("twosided",)
# Mitsuba counts samples and pixels in 32 bits with a sign.
_MOST = 2**31 - 1
_SIZES = ("width", "height", "crop_width", "crop_height")


# --------------------------------------------------------------------------------------------------------------- nodes


def check_nodes(state: Any) -> None:
    """Raise ``SceneError`` for nodes nested too deeply, and for numbers of samples and sizes of films below one.

    Args:
        state: parsed scene (``mitsuba.parser.ParserState``).
    """
    _check_nesting(state)
    for node in state.nodes:
        if node_kind(node) == "Sampler":
            _check_whole(node, "sample_count")
            if node.props.plugin_name() == "orthogonal":
                _check_whole(node, "strength", least=2)
        elif is_film(node):
            for name in _SIZES:
                _check_whole(node, name)


def _check_whole(node: Any, name: str, least: int = 1) -> None:
    if name not in node.props:
        return
    given = node.props[name]
    is_number = isinstance(given, (int, float)) and not isinstance(given, bool)
    if not is_number or given != given // 1 or not least <= given <= _MOST:
        raise SceneError(
            f"{_name(node)}: {name}: expected a whole number from {least} to 2^31 - 1, got {shown(given)}."
        )


def _name(node: Any) -> str:
    name, plugin = node.props.id(), node.props.plugin_name()
    return f"{name!r} ({plugin})" if name else plugin


def _check_nesting(state: Any) -> None:
    """Raise ``SceneError`` for nodes inside of nodes more than 32 deep, and for surfaces of more than 256 nodes.

    Each node of a surface counts as often as it is reached. Circles of references are left to Mitsuba, which names
    them.
    """
    levels: dict[int, int] = {}
    sizes: dict[int, int] = {}
    by_id = state.id_to_index
    below = {index: [child for _, child in children(state, node, by_id)] for index, node in enumerate(state.nodes)}
    entered: set[int] = set()
    for start in below:
        waiting = [start]
        while waiting:
            index = waiting[-1]
            if index not in entered:
                entered.add(index)
                waiting.extend(child for child in below[index] if child not in entered)
                continue
            waiting.pop()
            if index in levels:
                continue
            held = [child for child in below[index] if child in levels]
            levels[index] = 1 + max((levels[child] for child in held), default=0)
            sizes[index] = _size(state.nodes[index], sum(sizes[child] for child in held))
            if levels[index] > MOST_LEVELS:
                raise SceneError(
                    f"{_name(state.nodes[index])}: expected nodes inside of nodes at most {MOST_LEVELS} deep, got "
                    "more. Kernels of deeper ones take hours to build."
                )


def _size(node: Any, inside: int) -> int:
    if node_kind(node) not in _EXPANDED:
        return 1
    size = 1 + (2 if node.props.plugin_name() in _REACHED_TWICE else 1) * inside
    if size > MOST_EXPANDED:
        raise SceneError(
            f"{_name(node)}: expected at most {MOST_EXPANDED} nodes in one surface, medium or light, each counted as "
            f"often as it is reached, got {size}. Kernels of more take hours to build."
        )
    return size


def check_finite(state: Any) -> None:
    """Raise ``SceneError`` with the keys of all numbers of a parsed scene that are NaN or infinite.

    Args:
        state: parsed scene (``mitsuba.parser.ParserState``).
    """
    bad: dict[str, str] = {}
    waiting, seen, by_id = [(state.root, "")], set(), state.id_to_index
    while waiting:
        node, path = waiting.pop()
        for key, value in node.props.items():
            array = numbers_of(value)
            if array is not None:
                count_bad(bad, f"{path}{key}", array)
        for key, index in children(state, node, by_id):
            if index not in seen:
                seen.add(index)
                waiting.append((state.nodes[index], f"{path}{key}."))
    refuse(bad)


# --------------------------------------------------------------------------------------------------------- mesh files

# Plugins that hand on the faces of a file unchecked; Mitsuba checks those of an 'obj' itself.
_UNCHECKED = ("ply", "serialized")
_READ = ("filename", "shape_index", "shape_name")
# Files that were found to be right, by name, time and size: a scene is built several times.
_right: dict[tuple[Any, ...], None] = {}
_MOST_REMEMBERED = 4096


def check_mesh_files(state: Any) -> None:
    """Raise ``SceneError`` for faces of vertices that a mesh file does not have, and for files that are devices.

    Mitsuba reads memory beyond the vertices for such faces, and a pipe without an end. Called where Mitsuba finds the
    files; files that cannot be read are left to Mitsuba.

    Args:
        state: parsed scene (``mitsuba.parser.ParserState``).
    """
    import mitsuba as mi

    for node in state.nodes:
        for name in [name for name in node.props.keys() if "file" in name]:  # noqa: SIM118  # of Mitsuba's properties
            if isinstance(node.props[name], str):
                place = str(mi.file_resolver().resolve(node.props[name]))
                check_special(place, f"{name} of {node.props.plugin_name()}", SceneError)
        if node.props.plugin_name() in _UNCHECKED and isinstance(node.props.get("filename", None), str):
            _check_mesh_file(node)


def _check_mesh_file(node: Any) -> None:
    import mitsuba as mi

    plugin, given = node.props.plugin_name(), {name: node.props[name] for name in _READ if name in node.props}
    path = str(mi.file_resolver().resolve(given["filename"]))
    key = _file_state(path, plugin, given)
    if key is None or key in _right:
        return
    try:
        # Without normals of vertices Mitsuba does no more than read the file.
        mesh = mi.load_dict({"type": plugin, "face_normals": True, **given})
    except (RuntimeError, TypeError, ValueError):
        return
    name = f"{given['filename']} ({plugin})"
    _check_faces(mesh, name)
    if plugin == "ply" and (least := _smallest(path)) < 0:
        raise SceneError(_wrong_faces(name, mesh.vertex_count(), least))
    _right[key] = None
    while len(_right) > _MOST_REMEMBERED:
        del _right[next(iter(_right))]


def _file_state(path: str, plugin: str, given: dict[str, Any]) -> tuple[Any, ...] | None:
    """Return a key that tells a file, as it is now, from others; None without a file."""
    try:
        found = os.stat(path)
    except (OSError, ValueError):
        return None
    rest = tuple(sorted((key, str(value)) for key, value in given.items() if key != "filename"))
    return (path, plugin, rest, found.st_mtime_ns, found.st_size, found.st_ino)


def check_meshes(objects: Any) -> None:
    """Raise ``SceneError`` for faces without vertices of loaded meshes, those of loaded scenes included.

    Args:
        objects: loaded objects and scenes of a description.
    """
    import mitsuba as mi

    for one in objects:
        held = one.scene.shapes() if isinstance(one, LoadedScene) else [one.value]
        for shape in held:
            if isinstance(shape, mi.Mesh):
                _check_faces(shape, f"the mesh {shape.id()!r}")


def _check_faces(mesh: Any, name: str) -> None:
    count, faces = mesh.vertex_count(), np.array(mesh_faces(mesh))
    if faces.size and int(faces.max()) >= count:
        raise SceneError(_wrong_faces(name, count, int(faces.max())))


def _wrong_faces(name: str, count: int, number: int) -> str:
    return (
        f"{name}: expected faces of vertices from 0 to {count - 1}, got the number {number}. Mend the file, or write "
        "it anew with the program that it comes from."
    )


# ---------------------------------------------------------------------------------------------- headers of PLY files

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
_LISTS = ("vertex_index", "vertex_indices")
# A line of its own: comments may hold it, too.
_END = re.compile(rb"^end_header\s*?\n", re.MULTILINE)

# (name of an element, how many, its properties as (name, type, whether it is a list))
Element = tuple[str, int, list[tuple[str, str, bool]]]


def _smallest(path: str) -> int:
    """Return the smallest vertex number of the faces of a PLY file; 0 where none is negative.

    Mitsuba reads negative numbers as 0. It has read the file before: all faces are triangles.
    """
    try:
        return _smallest_vertex(Path(path).read_bytes())
    except (ValueError, LookupError):  # a form of header that Mitsuba reads and this library does not
        return 0


def _smallest_vertex(data: bytes) -> int:
    end = _END.search(data)
    if end is None:
        return 0
    begin = end.end()
    order, elements = _header(data[: end.start()].decode("latin-1"))
    before = 0
    for name, count, properties in elements:
        if name == "face":
            signed = [p for p in properties if p[0] in _LISTS and p[1].startswith("i")]
            if not signed or not count:
                return 0
            rows = _rows(data, begin, before, count, properties, order)
            return min(0, int(rows[signed[0][0]].min()))
        before += count * _width(properties, order)
    return 0


def _header(text: str) -> tuple[str, list[Element]]:
    """Return the order of bytes, "" for text, and the elements."""
    order, elements = "", list[Element]()
    for line in text.splitlines():
        words = line.split()
        if words[:1] == ["format"]:
            order = _ORDERS.get(words[1], "")
        elif words[:1] == ["element"]:
            elements.append((words[1], int(words[2]), []))
        elif words[:1] == ["property"]:
            listed = words[1] == "list"
            elements[-1][2].append((words[-1], _TYPES[words[-2]], listed))
            if listed:
                elements[-1][2].insert(-1, (f"number of {words[-1]}", _TYPES[words[2]], False))
    return order, elements


def _width(properties: list[tuple[str, str, bool]], order: str) -> int:
    """Return the bytes, or words of text, of a row."""
    return sum((3 if listed else 1) * (np.dtype(kind).itemsize if order else 1) for _, kind, listed in properties)


def _rows(
    data: bytes, begin: int, before: int, count: int, properties: list[tuple[str, str, bool]], order: str
) -> np.ndarray:
    fields = [(name, order + kind, (3,)) if listed else (name, order + kind) for name, kind, listed in properties]
    if order:
        return np.frombuffer(data, np.dtype(fields), count, begin + before)
    width = _width(properties, order)
    numbers = np.array(data[begin:].split()[before : before + count * width], np.float64).reshape(count, width)
    rows, column = np.zeros(count, np.dtype(fields)), 0
    for name, _, listed in properties:
        rows[name] = numbers[:, column : column + 3] if listed else numbers[:, column]
        column += 3 if listed else 1
    return rows
