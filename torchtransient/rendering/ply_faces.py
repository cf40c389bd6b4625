"""Negative numbers of vertices in PLY files, which Mitsuba reads as 0 without a word."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
_LISTS = ("vertex_index", "vertex_indices")
# A line of its own: comments may say it, too.
_END = re.compile(rb"^end_header\s*?\n", re.MULTILINE)

# (name of an element, how many, its properties as (name, type, whether it is a list))
Element = tuple[str, int, list[tuple[str, str, bool]]]


def smallest_vertex(path: str) -> int:
    """The smallest number of a vertex that a face of a PLY file has, of a file that Mitsuba has read: its faces are
    triangles. 0 where none is negative, or numbers have no sign.
    """
    data = Path(path).read_bytes()
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
    """(order of bytes, "" for text; elements)."""
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
    """Bytes, or words of text, of a row."""
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
