"""What a data set holds, as text and as a picture, read from its shards."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from torchtransient.data.generation.settings import read_description
from torchtransient.data.recipes.contact_sheet import behind_time, sheet_of
from torchtransient.data.recipes.outside_light import OutsideLight
from torchtransient.data.recipes.sample import Sample
from torchtransient.data.storage.file_names import RECIPE_FILE
from torchtransient.data.storage.manifest import shards_of
from torchtransient.data.storage.shard_file import Shard
from torchtransient.errors import StorageError

_WHAT = "data set"


def summary(folder: str | Path) -> str:
    """What a folder holds, some lines. Raises StorageError for what is no data set, and for damaged shards."""
    place = Path(folder)
    paths = shards_of(place)
    described = read_description(place) if (place / RECIPE_FILE).exists() else None
    if not paths and described is None:
        raise StorageError(f"{_WHAT}: '{place}' holds no shard.")
    samples = failed = size = 0
    arrays: list[str] = []
    keys: tuple[str, ...] = ()
    missed: list[Any] = []
    header: dict[str, Any] = described or {}
    for path in paths:
        with Shard(path) as shard:
            samples, failed = samples + len(shard.index), failed + len(shard.failed)
            size += path.stat().st_size
            missed += [shard.outside[row] for row in shard.index.values()]
            header = header or shard.header
            if shard.index and not arrays:
                keys = shard.keys
                row = next(iter(shard.index.values()))
                arrays = [_array(name, shard.read(name, row)) for name in shard.names]
    asked = f" of {header['n']}" if "n" in header else ""
    about = header.get("about", {})
    lines = [f"{place}: {samples}{asked} samples in {len(paths)} shards, {failed} failed, {size / 1e6:.4g} MB"]
    lines += [f"  {line}" for line in arrays]
    lines += [f"  values: {', '.join(keys)}"] if keys else []
    lines += [f"  stored: {header.get('store')}, {header.get('compression')}"]
    lines += [f"  {_axis(about['axis'])}"] if about.get("axis") else []
    lines += [f"  light outside of the window: {OutsideLight.of(missed).shares()}"] if about.get("axis") else []
    lines += [f"  {_rates(about['rates'])}"] if about.get("rates") else []
    lines += [f"  chirps: {_entries(about['chirps'])}"] if about.get("chirps") else []
    lines += [f"  {_frequencies(about['frequencies'])}"] if about.get("frequencies") else []
    spp, error = about.get("spp"), header.get("standard_error")
    lines += [f"  {spp} samples per pixel" + (f", standard error {error:.3g}" if error else "")] if spp else []
    lines += [f"  {line}" for line in _plan(about.get("plan", []))]
    lines += ["  made with " + ", ".join(f"{k} {v}" for k, v in about.get("versions", {}).items())]
    return "\n".join(lines)


def drawn_sheet(folder: str | Path, path: str | Path, count: int, seed: int) -> list[int]:
    """A contact sheet of samples that are drawn at random; returns which. Raises StorageError."""
    with contextlib.ExitStack() as stack:
        shards = [stack.enter_context(Shard(one)) for one in shards_of(folder)]
        owners = {index: shard for shard in shards for index in shard.index}
        if not owners:
            raise StorageError(f"{_WHAT}: '{folder}' holds no samples.")
        numbers = sorted(owners)
        chosen = np.random.default_rng(seed).choice(len(numbers), min(count, len(numbers)), replace=False)
        drawn = sorted(numbers[k] for k in chosen)
        about = shards[0].header.get("about", {})
        sheet_of(_samples(owners, drawn), path, about.get("axis"), str(folder), behind_time(about))
    return drawn


def _samples(owners: dict[int, Shard], drawn: list[int]) -> Iterator[Sample]:
    for index in drawn:
        shard = owners[index]
        row = shard.index[index]
        arrays = {name: shard.read(name, row) for name in shard.names}
        outside = (float(shard.outside[row, 0]), float(shard.outside[row, 1]))
        yield Sample(index, int(shard.seeds[row]), arrays=arrays, values=shard.values(row), outside=outside)


def _array(name: str, array: Any) -> str:
    return f"{name}: {' x '.join(map(str, array.shape))} {array.dtype}"


def _plan(plan: Any) -> list[str]:
    """Lines; of several scenes those of each under its name."""
    if not isinstance(plan, dict):
        return list(plan)
    return [f"{name}: {line}" for name, lines in plan.items() for line in lines]


def _frequencies(told: dict[str, Any]) -> str:
    numbers = told["per_metre"]
    return f"{len(numbers)} frequencies, {min(numbers):g} to {max(numbers):g} cycles per metre"


def _rates(told: dict[str, Any]) -> str:
    start, width, bins = (told[name] for name in ("start", "bin_width", "num_bins"))
    return f"{bins} bins of {width:g} m/s of rate, from {start:g} to {start + bins * width:g} m/s"


def _entries(told: dict[str, Any]) -> str:
    return ", ".join(f"{name} {value}" for name, value in told.items())


def _axis(axis: dict[str, Any]) -> str:
    start, width, bins = (axis[name] for name in ("start_opl", "bin_width_opl", "num_bins"))
    return f"{bins} bins of {width:g} m of optical path, from {start:g} to {start + bins * width:g} m"
