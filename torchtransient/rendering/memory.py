"""Memory that is left, and the check that a cube fits before it is allocated."""

from __future__ import annotations

import math

from torchtransient.array_files.free_memory import available_memory, size_in_words
from torchtransient.errors import StorageError
from torchtransient.scene.variant import device_type

_BYTES_PER_VALUE = 4
# So little is not asked for: the question takes as long as a small render.
_SMALL = 2**22


def available_bytes(variant: str) -> int | None:
    """Return the free memory of a variant's device in bytes, None where the system does not say.

    Args:
        variant: name of a variant.
    """
    if device_type(variant) == "cuda":
        import torch

        return int(torch.cuda.mem_get_info()[0])
    return available_memory()


def check_fits(
    cube_shape: tuple[int, ...], items: int, variant: str, storage_shape: tuple[int, ...] | None = None
) -> None:
    """Raise ``StorageError`` if the films of a call exceed the free memory.

    Several items are gathered in one tensor while the next is rendered: one film more than there are items.

    Args:
        cube_shape: shape of a film, (H, W, T, C).
        items: number of films.
        variant: variant, whose device has the memory.
        storage_shape: shape of the array that a render adds to; another one than that of the film, such as the nodes
            of beats, is in memory beside it when the render ends.
    """
    cube = math.prod(cube_shape) * _BYTES_PER_VALUE
    films = items + 1 if items > 1 else 1
    nodes = 0
    if storage_shape is not None and storage_shape != cube_shape:
        nodes = math.prod(storage_shape) * _BYTES_PER_VALUE
    total = cube * films + nodes
    if total <= _SMALL:
        return
    available = available_bytes(variant)
    if available is None or total <= available:
        return
    parts = " x ".join(str(n) for n in cube_shape)
    batch = f", {films} of them for {items} renders" if items > 1 else ""
    beside = f", with {size_in_words(nodes)} of nodes beside it" if nodes else ""
    raise StorageError(
        f"the transient cube would take {size_in_words(cube)} (H x W x T x C = {parts} float32{batch}){beside}, "
        f"{size_in_words(total)} in all, and {size_in_words(available)} are available on this {device_type(variant)}. "
        f"Use fewer bins, a smaller film or crop, or a smaller batch."
    )
