"""What a run is about, as it is handed to processes, and the file ``recipe.json`` that a later run is held against."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchtransient.array_files.part_files import whole_file, writing_said
from torchtransient.array_files.plain_texts import json_data
from torchtransient.checks import check_special, short_message
from torchtransient.data.generation.plan import Plan
from torchtransient.data.recipes.places import without_places
from torchtransient.data.recipes.plugin_modules import PluginNames
from torchtransient.data.storage.file_names import RECIPE_FILE
from torchtransient.errors import StorageError

# The first one left samples out whose light the window misses.
FORMAT = "torchtransient data set 2"
_WHAT = "generate"
# What decides about the bytes of shards, in the order in which differences are told.
DECIDING = ("format", "key", "n", "per_shard", "store", "compression")


@dataclass(frozen=True)
class Settings:
    """What every process of a run knows. Pickles when the recipe does."""

    recipe: Any
    folder: str
    n: int
    store: str
    compression: str
    retries: int
    # Plugin modules of others, which every process has to add.
    plugins: PluginNames = ()


def shard_header(settings: Settings, described: Mapping[str, Any], shard: int) -> dict[str, Any]:
    """The header of a shard file: the data set's description with the number of the shard, and without the places that
    files of its recipe had on the machine that began it.
    """
    recipe = without_places(described["recipe"])
    samples = list(_ends(Plan(settings.n, described["per_shard"]), shard))
    return {**described, "recipe": recipe, "shard": shard, "samples": samples}


def _ends(plan: Plan, shard: int) -> tuple[int, int]:
    indices = plan.indices(shard)
    return indices.start, indices.stop


def description(settings: Settings, per_shard: int, about: Any, standard_error: float | None) -> dict[str, Any]:
    """What ``recipe.json`` holds, plain data."""
    found: dict[str, Any] = plain(
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


def plain(value: Any) -> Any:
    """As JSON gives it back. Raises StorageError for what JSON does not have."""
    try:
        return json.loads(json.dumps(value, sort_keys=True))
    except (TypeError, ValueError) as error:
        raise StorageError(f"{_WHAT}: expected a recipe of plain data, which JSON can hold: {error}.") from error


def read_description(folder: Path) -> dict[str, Any] | None:
    """What is in the folder's ``recipe.json``, None where there is none. Raises StorageError for a damaged one."""
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
    """Put ``recipe.json`` where there is none, and return what is there afterwards: of two runs that begin at once one
    is first. Raises StorageError.
    """
    place = folder / RECIPE_FILE
    text = json.dumps(described, sort_keys=True, indent=1) + "\n"
    with whole_file(place, _WHAT, over=False) as unfinished, writing_said(place, _WHAT):
        unfinished.write_text(text, encoding="utf-8")
    return read_description(folder) or dict(described)


def check_same(
    found: Mapping[str, Any], wanted: Mapping[str, Any], where: Path, names: tuple[str, ...] = DECIDING
) -> None:
    """Raise StorageError where a data set that is there is not the one that is asked for; only names in both count."""
    for name in names:
        if name in found and name in wanted and found[name] != wanted[name]:
            told = f"{name} is {found[name]!r} there and {wanted[name]!r} here"
            if name == "key":
                recipes = [_deciding(side.get("recipe")) for side in (found, wanted)]
                told = "its recipe is another one" + _first_difference(*recipes)
                if all(isinstance(recipe, dict) for recipe in recipes) and "sampler" not in recipes[0]:
                    told += "; it was made with the sampler of its scene, which Recipe(sampler='scene') goes on with"
            raise StorageError(
                f"{_WHAT}: '{where}' belongs to another data set: {told}. Choose another folder, or generate with what "
                "is there."
            )


def _deciding(recipe: Any) -> Any:
    """Without the number of samples, which is none of what makes a recipe another one."""
    return {name: entry for name, entry in recipe.items() if name != "n"} if isinstance(recipe, dict) else recipe


def _first_difference(there: Any, here: Any, at: str = "") -> str:
    """Where two recipes differ first, for a message; a file that is named in both may have changed instead."""
    if isinstance(there, dict) and isinstance(here, dict):
        for name in sorted({*there, *here}):
            if there.get(name) != here.get(name):
                return _first_difference(there.get(name), here.get(name), f"{at}.{name}".lstrip("."))
    if there == here:
        return " (a file that it names has changed)"
    return f" ({at or 'it'} is {_short(there)} there and {_short(here)} here)"


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
