"""Settings of a run, the files of a data set, and ``recipe.json``, with which a later run is compared."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchtransient.array_files.part_files import whole_file, writing_said
from torchtransient.array_files.plain_texts import json_data
from torchtransient.checks import check_special, short_message, shown
from torchtransient.data.processes import PluginNames
from torchtransient.data.serialization import without_places
from torchtransient.errors import StorageError

MANIFEST_FILE, RECIPE_FILE = "manifest.json", "recipe.json"
SHARD_FILES = "shard-*.h5"
LEAST_BYTES, MOST_BYTES = 64 * 2**20, 256 * 2**20
# Least number of shards, so that all workers are busy and a kill loses little.
LEAST_SHARDS = 64
# Most shards of the smallest size; beyond, shards grow.
MANY_SHARDS = 256
# Format 1 left out samples whose light the window misses.
FORMAT = "torchtransient data set 2"
_WHAT = "generate"
# Entries that determine the bytes of shards, in the order in which differences are reported.
DECIDING = ("format", "key", "n", "per_shard", "store", "compression")


@dataclass(frozen=True)
class RunSettings:
    """Settings of a run, for every process. Pickles when the recipe does.

    Args:
        recipe: recipe whose samples are made.
        folder: folder of the data set.
        n: number of samples.
        store: see ``ShardWriter``.
        compression: see ``ShardWriter``.
        retries: attempts at a sample after the first.
        plugins: plugin modules of others, which every process has to add.
    """

    recipe: Any
    folder: str
    n: int
    store: str
    compression: str
    retries: int
    plugins: PluginNames = ()


@dataclass(frozen=True)
class Plan:
    """Division of samples into shards.

    Args:
        n: number of samples.
        per_shard: number of samples in a file, fewer in the last one.
    """

    n: int
    per_shard: int

    @property
    def shards(self) -> int:
        """Number of files."""
        return -(-self.n // self.per_shard)

    def indices(self, shard: int) -> range:
        """Return the samples of a shard; row 0 of the file is the first one.

        Args:
            shard: number of the shard.

        Returns:
            Range.
        """
        return range(shard * self.per_shard, min(self.n, (shard + 1) * self.per_shard))

    def share(self, part: int, parts: int) -> range:
        """Return the shards of one of several runs that divide the work.

        Args:
            part: number of the run.
            parts: number of runs.

        Returns:
            Every ``parts``-th shard, from ``part`` on.
        """
        return range(part, self.shards, parts)


def shard_file_name(number: int) -> str:
    """Name of a shard's file.

    Args:
        number: number of the shard.

    Returns:
        "shard-000003.h5".
    """
    return f"shard-{number:06d}.h5"


def samples_per_shard(n: int, sample_bytes: int) -> int:
    """Choose the samples in a shard: 64 MB; up to 256 MB where there would be more than 256 shards; fewer where there
    would be less than 64. It does not depend on the workers: files are the same everywhere.

    Args:
        n: number of samples in the data set.
        sample_bytes: bytes of a sample before compression.

    Returns:
        Number of samples.
    """
    sample_bytes = max(1, sample_bytes)
    least, most = LEAST_BYTES // sample_bytes, MOST_BYTES // sample_bytes
    by_size = min(most, max(least, -(-n // MANY_SHARDS)))
    return max(1, min(by_size, n // LEAST_SHARDS))


def shard_header(settings: RunSettings, described: Mapping[str, Any], shard: int) -> dict[str, Any]:
    """Return the header of a shard: description of the data set and number of the shard, without the folders of the
    recipe's files.

    Args:
        settings: settings of the run.
        described: content of ``recipe.json``.
        shard: number of the shard.

    Returns:
        Plain data.
    """
    recipe = without_places(described["recipe"])
    indices = Plan(settings.n, described["per_shard"]).indices(shard)
    return {**described, "recipe": recipe, "shard": shard, "samples": [indices.start, indices.stop]}


def description(settings: RunSettings, per_shard: int, about: Any, standard_error: float | None) -> dict[str, Any]:
    """Return the content of ``recipe.json``.

    Args:
        settings: settings of the run.
        per_shard: number of samples in a file.
        about: ``Maker.about``.
        standard_error: relative standard error of a sample, or None.

    Returns:
        Plain data.
    """
    found: dict[str, Any] = as_json(
        {
            "format": FORMAT,
            "key": settings.recipe.key(),
            "n": settings.n,
            "per_shard": per_shard,
            "store": settings.store,
            "compression": settings.compression,
            "about": about,
            "standard_error": standard_error,
            "recipe": settings.recipe.to_dict(),
        }
    )
    return found


def as_json(value: Any) -> Any:
    """Return a value as JSON gives it back.

    Args:
        value: value made of plain data.

    Returns:
        Plain data.

    Raises:
        StorageError: for values that JSON does not have.
    """
    try:
        return json.loads(json.dumps(value, sort_keys=True))
    except (TypeError, ValueError) as error:
        raise StorageError(f"{_WHAT}: expected a recipe of plain data, which JSON can hold: {error}.") from error


def read_description(folder: Path) -> dict[str, Any] | None:
    """Read ``recipe.json``.

    Args:
        folder: folder of the data set.

    Returns:
        Its content, None where there is none.

    Raises:
        StorageError: for a damaged file.
    """
    path = folder / RECIPE_FILE
    try:
        check_special(path, _WHAT)
        found = json_data(path.read_text(encoding="utf-8"), f"{_WHAT}: '{path}'")
    except FileNotFoundError:
        return None
    except (OSError, UnicodeDecodeError) as error:
        raise StorageError(f"{_WHAT}: '{path}' cannot be read, or is damaged: {short_message(error)}.") from error
    missing = [name for name in (*DECIDING, "about") if not isinstance(found, dict) or name not in found]
    if missing:
        raise StorageError(f"{_WHAT}: '{path}' is none of a data set: it lacks {missing[0]!r}. Choose another folder.")
    return dict(found)


def write_description(folder: Path, described: Mapping[str, Any]) -> dict[str, Any]:
    """Write ``recipe.json`` where there is none.

    Args:
        folder: folder of the data set.
        described: content of the file.

    Returns:
        Content of the file afterwards: that of the first one, where two runs begin at once.

    Raises:
        StorageError: for a full disk.
    """
    place = folder / RECIPE_FILE
    text = json.dumps(described, sort_keys=True, indent=1) + "\n"
    with whole_file(place, _WHAT, over=False) as unfinished, writing_said(place, _WHAT):
        unfinished.write_text(text, encoding="utf-8")
    return read_description(folder) or dict(described)


def check_same(
    found: Mapping[str, Any], wanted: Mapping[str, Any], where: Path, names: tuple[str, ...] = DECIDING
) -> None:
    """Check that a data set is the one that is asked for, by the entries that both descriptions have.

    Args:
        found: description in the folder.
        wanted: description of this run.
        where: path for messages.
        names: names of the entries that are compared.

    Raises:
        StorageError: for another data set.
    """
    for name in names:
        if name in found and name in wanted and found[name] != wanted[name]:
            text = f"{name} is {found[name]!r} there and {wanted[name]!r} here"
            if name == "key":
                recipes = [_deciding(side.get("recipe")) for side in (found, wanted)]
                text = "its recipe is another one" + _first_difference(*recipes)
                if all(isinstance(recipe, dict) for recipe in recipes) and "sampler" not in recipes[0]:
                    text += "; it was made with the sampler of its scene, which Recipe(sampler='scene') goes on with"
            raise StorageError(
                f"{_WHAT}: '{where}' belongs to another data set: {text}. Choose another folder, or generate with what "
                "is there."
            )


def _deciding(recipe: Any) -> Any:
    """Recipe without its number of samples, which does not make it another one."""
    return {name: entry for name, entry in recipe.items() if name != "n"} if isinstance(recipe, dict) else recipe


def _first_difference(there: Any, here: Any, at: str = "") -> str:
    """First difference of two recipes, for a message; a file that is named in both may have changed instead."""
    if isinstance(there, dict) and isinstance(here, dict):
        for name in sorted({*there, *here}):
            if there.get(name) != here.get(name):
                return _first_difference(there.get(name), here.get(name), f"{at}.{name}".lstrip("."))
    if there == here:
        return " (a file that it names has changed)"
    return f" ({at or 'it'} is {shown(there)} there and {shown(here)} here)"


def bytes_text(size: float) -> str:
    """Return a number of bytes as text, "1.5 MB".

    Args:
        size: number of bytes.
    """
    for unit in ("B", "kB", "MB", "GB"):
        if size < 1000:
            return f"{size:.3g} {unit}"
        size /= 1000
    return f"{size:.3g} TB"
