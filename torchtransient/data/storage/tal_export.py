"""Data sets of captures around a corner as files of y-tal, one for each sample; scans as plain data of a header."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchtransient.axes import FrequencyAxis
from torchtransient.capture import Capture, Scan
from torchtransient.data.reading.transient_dataset import TransientDataset
from torchtransient.errors import StorageError
from torchtransient.files.array_file import damage_said, path_of
from torchtransient.files.captures import tal
from torchtransient.files.plain_data import plain, restored
from torchtransient.render.progress import with_bar

_WHAT = "TAL export"
_MEASURED = ("transient", "phasor", "measurement")


def scan_data(scan: Scan) -> dict[str, Any]:
    """A scan as plain data that JSON can hold, for ``about["scan"]`` of a shard's header. Gradients are not kept."""
    found: dict[str, Any] = plain({f.name: getattr(scan, f.name) for f in fields(scan)}, None, "scan")
    return found


def scan_of(data: Mapping[str, Any]) -> Scan:
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


def export_tal(where: Any, folder: str | Path, *, field: str | None = None, progress: bool = True) -> list[Path]:
    """Write the samples of shards whose header has a scan as ``capture-00000000.hdf5``, ..., numbered as in the recipe,
    so that y-tal reads them; returns their paths.

    ``where``: as of :class:`~torchtransient.data.reading.transient_dataset.TransientDataset`. ``field``: what becomes
    ``H``, "transient", "phasor", or a "measurement" on the same axis; by default, the first of them that there is.
    Values that were drawn, and the steady image, go into the scene's information. Raises StorageError for other data
    sets, several channels, a folder that is missing and a full disk.
    """
    place = path_of(folder, _WHAT)
    if not place.is_dir():
        raise StorageError(f"{_WHAT}: expected a folder to write to, got '{place}'. Create it first.")
    data = TransientDataset(where)
    scan = data.about.get("scan")
    if not isinstance(scan, Mapping):
        raise StorageError(f"{_WHAT}: expected captures around a corner, whose header has a scan; these have none.")
    have = [name for name in _MEASURED if name in data.fields]
    name = have[0] if field is None and have else field
    if name not in have:
        raise StorageError(f"{_WHAT}: expected field as one of {', '.join(have) or 'none'}, got {field!r}.")
    made_scan = scan_of(scan)
    written = []
    for number in with_bar(range(len(data)), "export", progress):
        sample = data[number]
        target = place / f"capture-{sample['index']:08d}.hdf5"
        tal.write(target, _capture(sample, str(name), made_scan, data))
        written.append(target)
    return written


def _capture(sample: Mapping[str, Any], name: str, scan: Scan, data: TransientDataset) -> Capture:
    values = {key: v if isinstance(v, str) else v.tolist() for key, v in sample.get("values", {}).items()}
    settings: dict[str, Any] = {
        "scan": scan, "metadata": {"index": sample["index"], "values": values}, "steady": sample.get("steady"),
        "channels": tuple(data.about.get("channels", ())), "polarized": "polarized" in str(data.about.get("variant")),
    }  # fmt: skip
    measured = sample[name]
    if not measured.is_complex():
        return Capture(measured, data.axis, **settings)
    axis = data.about.get("axis")
    with damage_said(Path("about"), _WHAT, "the frequencies of a phasor"):
        if not isinstance(axis, Mapping):
            raise ValueError("about has no axis")
        frequencies = FrequencyAxis(axis["frequencies"], axis.get("start_opl", 0.0))
        return Capture(None, None, phasor=measured, frequencies=frequencies, **settings)
