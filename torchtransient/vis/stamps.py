"""Text under a frame: which moment it shows, and how far along the axis that is."""

from __future__ import annotations

from typing import Any

import numpy as np

from torchtransient.axes import TimeAxis
from torchtransient.units import opl_to_seconds
from torchtransient.vis.files import Image, missing

INK, DIM, GROUND = (235, 235, 235), (95, 95, 95), (20, 20, 20)


def moment(axis: TimeAxis | None, index: int, bins: int, word: str = "bin") -> str:
    """What a stamp says about a bin: its centre in metres and nanoseconds, or its number when no axis is known.

    `word`: what an entry is without an axis, "gate" for those of a gated film.
    """
    if axis is None:
        return f"{word} {index} of {bins}"
    opl = axis.start_opl + (index + 0.5) * axis.bin_width_opl
    return f"{_digits(opl, axis.bin_width_opl)} m   {_digits(*_nanoseconds(opl, axis.bin_width_opl))} ns"


def _nanoseconds(*lengths: float) -> list[float]:
    return [1e9 * opl_to_seconds(length) for length in lengths]


def _digits(value: float, step: float) -> str:
    """As many decimals as tell the halves of a bin apart."""
    decimals = int(np.clip(np.ceil(-np.log10(step / 2)), 0, 6))
    return f"{value:.{decimals}f}"


def with_strip(image: Image, text: str, share: float | None = None) -> Image:
    """The image over a dark strip with `text` and, with `share` in [0, 1], a bar that fills from left to right.

    The strip does not cover the picture. Its text is made smaller until it fits the width.
    """
    try:
        from PIL import Image as Pillow
        from PIL import ImageDraw
    except ImportError as error:
        raise missing("pillow") from error

    height, width = image.shape[:2]
    rows = max(16, round(0.075 * max(height, width)))
    strip = Pillow.new("RGB", (width, rows), GROUND)
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
