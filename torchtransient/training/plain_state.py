"""States as plain data, which `torch.load(weights_only=True)` reads without executing anything."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch.nn.parameter import is_lazy

from torchtransient.errors import StorageError

_PLAIN = (type(None), bool, int, float, complex, str, bytes, torch.Size, torch.dtype, torch.device)

# Kinds of numbers that torch has, in any order of their bytes.
_ARRAYS = [np.dtype(kind) for kind in ("?", "i1", "u1")]
_ARRAYS += [np.dtype(order + kind + size) for order in "<>" for kind in "iu" for size in "248"]
_ARRAYS += [np.dtype(order + kind) for order in "<>" for kind in ("f2", "f4", "f8", "c8", "c16")]


def plain(value: Any, where: str) -> Any:
    """``value`` with mappings as dictionaries, numbers and arrays of NumPy as those of Python and torch, and tensors
    detached. Raises StorageError, which names the place, for anything that is no data.
    """
    if type(value) in _PLAIN:
        return value
    if isinstance(value, torch.Tensor) and is_lazy(value):
        raise StorageError(f"save_checkpoint: {where} has no shape yet: run the lazy module once before.")
    if isinstance(value, torch.Tensor):
        return value.detach()
    if isinstance(value, np.generic) and type(value.item()) in _PLAIN:
        return value.item()
    if isinstance(value, np.ndarray) and value.dtype in _ARRAYS:
        return torch.from_numpy(value.astype(value.dtype.newbyteorder("="), copy=True))
    if isinstance(value, Mapping):
        items = {_key(key, where): plain(entry, f"{where}[{key!r}]") for key, entry in value.items()}
        return _ordered(value, items, where) if isinstance(value, OrderedDict) else items
    if type(value) in (list, tuple, set, frozenset):
        entries = [plain(entry, f"{where}[{n}]") for n, entry in enumerate(value)]
        return entries if type(value) is list else set(entries) if type(value) in (set, frozenset) else tuple(entries)
    raise StorageError(
        f"save_checkpoint: {where} is a {type(value).__name__}, expected data: numbers, texts, tensors, lists, "
        "dictionaries. Anything else would have to be executed when it is read."
    )


def _ordered(value: OrderedDict[Any, Any], items: dict[Any, Any], where: str) -> OrderedDict[Any, Any]:
    """With the versions of modules, by which they convert what older ones have written."""
    made = OrderedDict(items)
    if hasattr(value, "_metadata"):
        made._metadata = plain(value._metadata, f"{where}._metadata")  # type: ignore[attr-defined]
    return made


def _key(key: Any, where: str) -> Any:
    if type(key) in (str, int, bool, float, bytes, type(None)):
        return key
    if isinstance(key, tuple):
        return tuple(_key(entry, where) for entry in key)
    raise StorageError(f"save_checkpoint: a key of {where} is a {type(key).__name__}, expected a text or a number.")
