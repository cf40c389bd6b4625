"""Manifest of a data set, and the verification of its shards.

``manifest.json`` is a table of contents: equal shards give equal bytes, and it can be made again at any time.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torchtransient.array_files.part_files import whole_file, writing_said
from torchtransient.array_files.plain_texts import json_data
from torchtransient.checks import check_special, path_of, shown
from torchtransient.data.run_settings import MANIFEST_FILE, RECIPE_FILE, SHARD_FILES, shard_file_name
from torchtransient.data.shards import Shard, stored_checksum
from torchtransient.errors import StorageError
from torchtransient.rendering.progress import with_bar

FORMAT = "torchtransient manifest 1"
_WHAT = "data set"
# Most missing samples, whose numbers are held in memory.
_MOST_MISSING = 10**8


@dataclass(frozen=True)
class Verified:
    """Result of :func:`verify`.

    Args:
        folder: folder of the data set.
        samples: number of samples in sound shards.
        shards: number of shard files.
        faults: descriptions of the faults by the name of the file, "manifest.json" among them.
        missing: numbers of the samples of the recipe in no sound shard, whose shards are still to be made.
        failed: reasons of the samples that could not be made, by their numbers.
    """

    folder: Path
    samples: int
    shards: int
    faults: Mapping[str, Sequence[str]] = field(default_factory=dict)
    missing: tuple[int, ...] = ()
    failed: Mapping[int, str] = field(default_factory=dict)

    @property
    def damaged(self) -> tuple[str, ...]:
        """Names of the shards with faults, which have to be made again."""
        return tuple(name for name in self.faults if name != MANIFEST_FILE)

    @property
    def complete(self) -> bool:
        """True where no fault was found and no sample is missing. Samples that failed are not missing."""
        return not self.faults and not self.missing

    def __str__(self) -> str:
        lines = [f"{self.folder}: {self.samples} samples in {self.shards} shards, {len(self.failed)} failed"]
        lines += [f"{name}: {fault}" for name, faults in self.faults.items() for fault in faults]
        if self.missing:
            lines.append(f"missing: {len(self.missing)} samples, {ranges_text(self.missing)}")
        return "\n".join(lines)


def shards_of(folder: str | Path) -> list[Path]:
    """Return the shards of a folder by name.

    Args:
        folder: folder of the data set.

    Returns:
        Paths.

    Raises:
        StorageError: without such a folder.
    """
    place = path_of(folder, _WHAT)
    if not place.is_dir():
        raise StorageError(f"{_WHAT}: expected the folder of a data set, got '{place}'.")
    return sorted(path for path in place.glob(SHARD_FILES) if path.is_file())


def build_manifest(folder: str | Path, without: Collection[str] = ()) -> dict[str, Any]:
    """Write ``manifest.json`` from the shards of a folder.

    Checksums are those that the shards carry, not compared with their bytes: :func:`verify` does.

    Args:
        folder: folder of the data set.
        without: names of shards that are left out.

    Returns:
        The manifest.

    Raises:
        StorageError: for damaged shards, doubled samples, shards of several recipes, and no shard.
    """
    paths = [path for path in shards_of(folder) if path.name not in without]
    if not paths:
        raise StorageError(f"{_WHAT}: '{folder}' holds no shard ({SHARD_FILES}).")
    entries = [_Entry.read(path) for path in paths]
    faults = _faults_between(entries, {})
    if faults:
        name, texts = next(iter(faults.items()))
        raise StorageError(f"{_WHAT}: '{folder}': {name}: {texts[0]}. Use verify, which reports every shard.")
    return _write(Path(folder), entries)


def named_shards(folder: Path) -> dict[str, tuple[str, int]]:
    """Return the checksums and sizes of the shards in ``manifest.json``.

    Args:
        folder: folder of the data set.

    Returns:
        (checksum, bytes) by name; empty where the manifest is missing or damaged.
    """
    with suppress(StorageError, KeyError, TypeError, AttributeError):
        text = _text_of(folder / MANIFEST_FILE)
        found = {} if text is None else json_data(text, f"{_WHAT}: '{folder / MANIFEST_FILE}'")["shards"]
        return {name: (entry["sha256"], entry["bytes"]) for name, entry in found.items()}
    return {}


def fault_of(path: Path, named: Mapping[str, tuple[str, int]]) -> str | None:
    """Return the fault of the bytes of a shard, which are read unless the manifest names its checksum.

    Args:
        path: path of the shard.
        named: result of :func:`named_shards`.

    Returns:
        Text, or None.
    """
    try:
        if named.get(path.name) == (stored_checksum(path), path.stat().st_size):
            return None
        with Shard(path) as shard:
            return shard.verify()
    except StorageError as error:
        return str(error)


def verify(folder: str | Path, progress: bool = False) -> Verified:
    """Read every byte of a data set, compare it with its checksums, and write the manifest of the sound shards again.

    Faults are: damaged shards, shards under the name of another one, of another recipe, other versions of packages or
    plugins, with other arrays or values; doubled samples; a manifest that differs from the shards. Missing are samples
    that ``recipe.json`` counts; without it those between the first and the last one.

    Args:
        folder: folder of the data set.
        progress: show a bar.

    Returns:
        :class:`Verified`.

    Raises:
        StorageError: for other folders.
    """
    paths = shards_of(folder)
    expected = _expected(Path(folder))
    faults: dict[str, list[str]] = {}
    entries = []
    for path in with_bar(paths, "verify", progress):
        try:
            entry = _Entry.read(path, whole=True)
        except StorageError as error:
            faults[path.name] = [str(error)]
            continue
        entries.append(entry)
    between = _faults_between(entries, expected)
    sound = [entry for entry in entries if entry.name not in between]
    faults |= between
    before = _text_of(Path(folder) / MANIFEST_FILE)
    if sound or (paths and before is not None):
        _write(Path(folder), sound)
        if before is not None and before != _text_of(Path(folder) / MANIFEST_FILE):
            faults[MANIFEST_FILE] = ["did not tell what the shards hold; it was made again"]
    have = {number for entry in sound for number in (*entry.index, *entry.failed)}
    n = expected.get("n")
    count = n if isinstance(n, int) else max(have, default=-1) + 1
    if count - len(have) > _MOST_MISSING:
        where = f"'{Path(folder) / RECIPE_FILE}' counts" if isinstance(n, int) else "the numbers of its samples ask for"
        raise StorageError(f"{_WHAT}: {where} {shown(count)} samples, and {len(have)} are there: it is damaged.")
    missing = sorted(set(range(count)) - have)
    return Verified(
        Path(folder), sum(len(entry.index) for entry in sound), len(paths), dict(sorted(faults.items())),
        tuple(missing), {number: entry.failed[number] for entry in sound for number in entry.failed},
    )  # fmt: skip


# ----------------------------------------------------------------------------------------------------------- the shards


@dataclass(frozen=True)
class _Entry:
    """Entry of a shard in the manifest."""

    name: str
    size: int
    checksum: str
    header: dict[str, Any]
    index: list[int]
    failed: dict[int, str]
    seeds: list[int]
    outside: list[float]
    about: dict[str, Any]

    @classmethod
    def read(cls, path: Path, whole: bool = False) -> _Entry:
        """Read a shard; ``whole``: all of its bytes. Raises StorageError for a damaged one."""
        with Shard(path) as shard:
            fault = shard.verify() if whole else None
            if fault:
                raise StorageError(f"shard: '{path}': {fault}. Make the shard again.")
            rows = list(shard.index.values())
            about = {
                "store": shard.store, "compression": shard.compression,
                "arrays": {name: _kind(shard, name) for name in shard.names}, "values": list(shard.keys),
            }  # fmt: skip
            seeds = sorted(int(shard.seeds[row]) for row in rows)
            outside = [float(shard.outside[rows, side].max()) for side in (0, 1)] if rows else []
            return cls(
                path.name, path.stat().st_size, stored_checksum(path), shard.header, sorted(shard.index), shard.failed,
                seeds[:: max(1, len(seeds) - 1)], outside, about,
            )  # fmt: skip

    @property
    def key(self) -> Any:
        """Key of the recipe."""
        return self.header.get("key")


def _kind(shard: Shard, name: str) -> dict[str, Any]:
    return {"shape": list(shard.shape(name)), "dtype": shard.dtype(name), "encoding": shard.encoding(name)}


def _faults_between(entries: Sequence[_Entry], expected: Mapping[str, Any]) -> dict[str, list[str]]:
    """Faults of shards beside each other, by name: they differ from ``recipe.json`` or, without it, from the others, in
    the recipe, the code that rendered them, or their arrays.
    """
    faults: dict[str, list[str]] = {}
    key = expected.get("key")
    if key is None and entries:
        key = Counter(json.dumps(entry.key) for entry in entries).most_common(1)[0][0]
        key = json.loads(key)
    kinds = {"about": expected["about"]} if "about" in expected else {}
    owners: dict[int, str] = {}
    for entry in entries:
        texts = []
        if entry.key != key:
            texts.append(f"belongs to another recipe (key {shown(entry.key)}, expected {shown(key)})")
        number = entry.header.get("shard")
        if isinstance(number, int) and entry.name != shard_file_name(number):
            texts.append(f"is shard {number} under another name")
        if not texts:
            kind = _must_be_alike(entry)
            other = [name for name in kind if name in kinds and kinds[name] != kind[name]]
            texts += [_difference(name, kinds[name], kind[name]) for name in other]
            if not texts:
                kinds = kind | kinds
            doubled = [i for i in (*entry.index, *entry.failed) if owners.setdefault(i, entry.name) != entry.name]
            if doubled:
                texts.append(f"holds the samples {ranges_text(doubled)}, which {owners[doubled[0]]} holds too")
        if texts:
            faults[entry.name] = texts
    return faults


def _must_be_alike(entry: _Entry) -> dict[str, Any]:
    """Entries that a shard shares with its data set; one whose samples all failed has no arrays."""
    entries = {"about": entry.header.get("about"), **entry.about}
    return entries if entry.index else {name: entries[name] for name in ("about", "store", "compression")}


def _difference(name: str, expected: Any, found: Any) -> str:
    while isinstance(expected, dict) and isinstance(found, dict):
        part = next(k for k in sorted({*expected, *found}, key=str) if expected.get(k) != found.get(k))
        name, expected, found = f"{name}: {part}", expected.get(part), found.get(part)
    return f"differs from the data set in {name}: {shown(found)}, expected {shown(expected)}"


def _expected(folder: Path) -> dict[str, Any]:
    """Content of ``recipe.json``, empty where it is missing."""
    text = _text_of(folder / RECIPE_FILE)
    found = {} if text is None else json_data(text, f"{_WHAT}: '{folder / RECIPE_FILE}', which was cut or changed")
    return found if isinstance(found, dict) else {}


# --------------------------------------------------------------------------------------------------------- the manifest


def _write(folder: Path, entries: Sequence[_Entry]) -> dict[str, Any]:
    manifest = _manifest(entries)
    text = json.dumps(manifest, indent=1, sort_keys=True, ensure_ascii=False) + "\n"
    target = folder / MANIFEST_FILE
    if text != _text_of(target):
        with whole_file(target, _WHAT) as unfinished, writing_said(target, _WHAT):
            unfinished.write_text(text, encoding="utf-8")
    return manifest


def _manifest(entries: Sequence[_Entry]) -> dict[str, Any]:
    if not entries:  # no shard is sound
        return {"format": FORMAT, "samples": 0, "failed": {}, "shards": {}}
    first = next((entry for entry in entries if entry.index), entries[0])
    errors = sorted(e.header["standard_error"] for e in entries if isinstance(e.header.get("standard_error"), float))
    return {
        "format": FORMAT,
        **{name: first.header.get(name) for name in ("recipe", "key", "about")},
        **first.about,
        "samples": sum(len(entry.index) for entry in entries),
        "failed": {str(number): entry.failed[number] for entry in entries for number in sorted(entry.failed)},
        "standard_error": {"least": errors[0], "most": errors[-1]} if errors else None,
        "outside": [max(e.outside[side] for e in entries if e.outside) for side in (0, 1)] if first.outside else None,
        "shards": {
            entry.name: {
                "sha256": entry.checksum, "bytes": entry.size, "index": ranges(entry.index), "seeds": entry.seeds,
                "failed": sorted(entry.failed), "standard_error": entry.header.get("standard_error"),
            }
            for entry in entries
        },
    }  # fmt: skip


def ranges(numbers: Iterable[int]) -> list[list[int]]:
    """Return whole numbers as ranges.

    Args:
        numbers: whole numbers, in any order.

    Returns:
        Pairs [first, last].
    """
    found: list[list[int]] = []
    for number in sorted(numbers):
        if found and number == found[-1][1] + 1:
            found[-1][1] = number
        else:
            found.append([number, number])
    return found


def ranges_text(numbers: Iterable[int]) -> str:
    """Return whole numbers as text, "0 to 3, 7", of 8 ranges at most.

    Args:
        numbers: whole numbers, in any order.

    Returns:
        Text.
    """
    parts, most = [str(a) if a == b else f"{a} to {b}" for a, b in ranges(numbers)], 8
    return ", ".join(parts[:most]) + (f" and {len(parts) - most} more ranges" if len(parts) > most else "")


def _text_of(path: Path) -> str | None:
    check_special(path, _WHAT)
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise StorageError(f"{_WHAT}: '{path}' cannot be read: {error}.") from error
