"""Helpers of the writers of layouts: captures that a layout can hold, and what was read or assumed before."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchtransient.array_files.array_file import array_of
from torchtransient.capture import Capture
from torchtransient.checks import real_array
from torchtransient.errors import StorageError
from torchtransient.files.captures.contents import WHAT
from torchtransient.files.captures.reading import tensor_of


def assumed_in(capture: Capture, name: str, value: Any) -> bool:
    """Return True if a capture's metadata say that a value was assumed, and it still is the same.

    Args:
        capture: capture, whose metadata may be anything.
        name: argument of :func:`read_capture`.
        value: value in the capture.
    """
    said = capture.metadata.get("assumed")
    if not isinstance(said, Mapping) or name not in said:
        return False
    then, now = real_array(said[name]), real_array(value)
    return np.array_equal(then, now) if then is not None and now is not None else bool(said[name] == value)


def hidden_volume(capture: Capture, sizes: Mapping[str, int]) -> dict[str, NDArray[np.float64]]:
    """Return numbers about the hidden volume from the metadata of a capture.

    Args:
        capture: capture, whose metadata may be anything.
        sizes: numbers of values by name.

    Returns:
        Arrays by name, NaN for values that are missing or of another size.
    """
    said = capture.metadata.get("hidden_volume")
    found = {}
    for name, size in sizes.items():
        array = real_array(said.get(name)) if isinstance(said, Mapping) else None
        found[name] = np.full(size, np.nan) if array is None or array.size != size else array.reshape(-1)
    return found


def only_transient(capture: Capture, layout: str, legs: bool | None = None) -> Tensor:
    """Return the transient (T, ...) of a capture of one channel.

    Args:
        capture: capture with one channel and no batch.
        layout: name of the layout, for messages.
        legs: value of ``first_and_last_leg`` that the layout has, None for both.

    Raises:
        StorageError: for batches, several channels, Stokes components, phasors, truth values, lengths that are counted
            otherwise.
    """
    if capture.transient is None or capture.phasor is not None or capture.polarized:
        raise cannot(layout, "one transient alone", "phasors or Stokes components")
    one_channel(capture, capture.transient, layout)
    if capture.transient.dtype == torch.bool:
        raise cannot(layout, "numbers", "truth values; write them as numbers, transient.to(torch.uint8)")
    if legs is not None and capture.scan.first_and_last_leg != legs:
        words = "with the first and the last leg", "from wall to wall"
        raise cannot(layout, f"lengths {words[0] if legs else words[1]}", f"lengths {words[1] if legs else words[0]}")
    tensor: Tensor = capture.transient[0]
    return tensor


def one_channel(capture: Capture, tensor: Tensor, layout: str, before_channel: int = 0) -> None:
    """Check that a tensor has one channel, no batch, and counts that can be read again.

    Args:
        capture: capture that the tensor belongs to.
        tensor: tensor (..., C, T, ...).
        layout: name of the layout, for messages.
        before_channel: number of dimensions before C.

    Raises:
        StorageError: for other tensors.
    """
    if tensor.dtype == torch.uint64:
        tensor_of(array_of(tensor, WHAT))
    dims = before_channel + 2 + len(capture.scan.shape)
    if tensor.ndim != dims or tensor.shape[before_channel] != 1:
        raise cannot(
            layout, "one channel and no batch",
            f"{tuple(tensor.shape)}; write each item by itself, and one channel, or their sum",
        )  # fmt: skip


def cannot(layout: str, holds: str, got: str) -> StorageError:
    """Return the error for a capture that a layout cannot hold.

    Args:
        layout: name of the layout.
        holds: captures that it holds.
        got: the capture, in words.
    """
    return StorageError(
        f"{WHAT}: the layout {layout!r} holds {holds}, got {got}. The library's own format holds all of a capture: "
        "format='torchtransient'."
    )
