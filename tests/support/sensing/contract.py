"""What every sensing module has to keep. A module joins by one `Entry` in an `entries_*.py` file beside this one."""

from __future__ import annotations

import io
import pickle
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor, nn

LOOSE = {torch.float64: 1e-9, torch.float32: 2e-4}
HALVES = (torch.float16, torch.bfloat16)


def counts_like(shape: tuple[int, ...], seed: int = 0) -> Tensor:
    """Positive float64 numbers with a bump in time: a transient that every sensor can take."""
    g = torch.Generator().manual_seed(seed)
    x = 0.02 + 0.1 * torch.rand(shape, generator=g, dtype=torch.float64)
    bins = shape[-3]
    bump = torch.exp(-0.5 * ((torch.arange(bins, dtype=torch.float64) - bins / 3) / 1.5) ** 2)
    return x + 0.5 * bump.reshape(-1, 1, 1)


@dataclass(frozen=True)
class Entry:
    """One module under the contract.

    `make()` builds it; `shape` is a small input for gradcheck, whose first dimension is a batch; `input(shape, seed)`
    makes inputs.
    `conserves`: `f(output) - f(input)` has to vanish (sum of energy or counts).
    `dtypes`: those the expectation keeps. `random`: forward draws, with every policy in `policies`.
    `call`: (arguments that hold real numbers, the others) of a good call of the class, for the sweep of gradients.
    """

    name: str
    make: Callable[..., nn.Module]
    shape: tuple[int, ...] = (2, 1, 12, 2, 3)
    input: Callable[..., Tensor] = counts_like
    conserves: Callable[[Tensor], Tensor] | None = None
    dtypes: tuple[torch.dtype, ...] = (torch.float32, torch.float64)
    random: bool = False
    call: tuple[dict[str, Tensor], dict[str, Any]] | None = None
    policies: tuple[str, ...] = field(default=("expected", "gaussian", "straight_through", "score"))

    def module(self, dtype: torch.dtype = torch.float64, **keywords: Any) -> nn.Module:
        return self.make(**keywords).to(dtype)

    def x(self, dtype: torch.dtype = torch.float64, seed: int = 0) -> Tensor:
        return self.input(self.shape, seed).to(dtype)


def expected(module: nn.Module, x: Tensor) -> Tensor:
    return module.expected(x)


def parts(value: Any) -> list[Tensor]:
    """The tensors of an output: itself, or those of a tuple, in order."""
    return [value] if isinstance(value, Tensor) else [v for v in value if isinstance(v, Tensor)]


def pickled(module: nn.Module) -> nn.Module:
    return pickle.loads(pickle.dumps(module))


def through_state_dict(entry: Entry, module: nn.Module) -> nn.Module:
    buffer = io.BytesIO()
    torch.save(module.state_dict(), buffer)
    buffer.seek(0)
    other = deepcopy(module)
    for tensor in [*other.parameters(), *other.buffers()]:
        if tensor.is_floating_point():
            tensor.data.zero_()
    other.load_state_dict(torch.load(buffer, weights_only=True))
    return other
