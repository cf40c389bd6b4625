"""Which entries of a sample are images, of which size, and which might be without being called so."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from torch import Tensor

from torchtransient.array_files.array_file import tensor_in
from torchtransient.errors import SceneError, ShapeError

# Samples are flat but for a dictionary or two.
_DEEPEST = 4


def as_image(name: str, given: Any) -> Tensor:
    """A tensor (..., H, W) as it is, an array of numpy as a tensor of its own. Raises ShapeError."""
    if isinstance(given, np.ndarray):
        try:
            given = tensor_in(given.copy())
        except TypeError:
            raise ShapeError(f"Augment: expected {name!r} as numbers, got an array of {given.dtype}.") from None
    if not isinstance(given, Tensor) or given.ndim < 2:
        got = tuple(given.shape) if isinstance(given, Tensor) else type(given).__name__
        raise ShapeError(f"Augment: expected {name!r} as an image (..., H, W), got {got}.")
    return given


def size_of(images: Mapping[str, Tensor], known: Sequence[str]) -> tuple[int, int]:
    """(height, width) of all images. `known`: names that there might be. Raises SceneError, ShapeError."""
    sizes = {name: (int(image.shape[-2]), int(image.shape[-1])) for name, image in images.items()}
    if not sizes:
        raise SceneError(f"Augment: expected images among {', '.join(known)}, got none; name others in fields=.")
    if len(set(sizes.values())) > 1:
        raise ShapeError(f"Augment: expected images of one size, got {sizes}. Leave out those of other sizes.")
    return next(iter(sizes.values()))


def check_unknown(name: str, given: Any, size: tuple[int, int]) -> None:
    """Raise SceneError for an entry that might be an image of this size: a tensor, an array, a picture, nested lists,
    whether its pixels come last or not, and for dictionaries and records that hold one.
    """
    for shape in _shapes(given, _DEEPEST):
        if any(shape[k : k + 2] == size for k in range(len(shape) - 1)):
            raise SceneError(
                f"Augment: {name!r} has the size of an image, {shape}, and nothing says what it is; give "
                f'fields={{"{name}": "label"}}, "number", "light", "point", "direction" or "unchanged".'
            )


def _shapes(given: Any, deepest: int) -> Iterator[tuple[int, ...]]:
    if deepest == 0 or given is None or isinstance(given, (str, bytes)):
        return
    if isinstance(given, Mapping):
        inside: Any = given.values()
    elif dataclasses.is_dataclass(given):
        inside = vars(given).values() if hasattr(given, "__dict__") else ()
    else:
        inside = given if isinstance(given, (list, tuple)) else ()
        yield _shape(given)
    for one in inside:
        yield from _shapes(one, deepest - 1)


def _shape(given: Any) -> tuple[int, ...]:
    if isinstance(given, (list, tuple)) and any(isinstance(one, Tensor) for one in given):
        return ()
    try:
        shape = given.shape if hasattr(given, "shape") else np.shape(given)
        return tuple(int(one) for one in shape)
    except (TypeError, ValueError, RuntimeError):
        # Lists of different lengths, and objects of all kinds.
        return ()
