"""Captures of this and of other programs on disk. A file's layout is found from its contents."""

from __future__ import annotations

import zipfile
from pathlib import Path
from types import ModuleType
from typing import Any

from torchtransient.array_files.array_file import check_folder, damage_said, path_of
from torchtransient.array_files.hdf5 import hdf5_package, read_attributes
from torchtransient.axes import FrequencyAxis
from torchtransient.capture import Capture
from torchtransient.capture.capture import register_files
from torchtransient.checks import shown, some_of
from torchtransient.errors import ArgumentError, StorageError
from torchtransient.files.captures import (
    cdt,
    dirac,
    keyhole,
    own,
    phasor_field,
    rect_data,
    tal,
    tmf8828,
    vl53l8,
    zaragoza,
)
from torchtransient.files.captures.contents import WHAT, Contents, opened
from torchtransient.files.captures.reading import Reading

OWN = "torchtransient"
# Modules with `NAME`, `ENDINGS` of the files, `recognises(contents)`, `read(contents, reading)`, and, unless they are
# only read, `write(target, capture)`. In the order in which they are tried: names that say most come first.
_MODULES = (
    tal, zaragoza, dirac, phasor_field, keyhole, rect_data, cdt, tmf8828, vl53l8,
)  # fmt: skip
LAYOUTS: dict[str, ModuleType] = {module.NAME: module for module in _MODULES}
FORMATS = (OWN, *LAYOUTS)


def read_capture(
    path: str | Path,
    format: str | None = None,
    *,
    wall_size: Any = None,
    bin_width_s: float | None = None,
    start_s: float | None = None,
    sensor_origin: Any = None,
    laser_origin: Any = None,
    frequencies: FrequencyAxis | None = None,
    frame: int | None = None,
) -> Capture:
    """Read a capture of any known layout, as tensors on the CPU. Nothing in the file is executed.

    Args:
        path: the file.
        format: name of a layout of docs/capture_files.md, such as "tal" or "torchtransient", the library's own; None
            finds it from the content, independent of the name of the file.
        wall_size: size in metres, one number or (width, height), of a scanned area whose points are the centres of its
            cells.
        bin_width_s: width of a bin, seconds.
        start_s: start of the first bin, seconds after light leaves the wall, or the laser where the legs count.
        sensor_origin: place of the sensor, (3,) metres.
        laser_origin: place of the laser, (3,) metres.
        frequencies: frequencies of phasors.
        frame: index of the frame in a file of several, from 0.

    Returns:
        The capture. In files of other programs ``metadata["format"]`` names the layout, ``metadata["assumed"]`` values
        that neither file nor caller gave, and ``metadata["not_read"]`` other entries of the file.

    Raises:
        StorageError: for files that are missing, damaged, of no known layout, or hold no capture of this library; for a
            value that is missing and counts; for an argument that has no meaning or that the file gives itself.

    The arguments after `format` give values that a file lacks; docs/capture_files.md tells which layout needs which.
    Measured arrays are read once, and copied after that only to sum bounces or to make signed numbers of unsigned ones;
    axes change places as views.
    """
    given = {
        "wall_size": wall_size, "bin_width_s": bin_width_s, "start_s": start_s, "sensor_origin": sensor_origin,
        "laser_origin": laser_origin, "frequencies": frequencies, "frame": frame,
    }  # fmt: skip
    _check_name(format, FORMATS)
    source = path_of(path, WHAT)
    if format == OWN or (format is None and _is_own(source)):
        Reading(given, OWN, source).check_all_used()
        return own.read_capture(source)
    with opened(source) as contents:
        layout = _found(contents) if format is None else _asked_for(contents, format)
        reading = Reading(given, layout.NAME, source)
        capture: Capture = layout.read(contents, reading)
        reading.check_all_used()
        return capture


def write_capture(path: str | Path, capture: Capture, metadata: Any = None, *, format: str = OWN) -> Path:
    """Write a capture; an existing file is replaced once the new one is complete.

    Args:
        path: place of the file.
        capture: the capture.
        metadata: plain data beside the capture's own, in the library's own format.
        format: name of a layout that can be written, see :func:`read_capture`. The library's own holds all of a
            capture.

    Returns:
        The path.

    Raises:
        StorageError: for an unknown ending, a folder that is missing, a full disk, and captures that the format cannot
            hold.
        ArgumentError: for an unknown format.
    """
    _check_name(format, FORMATS)
    if format == OWN:
        return own.write_capture(path, capture, metadata)
    layout = LAYOUTS[format]
    if not hasattr(layout, "write"):
        names = ", ".join([OWN, *(name for name, entry in LAYOUTS.items() if hasattr(entry, "write"))])
        raise StorageError(f"{WHAT}: the layout {format!r} is only read. Write one of {names}.")
    if metadata is not None:
        raise StorageError(f"{WHAT}: metadata= is for the library's own format; got it with format={format!r}.")
    target = path_of(path, WHAT)
    if target.suffix.lower() not in LAYOUTS[format].ENDINGS:
        endings = ", ".join(LAYOUTS[format].ENDINGS)
        raise StorageError(f"{WHAT}: expected a name that ends in {endings} for format={format!r}, got '{target}'.")
    check_folder(target, WHAT)
    layout.write(target, capture)
    return target


def _check_name(name: Any, names: tuple[str, ...]) -> None:
    if name is not None and name not in names:
        raise ArgumentError(f"{WHAT}: expected format to be one of {', '.join(names)}, got {shown(name)}.")


def _is_own(source: Path) -> bool:
    """Return True for a file that names a format of this library."""
    if not source.is_file():
        return False
    if zipfile.is_zipfile(source):
        with damage_said(source, WHAT), zipfile.ZipFile(source) as file:
            return "format.npy" in file.namelist()
    with damage_said(source, WHAT), source.open("rb") as file:
        if file.read(8) != b"\x89HDF\r\n\x1a\n":
            return False
    with damage_said(source, WHAT), hdf5_package(WHAT).File(source, "r") as file:
        return str(read_attributes(file, WHAT, ["format"]).get("format", "")).startswith(OWN)


def _asked_for(contents: Contents, name: str) -> ModuleType:
    """Return the layout of a name. Raises StorageError for a file of another one."""
    layout = LAYOUTS[name]
    others = [other for other, entry in LAYOUTS.items() if entry.recognises(contents)]
    if others and not layout.recognises(contents):
        raise StorageError(
            f"{WHAT}: expected '{contents.source}' in the layout {name!r}, got one of {others[0]!r} (it holds "
            f"{some_of(sorted(contents.shapes), 120)}). Leave format= out, or give format={others[0]!r}."
        )
    return layout


def _found(contents: Contents) -> ModuleType:
    for layout in LAYOUTS.values():
        if layout.recognises(contents):
            return layout
    names = some_of(sorted(contents.shapes), 120) or "nothing"
    raise StorageError(
        f"{WHAT}: '{contents.source}' has no known layout ({', '.join(FORMATS)}); it holds {names} (links are not "
        "followed). Give format= if it is one of these; else read its arrays and make tt.nlos.Capture(transient, axis, "
        "scan) of them."
    )


register_files(read_capture, write_capture)
