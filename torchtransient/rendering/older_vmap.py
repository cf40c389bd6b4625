"""The batches of ``torch.autograd``, which are not those of ``torch.func``.

``torch.autograd.functional.jacobian(vectorize=True)``, ``hessian(vectorize=True)`` and ``torch.autograd.grad(
is_grads_batched=True)`` hand on cotangents and tangents of an older kind of batch, for which an autograd function has
no rule of its own: its ``forward`` is called with the batch as one tensor, which has no memory that could be rendered
from.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

# Of torch's older vmap.
MOST_LEVELS = 64


def each_of_older_vmap(function: Callable[..., tuple[torch.Tensor, ...]], *tensors: Any) -> tuple[torch.Tensor, ...]:
    """``function`` of tensors or None, called once for every entry of such a batch; once where there is none."""
    private: Any = torch
    level = private._C._vmapmode_increment_nesting() - 1
    private._C._vmapmode_decrement_nesting()
    # torch counts the levels by thread, and calls backwards of CUDA tensors in threads of its own, where none is open.
    return _each(function, level or MOST_LEVELS, tensors)


def _each(function: Callable[..., tuple[torch.Tensor, ...]], level: int, tensors: Any) -> tuple[torch.Tensor, ...]:
    """For the entries of the batches of a level and of those around it."""
    private: Any = torch
    batched = [t is not None and torch._C._functorch.is_legacy_batchedtensor(t) for t in tensors]
    if not any(batched):
        return function(*tensors)
    pairs = list(zip(tensors, batched, strict=True))
    # A tensor that is no batch of this level, but of one around it, is repeated as often as it is told.
    sizes = [
        {private._remove_batch_dim(t, level, told, 0).shape[0] for told in (1, 2)} for t, is_one in pairs if is_one
    ]
    of_level = [size for size in sizes if len(size) == 1]
    if not of_level:
        return _each(function, level - 1, tensors)
    (size,) = of_level[0]
    opened = [private._remove_batch_dim(t, level, size, 0) if is_one else None for t, is_one in pairs]
    columns = [
        _each(function, level - 1, [t if new is None else new[i] for t, new in zip(tensors, opened, strict=True)])
        for i in range(size)
    ]
    return tuple(private._add_batch_dim(torch.stack(column), 0, level) for column in zip(*columns, strict=True))
