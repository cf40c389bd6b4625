"""Writing pictures, with errors that say what to do."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchtransient.errors import ShapeError, StorageError

Image = NDArray[np.uint8]


def to_bytes(image: Any) -> Image:
    """[0, 1] to uint8, rounded to nearest."""
    return np.asarray(np.clip(np.asarray(image, dtype=np.float64), 0, 1) * 255 + 0.5).astype(np.uint8)


def save_image(image: Image, path: str | Path | None, who: str) -> Image:
    """Write an RGB image (H, W, 3) uint8 as PNG or JPEG, unless `path` is None; returns it. Raises StorageError."""
    if path is None:
        return image
    try:
        from PIL import Image as Pillow
    except ImportError as error:
        raise _missing("pillow") from error
    try:
        Pillow.fromarray(image).save(path)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:  # an unknown ending is a ValueError
        raise StorageError(f"{who}: cannot write '{path}': {error}. Choose a writable .png.") from error
    return image


def save_figure(figure: Any, path: str | Path | None, who: str, dpi: int = 120) -> Any:
    """Write a matplotlib figure, unless `path` is None; returns it. Raises StorageError."""
    if path is None:
        return figure
    try:
        figure.savefig(path, dpi=dpi)
    except (OSError, ValueError, TypeError, AttributeError) as error:  # an unknown ending is a ValueError
        raise StorageError(f"{who}: cannot write '{path}': {error}. Choose a writable .png.") from error
    return figure


def figure_type() -> Any:
    """matplotlib's Figure, which draws without a window; StorageError when matplotlib is not installed."""
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise _missing("matplotlib") from error
    return Figure


def picture_figure(height: int, width: int, panels: int = 1, side: float = 4.2, columns: int = 4) -> tuple[Any, Any]:
    """A figure for `panels` images of the given size in pixels, and its axes as a flat list without frames."""
    rows = math.ceil(panels / columns)
    columns = math.ceil(panels / rows)  # five as three and two, not as four and one
    ratio = min(max(height / width, 0.25), 4.0)
    # Room for a colour bar beside and a title above each image.
    size = (columns * side * 1.15, rows * (side * ratio * 0.92 + 0.35))
    figure = figure_type()(figsize=size, layout="constrained")
    axes = list(figure.subplots(rows, columns, squeeze=False).ravel())
    for axis in axes:
        axis.set_axis_off()
    return figure, axes


def enlarge(image: Image, factor: int) -> Image:
    """Every pixel as a square of `factor` pixels. Raises ShapeError when `factor` is not a whole number >= 1."""
    if factor < 1 or int(factor) != factor:
        raise ShapeError(f"picture: expected a whole number of at least 1 for scale, got {factor!r}.")
    return image.repeat(factor, axis=0).repeat(factor, axis=1) if factor > 1 else image


def _missing(package: str) -> StorageError:
    return StorageError(f"pictures need the package {package}. Install it with pip install 'torchtransient[vis]'.")
