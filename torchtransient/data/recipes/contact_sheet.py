"""The contact sheet of samples, of a recipe or of a data set."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from torchtransient.axes import TimeAxis
from torchtransient.data.recipes.maker import Maker
from torchtransient.data.recipes.sample import Sample
from torchtransient.data.recipes.specification import Specification
from torchtransient.vis.contact_sheet import Cell
from torchtransient.vis.contact_sheet import contact_sheet as draw
from torchtransient.vis.tone_mapping import tone_map

# Drawn values that a title has room for, and letters of each.
_MOST_VALUES, _MOST_LETTERS = 3, 24
_MEASURED = ("transient", "phasor", "gated", "rates", "beats")
# Histograms by rows, which are added up.
_ROWS = ("rates", "beats")


def contact_sheet(
    recipe: Specification, maker: Maker, indices: Iterable[int], path: str | Path | None, progress: bool = False
) -> Any:
    """Render some samples of a recipe and draw them; see :meth:`Recipe.preview`."""
    wanted = maker.order(indices)
    if progress:
        from tqdm.auto import tqdm

        wanted = tqdm(wanted, desc="preview", unit="sample")
    samples = sorted((maker.sample(index) for index in wanted), key=lambda sample: sample.index)
    about = maker.about()
    return sheet_of(samples, path, about.get("axis"), repr(recipe), behind_time(about))


def sheet_of(
    samples: Iterable[Sample], path: str | Path | None, axis: Mapping[str, Any] | None, title: str = "", behind: int = 2
) -> Any:
    """A sheet of samples that are there. ``axis``: that of the transients, as its numbers; ``behind``: dimensions that
    come after it.
    """
    times = None if axis is None else TimeAxis(**axis).edges_opl.numpy()
    return draw([cell_of(sample, behind) for sample in samples], path, times=times, title=title)


def behind_time(about: Mapping[str, Any]) -> int:
    """Dimensions of a transient behind its bins: rows and columns, or those of a scan."""
    return int(about.get("behind_time", 2))


def cell_of(sample: Sample, behind: int = 2) -> Cell:
    """A sample as a picture and a curve."""
    words = [f"{_name(key)} {_short(value)}" for key, value in sample.values.items() if _fits(value)]
    names = ", ".join(words[:_MOST_VALUES])
    images = {"light": _picture(sample.arrays, behind)}
    images |= {name: image for name, array in sample.arrays.items() if (image := _label(name, array)) is not None}
    return Cell(f"{sample.index}  {names}", images, _curve(sample.arrays, behind))


def _fits(value: Any) -> bool:
    return isinstance(value, str) or np.size(value) <= 3


def _name(key: str) -> str:
    """The first part of a key, and its last one where it says something."""
    parts = [part for part in key.split(".") if part not in ("value", "data", "reflectance", "bsdf", "emitter")]
    return ".".join(dict.fromkeys((parts or [key])[:1] + (parts or [key])[-1:]))


def _short(value: Any) -> str:
    text = value if isinstance(value, str) else ", ".join(f"{number:.2g}" for number in np.ravel(value))
    return text if len(text) <= _MOST_LETTERS else f"...{text[3 - _MOST_LETTERS :]}"


def _last(array: NDArray[Any], dimensions: int) -> NDArray[Any]:
    """The first of several sensors and Stokes components."""
    while array.ndim > dimensions:
        array = array[0]
    return array


def _picture(arrays: Mapping[str, NDArray[Any]], behind: int) -> NDArray[Any]:
    if "steady" in arrays and behind == 2:
        light = _last(arrays["steady"], 3)
    else:
        name = next((name for name in (*_MEASURED, "measurement") if name in arrays), None)
        if name is None:
            return np.zeros((1, 1, 3))
        light = np.abs(_over_time(arrays, name, behind)).sum(1)
        # Of pairs of points a table of all of them, of a list of points a row.
        while light.ndim > 3:
            light = light.reshape(light.shape[0], light.shape[1] * light.shape[2], -1)
        light = light if light.ndim == 3 else light[:, None]
    channels = light if light.shape[0] == 3 else np.repeat(light.mean(0, keepdims=True), 3, 0)
    shown = tone_map(torch.from_numpy(np.ascontiguousarray(channels, dtype=np.float32)))
    return np.asarray(shown)


def _over_time(arrays: Mapping[str, NDArray[Any]], name: str, behind: int) -> NDArray[Any]:
    """Light of the first sensor over time (C, T, ...), or over what the film has in place of time."""
    if name not in _ROWS:
        return _last(arrays[name], 2 + behind)
    total: NDArray[Any] = _last(arrays[name], 3 + behind).sum(1)
    return total


def _label(name: str, array: NDArray[Any]) -> NDArray[Any] | None:
    if name in (*_MEASURED, "steady", "measurement"):
        return None
    if name == "normals":
        directions: NDArray[Any] = np.clip((np.moveaxis(_last(array, 3), 0, -1) + 1) / 2, 0, 1)
        return directions
    if name == "velocity":
        speeds: NDArray[Any] = np.linalg.norm(_last(array, 3), axis=0)
        return speeds
    if name == "albedo":
        colour = np.moveaxis(_last(array, 3), 0, -1)
        if colour.shape[-1] != 3:
            colour = np.repeat(colour.mean(-1, keepdims=True), 3, axis=-1)
        shown: NDArray[Any] = np.clip(colour, 0, 1)
        return shown
    if array.ndim < 2 or name in ("position", "uv"):
        return None
    numbers: NDArray[Any] = _last(array, 2)
    return numbers


def _curve(arrays: Mapping[str, NDArray[Any]], behind: int) -> NDArray[Any] | None:
    timed = ("transient", "measurement", *_ROWS)
    name = next((name for name in timed if name in arrays and arrays[name].ndim >= 2 + behind), None)
    if name is None:
        return None
    light = _over_time(arrays, name, behind)
    curve: NDArray[Any] = light.sum((0, *range(2, light.ndim)), dtype=np.float64)
    return curve
