"""Numbers of tensors that carry gradients: torch warns where one is lost without a word, once in a process."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def no_gradient_is_lost() -> Iterator[None]:
    """Every warning is an error, that of a scalar whose gradient is lost each time."""
    before = torch.is_warn_always_enabled()
    torch.set_warn_always(True)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            yield
    finally:
        torch.set_warn_always(before)
