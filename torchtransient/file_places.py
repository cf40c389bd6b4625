"""Names of files that somebody gives: what is read is a file of a disk, and what is written replaces one at most.

A device has no end, a pipe may have no writer, and a rename puts a file in the place of either.
"""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import Any

from torchtransient.errors import StorageError, TorchTransientError
from torchtransient.quantities import shown


def path_of(path: Any, what: str) -> Path:
    """`path` as a Path. Raises StorageError for what is no name of a file, on this disk for instance."""
    try:
        found = Path(path)
        os.lstat(found)
    except (FileNotFoundError, NotADirectoryError):
        return found
    except (TypeError, ValueError, OSError) as error:
        reason = "" if isinstance(error, TypeError) else f": {error}"
        raise StorageError(f"{what}: expected the name of a file, got {shown(path)}{reason}.") from None
    return found


def is_special(path: str | os.PathLike[str]) -> bool:
    """Whether there is something that is neither a file nor a folder: a device, a pipe, a socket."""
    try:
        mode = os.stat(path).st_mode
    except (OSError, ValueError):
        return False
    return not (stat.S_ISREG(mode) or stat.S_ISDIR(mode))


def check_special(path: str | os.PathLike[str], what: str, error: type[TorchTransientError] = StorageError) -> None:
    """Raise ``error`` for a device, a pipe or a socket; what is not there is left to who opens it."""
    if is_special(path):
        raise error(f"{what}: '{path}' is no file on a disk (a device or a pipe). Give the name of a file.")


def check_source(path: Any, what: str) -> Path:
    """`path`, or StorageError where there is no file to read: nothing, a folder, a device or a pipe."""
    source = path_of(path, what)
    if source.is_file():
        return source
    problem = "is a folder" if source.is_dir() else "is no file on a disk" if source.exists() else "does not exist"
    raise StorageError(f"{what}: '{source}' {problem}. Give the name of a file.")


def check_folder(path: Any, what: str) -> Path:
    """`path`, or StorageError when its folder is missing or closed to us, or `path` is there and no file that may be
    written: a folder, a device, a pipe, a file without permission.
    """
    target = path_of(path, what)
    # What a link points to is replaced, not the link.
    place = Path(os.path.realpath(target)) if target.is_symlink() else target
    if not place.parent.is_dir():
        raise StorageError(f"{what}: the folder '{place.parent}' does not exist. Create it first.")
    closed = next((p for p in (place.parent, place) if p.exists() and not os.access(p, os.W_OK)), None)
    if place.is_dir() or closed or (place.exists() and not place.is_file()):
        problem = f"cannot be written: no permission for '{closed}'" if closed else "is no file on a disk"
        raise StorageError(f"{what}: '{target}' {'is a folder' if place.is_dir() else problem}. Choose another place.")
    return target
