"""Names of the files of a data set."""

from __future__ import annotations

MANIFEST_FILE, RECIPE_FILE = "manifest.json", "recipe.json"
SHARD_FILES = "shard-*.h5"


def shard_file_name(number: int) -> str:
    """The name of a shard's file."""
    return f"shard-{number:06d}.h5"
