"""What an operator was made from, as the state that models save and compare when they are loaded."""

from __future__ import annotations

import json
import math
from dataclasses import fields, is_dataclass
from typing import Any

import torch
from torch import Tensor

from torchtransient.errors import ShapeError, StorageError

# Shares by which numbers may differ: those of another machine, or that a file rounds to single precision.
SLACK = 1e-6
# Sums of a tensor that tell it from others.
SUMS = 4


def packed(described: dict[str, Any]) -> Tensor:
    """Plain data as JSON in bytes (N,), uint8 on the CPU: files that hold tensors alone take it too."""
    return torch.tensor(list(json.dumps(described).encode()), dtype=torch.uint8, device="cpu")


def unpacked(state: Any, who: str) -> Any:
    """The plain data of :func:`packed`. Raises StorageError."""
    try:
        return json.loads(bytes(state.cpu().tolist()).decode())
    except (AttributeError, TypeError, ValueError) as error:
        raise StorageError(f"{who}: expected the state of an operator, as state_dict() gives it: {error}.") from None


def plain(value: Any) -> Any:
    """A setting as plain data: records by their fields, tensors by their shape, size and some sums."""
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, Tensor):
        flat = value.detach().to("cpu", torch.float64).reshape(-1)
        k = torch.arange(1, SUMS + 1, dtype=torch.float64, device="cpu")[:, None]
        places = torch.arange(1, len(flat) + 1, dtype=torch.float64, device="cpu")
        size = float(flat.abs().max()) if len(flat) else 0.0
        return {"shape": list(value.shape), "size": size, "sums": (torch.cos(k * places) @ flat).tolist()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    record = {"type": type(value).__name__}
    if is_dataclass(value):
        record |= {field.name: plain(getattr(value, field.name)) for field in fields(value)}
    return record


def check_same(mine: Any, theirs: Any, who: str, what: str = "settings") -> None:
    """Raises ShapeError where the state that is loaded is that of another operator, ``what`` says in which respect."""
    if isinstance(mine, dict) and isinstance(theirs, dict) and mine.keys() == theirs.keys():
        if "sums" in mine and mine["shape"] == theirs["shape"]:
            slack = SLACK * max(mine["size"], theirs["size"]) * math.sqrt(max(1, math.prod(mine["shape"])))
            if all(abs(a - b) <= slack for a, b in zip(mine["sums"], theirs["sums"], strict=True)):
                return
            raise ShapeError(_words(who, what, "the same values", "others"))
        for key in mine:
            check_same(mine[key], theirs[key], who, key if what == "settings" else f"{what}.{key}")
        return
    if isinstance(mine, list) and isinstance(theirs, list) and len(mine) == len(theirs):
        for a, b in zip(mine, theirs, strict=True):
            check_same(a, b, who, what)
        return
    numbers = all(isinstance(x, int | float) and not isinstance(x, bool) for x in (mine, theirs))
    if not (math.isclose(mine, theirs, rel_tol=SLACK, abs_tol=1e-3 * SLACK) if numbers else mine == theirs):
        raise ShapeError(_words(who, what, mine, theirs))


def _words(who: str, what: str, mine: Any, theirs: Any) -> str:
    return (
        f"{who}: expected the state of an operator like this one, with {what} {mine!r}, got one with {theirs!r}. Make "
        "the operator as the one that was saved."
    )
