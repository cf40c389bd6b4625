"""Losses of photon counts on scales where bright and dark bins have a say: roots, and logarithms of ratios."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from torchtransient.checks import function
from torchtransient.errors import ShapeError
from torchtransient.losses.comparison import (
    Reduction,
    check_dense,
    check_level,
    check_mask,
    check_option,
    check_pair,
    check_reduction,
    counted,
    item_scale,
    reduce,
    working_dtype,
)
from torchtransient.losses.layouts import check_held, item_dims
from torchtransient.losses.results import LIGHT, Light, reads

_OFFSET = 3 / 8
_BACKGROUND = 1e-3


def anscombe(counts: Tensor, read_noise: Tensor | float = 0.0) -> Tensor:
    """`2 sqrt(n + 3/8 + read_noise^2)`: photon counts on a scale where their noise has variance one. Any shape.

    Anscombe 1948; with read noise, in counts, the generalised transform of Starck, Murtagh and Bijaoui 1998 for gain
    one; `read_noise` is a number, or a tensor that broadcasts to the counts, differentiable in it. The variance is 1
    within 1/(8 m) at a mean of m >= 4, 0.72 at m = 1, and vanishes with the light. Counts below zero, of a record less
    its background, continue the tangent at zero, so that values and gradients are finite.
    Whole numbers count in torch's default dtype, half precision in float32. Raises UnitError for a read noise below
    zero and for complex numbers, ShapeError for no tensor.
    """
    check_dense((counts,), "anscombe")
    whole = not (counts.is_floating_point() or counts.is_complex())
    counts = counts.to(torch.get_default_dtype() if whole else working_dtype((counts,), "anscombe"))
    sigma = check_level("read_noise", read_noise, counts, "anscombe", zero=True, square=True)
    offset = _OFFSET + sigma.square()
    negative = counts < 0
    root = (torch.where(negative, torch.zeros_like(counts), counts) + offset).sqrt()
    return 2 * root + torch.where(negative, counts, torch.zeros_like(counts)) / offset.sqrt()


@reads(input=LIGHT, target=LIGHT)
def root_loss(
    input: Light,
    target: Light,
    *,
    root: Callable[[Tensor], Tensor] = anscombe,
    mask: Tensor | None = None,
    reduction: Reduction = "mean",
) -> Tensor:
    """`(root(input) - root(target))^2` of each element, any shape, in photon counts. Symmetric.

    With `anscombe` about 1 on average where `input` is the mean that `target` was drawn of: a fit is as good as the
    noise lets it be when its loss is. Take `torchtransient.reconstruction.stabilized_root` with a floor of 1/4,
    `H / sqrt(|H| + 1/4)`, for what f-k migration sees of counts: `functools.partial` holds options of a root. Raises
    ShapeError, UnitError.
    """
    check_reduction(reduction, "root_loss")
    function("root_loss: root", root, "tensors")
    input, target = check_pair(input, target, "root_loss")
    mask = check_mask(mask, input, "root_loss")
    ours, theirs = root(counted(input, mask)), root(counted(target, mask))
    check_dense((ours, theirs), "root_loss, of the root")
    if ours.shape != input.shape:
        raise ShapeError(f"root_loss: expected a root that keeps the shape, got {tuple(ours.shape)}.")
    return reduce((ours - theirs).square(), reduction, "root_loss", mask)


@reads(input=LIGHT, target=LIGHT)
def log_ratio_loss(
    input: Light,
    target: Light,
    *,
    background: Tensor | float | None = None,
    dim: int | None = None,
    mask: Tensor | None = None,
    reduction: Reduction = "mean",
) -> Tensor:
    """`log((input + background) / (target + background))^2` of each element, any shape. Symmetric in what it is given.

    Relative errors of bins that are brighter than `background`, in the unit of the transient; errors of darker ones
    count as shares of it: put it where noise begins. None: 1e-3 of the mean of each item of the target (of the input,
    where that is dark), which is not symmetric; `dim`, where time is (`losses.layouts`), then says what is an item.
    Values below zero continue the tangent of the logarithm at zero, so
    that values are finite and gradients at most of the size of a logarithm over the background. Raises ShapeError;
    UnitError for a background that is not above zero.
    """
    where = "log_ratio_loss"
    check_held(reduction, dim, where)
    input, target = check_pair(input, target, where)
    mask = check_mask(mask, input, where)
    input, target = counted(input, mask), counted(target, mask)
    if background is None:
        level = _BACKGROUND * item_scale(target, input, item_dims(input, dim, where, " or background="), mask)
    else:
        level = check_level("background", background, input, where)
    return reduce((_log(input, level) - _log(target, level)).square(), reduction, where, mask)


def _log(x: Tensor, level: Tensor) -> Tensor:
    """`log(x + level)`, and its tangent at zero below zero."""
    negative, zero = x < 0, torch.zeros_like(x)
    return (torch.where(negative, zero, x) + level).log() + torch.where(negative, x, zero) / level


class RootLoss(nn.Module):
    """`root_loss(input, target)` with its options held."""

    def __init__(self, root: Callable[[Tensor], Tensor] = anscombe, reduction: Reduction = "mean") -> None:
        super().__init__()
        check_reduction(reduction, "RootLoss")
        function("RootLoss: root", root, "tensors")
        self.root, self.reduction = root, reduction

    def forward(self, input: Light, target: Light, mask: Tensor | None = None) -> Tensor:
        return root_loss(input, target, root=self.root, mask=mask, reduction=self.reduction)


class LogRatioLoss(nn.Module):
    """`log_ratio_loss(input, target)` with its options held."""

    def __init__(
        self, background: float | None = None, dim: int | None = None, reduction: Reduction = "mean"
    ) -> None:
        super().__init__()
        check_held(reduction, dim, "LogRatioLoss")
        check_option("background", background, "LogRatioLoss")
        self.background, self.dim, self.reduction = background, dim, reduction

    def forward(self, input: Light, target: Light, mask: Tensor | None = None) -> Tensor:
        return log_ratio_loss(
            input, target, background=self.background, dim=self.dim, mask=mask, reduction=self.reduction
        )
