"""One process of a run: shard after shard of its recipe, on every engine."""

from __future__ import annotations

import contextlib
import math
import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

from torchtransient.data.overview import LatestPicture
from torchtransient.data.processes import add_plugins, traced
from torchtransient.data.run_settings import Plan, RunSettings, as_json, check_same, shard_file_name, shard_header
from torchtransient.data.shards import ShardWriter
from torchtransient.errors import SceneError, StorageError, TorchTransientError, TorchTransientWarning
from torchtransient.rendering.threads import threads

Say = Callable[..., object]
NONE: Mapping[int, str] = MappingProxyType({})
# Most letters of a reason, which is stored for every sample that failed.
MOST_CHARACTERS = 500
_FOLDERS = re.compile(r"(?<![\w.])(?:/[^/\s'\":,;()]+)+/(?=[^/\s])")
_ADDRESS = re.compile(r"\b0x[0-9a-fA-F]{4,}\b")


class ShardMaker:
    """Maker of shards of one recipe. The process computes with one thread from here on: with several, sums are added up
    in the order in which threads finish, and bytes differ.

    Its methods report their progress by ``say``, each message a sign of life: ("begin", shard, index), ("end", shard,
    index, reason of a failure or None), ("retry", shard, index, reason), ("traced", shard, index, traceback),
    ("closing", shard).

    Args:
        settings: settings of the run.
    """

    def __init__(self, settings: RunSettings) -> None:
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
        """Free the scenes."""
        made, self._made = self._made, None
        if made is not None:
            made.close()

    def measure(self, indices: range, say: Say, skip: Mapping[int, str] = NONE) -> Measured:
        """Check the recipe, and make samples until one can be made.

        Args:
            indices: numbers of the samples to try.
            say: function of the entries of a message.
            skip: samples that are not tried, with the reason.

        Returns:
            Figures of the sample.

        Raises:
            SceneError: where none of the samples can be made. Errors of the check pass.
        """
        warned: list[tuple[str, type[Warning]]] = []
        check = getattr(self.settings.recipe, "check", None)
        if check is not None:
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always", TorchTransientWarning)
                check(self._maker)
            for one in caught:
                if issubclass(one.category, TorchTransientWarning):
                    warned.append((str(one.message), one.category))
                else:
                    warnings.showwarning(one.message, one.category, one.filename, one.lineno)
        reason = ""
        for index in indices:
            reason = skip.get(index, "")
            if not reason:
                say("begin", -1, index)
                found = self._sample(-1, index, say)
                say("end", -1, index, found if isinstance(found, str) else None)
                if not isinstance(found, str):
                    size = sum(array.nbytes for array in found.arrays.values())
                    error = self._standard_error(index, say)
                    return Measured(size, as_json(self._maker.about()), error, tuple(warned))
                reason = found
        raise SceneError(
            f"generate: none of the samples 0 to {indices.stop - 1} of the recipe can be made. The last one: {reason}"
        )

    def make(
        self, shard: int, described: Mapping[str, Any], say: Say, skip: Mapping[int, str] = NONE,
        first: Sequence[int] = (),
    ) -> tuple[int, int, int]:  # fmt: skip
        """Write one shard.

        Args:
            shard: number of the shard.
            described: content of ``recipe.json``.
            say: function of the entries of a message.
            skip: samples that are not tried, with the reason.
            first: samples that are made before the others.

        Returns:
            Samples, failed ones, and bytes of the file.

        Raises:
            StorageError: for a full disk for instance; nothing half-written is left.
        """
        settings = self.settings
        if not self._compared:
            about = as_json(self._maker.about())
            check_same(described["about"], about, Path(settings.folder), tuple(described["about"]))
            self._compared = True
        plan = Plan(settings.n, described["per_shard"])
        indices, failed = plan.indices(shard), 0
        path = Path(settings.folder) / shard_file_name(shard)
        header = shard_header(settings, described, shard)
        with ShardWriter(path, len(indices), header, store=settings.store, compression=settings.compression) as writer:
            others = [index for index in indices if index not in first]
            for index in (*first, *self._maker.order(others)):
                if index in skip:
                    found = skip[index]
                else:
                    say("begin", shard, index)
                    found = self._sample(shard, index, say)
                if isinstance(found, str):
                    writer.fail(index - indices.start, index, found)
                    failed += 1
                    say("end", shard, index, found)
                else:
                    writer.put(index - indices.start, found)
                    say("end", shard, index, None)
                    self._picture(found)
            say("closing", shard)
        return len(indices), failed, path.stat().st_size

    def _sample(self, shard: int, index: int, say: Say) -> Any:
        """Make a sample, or return the reason why it cannot be made."""
        for attempt in range(self.settings.retries + 1):
            try:
                found = self._maker.sample(index)
                if found.index != index:
                    raise TorchTransientError(f"the maker was asked for sample {index} and made {found.index}.")
            except Exception as error:  # noqa: BLE001  one sample that fails must not end the night
                reason = reason_of(error)
                if attempt == 0:
                    say("traced", shard, index, traced(error))
                # Its traces in kept scenes must not change other samples.
                with contextlib.suppress(Exception):
                    self.close()
                if attempt < self.settings.retries:
                    say("retry", shard, index, reason)
            else:
                return found
        return reason

    def _standard_error(self, index: int, say: Say) -> float | None:
        say("begin", -1, index)
        value: float | None = None
        try:
            value = float(self._maker.standard_error(index))
        except TorchTransientError as error:
            say("retry", -1, index, f"no standard error: {reason_of(error)}")
        say("end", -1, index, None)
        return value if value is not None and math.isfinite(value) else None


@dataclass(frozen=True)
class Measured:
    """Figures of the first sample that can be made, for all samples.

    Args:
        sample_bytes: bytes of a sample before compression.
        about: ``Maker.about``.
        standard_error: relative standard error of the sample, or None.
        warned: messages and classes of this library's warnings in the recipe's check, for the caller of ``generate``.
    """

    sample_bytes: int
    about: dict[str, Any]
    standard_error: float | None
    warned: tuple[tuple[str, type[Warning]], ...] = ()


def execute(task: tuple[Any, ...], maker: ShardMaker, say: Say) -> tuple[Any, ...]:
    """Execute a task of a worker.

    Args:
        task: ("measure", indices, skip) or ("shard", number, description, skip, first).
        maker: maker of the worker.
        say: function of the entries of a message.

    Returns:
        The last message, ("measured", Measured) or ("wrote", number, samples, failed, bytes).
    """
    kind, *rest = task
    if kind == "measure":
        indices, skip = rest
        return "measured", maker.measure(indices, say, skip)
    shard, described, skip, first = rest
    return "wrote", shard, *maker.make(shard, described, say, skip, first)


def reason_of(error: BaseException) -> str:
    """Return the reason of a failure in one line, the same in every run and place: without addresses in memory, and
    with the names alone of files in other folders.

    Args:
        error: exception that was raised.

    Returns:
        Text of 500 characters at most.
    """
    text = " ".join(f"{type(error).__name__}: {error}".split())
    text = _FOLDERS.sub("", _ADDRESS.sub("0x...", text))
    return text if len(text) <= MOST_CHARACTERS else f"{text[: MOST_CHARACTERS - 3]}..."


def fatal(error: BaseException) -> tuple[str, str, str]:
    """Return an error as plain texts, since not all errors pickle.

    Args:
        error: exception that was raised.

    Returns:
        Name of its class, message, traceback.
    """
    return type(error).__name__, str(error), traced(error)


def raised(kind: str, message: str) -> Exception:
    """Make the error of another process, of the library's class of that name.

    Args:
        kind: name of the class.
        message: message of the exception.

    Returns:
        Exception.
    """
    from torchtransient import errors

    known = getattr(errors, kind, None)
    if kind == "StorageError" or kind in ("OSError", "PermissionError", "FileNotFoundError"):
        return StorageError(f"{message} Finished shards are kept: the same call goes on.")
    if isinstance(known, type) and issubclass(known, TorchTransientError):
        return known(message)
    return TorchTransientError(f"generate: a worker ended: {kind}: {message}")
