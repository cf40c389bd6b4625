"""Squared error of two records."""

from __future__ import annotations

from torch import Tensor

from torchtransient.losses.checks import Reduction, masked_pair, reduce, squared_modulus
from torchtransient.losses.loss_module import LossModule
from torchtransient.losses.results import LIGHT, Light, reads


@reads(input=LIGHT, target=LIGHT)
def squared_loss(input: Light, target: Light, *, mask: Tensor | None = None, reduction: Reduction = "mean") -> Tensor:
    """Compute the squared error, `|input - target|^2`. Symmetric.

    Args:
        input: real or complex tensor, any shape.
        target: tensor of the same shape.
        mask: elements that count.
        reduction: "mean" over elements that count, "sum", or "none".

    Returns:
        Scalar, or the shape of the input for "none"; in the unit of the input, squared.

    Raises:
        ShapeError: for two shapes.
    """
    where = "squared_loss"
    input, target, mask = masked_pair(input, target, mask, where, complex_too=True)
    return reduce(squared_modulus(input - target), reduction, where, mask)


class SquaredLoss(LossModule, function=squared_loss, by_place=("reduction",)):
    """`squared_loss` with its reduction held."""
