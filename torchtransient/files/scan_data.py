"""Scans as plain data, beside other plain data in JSON."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchtransient.array_files.array_file import damage_said
from torchtransient.capture import Scan
from torchtransient.errors import StorageError
from torchtransient.files.plain_data import plain, restored

_WHAT = "scan"


def scan_data(scan: Scan) -> dict[str, Any]:
    """A scan as plain data that JSON can hold, Gradients are not kept."""
    found: dict[str, Any] = plain({f.name: getattr(scan, f.name) for f in fields(scan)}, None, "scan")
    return found


def scan_from_data(data: Mapping[str, Any]) -> Scan:
    """The scan that :func:`scan_data` made plain data of. Raises StorageError for other data."""
    with damage_said(Path("scan"), _WHAT, "the plain data of a scan"):
        found = restored(dict(data), {})
        unknown = set(found) - {f.name for f in fields(Scan)}
        if unknown:
            raise StorageError(f"{_WHAT}: expected the data of a scan, got {sorted(unknown)} beside it.")
        entries: dict[str, Any] = {
            name: torch.from_numpy(value) if isinstance(value, np.ndarray) else value for name, value in found.items()
        }
        return Scan(**entries)
