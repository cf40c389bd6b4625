"""``tt.nlos.simulate``: a capture with a bar, told of memory and time before, and with a file that keeps what is done.

With a part file the sensor points are rendered in tiles. A tile is in the file whole or not at all, so that a simulation
that was killed goes on where it was, and ends with the bits that it would have had.
"""

from __future__ import annotations

import hashlib
import math
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchtransient.axes import FrequencyAxis, TimeAxis
from torchtransient.capture import Capture, Scan
from torchtransient.errors import SceneError
from torchtransient.nlos.part_file import PartFile
from torchtransient.nlos.renderer import POINTS, CaptureRenderer, measured
from torchtransient.nlos.scene import hidden_bounds
from torchtransient.units import seconds_to_opl

# Tiles of a simulation with a part file: that many are lost by a kill at most.
TILES = 16
BIN_WIDTH_S = 16e-12
# Share of the paths that the time is estimated by.
PILOT_SHARE = 64


def simulate(
    hidden: Any,
    scan: Scan,
    *,
    time_axis: TimeAxis | None = None,
    frequencies: FrequencyAxis | Sequence[float] | None = None,
    spp: int = 4096,
    bounces: Sequence[int] = (3,),
    energy: Any = 1.0,
    sensor: torch.nn.Module | None = None,
    seed: int = 0,
    variant: str | None = None,
    part: str | Path | None = None,
    tiles: int | None = None,
    progress: bool = True,
    generator: torch.Generator | None = None,
) -> Capture:
    """What a scan measures of hidden things: a :class:`Capture`, without gradients (see :class:`CaptureRenderer`).

    ``hidden``, ``bounces``, ``energy``: as in :func:`~torchtransient.nlos.scene.capture_scene`. ``time_axis`` or
    ``frequencies``: what is measured; without them bins of 16 ps that hold all light of three bounces. ``spp``: paths
    for each sensor point, or for each pair of an exhaustive scan. ``sensor``: a module of ``tt.sensing`` that the
    transient goes through at last, with the noise of ``generator``. ``seed``: same seed and tiles, same capture.
    ``part``: name of a file that keeps finished tiles (16, or ``tiles``): with it a simulation that was killed goes on
    when it is called again. It is deleted at the end, when the capture is returned. ``progress``: say memory and time
    before it starts, and show a bar.

    Raises SceneError, ShapeError; StorageError where the capture does not fit into memory, or the part file belongs to
    another simulation.
    """
    if time_axis is not None and frequencies is not None:
        raise SceneError("simulate: expected time_axis or frequencies, got both.")
    if time_axis is None and frequencies is None:
        time_axis = scan.detach().default_axis(hidden_bounds(hidden), seconds_to_opl(BIN_WIDTH_S))
    count = _tile_count(tiles, part, scan)
    film = {"time_axis": time_axis, "frequencies": frequencies, "spp": spp}
    recipe = {"bounces": bounces, "energy": energy, "variant": variant, **film}
    if count == 1:
        renderer = CaptureRenderer(hidden, scan.detach(), sensor=sensor, **recipe)
        if progress:
            _say(renderer, scan, spp, 1)
        with torch.no_grad():
            return renderer(seed=seed, progress=progress, generator=generator)
    return _in_tiles(hidden, scan.detach(), recipe, _Tiles(count, seed, part, progress), sensor, generator)


class _Tiles:
    """How many tiles, of which seed, kept where."""

    def __init__(self, count: int, seed: int, part: str | Path | None, progress: bool) -> None:
        self.count, self.seed, self.part, self.progress = count, seed, part, progress

    def ranges(self, points: int) -> list[tuple[int, int]]:
        """First and last sensor point of each, of equal sizes but for the last: a size is a scene to be built."""
        size = -(-points // self.count)
        return [(first, min(first + size, points)) for first in range(0, points, size)]

    def seed_of(self, number: int) -> int:
        """The seed of a tile."""
        return int.from_bytes(hashlib.sha256(f"{self.seed}:{number}".encode()).digest()[:4], "little")


def _in_tiles(
    hidden: Any,
    scan: Scan,
    recipe: dict[str, Any],
    tiles: _Tiles,
    sensor: torch.nn.Module | None,
    generator: torch.Generator | None,
) -> Capture:
    from tqdm.auto import tqdm

    points = scan.sensor_points.reshape(-1, 3)
    ranges = tiles.ranges(len(points))
    key = hashlib.sha256(repr((_digest(hidden), _digest(scan), recipe, tiles.seed, ranges)).encode()).hexdigest()
    kept = None if tiles.part is None else PartFile(Path(tiles.part), key, len(points))
    renderers: dict[int, CaptureRenderer] = {}
    cube, capture = None, None
    bar = tqdm(total=len(points), desc="capture", unit=" points", disable=not tiles.progress)
    for number, (first, last) in enumerate(ranges):
        if kept is None or not kept.has(number):
            size = last - first
            listed = _listed(scan, points[first:last])
            if size not in renderers:
                renderers[size] = CaptureRenderer(hidden, listed, (POINTS,), **recipe)
                if tiles.progress and len(renderers) == 1:
                    _say(renderers[size], scan, recipe["spp"], len(points) / size)
            with torch.no_grad():
                capture = renderers[size]({POINTS: points[first:last]}, seed=tiles.seed_of(number))
            found = _points_first(capture)
            if kept is not None:
                kept.write(number, first, found.numpy())
            else:
                cube = torch.empty((len(points), *found.shape[1:]), dtype=found.dtype) if cube is None else cube
                cube[first:last] = found
        bar.update(last - first)
    bar.close()
    if kept is not None:
        if capture is None:  # all tiles were there: what they are of is told by one of few paths
            capture = CaptureRenderer(hidden, _listed(scan, points[:1]), **(recipe | {"spp": 1}))(seed=0)
        cube = torch.from_numpy(np.array(kept.cube))
    result = _assembled(capture, cube, scan, recipe["spp"])
    if sensor is not None and result.transient is not None:
        result = replace(result, transient=_through(result.transient, scan, sensor, generator))
    if kept is not None:
        kept.remove()
    return result


def _listed(scan: Scan, points: torch.Tensor) -> Scan:
    """The scan of some of the sensor points alone."""
    laser = points if scan.kind == "confocal" else scan.laser_points
    normals = {"sensor_normals": None, "laser_normals": None}
    return replace(scan, sensor_points=points, laser_points=laser, **normals)


def _points_first(capture: Capture) -> torch.Tensor:
    """The measured tensor of a list of points with these first, in the order of memory."""
    tensor = capture.transient if capture.transient is not None else capture.phasor
    assert tensor is not None
    return tensor.detach().cpu().movedim(-1, 0).contiguous()


def _assembled(capture: Capture, cube: torch.Tensor, scan: Scan, spp: int) -> Capture:
    tensor = cube.movedim(0, -1)
    tensor = tensor.reshape(*tensor.shape[:-1], *scan.sensor_shape)
    name = "transient" if capture.transient is not None else "phasor"
    metadata = {"spp": spp, "variant": capture.metadata["variant"]}
    return replace(capture, scan=scan, steady=None, metadata=metadata, **{name: tensor})


def _through(
    transient: torch.Tensor, scan: Scan, sensor: torch.nn.Module, generator: torch.Generator | None
) -> torch.Tensor:
    """What a sensor makes of a capture's transient."""
    dims = len(scan.shape)
    rows = math.prod(scan.laser_shape) if scan.kind == "exhaustive" else 1
    flat = transient.reshape(*transient.shape[: transient.ndim - dims], rows, -1)
    seen: torch.Tensor = sensor(flat, generator=generator)
    return seen.reshape(*seen.shape[:-2], *scan.shape)


def _say(renderer: CaptureRenderer, scan: Scan, spp: int, times: float) -> None:
    """Memory and time of what is about to start, from a small share of its paths."""
    some = max(1, spp // PILOT_SHARE)
    with torch.no_grad():
        renderer(seed=0, spp=some)  # compiles
        began = time.perf_counter()
        out = renderer(seed=0, spp=some)
        seconds = (time.perf_counter() - began) * times * max(1.0, spp / some)
    tensor = out.transient if out.transient is not None else out.phasor
    assert tensor is not None
    size = tensor.numel() * tensor.element_size() * times
    print(f"{scan!r}: {size / 2**20:.4g} MiB, about {seconds:.3g} s", file=sys.stderr)


def _tile_count(tiles: int | None, part: str | Path | None, scan: Scan) -> int:
    if tiles is None:
        tiles = 1 if part is None else TILES
    if isinstance(tiles, bool) or not isinstance(tiles, int) or tiles < 1:
        raise SceneError(f"simulate: tiles: expected a whole number of at least 1, got {tiles!r}.")
    if tiles == 1 and part is not None:
        tiles = min(2, math.prod(scan.sensor_shape))
    return min(tiles, math.prod(scan.sensor_shape))


def _digest(value: Any) -> str:
    """A text that is the same for equal descriptions."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{k}: {_digest(v)}" for k, v in value.items()) + "}"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(_digest, value)) + "]"
    if isinstance(value, torch.Tensor):
        value = value.detach().cpu().numpy()
    if isinstance(value, np.ndarray):
        return f"{value.dtype}{value.shape}{hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()}"
    if isinstance(value, Scan):
        return _digest({k: v for k, v in vars(value).items()})
    if hasattr(value, "vertices") and hasattr(value, "faces"):
        return _digest([np.asarray(value.vertices), np.asarray(value.faces)])
    return repr(value)
