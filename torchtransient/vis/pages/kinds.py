"""Content of a page for each kind of result: renders, captures, volumes, tensors, two of a kind, and samples."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchtransient.axes import RateAxis, TimeAxis
from torchtransient.capture import Capture
from torchtransient.checks import shown
from torchtransient.errors import ArgumentError, ShapeError
from torchtransient.vis.pages.content import (
    Content,
    Planes,
    Slider,
    bin_slider,
    frequency_slider,
    gate_slider,
    time_slider,
)  # fmt: skip
from torchtransient.vis.sources import as_tensor, frequencies_of, read_any

# What films measure, by the names of results.
_FILMS = ("rates", "beats", "slow_phasor", "phasor", "gated", "transient")


def content_of(x: Any, *, axis: TimeAxis | None, rate_axis: RateAxis | None, frequencies: Any, samples: int) -> Content:
    """Return the content of a page.

    Args:
        x: anything that :func:`torchtransient.vis.view` shows.
        axis, rate_axis, frequencies: axes of tensors.
        samples: most samples of a sequence.

    Raises:
        ShapeError, ArgumentError, StorageError: as for ``view``.
    """
    known = {"axis": axis, "rate_axis": rate_axis, "frequencies": frequencies}
    if isinstance(x, tuple) and len(x) == 2:
        return _together([_single(part, **known) for part in x], ("A", "B"))
    sequence = hasattr(x, "__getitem__") or hasattr(x, "__iter__")
    if sequence and not isinstance(x, Tensor | np.ndarray | Mapping | str | Path):
        known["axis"] = getattr(x, "axis", None) if axis is None else axis
        parts = list(islice(_each(x), samples))
        if not parts:
            raise ShapeError(f"view: expected at least one sample, got an empty {type(x).__name__}.")
        names = [f"sample {n}" for n in range(len(parts))]
        found = _together([_single(part, **known) for part in parts], names)
        left = len(x) - len(parts) if hasattr(x, "__len__") else 0
        return replace(found, notes=(*found.notes, f"The first {len(parts)} of {len(x)} samples.")) if left else found
    return _single(x, **known)


def _each(x: Any) -> Iterator[Any]:
    if hasattr(x, "__getitem__") and hasattr(x, "__len__"):
        return (x[number] for number in range(len(x)))
    return iter(x)


def _together(parts: list[Content], names: Sequence[str]) -> Content:
    first = parts[0]
    for part in parts[1:]:
        same = (part.kind, part.shape, part.layers, part.planes[0].light.shape) == (
            first.kind, first.shape, first.layers, first.planes[0].light.shape,
        )  # fmt: skip
        if not same:
            raise ShapeError(
                f"view: expected results of one kind and shape to compare, got {first.kind} {first.shape} and "
                f"{part.kind} {part.shape}."
            )
        if not np.allclose(part.slider.centers, first.slider.centers):
            raise ShapeError(
                f"view: expected results over one {first.slider.name} to compare, got others. Render both with one "
                "axis, or give the tensors alone to compare them bin by bin."
            )
    return replace(first, items=tuple(names), planes=tuple(planes for part in parts for planes in part.planes))


def _single(x: Any, axis: Any, rate_axis: Any, frequencies: Any) -> Content:
    if isinstance(x, str | Path):
        x = read_any(Path(x))
    if isinstance(x, Mapping):
        # The light of a sample is its measurement where it holds no other.
        light = {} if {*_FILMS} & {*x} else {"transient": x.get("measurement")}
        x = SimpleNamespace(**{"axis": axis, **x, **light})
    if isinstance(x, Capture):
        return _capture(x)
    if hasattr(x, "grid") and hasattr(x, "picture"):
        return _volume(x)
    axis = getattr(x, "axis", None) if axis is None else axis
    rate_axis = getattr(x, "rate_axis", None) if rate_axis is None else rate_axis
    frequencies = getattr(x, "frequencies", None) if frequencies is None else frequencies
    name = next((name for name in _FILMS if getattr(x, name, None) is not None), "")
    cube = as_tensor(getattr(x, name) if name else x, "view")
    match name:
        case "rates":
            return _rates(cube, axis, rate_axis)
        case "beats":
            return _beats(cube, axis)
        case "slow_phasor":
            return _slow_phasors(cube, frequencies, getattr(x, "slow_times", None))
        case "phasor":
            return _phasors(cube, frequencies)
        case "gated":
            return _light(cube, gate_slider(cube.shape[-3], getattr(x, "gates", None)), "gates", _errors(x))
        case "transient":
            return _light(cube, _slider_of(cube, axis), error=_errors(x))
    return _plain(cube, axis, rate_axis, frequencies)


def _plain(cube: Tensor, axis: Any, rate_axis: Any, frequencies: Any) -> Content:
    if cube.is_complex():
        return _phasors(cube, frequencies)
    if frequencies is not None:
        raise ArgumentError(f"view: frequencies are those of complex phasors (C, F, H, W), got {cube.dtype}.")
    if rate_axis is not None:
        return _rates(cube, axis, rate_axis)
    if cube.ndim == 3 and len(cube) == 3 and axis is None:
        raise ShapeError(
            f"view: {tuple(cube.shape)} is a steady picture in colour, or three bins of time. Give light as "
            "(C, T, H, W): steady[:, None] of a picture, cube[None] of bins."
        )
    if cube.ndim == 3:
        cube = cube[None]
    if cube.ndim == 5 and cube.shape[0] == 4 and not _may_be_stokes(cube):
        raise ShapeError(
            f"view: expected Stokes components (4, C, T, H, W) with C = 1 or 3 and S1, S2, S3 within S0, got "
            f"{tuple(cube.shape)} without either. Light over rates (C, R, T, H, W) needs rate_axis=tt.RateAxis(...); "
            "polarized light of other channels is shown of its result, or with one channel chosen."
        )
    return _light(cube, _slider_of(cube, axis))


def _may_be_stokes(cube: Tensor) -> bool:
    """Sums of Stokes vectors have a polarized part within S0, and so has the sum over all pixels and bins."""
    s0, *others = cube.flatten(1).sum(1, dtype=torch.float64).tolist()
    return cube.shape[1] in (1, 3) and not math.hypot(*others) > 1.01 * s0


def _errors(x: Any) -> Tensor | None:
    if getattr(x, "cells", None) is None:
        return None
    found = as_tensor(x.error_map(), "view")
    return found[0] if found.ndim == 4 else found


def _slider_of(cube: Tensor, axis: TimeAxis | None) -> Slider:
    """Return the slider of bins of time of light (..., T, H, W), which count without an axis."""
    bins = cube.shape[-3] if cube.ndim > 2 else 0
    if axis is None:
        return bin_slider(bins)
    if axis.num_bins != bins:
        raise ShapeError(f"view: the axis has {axis.num_bins} bins, the light {bins}.")
    return time_slider(axis.centers_opl.numpy())


def _grey(cube: Tensor) -> tuple[Tensor, tuple[str, ...]]:
    """One channel or three; the mean of other numbers, and a note about it."""
    if len(cube) in (1, 3):
        return cube, ()
    mean, notes = _over_channels(cube)
    return mean[None], notes


def _light(cube: Tensor, slider: Slider, kind: str = "transient", error: Tensor | None = None) -> Content:
    """Return the content of light (C, T, H, W), or polarized (4, C, T, H, W), with standard errors (T, H, W)."""
    if cube.ndim == 5 and cube.shape[0] == 4:
        mean, notes = _over_channels(cube.transpose(0, 1))
        ratios = torch.where(mean[:1] > 0, mean[1:] / mean[:1], 0.0)
        planes = Planes(mean[:1], ratios=ratios, error=error)
        return Content("polarized", slider, ("",), ("",), (planes,), notes=notes)
    if cube.ndim != 4 or not cube.numel():
        raise ShapeError(
            f"view: expected light (C, T, H, W), polarized (4, C, T, H, W) or a result that has some, got "
            f"{tuple(cube.shape)}; of a batch, choose one entry. Rates (C, R, T, H, W) need rate_axis=tt.RateAxis(...)."
        )
    light, notes = _grey(cube)
    quantity = "radiance through a gate" if kind == "gates" else "radiance in a bin"
    return Content(kind, slider, ("",), ("",), (Planes(light, error=error),), quantity=quantity, notes=notes)


def _phasors(cube: Tensor, known: Any) -> Content:
    cube = cube[0] if cube.ndim == 5 and cube.shape[0] == 4 else cube
    if cube.ndim != 4 or not cube.is_complex():
        raise ShapeError(
            f"view: expected complex phasors (C, F, H, W), got {cube.dtype} {tuple(cube.shape)}. Phasors at several "
            "slow times (C, S, F, H, W) are shown of a result that has them, or of {'slow_phasor': tensor}."
        )
    mean, notes = _over_channels(cube)
    slider = frequency_slider(_frequencies(known, len(mean)), len(mean))
    planes = Planes(mean.abs()[None], phase=mean.angle())
    return Content("phasors", slider, ("",), ("",), (planes,), quantity="amplitude", notes=notes)


def _slow_phasors(cube: Tensor, known: Any, slow_times: Any) -> Content:
    """Phasors (C, S, F, H, W): the slider is the slow time, and frequencies are layers."""
    cube = cube[0] if cube.ndim == 6 and cube.shape[0] == 4 else cube
    if cube.ndim != 5 or not cube.is_complex():
        raise ShapeError(
            f"view: expected complex phasors (C, S, F, H, W) at S slow times, got {cube.dtype} {tuple(cube.shape)}."
        )
    mean, notes = _over_channels(cube)
    numbers = _frequencies(known, mean.shape[1])
    if slow_times is None:
        slider = Slider("slow time", "", np.arange(len(mean), dtype=np.float64))
    else:
        slider = Slider("slow time", "s", np.array(slow_times, dtype=np.float64))
        if len(slow_times) != len(mean):
            raise ShapeError(f"view: expected {len(mean)} slow_times, as the phasors have, got {len(slow_times)}.")
    names = tuple(f"{n}" if numbers is None else f"{numbers[n]:.6g} /m" for n in range(mean.shape[1]))
    planes = tuple(Planes(part.abs()[None], phase=part.angle()) for part in mean.unbind(1))
    return Content(
        "slow phasors", slider, ("",), names, planes, quantity="amplitude", layer_name="frequency", notes=notes
    )


def _frequencies(known: Any, count: int) -> tuple[float, ...] | None:
    numbers = frequencies_of(known)
    if numbers is not None and len(numbers) != count:
        raise ShapeError(f"view: expected {count} frequencies, as the phasors have, got {len(numbers)}.")
    return numbers


def _over_channels(cube: Tensor) -> tuple[Tensor, tuple[str, ...]]:
    """Return the mean over channels, and a note where there are several."""
    return cube.mean(0), () if cube.shape[0] == 1 else (f"Mean over {cube.shape[0]} channels.",)


def _rows(cube: Tensor, what: str) -> tuple[Tensor, tuple[str, ...]]:
    if cube.ndim != 5 or cube.is_complex():
        raise ShapeError(f"view: expected {what}, got {tuple(cube.shape)}; of a batch, choose one entry.")
    return _over_channels(cube)


def _rates(cube: Tensor, axis: Any, rate_axis: Any) -> Content:
    mean, notes = _rows(cube, "light over rates and lengths (C, R, T, H, W)")
    if not isinstance(rate_axis, RateAxis) or rate_axis.num_bins != len(mean):
        raise ShapeError(f"view: light over {len(mean)} rates needs rate_axis=RateAxis(...), got {shown(rate_axis)}.")
    centers = tuple(rate_axis.centers.tolist())
    return Content(
        "rates", _slider_of(mean, axis), ("",), tuple(f"{rate:.4g} m/s" for rate in centers),
        tuple(Planes(part[None]) for part in mean), layer_name="rate", layer_numbers=centers, notes=notes,
    )  # fmt: skip


def _beats(cube: Tensor, axis: Any) -> Content:
    mean, notes = _rows(cube, "beats (C, 2, T, H, W)")
    planes = tuple(Planes(part[None]) for part in mean)
    slider = _slider_of(mean, axis)
    names = ("up chirp", "down chirp")
    return Content("beats", slider, ("",), names, planes, quantity="beat power", layer_name="chirp", notes=notes)


def _capture(capture: Capture) -> Content:
    tensor = capture.transient if capture.transient is not None else capture.phasor
    cube = as_tensor(tensor, "view")
    scan, rank = capture.scan, len(capture.scan.shape)
    if capture.polarized:
        cube = cube.select(cube.ndim - rank - 3, 0)
    if cube.ndim != rank + 2:
        raise ShapeError(f"view: expected one capture, got a batch {tuple(cube.shape)}; choose one of it.")
    rows, columns = (1, *scan.sensor_shape)[-2:]
    spots = scan.laser_shape if scan.kind == "exhaustive" else ()
    cube = cube.reshape(*cube.shape[:2], -1, rows, columns)
    laser_grid = (1, *spots)[-2:] if spots else ()
    names = tuple(_spot_name(n, laser_grid) for n in range(cube.shape[2])) if spots else ("",)
    common: dict[str, Any] = {"items": ("",), "layers": names, "layer_grid": laser_grid}
    common |= {"layer_name": "laser spot" if spots else ""}
    if len(scan.sensor_shape) == 2:
        extent, across, up, middle = _wall(scan.sensor_points)
        lasers = scan.laser_points.detach().cpu().double().reshape(-1, 3) - middle
        marks = tuple((float(p @ across), float(p @ up)) for p in lasers) if scan.kind != "confocal" else ()
        common |= {"extent": extent, "unit": "m", "marks": marks if scan.kind in ("single", "exhaustive") else ()}
    if capture.transient is None:
        parts = [_phasors(cube[:, :, n], capture.frequencies) for n in range(cube.shape[2])]
        return replace(parts[0], planes=tuple(part.planes[0] for part in parts), **common)
    light = [_grey(cube[:, :, n]) for n in range(cube.shape[2])]
    slider = _slider_of(light[0][0], capture.axis)
    return Content("capture", slider, planes=tuple(Planes(part) for part, _ in light), notes=light[0][1], **common)


def _spot_name(number: int, grid: tuple[int, ...]) -> str:
    return f"({number // grid[1]}, {number % grid[1]})" if grid[0] > 1 else f"{number}"


def _wall(points: Tensor) -> tuple[tuple[float, float, float, float], Tensor, Tensor, Tensor]:
    """Extent of a grid of points around their mean, each with a cell of its own, and the wall's directions."""
    points = points.detach().cpu().double()
    middle = points.reshape(-1, 3).mean(0)
    rows, columns = points.shape[:2]
    steps = [
        (points[:, -1] - points[:, 0]).mean(0) / max(1, columns - 1),
        (points[-1] - points[0]).mean(0) / max(1, rows - 1),
    ]
    sizes = [float(step.norm()) or 1.0 for step in steps]
    across, up = (step / size for step, size in zip(steps, sizes, strict=True))
    half = (columns * sizes[0] / 2, rows * sizes[1] / 2)
    return (-half[0], half[0], -half[1], half[1]), across, up, middle


def _volume(volume: Any) -> Content:
    values = as_tensor(volume.picture(), "view")
    (rows, columns), (dy, dx) = values.shape[1:], volume.grid.pitch
    extent = (-columns * dx / 2, columns * dx / 2, -rows * dy / 2, rows * dy / 2)
    slider = Slider("depth", "m", volume.grid.depths.cpu().double().numpy())
    return Content("volume", slider, ("",), ("",), (Planes(values[None]),), quantity="value", extent=extent, unit="m")


def binned(content: Content, times: int, pixels: int) -> Content:
    """Return a content with fewer bins and pixels; those at the ends that fill none are left out.

    Args:
        content: the content.
        times: bins that are added up to one.
        pixels: rows and columns that are averaged to one.
    """
    t, h, w = (n // k * k for n, k in zip(content.shape, (times, pixels, pixels), strict=True))

    def mean(x: Tensor) -> Tensor:
        part = x[..., :t, :h, :w].float()
        sizes = (t // times, times, h // pixels, pixels, w // pixels, pixels)
        return part.reshape(*x.shape[:-3], *sizes).mean((-5, -3, -1))

    def reduced(planes: Planes) -> Planes:
        light, ratios, phase, error = mean(planes.light) * times, None, None, None
        if planes.ratios is not None:
            ratios = torch.where(light > 0, mean(planes.ratios * planes.light) * times / light, 0.0)
        if planes.phase is not None:
            waves = torch.complex(*(mean(planes.light[0] * part) for part in (planes.phase.cos(), planes.phase.sin())))
            light, phase = waves.abs()[None], waves.angle()
        if planes.error is not None:
            error = (mean(planes.error.square()) * times).sqrt() / pixels
        return Planes(light, ratios, phase, error)

    slider = replace(content.slider, centers=content.slider.centers[:t].reshape(-1, times).mean(1))
    extent = content.extent
    if extent is not None:
        left, right, low, high = extent
        rows, columns = content.shape[1:]
        extent = (left, left + (right - left) * w / columns, low, low + (high - low) * h / rows)
    parts = [f"adds up {times} bins"] * (times > 1) + [f"averages {pixels} x {pixels} pixels"] * (pixels > 1)
    note = f"To be small, the page {' and '.join(parts)}."
    return replace(
        content, slider=slider, planes=tuple(map(reduced, content.planes)), extent=extent, notes=(*content.notes, note),
        stride=pixels, block=pixels,
    )  # fmt: skip
