"""Metadata of captures and volumes: what JSON can hold, and holds as it is."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from torchtransient.checks import shown
from torchtransient.errors import StorageError


def metadata_text(metadata: Any, who: str) -> str:
    """Metadata as JSON. Raises StorageError for what is no mapping, for data that JSON cannot hold, and for names that
    are no texts, which JSON would make texts of: 1 and "1" would be one name. Tuples come back as lists.
    """
    if not isinstance(metadata, Mapping):
        raise StorageError(f"{who}: expected metadata as names and values, got {shown(metadata)}.")
    try:
        found = json.dumps(dict(metadata), default=_refuse)
        _check_names(metadata)
    except (TypeError, ValueError, RecursionError) as error:
        raise StorageError(f"{who}: expected metadata of plain data that JSON can hold: {error}.") from None
    return found


def _check_names(data: Any) -> None:
    if isinstance(data, Mapping):
        for name in data:
            if not isinstance(name, str):
                raise TypeError(f"the name {shown(name)} is a {type(name).__name__} and no text")
    for part in data.values() if isinstance(data, Mapping) else data if isinstance(data, list | tuple) else ():
        _check_names(part)


def _refuse(value: object) -> Any:
    raise TypeError(f"{type(value).__name__} is not plain data")
