"""Generation of data sets: the samples of a recipe on disk, by workers that may die."""

from __future__ import annotations

import contextlib
import math
import multiprocessing
import platform
import time
import warnings
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Any

from torchtransient.array_files.hdf5 import hdf5_package
from torchtransient.array_files.part_files import check_system, sweep_parts
from torchtransient.checks import a_recipe, count, is_one_of, path_of, shown
from torchtransient.data.crew import Ledger, RunLog, SampleBar
from torchtransient.data.engines import InProcessCrew, Supervisor, make_on_ray, ray_package
from torchtransient.data.manifest import build_manifest, fault_of, named_shards, shards_of
from torchtransient.data.processes import registered_plugins
from torchtransient.data.run_settings import (
    MANIFEST_FILE,
    RECIPE_FILE,
    SHARD_FILES,
    Plan,
    RunSettings,
    as_json,
    bytes_text,
    check_same,
    description,
    read_description,
    samples_per_shard,
    shard_file_name,
    shard_header,
    write_description,
)
from torchtransient.data.shard_format import check_compression, check_store
from torchtransient.data.shards import Shard
from torchtransient.errors import ArgumentError, SceneError, StorageError, TorchTransientError, UnitError, level_of_user

ENGINES = ("local", "ray")
# Samples that are tried until one can be measured.
MEASURED = 16
_WHAT = "generate"


@dataclass(frozen=True)
class Generated:
    """Result of a run.

    Args:
        folder: folder of the data set.
        samples: number of samples that this run has made.
        failed: number of samples among them that could not be made.
        kept: number of samples in shards that were there before.
        shards: number of shards that this run has made.
        bytes: bytes of these shards.
        seconds: seconds from the call to the end of the run.
        restarts: number of workers that were replaced.
    """

    folder: Path
    _: KW_ONLY
    samples: int
    failed: int
    kept: int
    shards: int
    bytes: int
    seconds: float
    restarts: int

    @property
    def samples_per_second(self) -> float:
        """Rate of this run, with the start of the workers."""
        return self.samples / self.seconds if self.seconds > 0 else math.nan

    def __str__(self) -> str:
        parts = [f"{self.samples} samples in {self.shards} shards, {bytes_text(self.bytes)}"]
        parts += [f"{self.failed} failed"] if self.failed else []
        parts += [f"{self.kept} were there"] if self.kept else []
        parts += [f"{self.restarts} worker{'s' * (self.restarts != 1)} replaced"] if self.restarts else []
        rate = f", {self.samples_per_second:.3g} samples a second" if self.samples else ""
        parts += [f"{self.seconds:.1f} s{rate}"]
        return f"{self.folder}: {'; '.join(parts)}"


def generate(
    recipe: Any,
    folder: str | Path,
    n: int | None = None,
    *,
    workers: int = 2,
    store: str = "exact",
    compression: str = "blosc2",
    resume: bool = True,
    engine: str = "local",
    shard: tuple[int, int] | None = None,
    per_shard: int | None = None,
    timeout_s: float | None = None,
    retries: int = 2,
    progress: bool = True,
    address: str | None = None,
) -> Generated:
    """Render samples 0 to ``n`` - 1 of a recipe into shard files in a folder.

    The same call goes on after whatever ended it: finished shards are kept, damaged ones are made again (bytes are
    compared with checksums where the manifest does not name the shard, as after ``verify``). Files of a recipe have the
    same bytes in whatever order, by however many workers and on whichever engine they are made, on one kind of
    processor with the same packages; every worker computes with one thread. A sample that raises is tried again with
    new scenes; then it stands in its shard as failed, with the reason, and so do samples over which worker after worker
    dies or is silent for ``timeout_s``. To try failed samples again, delete their shard. Light outside of the window is
    no failure: samples are kept with their shares of it. The first run of a folder checks the recipe
    (:meth:`Recipe.check`), whose warnings give the number of samples concerned.

    The folder holds ``recipe.json``, ``shard-*.h5``, ``manifest.json`` (made of the shards), ``log.jsonl`` (times,
    deaths, failures) and ``latest.png``. Scripts need ``if __name__ == "__main__"``: workers import them.

    Args:
        recipe: :class:`Recipe`, or an object of one's own with ``maker()``, ``key()`` and ``to_dict()`` that pickles.
        folder: folder of the data set, made if missing.
        n: number of samples; None takes the recipe's own.
        workers: processes of one thread each, replaced when they die. 0 makes samples in this process, as torch's
            loaders do, where a debugger finds them and a crash ends the run.
        store: "exact", "rounded" or "counts", see :class:`ShardWriter`.
        compression: "blosc2", "gzip" or "none".
        resume: False raises where the folder has a data set.
        engine: "local" (processes) or "ray" (tasks on a cluster whose machines all see ``folder``; each makes an even
            share of the shards).
        shard: (i, k) makes every k-th shard from the i-th on: k machines that see one folder divide the work.
        per_shard: samples in a file; by default 64 to 256 MB before compression, and 64 files at least.
        timeout_s: seconds for one sample, the compilation of a new scene included; by default 30 times the slowest so
            far, at least 120.
        retries: attempts at a sample after the first.
        progress: show a bar.
        address: address of the cluster of Ray; None for a running or a new local one.

    Returns:
        :class:`Generated`.

    Raises:
        StorageError: for a full disk (finished shards stay whole; the same call goes on) and for a folder of another
            recipe or other settings.
        UnitError: for numbers out of range.
        ArgumentError: for other recipes, stores, compressions and engines, and without a number of samples.
        SceneError: where no sample can be made.
        TorchTransientError: where workers die without end. KeyboardInterrupt passes, with workers stopped.
    """
    start = time.monotonic()
    check_system(_WHAT)
    _check_process()
    a_recipe(_WHAT, recipe, "maker", "key", "to_dict")
    n = getattr(recipe, "n", None) if n is None else n
    if n is None:
        raise ArgumentError(f"{_WHAT}: neither the call nor the recipe says how many samples. Give n=.")
    n, retries = _whole("n", n, 1), _whole("retries", retries, 0)
    workers = _whole("workers", workers, int(is_one_of(engine, ("ray",))))
    per_shard = None if per_shard is None else _whole("per_shard", per_shard, 1)
    # Infinity is no limit.
    if timeout_s is not None and not timeout_s > 0:
        raise UnitError(f"{_WHAT}: expected timeout_s to be a number above 0, or None, got {shown(timeout_s)}.")
    if shard is not None and not 0 <= shard[0] < shard[1]:
        raise UnitError(f"{_WHAT}: expected shard=(i, k) with 0 <= i < k, got {shown(shard)}.")
    _check_choices(store, compression, engine, address, recipe)
    place = _folder(folder)
    settings = RunSettings(recipe, str(place), n, store, compression, retries, registered_plugins())
    wanted = description(settings, per_shard or 0, {}, None)
    if per_shard is None:
        del wanted["per_shard"]
    found = _there(place, wanted, resume)
    log = RunLog(place)
    _sweep(place)
    ledger = Ledger(retries, log, SampleBar(0, 0, shown=False))
    log("begin", n=n, workers=workers, engine=engine, shard=shard, host=platform.node())
    kept = 0
    try:
        with (Supervisor if workers else InProcessCrew)(settings, workers, ledger, timeout_s) as crew:
            if found is None:
                found = _begin(crew, settings, per_shard, wanted)
            plan = Plan(n, found["per_shard"])
            share = plan.share(*(shard or (0, 1)))
            left, kept = _survey(place, settings, found, share, log)
            total = sum(len(plan.indices(k)) for k in share)
            ledger.bar = SampleBar(total, total - sum(len(plan.indices(k)) for k in left), shown=progress)
            if engine == "local":
                crew.make(left, found)
            else:
                crew.close(stopped=False)
                call = {
                    "recipe": recipe, "folder": place, "n": n, "store": store, "compression": compression,
                    "per_shard": plan.per_shard, "timeout_s": timeout_s, "retries": retries,
                }  # fmt: skip
                first, step, tasks = *(shard or (0, 1)), min(workers, len(left))
                calls = [{**call, "shard": (first + step * task, step * tasks)} for task in range(tasks)]
                _make_on_ray(calls, address, place, left, ledger)
        _write_manifest(place)
    except BaseException as error:
        log("stopped", error=f"{type(error).__name__}: {error}")
        raise
    else:
        log("end", seconds=round(time.monotonic() - start, 3), **ledger.totals())
    finally:
        ledger.bar.close()
        _sweep(place)
    done = ledger.totals()
    return Generated(place, kept=kept, seconds=time.monotonic() - start, **done)


def _begin(crew: Any, settings: RunSettings, per_shard: int | None, wanted: dict[str, Any]) -> dict[str, Any]:
    """Describe a new data set by its first sample."""
    measured = crew.measure(range(min(settings.n, MEASURED)))
    for message, category in measured.warned:
        warnings.warn(message, category, level_of_user())
    size = per_shard or samples_per_shard(settings.n, measured.sample_bytes)
    described = description(settings, size, measured.about, measured.standard_error)
    place = Path(settings.folder)
    # Another run may have been first.
    found = write_description(place, described)
    check_same(found, wanted, place / RECIPE_FILE)
    return found


def _there(place: Path, wanted: dict[str, Any], resume: bool) -> dict[str, Any] | None:
    """Description in the folder, checked; None for a new folder."""
    found = read_description(place)
    first = next(iter(sorted(place.glob(SHARD_FILES))), None)
    if not resume and (found is not None or first is not None):
        raise StorageError(
            f"{_WHAT}: '{place}' has a data set, and resume=False was asked for. Choose another folder, or delete it."
        )
    if found is not None:
        check_same(found, wanted, place / RECIPE_FILE)
    elif first is not None:
        # A damaged one has no header, and is made again.
        header: dict[str, Any] = {}
        with contextlib.suppress(StorageError), Shard(first) as there:
            header = there.header
        check_same(header, wanted, first)
    return found


def _survey(
    place: Path, settings: RunSettings, described: dict[str, Any], share: range, log: RunLog
) -> tuple[list[int], int]:
    """Shards that are missing or damaged, and the number of samples in the others. Raises StorageError for shards of
    another data set.
    """
    left, kept, named = [], 0, named_shards(place)
    for number in share:
        path = place / shard_file_name(number)
        if not path.exists():
            left.append(number)
            continue
        # A disk may have lost written bytes. The manifest does not name shards that verify found damaged.
        fault = fault_of(path, named)
        header: dict[str, Any] = {}
        if fault is None:
            try:
                with Shard(path) as there:
                    header, samples = there.header, len(there.index)
            except StorageError as error:
                fault = str(error)
        expected = as_json(shard_header(settings, described, number))
        if fault is None:
            fault = _fault_of_header(header, expected, path)
        if fault is not None:
            log("damaged", shard=number, error=fault)
            left.append(number)
            continue
        kept += samples
    return left, kept


def _fault_of_header(header: dict[str, Any], expected: dict[str, Any], path: Path) -> str | None:
    """Fault of a shard in the place of another one, None for the right one. Raises StorageError for one of another data
    set.
    """
    check_same(header, expected, path)
    other = [k for k in sorted({*header, *expected}) if header.get(k) != expected.get(k)]
    if other and set(other) <= {"shard", "samples"}:
        return f"'{path}' is shard {shown(header.get('shard'))} under another name."
    if other:
        raise StorageError(
            f"{_WHAT}: '{path}' is of this recipe and differs in {other[0]!r}, as when other versions of packages made "
            "it. Choose another folder."
        )
    return None


def _make_on_ray(
    calls: list[dict[str, Any]], address: str | None, place: Path, left: list[int], ledger: Ledger
) -> None:
    """Make shards by tasks of Ray, and add up what they hold."""
    waiting = {number: place / shard_file_name(number) for number in left}
    for damaged in waiting.values():
        damaged.unlink(missing_ok=True)

    def add_up() -> None:
        for number, path in list(waiting.items()):
            if path.exists():
                with Shard(path) as made:
                    samples, failed = len(made.index), len(made.failed)
                ledger.bar(samples + failed, failed=failed)
                ledger.wrote(number, samples + failed, failed, path.stat().st_size)
                del waiting[number]

    ledger.restarts += make_on_ray(generate, calls, address, add_up)
    if waiting:
        raise StorageError(
            f"{_WHAT}: shard {min(waiting)} was made, and is not in '{place}'. All machines of the cluster have to see "
            "this folder under this name."
        )


def _write_manifest(place: Path) -> None:
    """Write the manifest, again where another run on this folder has finished shards meanwhile: the last run to look
    has seen all. Shards of other runs that ``verify`` found damaged are left out.
    """
    named, damaged = named_shards(place), set[str]()
    if (place / MANIFEST_FILE).exists():
        written = (place / MANIFEST_FILE).stat().st_mtime_ns
        # Younger ones were finished after it; each of many machines would read all of them.
        older = [path for path in shards_of(place) if path.stat().st_mtime_ns <= written]
        damaged = {path.name for path in older if path.name not in named and fault_of(path, named)}
    seen: set[str] | None = None
    while (now := {path.name for path in place.glob(SHARD_FILES)}) != seen:
        seen = now
        if now - damaged:
            build_manifest(place, damaged)


def _sweep(place: Path) -> None:
    with contextlib.suppress(OSError):
        sweep_parts(place)


# ---------------------------------------------------------------------------------------------------------- arguments


def _check_process() -> None:
    if getattr(multiprocessing.current_process(), "_inheriting", False):
        raise TorchTransientError(
            f"{_WHAT}: called while a worker imports this script. Put the call under if __name__ == '__main__'."
        )


def _whole(name: str, value: Any, least: int) -> int:
    return count(f"{_WHAT}: {name}", value, least, UnitError)


def _check_choices(store: Any, compression: Any, engine: Any, address: Any, recipe: Any) -> None:
    hdf5_package(_WHAT)
    check_store(store, _WHAT)
    check_compression(compression, _WHAT)
    if not is_one_of(engine, ENGINES):
        raise ArgumentError(f"{_WHAT}: expected engine to be one of {', '.join(ENGINES)}, got {shown(engine)}.")
    if engine == "ray":
        ray_package()
    elif address is not None:
        raise UnitError(f"{_WHAT}: address={shown(address)} is for engine='ray', got engine={engine!r}.")
    if store == "counts" and getattr(recipe, "device", ...) is None:
        raise SceneError(f"{_WHAT}: store='counts' stores the measurement of recipes with a device; give one.")


def _folder(folder: Any) -> Path:
    place = path_of(folder, _WHAT).absolute()
    try:
        place.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StorageError(f"{_WHAT}: the folder '{place}' cannot be made: {error}.") from error
    return place
