"""Frames into a video file: `.mp4` (H.264) or `.gif`."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from torchtransient import checks
from torchtransient.array_files.part_files import replacing
from torchtransient.checks import check_folder, one_by_one, path_of, positive, short_message, shown
from torchtransient.errors import MissingPackageError, ShapeError, StorageError, UnitError
from torchtransient.vis.files import Image
from torchtransient.vis.stamps import DIM, GROUND, INK

ENDINGS = (".mp4", ".gif")
_PALETTE_FRAMES = 24
_PALETTE_PIXELS = 2**18
# Mixed with neighbours, these would look tinted: the strip with the time, the greys of its letters, black and white.
_GREYS = [(level, level, level) for level in range(GROUND[0] + 24, INK[0], 24)]
_KEPT = (GROUND, DIM, INK, (0, 0, 0), (255, 255, 255), *_GREYS)


def check_video(path: str | Path) -> Path:
    """Return `path`, or raise StorageError when `write_video` could not write there. For before a long render."""
    target = path_of(path, "video")
    if target.suffix.lower() not in ENDINGS:
        raise StorageError(f"video: expected a name that ends in .mp4 or .gif, got '{path}'.")
    check_folder(target, "video")
    if target.suffix.lower() == ".mp4":
        _ffmpeg()
    else:
        _pillow()
    return target


def write_video(
    path: str | Path, frames: Iterable[Image], count: int, *, fps: float = 25.0, progress: bool = False
) -> Path:
    """Write `count` frames (H, W, 3) uint8 of equal size; returns the path.

    Frames are taken one after the other, so a generator needs no memory for all of them; a GIF looks at up to 24 of
    them first for its palette, which is one for all frames (colours of one palette per frame would flicker), and
    therefore takes a second look at the iterable: give a list, or an object that can be iterated twice. An MP4 has an
    even number of rows and columns: an odd last one is repeated. GIF players know hundredths of a second: `fps` is
    rounded to that, and equal frames that follow each other become one that is shown longer. Raises ShapeError without
    frames or for frames of different size, UnitError unless fps > 0, StorageError when the file cannot be written or
    imageio-ffmpeg is missing (extra `vis`).
    """
    target = check_video(path)
    try:
        fps = positive("fps", fps)
    except UnitError:
        raise UnitError(f"video: expected fps > 0, got {shown(fps)}.") from None
    one_by_one("video", frames, "frames (H, W, 3) of uint8")
    many = checks.count("video: count", count, 0, ShapeError)
    if not many:
        raise ShapeError("video: expected at least one frame, got none.")
    if target.suffix.lower() != ".mp4" and fps > 50:
        raise UnitError(f"video: a GIF shows at most 50 frames a second, got fps={fps!r}. Write an .mp4.")
    with replacing(target, "video") as unfinished:
        try:
            if target.suffix.lower() == ".mp4":
                _write_mp4(unfinished, _followed(frames, many, progress), fps)
            else:
                palette = _palette(frames, many)
                _write_gif(unfinished, _followed(frames, many, progress), palette, fps)
        except OSError as error:  # with the command and its output, where it is ffmpeg's
            raise StorageError(f"video: '{target}' could not be written: {short_message(error)}.") from error
    return target


def checked_frame(frame: Any, who: str) -> Image:
    """An image (H, W, 3) of uint8. Raises ShapeError for what is none."""
    if not isinstance(frame, np.ndarray):
        raise ShapeError(f"{who}: expected frames (H, W, 3) of uint8, got {shown(frame)}.")
    if frame.ndim != 3 or frame.shape[2] != 3 or frame.dtype != np.uint8:
        raise ShapeError(f"{who}: expected frames (H, W, 3) of uint8, got {frame.dtype} {tuple(frame.shape)}.")
    return frame


def _followed(frames: Iterable[Image], count: int, progress: bool) -> Iterator[Image]:
    """The frames, checked, behind a progress bar."""
    from tqdm import tqdm

    size: tuple[int, ...] | None = None
    for given in tqdm(frames, total=count, desc="video", unit="frame", disable=not progress):
        frame = checked_frame(given, "video")
        if size is not None and frame.shape != size:
            raise ShapeError(f"video: expected frames of equal size {size}, got {tuple(frame.shape)}.")
        size = frame.shape
        yield frame


def _write_mp4(target: Path, frames: Iterator[Image], fps: float) -> None:
    writer = None
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
    finally:
        if writer is not None:
            writer.close()
    if not _is_whole(target):  # which ffmpeg says on stderr alone
        raise StorageError("video: ffmpeg ended before the file was whole. Is the disk full?")


def _is_whole(mp4: Path) -> bool:
    """Whether the boxes that an MP4 consists of, each with its length before it, fill the file, with a table."""
    kinds, place, size = set(), 0, mp4.stat().st_size
    with mp4.open("rb") as file:
        while place + 8 <= size:
            file.seek(place)
            length, kind = struct.unpack(">I4s", file.read(8))
            if length == 1:  # it follows, in 64 bits
                length = int.from_bytes(file.read(8), "big")
            if length < 8:
                return False
            kinds.add(kind)
            place += length
    return place == size and kinds >= {b"moov", b"mdat"}


def _palette(frames: Iterable[Image], count: int) -> Any:
    """256 colours that serve up to 24 frames out of all."""
    pillow = _pillow()
    step = max(1, math.ceil(count / _PALETTE_FRAMES))
    seen = []
    for number, frame in enumerate(frames):
        if number % step == 0:
            pixels = checked_frame(frame, "video").reshape(-1, 3)
            seen.append(pixels[:: max(1, pixels.shape[0] * _PALETTE_FRAMES // _PALETTE_PIXELS)])
    if not seen:
        raise ShapeError("video: expected frames that can be iterated twice for a GIF, got none.")
    # A colour that fills the picture, such as black, must not use up the palette.
    colours = np.unique(np.concatenate(seen) & 0xFC, axis=0)
    row = pillow.fromarray(np.ascontiguousarray(colours[None]).astype(np.uint8))
    chosen = row.quantize(256 - len(_KEPT), method=pillow.Quantize.MEDIANCUT).getpalette() or []
    palette = pillow.new("P", (1, 1))
    kept = [level for colour in _KEPT for level in colour]
    palette.putpalette(kept + chosen[: 768 - len(kept)])
    return palette


def _write_gif(target: Path, frames: Iterator[Image], palette: Any, fps: float) -> None:
    pillow = _pillow()
    images = (pillow.fromarray(frame).quantize(palette=palette, dither=pillow.Dither.NONE) for frame in frames)
    first = next(images, None)
    if first is None:
        raise ShapeError("video: expected frames that can be iterated twice for a GIF, got none the second time.")
    duration = max(2, round(100 / fps)) * 10
    first.save(target, format="GIF", save_all=True, append_images=images, duration=duration, loop=0, optimize=False)


def _ffmpeg() -> Any:
    try:
        import imageio_ffmpeg
    except ImportError as error:
        raise MissingPackageError(
            "video: an .mp4 needs the package imageio-ffmpeg, which brings ffmpeg along. Install it with pip install "
            "'torchtransient[vis]', or choose a name that ends in .gif."
        ) from error
    return imageio_ffmpeg


def _pillow() -> Any:
    try:
        from PIL import Image as Pillow
    except ImportError as error:
        raise MissingPackageError(
            "video: a .gif needs the package pillow. Install it with pip install 'torchtransient[vis]'."
        ) from error
    return Pillow
