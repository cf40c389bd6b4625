"""Where `Capture.read` and `Capture.write` find their files: above, in the room that knows the layouts."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from torchtransient.errors import StorageError

# `tt.nlos.read_capture`, `tt.nlos.write_capture`: their arguments are told there.
ReadsCaptures = Callable[..., Any]
WritesCaptures = Callable[..., Path]

_files: list[tuple[ReadsCaptures, WritesCaptures]] = []


def register_files(read: ReadsCaptures, write: WritesCaptures) -> None:
    """Say who reads and writes; a later call replaces an earlier one."""
    _files[:] = [(read, write)]


def reader() -> ReadsCaptures:
    """Who reads captures. Raises StorageError until the room of the layouts is loaded."""
    return _registered()[0]


def writer() -> WritesCaptures:
    """Who writes captures. Raises StorageError until the room of the layouts is loaded."""
    return _registered()[1]


def _registered() -> tuple[ReadsCaptures, WritesCaptures]:
    if not _files:
        raise StorageError("Capture: no layout of files is loaded. Import torchtransient.nlos first.")
    return _files[0]
