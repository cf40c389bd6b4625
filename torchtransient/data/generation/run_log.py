"""``log.jsonl`` and the progress bar of a run: what happened and when, which is no part of the data."""

from __future__ import annotations

import contextlib
import json
import os
import time
from pathlib import Path
from typing import Any

LOG_FILE = "log.jsonl"


class RunLog:
    """One line of JSON for each event. Runs on one folder share the file: a line is one write at its end. A disk that
    is full keeps no run from ending as it should, so lines may be missing then.
    """

    def __init__(self, folder: Path) -> None:
        self._handle: int | None = None
        with contextlib.suppress(OSError):
            self._handle = os.open(folder / LOG_FILE, os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o666)
            size = os.fstat(self._handle).st_size
            # A killed run may have left half a line.
            if size and os.pread(self._handle, 1, size - 1) != b"\n":
                os.write(self._handle, b"\n")

    def __call__(self, event: str, **facts: Any) -> None:
        if self._handle is None:
            return
        now = time.time()
        stamp = time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(now)) + f".{int(now * 1000) % 1000:03d}Z"
        line = json.dumps({"time": stamp, "event": event, "run": os.getpid(), **facts}, default=str) + "\n"
        with contextlib.suppress(OSError):
            os.write(self._handle, line.encode())

    def close(self) -> None:
        """End it."""
        if self._handle is not None:
            os.close(self._handle)
            self._handle = None


class SampleBar:
    """A progress bar over samples, with how many failed and how often a worker was replaced. tqdm is imported only when
    it is shown.
    """

    def __init__(self, total: int, done: int, shown: bool) -> None:
        self._bar: Any = None
        self.failed = self.restarts = 0
        if shown:
            from tqdm.auto import tqdm

            self._bar = tqdm(total=total, initial=done, desc="samples", unit="sample", dynamic_ncols=True)

    def __call__(self, samples: int, failed: int = 0, restarts: int = 0) -> None:
        """So many more; negative ones were lost with their shard."""
        self.failed += failed
        self.restarts += restarts
        if self._bar is None:
            return
        try:
            if failed or restarts:
                self._bar.set_postfix({"failed": self.failed, "restarts": self.restarts}, refresh=False)
            self._bar.update(samples)
        except (OSError, ValueError):
            # The terminal is gone; the night goes on.
            self._bar = None

    def close(self) -> None:
        """End it."""
        if self._bar is not None:
            with contextlib.suppress(OSError, ValueError):
                self._bar.close()
