"""Data sets for other programs: WebDataset tars (measured arrays as ``.npy.zst``, labels as ``.npy``, values as
``.json``), and captures around a corner as files of y-tal. Equal data sets give equal bytes.
"""

from __future__ import annotations

import io
import json
import tarfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchtransient.array_files.array_file import check_source, damage_said, path_of
from torchtransient.array_files.hdf5 import check_memory
from torchtransient.array_files.part_files import whole_file, writing_said
from torchtransient.capture import Capture, Scan
from torchtransient.checks import shown
from torchtransient.data.sample import outside_tensor
from torchtransient.data.serialization import read_frequencies
from torchtransient.data.shard_format import COUNTED, measured_names
from torchtransient.data.transient_dataset import TransientDataset
from torchtransient.errors import ArgumentError, MissingPackageError, StorageError
from torchtransient.files.captures import tal
from torchtransient.files.plain_data import scan_from_data
from torchtransient.rendering.progress import with_bar

_WHAT = "WebDataset"
_LEVEL = 3
_TAR_BYTES = 256e6
_NPY, _PACKED, _JSON = ".npy", ".npy.zst", "sample.json"
_TAL = "TAL export"
# Arrays that captures can hold.
_MEASURED = ("transient", "phasor", "measurement")


def export_web_dataset(
    where: Any, folder: str | Path, *, progress: bool = True, **reading: Any
) -> list[Path]:  # fmt: skip
    """Write the samples of shards as ``samples-000000.tar``, ..., of about 256 MB each.

    ``about.json`` beside them has the description of the render and the time axis of what was written. Counts keep the
    type that they are stored in. A tar appears once it is whole; those that are there are replaced.

    Args:
        where: folder, pattern of names, shard, or a list of these, see :class:`~torchtransient.data.TransientDataset`.
        folder: existing folder that the files are written to.
        progress: show a bar.
        reading: other arguments of :class:`~torchtransient.data.TransientDataset`, windows and transforms too.

    Returns:
        Paths of the tars.

    Raises:
        StorageError: as the data set, for a missing folder and a full disk.
        MissingPackageError: without the package zstandard.
    """
    place = path_of(folder, _WHAT)
    if not place.is_dir():
        raise StorageError(f"{_WHAT}: expected a folder to write to, got '{place}'. Create it first.")
    compressor = _zstandard().ZstdCompressor(level=_LEVEL)
    data = TransientDataset(where, **{"as_stored": True, **reading})
    numbers = iter(with_bar(range(len(data)), "export", progress))
    _write_about(place / "about.json", data)
    written: list[Path] = []
    left, measured = len(data), measured_names(data.about)
    while left:
        target = place / f"samples-{len(written):06d}.tar"
        with (
            whole_file(target, _WHAT) as unfinished,
            writing_said(target, _WHAT),
            tarfile.open(unfinished, "w", format=tarfile.USTAR_FORMAT) as tar,
        ):
            while left and tar.offset < _TAR_BYTES:
                _add(tar, data[next(numbers)], compressor, measured)
                left -= 1
        written.append(target)
    next(numbers, None)  # ends the bar
    return written


def decode_web_sample(members: Mapping[str, Any], *, as_stored: bool = False) -> dict[str, Any]:
    """Decode a sample from its members: ``webdataset.WebDataset(tars).map(decode_web_sample)``.

    Args:
        members: bytes by ending; members that begin with "__" are left out.
        as_stored: keep the type of counts instead of float32.

    Returns:
        Sample like those of a TransientDataset.

    Raises:
        StorageError: for members that are damaged or of other kinds.
    """
    found: dict[str, Any] = {}
    with damage_said(Path(str(members.get("__key__", "sample"))), _WHAT, "a sample of a data set of torchtransient"):
        for ending in sorted(members):
            if ending.startswith("__"):
                continue
            if ending == _JSON:
                found |= _values(members[ending])
                continue
            suffix = next((one for one in (_PACKED, _NPY) if ending.endswith(one)), None)
            if suffix is None:
                raise StorageError(f"{_WHAT}: expected members that end in {_NPY}, {_PACKED} or {_JSON}, got {ending}.")
            name = ending.removesuffix(suffix)
            content = _unpacked(members[ending]) if suffix == _PACKED else members[ending]
            array = np.load(io.BytesIO(content), allow_pickle=False)
            counts = name == COUNTED and array.dtype.kind == "u" and not as_stored
            found[name] = torch.from_numpy(array.astype(np.float32) if counts else array)
    return found


def read_web_dataset(path: str | Path, *, as_stored: bool = False) -> Iterator[dict[str, Any]]:
    """Read the samples of a tar one by one, without the package webdataset.

    Args:
        path: path of the tar.
        as_stored: keep the type of counts instead of float32.

    Returns:
        Iterator of samples like those of a TransientDataset.

    Raises:
        StorageError: for damaged files.
    """
    source = check_source(path, _WHAT)
    kind = "a WebDataset of torchtransient"
    with damage_said(source, _WHAT, kind), _tar_errors(), tarfile.open(source, "r:") as tar:
        members: dict[str, Any] = {}
        for member in tar:
            key, _, ending = member.name.partition(".")
            if not member.isfile():
                raise StorageError(f"{_WHAT}: '{source}' holds '{member.name}', which is no plain file.")
            if members and members["__key__"] != key:
                yield decode_web_sample(members, as_stored=as_stored)
                members = {}
            check_memory(member.size, f"{_WHAT}: '{member.name}'")
            opened = tar.extractfile(member)
            assert opened is not None  # it is a file
            members |= {"__key__": key, ending: opened.read()}
        if members:
            yield decode_web_sample(members, as_stored=as_stored)


def export_tal(where: Any, folder: str | Path, *, field: str | None = None, progress: bool = True) -> list[Path]:
    """Write the samples of captures around a corner as ``capture-00000000.hdf5``, ..., numbered as in the recipe, which
    y-tal reads.

    Each sample has its own scan where they vary. Values that were drawn and the steady image go into the scene's
    information.

    Args:
        where: folder, pattern of names, shard, or a list of these, see :class:`~torchtransient.data.TransientDataset`;
            their headers have a scan.
        folder: existing folder that the files are written to.
        field: array that becomes ``H``: "transient", "phasor", or a "measurement" on the same axis; None for the first
            of them that there is.
        progress: show a bar.

    Returns:
        Paths of the files.

    Raises:
        StorageError: for other data sets, several channels, a missing folder and a full disk.
        ArgumentError: for an unknown field.
    """
    place = path_of(folder, _TAL)
    if not place.is_dir():
        raise StorageError(f"{_TAL}: expected a folder to write to, got '{place}'. Create it first.")
    data = TransientDataset(where)
    scans = _scans(data.about)
    have = [name for name in _MEASURED if name in data.fields]
    name = have[0] if field is None and have else field
    if name not in have:
        raise ArgumentError(f"{_TAL}: expected field as one of {', '.join(have) or 'none'}, got {field!r}.")
    written = []
    for number in with_bar(range(len(data)), "export", progress):
        sample = data[number]
        target = place / f"capture-{sample['index']:08d}.hdf5"
        tal.write(target, _capture(sample, str(name), _scan_of(sample, scans), data))
        written.append(target)
    return written


def _add(tar: tarfile.TarFile, sample: Mapping[str, Any], compressor: Any, measured: Sequence[str]) -> None:
    key = f"{sample['index']:08d}"
    values = {name: v if isinstance(v, str) else np.asarray(v) for name, v in sample.get("values", {}).items()}
    plain = {
        "index": sample["index"],
        "outside": sample["outside"].tolist(),
        "values": {name: v if isinstance(v, str) else v.tolist() for name, v in values.items()},
        "dtypes": {name: str(v.dtype) for name, v in values.items() if not isinstance(v, str)},
    }
    _member(tar, f"{key}.{_JSON}", json.dumps(plain, sort_keys=True).encode())
    for name in sorted(sample):
        if name in ("index", "outside", "values"):
            continue
        if not isinstance(sample[name], torch.Tensor) or "." in name:
            raise StorageError(f"{_WHAT}: expected '{name}' as a tensor, under a name without points.")
        buffer = io.BytesIO()
        np.lib.format.write_array(buffer, np.ascontiguousarray(sample[name].numpy()), version=(1, 0))
        packed = name in measured
        content = compressor.compress(buffer.getbuffer()) if packed else buffer.getvalue()
        _member(tar, f"{key}.{name}{_PACKED if packed else _NPY}", content)


def _member(tar: tarfile.TarFile, name: str, content: bytes) -> None:
    """Add a member without an owner or a time to a tar."""
    entry = tarfile.TarInfo(name)
    entry.size = len(content)
    tar.addfile(entry, io.BytesIO(content))


def _write_about(target: Path, data: TransientDataset) -> None:
    axis = data.axis
    about = {"about": data.about, "fields": list(data.fields)}
    if axis is not None:
        about["axis"] = {"start_opl": axis.start_opl, "bin_width_opl": axis.bin_width_opl, "num_bins": axis.num_bins}
    with whole_file(target, _WHAT) as unfinished, writing_said(target, _WHAT):
        unfinished.write_text(json.dumps(about, indent=1, sort_keys=True) + "\n", encoding="utf-8")


def _values(content: bytes) -> dict[str, Any]:
    plain = json.loads(content)
    dtypes = plain["dtypes"]
    values = {
        name: value if name not in dtypes else torch.from_numpy(np.array(value, dtypes[name]))
        for name, value in plain["values"].items()
    }
    # Tars of earlier versions have no shares.
    outside = {"outside": outside_tensor(plain["outside"])} if "outside" in plain else {}
    return {"index": int(plain["index"]), **outside, **({"values": values} if values else {})}


def _unpacked(content: bytes) -> bytes:
    zstandard = _zstandard()
    try:
        check_memory(zstandard.get_frame_parameters(content).content_size, _WHAT)
        found: bytes = zstandard.ZstdDecompressor().decompress(content)
    except zstandard.ZstdError as error:
        raise ValueError(str(error)) from error
    return found


@contextmanager
def _tar_errors() -> Iterator[None]:
    """Errors of tar files as ValueError, which readers report as damage."""
    try:
        yield
    except tarfile.TarError as error:
        raise ValueError(str(error)) from error


def _zstandard() -> Any:
    try:
        import zstandard
    except ImportError as error:
        raise MissingPackageError(
            f"{_WHAT}: needs the package zstandard. Install it with pip install 'torchtransient[webdataset]'."
        ) from error
    return zstandard


def _scans(about: Mapping[str, Any]) -> list[Scan]:
    """The scan of all samples, or those among which each has its own."""
    given = about.get("scans") or [about.get("scan")]
    if not isinstance(given, list) or not all(isinstance(one, Mapping) for one in given):
        raise StorageError(f"{_TAL}: expected captures around a corner, whose header has a scan; these have none.")
    return [scan_from_data(one) for one in given]


def _scan_of(sample: Mapping[str, Any], scans: list[Scan]) -> Scan:
    if len(scans) == 1:
        return scans[0]
    # The text of recipes for an entry of a choice.
    name = sample.get("values", {}).get("scan")
    chosen = str(name).removeprefix("#")
    if not chosen.isdecimal() or int(chosen) >= len(scans):
        raise StorageError(
            f"{_TAL}: sample {sample['index']}: expected the value 'scan' as one of #0 to #{len(scans) - 1}, got "
            f"{shown(name)}: it does not tell which of the scans is its own."
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
    with damage_said(Path("about"), _TAL, "the frequencies of a phasor"):
        frequencies = read_frequencies(data.about["frequencies"])
    return Capture(None, None, phasor=measured, frequencies=frequencies, **settings)
