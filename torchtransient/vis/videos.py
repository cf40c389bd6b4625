"""A transient as frames and as a video: `.mp4` (H.264) or `.gif`, with the time in a strip under each frame."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchtransient.array_files.part_files import replacing
from torchtransient.axes import TimeAxis
from torchtransient.checks import check_folder, path_of, positive, short_message, shown
from torchtransient.errors import ShapeError, StorageError, UnitError
from torchtransient.units import opl_to_seconds
from torchtransient.vis.files import Image, enlarge, needed, pillow, to_bytes
from torchtransient.vis.sources import Source, images_of
from torchtransient.vis.tone_mapping import exposure_of, exposure_of_video, tone_map

# Pixels: smaller pictures are enlarged to about this, else a player shows a stamp.
_VISIBLE = 320
INK, DIM, GROUND = (235, 235, 235), (95, 95, 95), (20, 20, 20)
ENDINGS = (".mp4", ".gif")
_PALETTE_FRAMES = 24
_PALETTE_PIXELS = 2**18
# Mixed with neighbours, these would look tinted: the strip with the time, the greys of its letters, black and white.
_GREYS = [(level, level, level) for level in range(GROUND[0] + 24, INK[0], 24)]
_KEPT = (GROUND, DIM, INK, (0, 0, 0), (255, 255, 255), *_GREYS)


@dataclass(frozen=True)
class Frames:
    """Frames (H, W, 3) uint8 that are made when they are asked for; `len`, iteration (any number of times), indices.

    Args:
        count: number of frames.
        make: function of the number of a frame.
    """

    count: int
    make: Callable[[int], Image]

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
    """Return the frames of a transient under one exposure, one after the other in time.

    Args:
        source: transient (C, T, H, W), polarized (4, C, T, H, W), a RenderOutput, a Capture (a grid; of exhaustive ones
            the middle laser spot), or a file. Gated images are frames in the order of their gates.
        axis: time axis; None takes that of the source.
        exposure: factor of the radiance in a bin; None leaves 1 % of the lit pixels of all frames white.
        curve: tone curve, "srgb", "gamma", "linear" or "log", see ``tone_map``.
        accumulate: show the light that has arrived so far.
        stamp: put the time under each frame.
        scale: side of a pixel on the screen; None enlarges small pictures to some 320 pixels.
        every: bins that are added up to a frame.

    Returns:
        Frames (H, W, 3) uint8, made when they are asked for. Pixels that are not finite are magenta.

    Raises:
        ShapeError: for other shapes, and an axis that does not fit.
        UnitError: for an exposure that is not positive.
    """
    cube, axis, word = images_of(source, axis, "frames")
    bins, (height, width) = cube.shape[1], cube.shape[2:]
    count = -(-bins // every)
    if exposure is not None:
        exposure = positive("frames: exposure", exposure)
    else:
        exposure = exposure_of(cube.sum(1)) if accumulate else exposure_of_video(_added(cube, every))
    factor = max(1, round(_VISIBLE / max(height, width))) if scale is None else scale
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
    **settings: Any,
) -> Path:
    """Write the :func:`frames` of a transient as ``.mp4`` or ``.gif``.

    Args:
        source, axis: transient, or a result or file that has one, and its time axis, see ``frames``.
        path: file, ``.mp4`` or ``.gif``.
        fps: frames per second.
        progress: show a bar.
        **settings: exposure, curve, accumulate, stamp, scale, every of ``frames``.

    Returns:
        The path.

    Raises:
        StorageError: for another ending or a folder that is missing, before any frame is made.
        MissingPackageError: without imageio-ffmpeg or Pillow (extra ``vis``).
        ShapeError, UnitError: as for ``frames``.
    """
    check_video(path)
    shown = frames(source, axis=axis, **settings)
    return write_video(path, shown, len(shown), fps=fps, progress=progress)


def _added(cube: Tensor, every: int) -> Tensor:
    """Return the cube in bins of `every`; a copy is only made when it is smaller."""
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


# ------------------------------------------------------------------------------------------------------------ files


def check_video(path: str | Path) -> Path:
    """Return the path, checked before a long render.

    Args:
        path: file of a video.

    Raises:
        StorageError: for another ending than .mp4 and .gif, or a folder that is missing.
        MissingPackageError: without the package that writes it.
    """
    target = path_of(path, "video")
    if target.suffix.lower() not in ENDINGS:
        raise StorageError(f"video: expected a name that ends in .mp4 or .gif, got '{path}'.")
    check_folder(target, "video")
    if target.suffix.lower() == ".mp4":
        _ffmpeg()
    else:
        pillow()
    return target


def write_video(
    path: str | Path, frames: Iterable[Image], count: int, *, fps: float = 25.0, progress: bool = False
) -> Path:
    """Write frames as ``.mp4`` or ``.gif``.

    A GIF looks at up to 24 frames first for its palette, one for all frames (colours of one palette per frame would
    flicker), and iterates twice. An MP4 has an even number of rows and columns: an odd last one is repeated. GIF
    players know hundredths of a second: ``fps`` is rounded to that, and equal frames that follow each other become one
    that is shown longer.

    Args:
        path: file, ``.mp4`` or ``.gif``.
        frames: images (H, W, 3) uint8 of equal size, taken one after the other; for a GIF an object that iterates
            twice.
        count: number of frames.
        fps: frames per second.
        progress: show a bar.

    Returns:
        The path.

    Raises:
        ShapeError: without frames, and for frames of several sizes.
        UnitError: unless ``fps`` is positive, and at most 50 of a GIF.
        StorageError: when the file cannot be written.
        MissingPackageError: without imageio-ffmpeg or Pillow (extra ``vis``).
    """
    target = check_video(path)
    fps = positive("video: fps", fps)
    if target.suffix.lower() != ".mp4" and fps > 50:
        raise UnitError(f"video: a GIF shows at most 50 frames a second, got fps={fps!r}. Write an .mp4.")
    with replacing(target, "video") as unfinished:
        try:
            if target.suffix.lower() == ".mp4":
                _write_mp4(unfinished, _followed(frames, count, progress), fps)
            else:
                palette = _palette(_followed(frames, count, progress=False), count)
                _write_gif(unfinished, _followed(frames, count, progress), palette, fps)
        except OSError as error:  # with the command and its output, where it is ffmpeg's
            raise StorageError(f"video: '{target}' could not be written: {short_message(error)}.") from error
    return target


def _followed(frames: Iterable[Image], count: int, progress: bool) -> Iterator[Image]:
    """Yield the frames, checked, behind a progress bar."""
    from tqdm import tqdm

    size: tuple[int, ...] = ()
    for frame in tqdm(frames, total=count, desc="video", unit="frame", disable=not progress):
        size = size or frame.shape
        if frame.dtype != np.uint8 or frame.shape != size or len(size) != 3 or size[2] != 3:
            raise ShapeError(f"video: expected frames (H, W, 3) of uint8 and of one size, got {shown(frame)}.")
        yield frame
    if not size:
        raise ShapeError("video: expected at least one frame, got none; for a GIF frames are iterated twice.")


def _write_mp4(target: Path, frames: Iterator[Image], fps: float) -> None:
    writer, written = None, 0
    try:
        for frame in frames:
            odd = [(0, n % 2) for n in frame.shape[:2]]
            even = np.pad(frame, (*odd, (0, 0)), mode="edge")
            if writer is None:
                height, width = even.shape[:2]
                # yuv420p is what browsers and slides play; crf 18 keeps small pixels sharp.
                writer = _ffmpeg().write_frames(
                    str(target), (width, height), fps=fps, codec="libx264", pix_fmt_in="rgb24", pix_fmt_out="yuv420p",
                    macro_block_size=2, quality=None, ffmpeg_log_level="error",
                    output_params=["-crf", "18", "-movflags", "+faststart", "-f", "mp4"],
                )  # fmt: skip
                writer.send(None)
            writer.send(np.ascontiguousarray(even))
            written += 1
    finally:
        if writer is not None:
            writer.close()
    with contextlib.suppress(RuntimeError):  # of a file that is none
        if _ffmpeg().count_frames_and_secs(str(target))[0] == written:
            return
    # ffmpeg says so on stderr alone
    raise StorageError("video: ffmpeg ended before the file was whole. Is the disk full?")


def _palette(frames: Iterable[Image], count: int) -> Any:
    """Return 256 colours that serve up to 24 frames out of all."""
    step = max(1, math.ceil(count / _PALETTE_FRAMES))
    seen = []
    for number, frame in enumerate(frames):
        if number % step == 0:
            pixels = frame.reshape(-1, 3)
            seen.append(pixels[:: max(1, pixels.shape[0] * _PALETTE_FRAMES // _PALETTE_PIXELS)])
    # A colour that fills the picture, such as black, must not use up the palette.
    colours = np.unique(np.concatenate(seen) & 0xFC, axis=0)
    row = pillow().fromarray(np.ascontiguousarray(colours[None]).astype(np.uint8))
    chosen = row.quantize(256 - len(_KEPT), method=pillow().Quantize.MEDIANCUT).getpalette() or []
    palette = pillow().new("P", (1, 1))
    kept = [level for colour in _KEPT for level in colour]
    palette.putpalette(kept + chosen[: 768 - len(kept)])
    return palette


def _write_gif(target: Path, frames: Iterator[Image], palette: Any, fps: float) -> None:
    none = pillow().Dither.NONE
    images = (pillow().fromarray(frame).quantize(palette=palette, dither=none) for frame in frames)
    first = next(images)
    duration = max(2, round(100 / fps)) * 10
    first.save(target, format="GIF", save_all=True, append_images=images, duration=duration, loop=0, optimize=False)


def _ffmpeg() -> Any:
    return needed("imageio_ffmpeg", "imageio-ffmpeg")


# ------------------------------------------------------------------------------------------- the strip with the time


def moment(axis: TimeAxis | None, index: int, bins: int, word: str = "bin") -> str:
    """Return the text of a stamp: the centre of a bin in metres and nanoseconds, or its number without an axis.

    Args:
        axis: time axis, None for none.
        index: number of the bin.
        bins: number of bins.
        word: name of an entry without an axis, "gate" for those of a gated film.
    """
    if axis is None:
        return f"{word} {index} of {bins}"
    opl = axis.start_opl + (index + 0.5) * axis.bin_width_opl
    time_ns, width_ns = (1e9 * opl_to_seconds(length) for length in (opl, axis.bin_width_opl))
    return f"{_digits(opl, axis.bin_width_opl)} m   {_digits(time_ns, width_ns)} ns"


def _digits(value: float, step: float) -> str:
    """Format with as many decimals as tell the halves of a bin apart."""
    decimals = int(np.clip(np.ceil(-np.log10(step / 2)), 0, 6))
    return f"{value:.{decimals}f}"


def with_strip(image: Image, text: str, share: float | None = None) -> Image:
    """Return the image over a dark strip with a text, made smaller until it fits the width.

    Args:
        image: image (H, W, 3) uint8.
        text: text in the strip.
        share: share, 0 to 1, of a bar that fills from left to right; None draws no bar.
    """
    height, width = image.shape[:2]
    rows = max(16, round(0.075 * max(height, width)))
    strip = pillow().new("RGB", (width, rows), GROUND)
    from PIL import ImageDraw

    draw = ImageDraw.Draw(strip)
    bar = max(2, rows // 9)
    font = _font(draw, text, 0.58 * rows, width - rows // 2)
    draw.text((rows // 4, (rows - bar) / 2 + bar), text, fill=INK, font=font, anchor="lm")
    if share is not None:
        draw.rectangle((0, 0, width, bar - 1), fill=DIM)
        filled = round(share * width)
        if filled:
            draw.rectangle((0, 0, filled - 1, bar - 1), fill=INK)
    return np.concatenate([image, np.asarray(strip)])


def _font(draw: Any, text: str, size: float, room: float) -> Any:
    from PIL import ImageFont

    font = ImageFont.load_default(size)
    while size > 6 and draw.textlength(text, font=font) > room:
        size *= 0.9
        font = ImageFont.load_default(size)
    return font
