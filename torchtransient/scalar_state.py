"""Modules whose single numbers are loaded from single numbers alone, in every version of torch."""

from __future__ import annotations

import functools
import itertools
from typing import Any

import torch
from torch import Tensor, nn


class ScalarState(nn.Module):
    """Base of modules with numbers in their state. Torch 2.6 takes the first number of several for one number, in
    silence; later versions report it. Loading reports it here, of the numbers of modules inside too.
    """

    def _load_from_state_dict(self, state: Any, prefix: str, *rest: Any) -> None:
        super()._load_from_state_dict(state, prefix, *rest)
        errors = rest[-1]
        if not _first_is_taken():
            return
        for name, own in itertools.chain(self.named_parameters(), self.named_buffers()):
            given, key = state.get(prefix + name), prefix + name
            several = isinstance(given, Tensor) and given.ndim == 1 and len(given) != 1
            if own.ndim == 0 and several and not any(key in error for error in errors):
                errors.append(f"size mismatch for {key}: {tuple(given.shape)} in the state, expected one number.")


@functools.cache
def _first_is_taken() -> bool:
    """Whether this version of torch loads a number from several."""
    module = nn.Module()
    module.register_buffer("number", torch.zeros(()))
    try:
        module.load_state_dict({"number": torch.zeros(2)})
    except RuntimeError:
        return False
    return True
