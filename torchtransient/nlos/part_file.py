"""The part file of a simulation: finished rows, on disk.

Three files: ``NAME``, JSON with the key of the simulation and the numbers of its finished rows; ``NAME.npy``, the rows
in NumPy's own format; ``NAME.lock``, held while a process works on it. Rows are written first and named afterwards,
with a checksum, and the JSON replaces the one before in one step: a kill at any moment, or a full disk, loses the rows
in progress and nothing else.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
import torch
from numpy.typing import NDArray

from torchtransient.array_files.part_files import whole_file
from torchtransient.axes import FrequencyAxis, TimeAxis
from torchtransient.capture import Capture, Scan
from torchtransient.checks import short_message
from torchtransient.errors import StorageError

Rows = NDArray[np.float32]


@dataclass(frozen=True)
class RowLayout:
    """Layout of a capture as rows of numbers, one for each sensor point.

    A row holds the transient (or phasor, real and imaginary part in turn) of shape ``front``, then the steady image's
    ``steady`` channels, 0 without one. ``front`` has the laser's dimensions of an exhaustive scan at its end.
    """

    front: tuple[int, ...]
    steady: tuple[int, ...]
    phasor: bool
    channels: tuple[str, ...]
    polarized: bool

    @classmethod
    def of(cls, capture: Capture) -> RowLayout:
        """Return the layout of a capture."""
        measured = _measured(capture)
        rank = len(capture.scan.sensor_shape)
        steady = () if capture.steady is None else tuple(capture.steady.shape[: capture.steady.ndim - rank])
        return cls(
            front=tuple(measured.shape[: measured.ndim - rank]),
            steady=steady,
            phasor=measured.is_complex(),
            channels=capture.channels,
            polarized=capture.polarized,
        )

    @classmethod
    def from_plain(cls, plain: Mapping[str, Any]) -> RowLayout:
        """Return the layout of its fields, as JSON has them."""
        given: dict[str, Any] = {name: tuple(v) if isinstance(v, list) else v for name, v in plain.items()}
        return cls(**given)

    @property
    def split(self) -> int:
        """Number of columns of a row before those of the steady image."""
        return math.prod(self.front) * (2 if self.phasor else 1)

    @property
    def columns(self) -> int:
        """Number of columns of a row."""
        return self.split + (math.prod(self.steady) if self.steady else 0)

    def rows(self, capture: Capture) -> Rows:
        """Return the rows (N, columns) of a capture's sensor points, in the order of the scan."""
        rank = len(capture.scan.sensor_shape)
        measured = _points_first(_measured(capture), rank)
        if self.phasor:
            measured = torch.view_as_real(measured)
        parts = [measured.reshape(len(measured), -1)]
        if capture.steady is not None:
            parts.append(_points_first(capture.steady, rank).reshape(len(measured), -1))
        return torch.cat(parts, 1).numpy() if len(parts) > 1 else parts[0].numpy()

    def capture(
        self, rows: Rows, scan: Scan, axis: TimeAxis | None, frequencies: FrequencyAxis | None
    ) -> dict[str, Any]:
        """Return the arguments of :class:`Capture`, but its metadata, as views of ``rows`` (N, columns)."""
        numbers = torch.from_numpy(rows)
        measured, steady = numbers[:, : self.split], numbers[:, self.split :]
        if self.phasor:
            # Beside a steady image the pairs of a row may begin at odd places.
            measured = torch.view_as_complex(measured.reshape(len(numbers), -1, 2).contiguous())
        made: dict[str, Any] = {"transient": None, "phasor": None, "steady": None}
        made["phasor" if self.phasor else "transient"] = _points_last(measured, self.front, scan)
        if self.steady:
            made["steady"] = _points_last(steady, self.steady, scan)
        settings = {"channels": self.channels, "polarized": self.polarized}
        return made | settings | {"scan": scan, "axis": axis, "frequencies": frequencies}


def _measured(capture: Capture) -> torch.Tensor:
    found = capture.transient if capture.transient is not None else capture.phasor
    assert found is not None  # a simulation measures one of them
    return found


def _points_first(tensor: torch.Tensor, rank: int) -> torch.Tensor:
    """(N, ...) of (..., *sensor): in memory as films are."""
    flat = tensor.cpu().flatten(tensor.ndim - rank)
    return flat.movedim(-1, 0).contiguous()


def _points_last(rows: torch.Tensor, front: tuple[int, ...], scan: Scan) -> torch.Tensor:
    """(*front, *sensor) of (N, columns)."""
    moved = rows.reshape(len(rows), *front).movedim(0, -1)
    return moved.reshape(*front, *scan.sensor_shape)


FORMAT = "torchtransient part 2"


class PartFile:
    """Finished rows of one simulation. To be used in a ``with`` block, which holds the lock.

    ``about``: plain data that was kept with them, empty at first.

    Args:
        path: path of the JSON file.
        key: key of the simulation; "" takes the file of any simulation, to remove it.

    Raises:
        StorageError: where ``path`` is another kind of file, belongs to another simulation, is damaged, or is worked on
            by another process.
    """

    def __init__(self, path: Path, key: str) -> None:
        self.path, self._key = path, key
        self._data = path.with_name(path.name + ".npy")
        self._lock = contextlib.ExitStack()
        self._done: dict[int, list[int]] = {}
        self._file: IO[bytes] | None = None
        self.about: dict[str, Any] = {}
        self.seconds = 0.0

    def __enter__(self) -> PartFile:
        if not self.path.parent.is_dir():
            raise StorageError(f"part file: the folder '{self.path.parent}' does not exist. Create it first.")
        with contextlib.ExitStack() as lock:
            lock.enter_context(_locked(self.path.with_name(self.path.name + ".lock")))
            if self.path.exists():
                self._read()
            self._lock = lock.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._close()
        self._lock.close()

    # -------------------------------------------------------------------------------------------------------- reading

    def _read(self) -> None:
        try:
            said = json.loads(self.path.read_text(encoding="utf-8"))
            done = {int(number): [int(n) for n in entry] for number, entry in said["done"].items()}
            form, key, about, seconds = said["format"], said["key"], dict(said["about"]), float(said["seconds"])
            if any(first < 0 or count < 1 for first, count, _ in done.values()):
                raise ValueError("rows before the first one")
        except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
            raise StorageError(
                f"part file: '{self.path}' is not the part file of a simulation ({FORMAT}), or is damaged: "
                f"{short_message(error)}. Give another name, or delete it to start anew."
            ) from error
        if form == FORMAT and not self._key:
            return
        if form != FORMAT or key != self._key:
            raise StorageError(
                f"part file: '{self.path}' belongs to another simulation. Give another name, or delete it."
            )
        self._done, self.about, self.seconds = done, about, seconds
        with self._errors_said():
            try:
                self._file = self._data.open("r+b")
            except FileNotFoundError as error:
                raise StorageError(
                    f"part file: '{self._data}', which holds the rows that '{self.path}' tells of, is gone. Put it "
                    f"back, or delete '{self.path}' to start anew."
                ) from error
            self._check()

    def _check(self) -> None:
        """Check the rows by their checksums. Raises StorageError."""
        there = self._rows()
        for first, count, checksum in self._done.values():
            if zlib.crc32(there[first : first + count].data) != checksum:
                raise StorageError(
                    f"part file: '{self._data}' is damaged or cut off: rows {first} to {first + count - 1} are not "
                    f"those that '{self.path}' tells of. Delete both to start anew."
                )

    def has(self, number: int) -> bool:
        """Return True where a part is finished."""
        return number in self._done

    @property
    def last(self) -> int | None:
        """The highest number that is finished, None without one."""
        return max(self._done, default=None)

    def rows(self, first: int, count: int) -> Rows:
        """Return some rows, (count, columns)."""
        with self._errors_said():
            return self._rows()[first : first + count].copy()

    def everything(self) -> Rows:
        """Return all rows, read into memory."""
        with self._errors_said():
            return np.load(self._data, allow_pickle=False)  # type: ignore[no-any-return]

    def _rows(self) -> Rows:
        return np.load(self._data, mmap_mode="r", allow_pickle=False)  # type: ignore[no-any-return]

    # -------------------------------------------------------------------------------------------------------- writing

    def keep(
        self, number: int, first: int, rows: Rows, *, total: int, seconds: float, about: Mapping[str, Any],
        instead_of: int | None = None,
    ) -> None:  # fmt: skip
        """Keep a part.

        Args:
            number: number of the part.
            first: first row of the part.
            rows: rows of the part, (N, columns).
            total: number of rows of the file.
            seconds: time in seconds that the part took.
            about: plain data to be kept with all parts.
            instead_of: number of a part that it replaces.

        Raises:
            StorageError: for a full disk, which leaves the parts before.
        """
        with self._errors_said():
            data = np.ascontiguousarray(rows, dtype=np.float32).tobytes()
            if self._file is None:
                self._file = self._data.open("w+b")
                header = {"descr": "<f4", "fortran_order": False, "shape": (total, rows.shape[1])}
                np.lib.format.write_array_header_1_0(self._file, header)
                self._file.truncate(self._start() + 4 * total * rows.shape[1])
            self._file.seek(self._start() + first * 4 * rows.shape[1])
            self._file.write(data)
            self._file.flush()
            os.fsync(self._file.fileno())
            done = {n: entry for n, entry in self._done.items() if n != instead_of}
            done[number] = [first, len(rows), zlib.crc32(data)]
            seconds += self.seconds
            said = {"format": FORMAT, "key": self._key, "done": done, "seconds": seconds, "about": dict(about)}
            with whole_file(self.path, "part file") as fresh:
                fresh.write_text(json.dumps(said), encoding="utf-8")
            self._done, self.seconds, self.about = done, seconds, dict(about)

    def _start(self) -> int:
        """Return the place of the first row: behind the header, which says its own length."""
        assert self._file is not None
        self._file.seek(8)
        return 10 + int.from_bytes(self._file.read(2), "little")

    def remove(self) -> None:
        """Delete the files; the lock goes at the end of the ``with`` block."""
        self._close()
        self._done = {}
        for path in (self.path, self._data):
            path.unlink(missing_ok=True)

    def _close(self) -> None:
        if self._file is not None:
            # What a full disk has left in the buffer was not finished.
            with contextlib.suppress(OSError):
                self._file.close()
            self._file = None

    @contextlib.contextmanager
    def _errors_said(self) -> Iterator[None]:
        try:
            yield
        except (OSError, EOFError, ValueError) as error:
            if isinstance(error, StorageError):
                raise
            raise StorageError(
                f"part file: '{self.path}' and '{self._data.name}' could not be read or written: {error}. What was "
                "finished before is kept: with room on the disk the same call goes on."
            ) from error


def delete_part_file(path: Path) -> None:
    """Delete the files of a simulation's parts, if there are any.

    Args:
        path: path of the JSON file.

    Raises:
        StorageError: for another kind of file, or one that another process works on.
    """
    if not path.exists():
        return
    with PartFile(path, "") as kept:
        kept.remove()


@contextlib.contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Hold a file that one process at a time holds; the system lets go of it when the process ends, however it does.

    Raises StorageError where another process holds it.
    """
    import fcntl

    while True:
        try:
            file = path.open("a+", encoding="utf-8")
        except OSError as error:
            raise StorageError(f"part file: '{path}' could not be opened: {error}.") from error
        with file:
            try:
                fcntl.flock(file.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                raise StorageError(
                    f"part file: another process works on '{path.with_suffix('')}'. Wait for it, or give another name."
                ) from error
            # The one that held it before may have deleted it: then it is nobody's any more.
            try:
                ours = os.path.samestat(os.fstat(file.fileno()), path.stat())
            except FileNotFoundError:
                continue
            if not ours:
                continue
            try:
                yield
            finally:
                path.unlink(missing_ok=True)
            return
