"""Writing pictures, with errors that say what to do."""

from __future__ import annotations

import importlib
import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from torchtransient.array_files.part_files import replacing
from torchtransient.checks import check_folder, short_message
from torchtransient.errors import MissingPackageError, StorageError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Image = NDArray[np.uint8]


def to_bytes(image: Any) -> Image:
    """Round [0, 1] to uint8.

    Args:
        image: numbers of any shape; those outside are clipped.
    """
    return np.asarray(np.clip(np.asarray(image, dtype=np.float64), 0, 1) * 255 + 0.5).astype(np.uint8)


def save_image(image: Image, path: str | Path | None, who: str) -> Image:
    """Write an RGB image and return it.

    Args:
        image: image (H, W, 3) uint8.
        path: file, PNG or JPEG by its ending; None writes none.
        who: beginning of messages.

    Raises:
        StorageError: when it cannot be written.
    """
    if path is None:
        return image
    images = pillow()
    with _place_of(path, who) as (unfinished, ending):
        images.fromarray(image).save(unfinished, format=images.registered_extensions().get(f".{ending}", ending))
    return image


def save_figure(figure: Figure, path: str | Path | None, who: str, dpi: int = 120) -> Figure:
    """Write a matplotlib figure and return it.

    Args:
        figure: the figure.
        path: file, ``.png`` where it has no ending; None writes none.
        who: beginning of messages.
        dpi: dots per inch.

    Raises:
        StorageError: when it cannot be written.
    """
    if path is None:
        return figure
    if isinstance(path, (str, Path)) and not Path(path).suffix:  # as matplotlib has it
        path = f"{path}.png"
    with _place_of(path, who) as (unfinished, ending):
        figure.savefig(unfinished, dpi=dpi, format=ending)
    return figure


def check_picture(path: str | Path, who: str = "picture") -> None:
    """Check before a long render that matplotlib can write a picture.

    Args:
        path: file of the picture.
        who: beginning of messages.

    Raises:
        StorageError: for a folder that is missing, or an ending that matplotlib does not know.
        MissingPackageError: without matplotlib.
    """
    check_folder(path, who)
    figure_type()
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    endings = FigureCanvasAgg.get_supported_filetypes()
    if Path(path).suffix.lstrip(".").lower() not in endings:
        known = ", ".join(f".{ending}" for ending in sorted(endings))
        raise StorageError(f"{who}: expected a name that ends in .png, or another of {known}, got '{path}'.")


@contextmanager
def _place_of(path: str | Path, who: str) -> Iterator[tuple[Path, str]]:
    """Yield a name to write to, which takes the place of `path` once it is whole, and the ending of `path`."""
    target = check_folder(path, who)
    with replacing(target, who) as unfinished:
        try:
            yield unfinished, target.suffix.lstrip(".").lower()
        except (OSError, ValueError, KeyError) as error:  # of an unknown ending, too
            raise StorageError(
                f"{who}: '{path}' could not be written: {short_message(error)}. Choose a writable .png."
            ) from error


def to_palette(path: str | Path) -> None:
    """Write a PNG file again with 256 colours: a third of the bytes, off by 2 of 255 in the mean and 20 at most.

    Args:
        path: the file; of other kinds it is left as it is.
    """
    if Path(path).suffix != ".png":
        return
    images = pillow()
    picture = images.open(path).convert("RGB")
    few = picture.quantize(256, images.Quantize.MAXCOVERAGE, kmeans=2, dither=images.Dither.NONE)
    few.save(path, optimize=True)


def needed(module: str, package: str, extra: str = "vis") -> Any:
    """Return a module of a package that may be missing.

    Args:
        module: full name of the module.
        package: package that has it.
        extra: extra of this library that brings the package.

    Raises:
        MissingPackageError: without the package.
    """
    try:
        importlib.import_module(module.partition(".")[0])
        return importlib.import_module(module)
    except ImportError as error:
        raise MissingPackageError(
            f"this needs the package {package}. Install it with pip install 'torchtransient[{extra}]'."
        ) from error


def figure_type() -> type[Figure]:
    """Return matplotlib's Figure, which draws without a window. Raises MissingPackageError without matplotlib."""
    found: type[Figure] = needed("matplotlib.figure", "matplotlib").Figure
    return found


def picture_figure(height: int, width: int, panels: int = 1, side: float = 4.2, columns: int = 4) -> tuple[Figure, Any]:
    """Return a figure for images of one size, and its axes as a flat list without frames.

    Args:
        height, width: pixels of an image.
        panels: number of images.
        side: width of an image, inches.
        columns: most images in a row.
    """
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
    """Return an image with every pixel as a square.

    Args:
        image: image (H, W, 3) uint8.
        factor: side of the square, at least 1.
    """
    return image.repeat(factor, axis=0).repeat(factor, axis=1)


def pillow() -> Any:
    """Return the module PIL.Image. Raises MissingPackageError without Pillow."""
    return needed("PIL.Image", "pillow")


def grey_where_broken(name: str) -> Any:
    """Return a colour map of matplotlib whose colour for NaN is grey.

    Args:
        name: name of the map.

    Raises:
        MissingPackageError: without matplotlib.
    """
    return needed("matplotlib", "matplotlib").colormaps[name].with_extremes(bad=(0.5, 0.5, 0.5))
