"""Light in flight: a transient as frames and as a video."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypedDict, Unpack

import numpy as np
import torch
from torch import Tensor

from torchtransient import checks
from torchtransient.axes import TimeAxis
from torchtransient.checks import function, several
from torchtransient.errors import ShapeError
from torchtransient.vis.files import Image, enlarge, to_bytes
from torchtransient.vis.sources import Source, images_of
from torchtransient.vis.stamps import moment, with_strip
from torchtransient.vis.tone_mapping import checked_positive, exposure_of, exposure_of_video, tone_map
from torchtransient.vis.video_file import check_video, checked_frame, write_video

_VISIBLE = 320  # pixels: smaller pictures are enlarged to about this, else a player shows a stamp


class FrameSettings(TypedDict, total=False):
    """What `frames` is told besides what it shows; its own defaults hold for what is left out."""

    exposure: float | None
    curve: str
    accumulate: bool
    stamp: bool
    scale: int | None
    every: int


@dataclass(frozen=True)
class Frames:
    """Frames (H, W, 3) uint8 that are made when they are asked for; `len`, iteration (any number of times), indices."""

    count: int
    make: Callable[[int], Image]

    def __post_init__(self) -> None:
        object.__setattr__(self, "count", checks.count("Frames: count", self.count, 0, ShapeError))
        function("Frames: make", self.make, "the number of a frame")

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> Image:
        if not -self.count <= index < self.count:
            raise IndexError(f"frame {index} of {self.count}")
        return self.make(index % self.count)

    def __iter__(self) -> Iterator[Image]:
        return (self.make(index) for index in range(self.count))


def frames(
    source: Source,
    *,
    axis: TimeAxis | None = None,
    exposure: float | None = None,
    curve: str = "srgb",
    accumulate: bool = False,
    stamp: bool = True,
    scale: int | None = None,
    every: int = 1,
) -> Frames:
    """The frames of a transient under one exposure, one after the other in time.

    `source`: a transient (C, T, H, W), polarized (4, C, T, H, W), a RenderOutput, or a file; `axis` for sources that
    have none. The images of a gated film are frames too, in the order of its gates. `exposure` multiplies the radiance
    of a bin (None: 99 % of the lit pixels of all frames are below white); `curve` as in `tone_map`. `accumulate` shows
    the light that has arrived so far. `every` adds up that many bins to a frame. `scale` enlarges pixels (None: small
    pictures to some 320 pixels). `stamp` puts the time under each frame. Pixels that are not finite are magenta. Raises
    ShapeError and UnitError.
    """
    cube, axis, word = images_of(source, axis, "frames")
    every = checks.count("frames: every", every, 1, ShapeError)
    bins, (height, width) = cube.shape[1], cube.shape[2:]
    count = -(-bins // every)
    if exposure is not None:
        exposure = checked_positive("exposure", exposure, "frames")
    else:
        exposure = exposure_of(cube.sum(1)) if accumulate else exposure_of_video(_added(cube, every))
    factor = max(1, round(_VISIBLE / max(height, width))) if scale is None else scale
    factor = checks.count("frames: scale", factor, 1, ShapeError)
    running = _Running(cube) if accumulate else None

    def make(index: int) -> Image:
        first, last = index * every, min((index + 1) * every, bins)
        light = cube[:, first:last].sum(1) if running is None else running.until(last)
        shown = enlarge(to_bytes(tone_map(light, exposure, curve).numpy()), factor)
        middle = (first + last - 1) // 2 if running is None else last - 1
        return with_strip(shown, moment(axis, middle, bins, word), last / bins) if stamp else shown

    return Frames(count, make)


def video(
    source: Source,
    path: str | Path,
    *,
    fps: float = 25.0,
    progress: bool = False,
    axis: TimeAxis | None = None,
    **settings: Unpack[FrameSettings],
) -> Path:
    """Write the `frames` of a transient as `.mp4` or `.gif`; returns the path.

    `progress` shows a bar. `axis` and `settings` (exposure, curve, accumulate, stamp, scale, every) are those of
    `frames`. Raises StorageError for another ending, a folder that is
    missing, or a missing package (`pip install 'torchtransient[vis]'`), before any frame is made.
    """
    check_video(path)
    shown = frames(source, axis=axis, **settings)
    return write_video(path, shown, len(shown), fps=fps, progress=progress)


def side_by_side(parts: Sequence[Frames], gap: int = 4) -> Frames:
    """Frames beside each other, as far as the shortest of `parts` reaches; smaller ones stand on the upper edge.

    Raises ShapeError without any part. Write the result with `write_video(path, frames, len(frames))`.
    """
    parts = several("side_by_side", parts, "sequences of frames")
    for part in parts:
        if not isinstance(part, (Frames, list, tuple)):
            raise ShapeError(f"side_by_side: expected several sequences of frames, got {checks.shown(part)} among "
                             "them; tt.vis.frames makes one.")  # fmt: skip
    if not parts:
        raise ShapeError("side_by_side: expected at least one sequence of frames, got none.")
    between = checks.count("side_by_side: gap", gap, 0, ShapeError)

    def make(index: int) -> Image:
        images = [checked_frame(part[index], "side_by_side") for part in parts]
        height = max(image.shape[0] for image in images)
        row = []
        for image in images:
            row += [np.pad(image, ((0, height - image.shape[0]), (0, 0), (0, 0)))]
            row += [np.full((height, between, 3), 255, np.uint8)]
        return np.concatenate(row[:-1], axis=1)

    return Frames(min(len(part) for part in parts), make)


def _added(cube: Tensor, every: int) -> Tensor:
    """The cube in bins of `every`, of which a copy is only made when it is smaller."""
    if every == 1:
        return cube
    return torch.stack([cube[:, k : k + every].sum(1) for k in range(0, cube.shape[1], every)], dim=1)


class _Running:
    """The sum of the frames until one of them; asked for in order, each frame is added once."""

    def __init__(self, cube: Tensor) -> None:
        self.cube, self.last = cube, 0
        self.total = torch.zeros_like(cube[:, 0], dtype=torch.float64)

    def until(self, last: int) -> Tensor:
        if last < self.last:
            self.last = 0
            self.total = torch.zeros_like(self.total)
        self.total += self.cube[:, self.last : last].sum(1)
        self.last = last
        return self.total
