"""Data sets of captures around a corner as files of y-tal, one for each sample; scans as plain data of a header."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torchtransient.array_files.array_file import damage_said, path_of
from torchtransient.capture import Capture, Scan
from torchtransient.checks import shown
from torchtransient.data.reading.transient_dataset import TransientDataset
from torchtransient.data.recipes.written import read_frequencies
from torchtransient.errors import ArgumentError, StorageError
from torchtransient.files.captures import tal
from torchtransient.files.plain_data import scan_from_data
from torchtransient.rendering.progress import with_bar

_WHAT = "TAL export"
# What captures can hold.
_MEASURED = ("transient", "phasor", "measurement")


def export_tal(where: Any, folder: str | Path, *, field: str | None = None, progress: bool = True) -> list[Path]:
    """Write the samples of shards whose header has a scan as ``capture-00000000.hdf5``, ..., numbered as in the recipe,
    so that y-tal reads them; returns their paths.

    ``where``: as of :class:`~torchtransient.data.reading.transient_dataset.TransientDataset`. ``field``: what becomes
    ``H``, "transient", "phasor", or a "measurement" on the same axis; by default, the first of them that there is.
    Each sample has its own scan where they vary. Values that were drawn, and the steady image, go into the scene's
    information. Raises StorageError for other data sets, several channels, a folder that is missing and a full disk.
    """
    place = path_of(folder, _WHAT)
    if not place.is_dir():
        raise StorageError(f"{_WHAT}: expected a folder to write to, got '{place}'. Create it first.")
    data = TransientDataset(where)
    scans = _scans(data.about)
    have = [name for name in _MEASURED if name in data.fields]
    name = have[0] if field is None and have else field
    if name not in have:
        raise ArgumentError(f"{_WHAT}: expected field as one of {', '.join(have) or 'none'}, got {field!r}.")
    written = []
    for number in with_bar(range(len(data)), "export", progress):
        sample = data[number]
        target = place / f"capture-{sample['index']:08d}.hdf5"
        tal.write(target, _capture(sample, str(name), _scan_of(sample, scans), data))
        written.append(target)
    return written


def _scans(about: Mapping[str, Any]) -> list[Scan]:
    """The scan of all samples, or those among which each has its own."""
    given = about.get("scans") or [about.get("scan")]
    if not isinstance(given, list) or not all(isinstance(one, Mapping) for one in given):
        raise StorageError(f"{_WHAT}: expected captures around a corner, whose header has a scan; these have none.")
    return [scan_from_data(one) for one in given]


def _scan_of(sample: Mapping[str, Any], scans: list[Scan]) -> Scan:
    if len(scans) == 1:
        return scans[0]
    # As recipes name an entry of a choice.
    told = sample.get("values", {}).get("scan")
    chosen = str(told).removeprefix("#")
    if not chosen.isdecimal() or int(chosen) >= len(scans):
        raise StorageError(
            f"{_WHAT}: sample {sample['index']}: expected the value 'scan' as one of #0 to #{len(scans) - 1}, got "
            f"{shown(told)}: it does not tell which of the scans is its own."
        )
    return scans[int(chosen)]


def _capture(sample: Mapping[str, Any], name: str, scan: Scan, data: TransientDataset) -> Capture:
    values = {key: v if isinstance(v, str) else v.tolist() for key, v in sample.get("values", {}).items()}
    settings: dict[str, Any] = {
        "scan": scan, "metadata": {"index": sample["index"], "values": values}, "steady": sample.get("steady"),
        "channels": tuple(data.about.get("channels", ())), "polarized": "polarized" in str(data.about.get("variant")),
    }  # fmt: skip
    measured = sample[name]
    if not measured.is_complex():
        return Capture(measured, data.axis, **settings)
    with damage_said(Path("about"), _WHAT, "the frequencies of a phasor"):
        frequencies = read_frequencies(data.about["frequencies"])
    return Capture(None, None, phasor=measured, frequencies=frequencies, **settings)
