"""One process' part of a data set, whatever engine has started it: shard after shard of its recipe."""

from __future__ import annotations

import contextlib
import math
import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from torchtransient.data.generation.latest_picture import LatestPicture
from torchtransient.data.generation.plan import Plan
from torchtransient.data.generation.settings import Settings, check_same, plain, shard_header
from torchtransient.data.generation.told_errors import traced
from torchtransient.data.recipes.plugin_modules import add_plugins
from torchtransient.data.storage.file_names import shard_file_name
from torchtransient.errors import SceneError, StorageError, TorchTransientError, TorchTransientWarning

# Words of a reason at most: it stands in the file for every sample that failed.
MOST_CHARACTERS = 500
_FOLDERS = re.compile(r"(?<![\w.])(?:/[^/\s'\":,;()]+)+/(?=[^/\s])")
_ADDRESS = re.compile(r"\b0x[0-9a-fA-F]{4,}\b")


class Told(Protocol):
    """Who hears what becomes of samples. Every call is a sign of life."""

    def begin(self, shard: int, index: int) -> str | None:
        """Before a sample. A text: the sample is not to be tried, and that is why."""

    def end(self, shard: int, index: int, failed: str | None) -> None:
        """After it: made, or failed for a reason."""

    def retry(self, shard: int, index: int, reason: str) -> None:
        """It failed, and is tried again."""

    def traced(self, shard: int, index: int, trace: str) -> None:
        """Where it has failed first."""

    def closing(self, shard: int) -> None:
        """All samples are there, the file is finished."""


@dataclass(frozen=True)
class Measured:
    """Figures of the first sample that can be made, for all: bytes before compression, facts, standard error.
    ``warned``: messages and classes of this library's warnings of the recipe's check, which the caller of
    ``generate`` gets.
    """

    sample_bytes: int
    about: dict[str, Any]
    standard_error: float | None
    warned: tuple[tuple[str, type[Warning]], ...] = ()


class ShardMaker:
    """Makes shards of one recipe. The process computes with one thread from here on: with more of them sums are added
    up in the order in which threads come, and bytes differ.
    """

    def __init__(self, settings: Settings) -> None:
        from torchtransient.rendering.threads import threads

        threads(1)
        add_plugins(settings.plugins, "generate")
        self.settings = settings
        self._made: Any = settings.recipe.maker()
        self._picture = LatestPicture(Path(settings.folder))
        self._compared = False

    @property
    def _maker(self) -> Any:
        if self._made is None:
            self._made = self.settings.recipe.maker()
        return self._made

    def close(self) -> None:
        """Let go of the scenes."""
        made, self._made = self._made, None
        if made is not None:
            made.close()

    def measure(self, indices: range, told: Told) -> Measured:
        """Check the recipe, and make samples until one can be made. Raises what is wrong with the recipe, SceneError
        where none of the samples can be made.
        """
        said: list[tuple[str, type[Warning]]] = []
        check = getattr(self.settings.recipe, "check", None)
        if check is not None:
            with warnings.catch_warnings(record=True) as warned:
                warnings.simplefilter("always", TorchTransientWarning)
                check(self._maker)
            for one in warned:
                if issubclass(one.category, TorchTransientWarning):
                    said.append((str(one.message), one.category))
                else:
                    warnings.showwarning(one.message, one.category, one.filename, one.lineno)
        reason = ""
        for index in indices:
            reason = told.begin(-1, index) or ""
            if not reason:
                found = self._sample(-1, index, told)
                told.end(-1, index, found if isinstance(found, str) else None)
                if not isinstance(found, str):
                    size = sum(array.nbytes for array in found.arrays.values())
                    error = self._standard_error(index, told)
                    return Measured(size, plain(self._maker.about()), error, tuple(said))
                reason = found
        raise SceneError(
            f"generate: none of the samples 0 to {indices.stop - 1} of the recipe can be made. The last one: {reason}"
        )

    def make(
        self, shard: int, described: Mapping[str, Any], told: Told, first: Sequence[int] = ()
    ) -> tuple[int, int, int]:
        """Write one shard; returns samples, failed ones, and bytes of the file. ``first``: samples that come before the
        others. Raises StorageError, for a full disk for instance, and leaves nothing half-written.
        """
        from torchtransient.data.storage.shard_file import ShardWriter

        settings = self.settings
        if not self._compared:
            about = plain(self._maker.about())
            check_same(described["about"], about, Path(settings.folder), tuple(described["about"]))
            self._compared = True
        plan = Plan(settings.n, described["per_shard"])
        indices, failed = plan.indices(shard), 0
        path = Path(settings.folder) / shard_file_name(shard)
        header = shard_header(settings, described, shard)
        with ShardWriter(
            path, len(indices), header, store=settings.store, compression=settings.compression
        ) as writer:
            others = [index for index in indices if index not in first]
            for index in (*first, *self._maker.order(others)):
                reason = told.begin(shard, index)
                if reason is None:
                    found = self._sample(shard, index, told)
                    if isinstance(found, str):
                        reason = found
                    else:
                        writer.put(index - indices.start, found)
                if reason is not None:
                    writer.fail(index - indices.start, index, reason)
                    failed += 1
                told.end(shard, index, reason)
                if reason is None:
                    self._picture(found)
            told.closing(shard)
        return len(indices), failed, path.stat().st_size

    def _sample(self, shard: int, index: int, told: Told) -> Any:
        """A sample, or the reason why there is none."""
        for attempt in range(self.settings.retries + 1):
            try:
                found = self._maker.sample(index)
                if found.index != index:
                    raise TorchTransientError(f"the maker was asked for sample {index} and made {found.index}.")
            except Exception as error:  # noqa: BLE001  one sample that fails must not end the night
                reason = reason_of(error)
                if attempt == 0:
                    told.traced(shard, index, traced(error))
                # What it may have left behind in kept scenes must not decide about other samples.
                with contextlib.suppress(Exception):
                    self.close()
                if attempt < self.settings.retries:
                    told.retry(shard, index, reason)
            else:
                return found
        return reason

    def _standard_error(self, index: int, told: Told) -> float | None:
        told.begin(-1, index)
        value: float | None = None
        try:
            value = float(self._maker.standard_error(index))
        except TorchTransientError as error:
            told.retry(-1, index, f"no standard error: {reason_of(error)}")
        told.end(-1, index, None)
        return value if value is not None and math.isfinite(value) else None


def reason_of(error: BaseException) -> str:
    """One line that says why, the same one in every run and place: without addresses in memory, and of files in other
    folders their names alone.
    """
    text = " ".join(f"{type(error).__name__}: {error}".split())
    text = _FOLDERS.sub("", _ADDRESS.sub("0x...", text))
    return text if len(text) <= MOST_CHARACTERS else f"{text[: MOST_CHARACTERS - 3]}..."


def fatal(error: BaseException) -> tuple[str, str, str]:
    """An error as plain texts, since not all errors pickle: name of its class, message, files and lines."""
    return type(error).__name__, str(error), traced(error)


def raised(kind: str, message: str) -> Exception:
    """The error of another process again, of the library's class of that name."""
    from torchtransient import errors

    known = getattr(errors, kind, None)
    if kind == "StorageError" or kind in ("OSError", "PermissionError", "FileNotFoundError"):
        return StorageError(f"{message} Finished shards are kept: the same call goes on.")
    if isinstance(known, type) and issubclass(known, TorchTransientError):
        return known(message)
    return TorchTransientError(f"generate: a worker ended: {kind}: {message}")


