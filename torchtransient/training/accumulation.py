"""The gradient of a batch, computed part by part."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import nullcontext
from typing import TypeVar

import torch
from torch import nn
from torch.nn.parallel import DistributedDataParallel

from torchtransient.checks import Numbers, finite
from torchtransient.errors import GradientError, ShapeError

Part = TypeVar("Part")


def accumulate(
    loss_of: Callable[[Part], torch.Tensor],
    parts: Iterable[Part],
    *,
    weights: Numbers | None = None,
    model: nn.Module | None = None,
    scaler: torch.amp.GradScaler | None = None,
) -> float:
    """Add the gradient of ``sum_k w_k loss_of(part_k)`` to the parameters, and return that sum.

    Each part is rendered, differentiated and forgotten before the next, so that memory is that of the largest part:
    views, sensors or pieces of a batch whose cubes do not fit side by side. Gradients are those of the sum in one piece
    but for the order of float sums. ::

        optimizer.zero_grad()
        loss = tt.training.accumulate(lambda view: loss_fn(renderer({POSE: poses[view]}), measured[view]), range(8))
        optimizer.step()

    Args:
        loss_of: function of a part that returns a scalar tensor.
        parts: any iterable that ends.
        weights: one for each part; None takes 1 / number of parts, which gives the gradient of a mean over parts of one
            size. Parts of other sizes of a mean over samples: ``[len(p) / total ...]``.
        model: a DistributedDataParallel, whose ranks exchange gradients once, at the last part, instead of at each one.
        scaler: scales losses before they are differentiated; the sum that is returned is not scaled.

    Raises:
        ShapeError: for no parts, weights that do not match them and losses that are no scalars.
        UnitError: for weights that are not finite.
        GradientError: for a loss without a gradient. Nothing has been differentiated then, except by parts before it.
    """
    listed = list(parts)
    if not listed:
        raise ShapeError("accumulate: expected at least one part, got none.")
    given = [1.0 / len(listed)] * len(listed) if weights is None else weights
    shares = [finite("accumulate: weight", weight) for weight in given]
    if len(shares) != len(listed):
        raise ShapeError(f"accumulate: expected a weight for each of {len(listed)} parts, got {len(shares)}.")
    values = []
    for n, (part, share) in enumerate(zip(listed, shares, strict=True)):
        waits = isinstance(model, DistributedDataParallel) and n + 1 < len(listed)
        # The forward pass stands inside: DDP prepares there for what its backward pass does.
        with model.no_sync() if waits else nullcontext():  # type: ignore[union-attr, operator]
            loss = loss_of(part)
            if not isinstance(loss, torch.Tensor) or loss.numel() != 1 or loss.is_complex():
                came = f"{loss.dtype} {tuple(loss.shape)}" if isinstance(loss, torch.Tensor) else type(loss).__name__
                raise ShapeError(f"accumulate: expected the loss of a part as one real number in a tensor, got {came}.")
            if not loss.requires_grad:
                raise GradientError(
                    "accumulate: the loss of a part depends on nothing that has a gradient; parameters need "
                    "requires_grad=True, and loss_of may not detach or run under torch.no_grad."
                )
            # A share of a small loss may be nothing in half precision.
            scaled = loss.reshape(()).to(torch.promote_types(loss.dtype, torch.float32)) * share
            (scaled if scaler is None else scaler.scale(scaled)).backward()  # type: ignore[no-untyped-call]
            values.append(scaled.detach())
            del loss, scaled
    return sum(float(value) for value in values)
