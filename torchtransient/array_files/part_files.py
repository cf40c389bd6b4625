"""Files that appear whole or not at all. An unfinished file lies beside its place, locked by the process that writes
it, so that leftovers of killed processes can be told from files that are being written.
"""

from __future__ import annotations

import errno
import os
import platform
import re
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from torchtransient.checks import check_folder
from torchtransient.errors import StorageError

_SUFFIX = ".part"
# Names that this module gives.
_OURS = re.compile(r"\..{1,40}\.[0-9a-f]{8}\.part", re.DOTALL)
# What file systems without locks answer.
_NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)
# What this process is writing.
_unfinished: set[Path] = set()


def check_system(what: str) -> None:
    """Check that files can be locked, and replaced while they are open.

    Args:
        what: subject of messages.

    Raises:
        StorageError: on Windows.
    """
    if platform.system() == "Windows":
        raise StorageError(f"{what}: files and data sets are written on Linux and macOS, this is Windows.")


@contextmanager
def whole_file(target: Path, what: str, *, over: bool = True, synchronized: bool = True) -> Iterator[Path]:
    """Write a locked neighbour of a file, which takes its place when the block succeeds and is removed when it fails.

    Args:
        target: place of the file.
        what: subject of messages.
        over: replace a file that is there; otherwise that one stays.
        synchronized: have file and folder on the disk before it ends, so that they survive a loss of power; takes 10
            ms.

    Yields:
        Path of the neighbour.

    Raises:
        StorageError: for a full or closed disk, and on Windows; errors of the block stay as they are.
    """
    check_system(what)
    with writing_said(target, what):
        unfinished, lock = _locked(target)
    try:
        _unfinished.add(unfinished)
        yield unfinished
        with writing_said(target, what):
            if synchronized:
                os.fsync(lock)
            _put(unfinished, target, over)
            if synchronized:
                _sync_folder(target.parent)
    finally:
        unfinished.unlink(missing_ok=True)
        _unfinished.discard(unfinished)
        os.close(lock)


@contextmanager
def writing_said(target: Path, what: str) -> Iterator[None]:
    """Turn errors of the disk into StorageError.

    Args:
        target: file that is written.
        what: subject of messages.
    """
    try:
        yield
    except OSError as error:
        raise StorageError(f"{what}: '{target}' could not be written: {error}.") from error


@contextmanager
def replacing(target: Path, what: str) -> Iterator[Path]:
    """Write a temporary neighbour of a file that takes its place when the block succeeds and disappears when it fails.

    Args:
        target: place of the file. Of a link, the file that it points to is replaced; permissions stay.
        what: subject of messages.

    Yields:
        Path of the neighbour.
    """
    place = Path(os.path.realpath(target))
    sweep_parts(place.parent)
    with whole_file(place, what, synchronized=False) as unfinished, writing_said(target, what):
        yield unfinished
        if place.exists():
            shutil.copymode(place, unfinished)


def write_text(path: Any, text: str, what: str) -> None:
    """Write a file of text, whole or not at all.

    Args:
        path: place of the file.
        text: its content, written as UTF-8.
        what: subject of messages.

    Raises:
        StorageError: for a place that cannot be written, and a full disk, which leaves the old file.
    """
    with replacing(check_folder(path, what), what) as unfinished:
        unfinished.write_text(text, encoding="utf-8")


def sweep_parts(folder: str | Path) -> list[Path]:
    """Remove unfinished files of processes that have ended.

    Args:
        folder: folder that is searched.

    Returns:
        Paths that were removed.

    Files whose writer lives are locked and stay; those of writers on other machines too, if the file system carries
    locks between machines (NFS from version 4 on does). Without locks everything stays. So do files with other names,
    and files that may not be opened.
    """
    removed = []
    for path in sorted(Path(folder).glob(f".*{_SUFFIX}")):
        if not _OURS.fullmatch(path.name):
            continue
        try:
            descriptor = os.open(path, os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK)
        except OSError:
            continue
        try:
            if _lock(descriptor) == "ours":
                path.unlink(missing_ok=True)
                removed.append(path)
        finally:
            os.close(descriptor)
    return removed


def remove_unfinished() -> None:
    """Remove the files that this process is writing, for a process that ends at once, without its ``finally``."""
    for path in tuple(_unfinished):
        with suppress(OSError):
            path.unlink(missing_ok=True)


def _put(unfinished: Path, target: Path, over: bool) -> None:
    if not over:
        try:
            os.link(unfinished, target)
        except FileExistsError:
            return
        except OSError:
            # Disks without hard links.
            if target.exists():
                return
        else:
            return
    unfinished.replace(target)


def _locked(target: Path) -> tuple[Path, int]:
    while True:
        path = target.with_name(f".{target.name[:40]}.{secrets.token_hex(4)}{_SUFFIX}")
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
        # It may be swept before it is locked. Without locks nothing is swept.
        if _lock(descriptor) != "theirs" and path.exists():
            return path, descriptor
        os.close(descriptor)


def _lock(descriptor: int) -> str:
    """Lock an open file and return its owner: "ours", "theirs", or "unlocked" on file systems without locks."""
    import fcntl

    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return "theirs"
    except OSError as error:
        if error.errno in _NO_LOCKS:
            return "unlocked"
        raise
    return "ours"


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
