"""Files that appear whole or not at all. What is unfinished lies beside its place, locked by the process that writes
it, so that what a killed one left can be told from what another one is writing.
"""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from torchtransient.errors import StorageError

_SUFFIX = ".part"


@contextmanager
def whole_file(target: Path, what: str) -> Iterator[Path]:
    """A locked neighbour of `target`, on the disk and in its place when the block has succeeded, removed when it
    failed.

    The file and its folder are synchronized: what is in its place survives a loss of power. Raises StorageError for a
    disk that is full or closed to us; errors of the block stay what they are.
    """
    with writing_said(target, what):
        unfinished, lock = _locked(target)
    try:
        yield unfinished
        with writing_said(target, what):
            os.fsync(lock)
            unfinished.replace(target)
            _sync_folder(target.parent)
    finally:
        unfinished.unlink(missing_ok=True)
        os.close(lock)


@contextmanager
def writing_said(target: Path, what: str) -> Iterator[None]:
    """Errors of the disk as StorageError."""
    try:
        yield
    except OSError as error:
        raise StorageError(f"{what}: '{target}' could not be written: {error}.") from error


def sweep_parts(folder: str | Path) -> list[Path]:
    """Remove what writers that are gone left unfinished in a folder. Returns what was removed.

    Files whose writer lives are locked and stay; those of writers on other machines too, where the file system carries
    locks between machines (NFS from version 4 on does).
    """
    import fcntl

    removed = []
    for path in sorted(Path(folder).glob(f".*{_SUFFIX}")):
        try:
            descriptor = os.open(path, os.O_RDWR)
        except FileNotFoundError:
            continue
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            path.unlink(missing_ok=True)
            removed.append(path)
        except BlockingIOError:
            pass
        finally:
            os.close(descriptor)
    return removed


def _locked(target: Path) -> tuple[Path, int]:
    import fcntl

    while True:
        path = target.with_name(f".{target.name[:40]}.{secrets.token_hex(4)}{_SUFFIX}")
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if path.exists():
                return path, descriptor
        except BlockingIOError:
            pass
        # Somebody swept it before it was locked.
        os.close(descriptor)


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
