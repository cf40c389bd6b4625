"""Keys of simulations: texts that are equal if everything that decides about the numbers is equal."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch


def content_key(*parts: Any) -> str:
    """Return a key of descriptions, scans, arrays and plain data.

    Args:
        parts: any of these; files that descriptions name count with their content.

    Returns:
        SHA-256, hexadecimal.
    """
    return hashlib.sha256(_text(parts).encode()).hexdigest()


def _text(value: Any) -> str:
    if isinstance(value, Mapping):
        inside = ", ".join(f"{name!r}: {_text(entry)}" for name, entry in value.items())
        return "{" + inside + "}"
    if isinstance(value, tuple | list):
        return "[" + ", ".join(map(_text, value)) + "]"
    if isinstance(value, str | Path):
        return f"{str(value)!r}{contents_of(Path(value))}"
    if is_dataclass(value) and not isinstance(value, type):
        return type(value).__name__ + _text({field.name: getattr(value, field.name) for field in fields(value)})
    if isinstance(value, torch.Tensor):
        value = value.detach().cpu().numpy()
    # Transforms of Mitsuba keep their numbers in `matrix`.
    if hasattr(value, "matrix"):
        value = np.asarray(value.matrix)
    # Dr.Jit's arrays and all that numpy can read; as text large ones are abbreviated.
    if hasattr(value, "__array__") or hasattr(value, "__dlpack__"):
        value = np.asarray(value)
    if isinstance(value, np.ndarray):
        return f"{value.dtype}{value.shape}{hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()}"
    if hasattr(value, "vertices") and hasattr(value, "faces"):
        return _text([np.asarray(value.vertices), np.asarray(value.faces)])
    return repr(value)


def contents_of(path: Path) -> str:
    """Return the SHA-256 of a file's content, "" for paths of no file.

    Args:
        path: any path.
    """
    try:
        if not path.is_file():
            return ""
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except (OSError, ValueError):
        return ""
