"""Weights of a mixture: not negative, one in sum."""

from __future__ import annotations

import operator
from typing import Any

import torch
from torch import Tensor

from torchtransient.errors import ShapeError, UnitError
from torchtransient.floating import floating, holds, without_autocast
from torchtransient.parametrize.bounded import checked_margin
from torchtransient.parametrize.settings import Settings

# What single precision makes of a sum of some hundred weights.
_SLACK = 1e-4


@without_autocast
def simplex(x: Tensor, dim: int = -1) -> Tensor:
    """Map all real numbers to weights between 0 and 1 with the sum 1, by softmax.

    Args:
        x: tensor of any shape.
        dim: dimension of the weights.

    Raises:
        ShapeError: for a dimension that is missing or empty.
    """
    return torch.softmax(_checked(x, dim, "simplex"), dim)


@without_autocast
def simplex_inverse(weights: Tensor, dim: int = -1, margin: float | None = None) -> Tensor:
    """Return the `x`, zero on average along `dim`, that `simplex` maps to `weights`.

    Args:
        weights: weights that are not negative, with the sum 1 along `dim`.
        dim: dimension of the weights.
        margin: least weight, a share between 0 and 0.5 of an equal weight; smaller ones are raised to it, and the sum
            is made 1 again (never below the smallest normal number of the dtype). None refuses weights of zero, which
            have no `x`.

    Raises:
        UnitError: for negative weights, sums other than 1, and weights of zero without a margin.
    """
    return _inverse(weights, dim, checked_margin(margin, "simplex_inverse"), "simplex_inverse")


def _inverse(weights: Tensor, dim: int, margin: float | None, where: str) -> Tensor:
    weights = _checked(weights, dim, where)
    sums = weights.sum(dim)
    # Half precision cannot do better.
    slack = max(_SLACK, weights.shape[dim] * torch.finfo(weights.dtype).eps)
    if not holds((weights >= 0).all(dim) & ((sums - 1).abs() < slack)):
        raise UnitError(
            f"{where}: expected weights that are not negative and have the sum 1, got {weights.min().item():g} as the "
            f"smallest and sums from {sums.min().item():g} to {sums.max().item():g}. Divide them by their sum."
        )
    if margin is not None:
        weights = weights.clamp_min(max(margin / weights.shape[dim], torch.finfo(weights.dtype).tiny))
    elif not holds(weights > 0):
        raise UnitError(f"{where}: no finite number stands for the weight 0; give margin=1e-3 to start above it.")
    logarithms = torch.log(weights)
    return logarithms - logarithms.mean(dim, keepdim=True)


class Simplex(Settings):
    """`simplex` as a parametrization: weights of returns, materials or modes of one mixture.

    Args:
        dim: dimension of the weights; part of `state_dict`.
        margin: least weight, a share between 0 and 0.5 of an equal weight, or None, see `simplex_inverse`.
    """

    def __init__(self, dim: int = -1, margin: float | None = None) -> None:
        super().__init__()
        self.dim, self.margin = operator.index(dim), checked_margin(margin, "Simplex")

    @without_autocast
    def forward(self, x: Tensor) -> Tensor:
        """Return `simplex` of a tensor.

        Args:
            x: tensor that has the dimension of the module.
        """
        return simplex(x, self.dim)

    @without_autocast
    def right_inverse(self, weights: Tensor) -> Tensor:
        """Return `simplex_inverse` of weights.

        Args:
            weights: shares that sum to one along the dimension of the module.

        Raises:
            UnitError: for anything else.
        """
        return _inverse(weights, self.dim, self.margin, "Simplex")

    def get_extra_state(self) -> Tensor:
        return torch.tensor(self.dim)

    def set_extra_state(self, state: Any) -> None:
        self.dim = int(state)

    def extra_repr(self) -> str:
        return f"dim={self.dim}"


def _checked(x: Tensor, dim: int, where: str) -> Tensor:
    x = floating(x, where)
    if not -x.ndim <= dim < x.ndim or not x.shape[dim]:
        raise ShapeError(f"{where}: expected weights along dimension {dim}, got a tensor {tuple(x.shape)}.")
    return x
