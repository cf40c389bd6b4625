"""``latest.png``: the last sample, small, as a sign that a night's run does what was meant."""

from __future__ import annotations

import contextlib
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchtransient.array_files.part_files import whole_file

NAME = "latest.png"
EVERY_S = 10.0
SIDE = 256


class LatestPicture:
    """Writes the picture of a sample where the one that is there is older than ten seconds. Never raises: a data set is
    worth more than its picture.
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
                _save(pixels, part)
        except Exception:  # noqa: BLE001  a picture is never a reason to fail
            self._next = now + 60 * EVERY_S


def picture_of(sample: Any) -> NDArray[np.uint8]:
    """The light of a sample, (H, W, 3)."""
    from torchtransient.data.recipes.contact_sheet import cell_of
    from torchtransient.vis.files import enlarge, to_bytes

    pixels = to_bytes(cell_of(sample).images["light"])
    return enlarge(pixels, max(1, SIDE // max(pixels.shape[:2])))


def _save(pixels: NDArray[np.uint8], path: Path) -> None:
    try:
        from PIL import Image
    except ImportError:
        from matplotlib.image import imsave

        imsave(path, pixels, format="png")
    else:
        Image.fromarray(pixels).save(path, format="PNG")
