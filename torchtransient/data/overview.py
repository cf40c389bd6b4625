"""Data sets at a glance: contact sheets of recipes and folders, ``latest.png`` of a run, and a summary as text."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from torchtransient.array_files.part_files import whole_file
from torchtransient.axes import TimeAxis
from torchtransient.data.maker import Maker
from torchtransient.data.manifest import shards_of
from torchtransient.data.run_settings import RECIPE_FILE, read_description
from torchtransient.data.sample import OutsideLight, Sample
from torchtransient.data.shards import Shard
from torchtransient.data.specification import Specification
from torchtransient.errors import StorageError
from torchtransient.rendering.progress import with_bar
from torchtransient.vis.contact_sheet import Cell
from torchtransient.vis.contact_sheet import contact_sheet as draw
from torchtransient.vis.files import enlarge, pillow, to_bytes
from torchtransient.vis.tone_mapping import tone_map

# Most values in a title, and letters of each.
_MOST_VALUES, _MOST_LETTERS = 3, 24
_MEASURED = ("transient", "phasor", "gated", "rates", "beats")
# Films with an axis of rows, which are summed.
_ROWS = ("rates", "beats")
NAME = "latest.png"
EVERY_S = 10.0
SIDE = 256
_WHAT = "data set"


def contact_sheet(
    recipe: Specification, maker: Maker, indices: Iterable[int], path: str | Path | None, progress: bool = False
) -> Any:
    """Render some samples of a recipe and draw them; see :meth:`Recipe.preview`.

    Args:
        recipe: description.
        maker: maker of the samples.
        indices: numbers of the samples in the recipe, from 0.
        path: path of the picture, or None.
        progress: show a bar.

    Returns:
        Figure of matplotlib without a path.
    """
    wanted = with_bar(maker.order(indices), "preview", progress)
    samples = sorted((maker.sample(index) for index in wanted), key=lambda sample: sample.index)
    about = maker.about()
    return sheet_of(samples, path, about.get("axis"), repr(recipe), behind_time(about))


def sheet_of(
    samples: Iterable[Sample], path: str | Path | None, axis: Mapping[str, Any] | None, title: str = "", behind: int = 2
) -> Any:
    """Draw samples.

    Args:
        samples: samples in the order in which they are drawn.
        path: path of the picture, or None.
        axis: fields of the time axis of transients, or None.
        title: title of the sheet.
        behind: number of dimensions behind time.

    Returns:
        Figure of matplotlib without a path.
    """
    times = None if axis is None else TimeAxis(**axis).edges_opl.numpy()
    return draw([cell_of(sample, behind) for sample in samples], path, times=times, title=title)


def drawn_sheet(folder: str | Path, path: str | Path, count: int, seed: int) -> list[int]:
    """Draw a contact sheet of random samples of a data set.

    Args:
        folder: folder of the data set.
        path: path of the picture.
        count: number of samples.
        seed: seed of the random choice of samples.

    Returns:
        Numbers of the samples.

    Raises:
        StorageError: for a folder without samples.
    """
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


def summary(folder: str | Path) -> str:
    """Summarize a data set in some lines.

    Args:
        folder: folder of the data set.

    Returns:
        Text.

    Raises:
        StorageError: for other folders and damaged shards.
    """
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


def behind_time(about: Mapping[str, Any]) -> int:
    """Return the dimensions of a transient behind its bins: rows and columns, or those of a scan.

    Args:
        about: entry ``about`` of a header.

    Returns:
        Number.
    """
    return int(about.get("behind_time", 2))


def cell_of(sample: Sample, behind: int = 2) -> Cell:
    """Sample as a picture and a curve.

    Args:
        sample: sample of a recipe.
        behind: number of dimensions behind time.

    Returns:
        Cell of a contact sheet.
    """
    values = {key: value for key, value in sample.values.items() if isinstance(value, str) or np.size(value) <= 3}
    words = [f"{_name(key)} {_short(value)}" for key, value in values.items()]
    names = ", ".join(words[:_MOST_VALUES])
    images = {"light": _picture(sample.arrays, behind)}
    images |= {name: image for name, array in sample.arrays.items() if (image := _label(name, array)) is not None}
    return Cell(f"{sample.index}  {names}", images, _curve(sample.arrays, behind))


def _name(key: str) -> str:
    """The first part of a key, and the last one that is not a general word such as "value"."""
    parts = [part for part in key.split(".") if part not in ("value", "data", "reflectance", "bsdf", "emitter")]
    return ".".join(dict.fromkeys((parts or [key])[:1] + (parts or [key])[-1:]))


def _short(value: Any) -> str:
    text = value if isinstance(value, str) else ", ".join(f"{number:.2g}" for number in np.ravel(value))
    return text if len(text) <= _MOST_LETTERS else f"...{text[3 - _MOST_LETTERS :]}"


def _first(array: NDArray[Any], dimensions: int) -> NDArray[Any]:
    """The first of several sensors and Stokes components: the last dimensions of an array, at 0 of the others."""
    found: NDArray[Any] = array[(0,) * (array.ndim - dimensions)]
    return found


def _picture(arrays: Mapping[str, NDArray[Any]], behind: int) -> NDArray[Any]:
    if "steady" in arrays and behind == 2:
        light = _first(arrays["steady"], 3)
    else:
        name = next((name for name in (*_MEASURED, "measurement") if name in arrays), None)
        if name is None:
            return np.zeros((1, 1, 3))
        light = np.abs(_over_time(arrays, name, behind)).sum(1)
        # Pairs of points as a table, a list of points as a row.
        while light.ndim > 3:
            light = light.reshape(light.shape[0], light.shape[1] * light.shape[2], -1)
        light = light if light.ndim == 3 else light[:, None]
    channels = light if light.shape[0] == 3 else np.repeat(light.mean(0, keepdims=True), 3, 0)
    shown = tone_map(torch.from_numpy(np.ascontiguousarray(channels, dtype=np.float32)))
    return np.asarray(shown)


def _over_time(arrays: Mapping[str, NDArray[Any]], name: str, behind: int) -> NDArray[Any]:
    """Light of the first sensor over time (C, T, ...), or over the film's axis in place of time."""
    if name not in _ROWS:
        return _first(arrays[name], 2 + behind)
    total: NDArray[Any] = _first(arrays[name], 3 + behind).sum(1)
    return total


def _label(name: str, array: NDArray[Any]) -> NDArray[Any] | None:
    if name in (*_MEASURED, "steady", "measurement"):
        return None
    if name == "normals":
        directions: NDArray[Any] = np.clip((np.moveaxis(_first(array, 3), 0, -1) + 1) / 2, 0, 1)
        return directions
    if name == "velocity":
        speeds: NDArray[Any] = np.linalg.norm(_first(array, 3), axis=0)
        return speeds
    if name == "albedo":
        colour = np.moveaxis(_first(array, 3), 0, -1)
        if colour.shape[-1] != 3:
            colour = np.repeat(colour.mean(-1, keepdims=True), 3, axis=-1)
        shown: NDArray[Any] = np.clip(colour, 0, 1)
        return shown
    if array.ndim < 2 or name in ("position", "uv"):
        return None
    numbers: NDArray[Any] = _first(array, 2)
    return numbers


def _curve(arrays: Mapping[str, NDArray[Any]], behind: int) -> NDArray[Any] | None:
    timed = ("transient", "measurement", *_ROWS)
    name = next((name for name in timed if name in arrays and arrays[name].ndim >= 2 + behind), None)
    if name is None:
        return None
    light = _over_time(arrays, name, behind)
    curve: NDArray[Any] = light.sum((0, *range(2, light.ndim)), dtype=np.float64)
    return curve


class LatestPicture:
    """Picture of the latest sample, written where the one in the folder is older than ten seconds. Never raises: the
    data set is worth more than its picture.

    Args:
        folder: folder of the data set.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / NAME
        self._next = 0.0

    def __call__(self, sample: Any) -> None:
        now = time.monotonic()
        if now < self._next:
            return
        self._next = now + EVERY_S
        try:
            with contextlib.suppress(FileNotFoundError):
                if abs(time.time() - self._path.stat().st_mtime) < EVERY_S:
                    return
            pixels = picture_of(sample)
            with whole_file(self._path, "generate", synchronized=False) as part:
                pillow().fromarray(pixels).save(part, format="PNG")
        except Exception:  # noqa: BLE001  a picture is never a reason to fail
            self._next = now + 60 * EVERY_S


def picture_of(sample: Any) -> NDArray[np.uint8]:
    """Draw the light of a sample as a picture.

    Args:
        sample: sample of a recipe.

    Returns:
        uint8 (H, W, 3).
    """
    pixels = to_bytes(cell_of(sample).images["light"])
    return enlarge(pixels, max(1, SIDE // max(pixels.shape[:2])))


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
    """Lines of the plan; of several scenes each line under the scene's name."""
    if not isinstance(plan, dict):
        return list(plan)
    return [f"{name}: {line}" for name, lines in plan.items() for line in lines]


def _frequencies(axis: dict[str, Any]) -> str:
    numbers = axis["per_metre"]
    return f"{len(numbers)} frequencies, {min(numbers):g} to {max(numbers):g} cycles per metre"


def _rates(axis: dict[str, Any]) -> str:
    start, width, bins = (axis[name] for name in ("start", "bin_width", "num_bins"))
    return f"{bins} bins of {width:g} m/s of rate, from {start:g} to {start + bins * width:g} m/s"


def _entries(axis: dict[str, Any]) -> str:
    return ", ".join(f"{name} {value}" for name, value in axis.items())


def _axis(axis: dict[str, Any]) -> str:
    start, width, bins = (axis[name] for name in ("start_opl", "bin_width_opl", "num_bins"))
    return f"{bins} bins of {width:g} m of optical path, from {start:g} to {start + bins * width:g} m"
