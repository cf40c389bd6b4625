"""Losses of Monte Carlo renders: a loss that is not linear in a render is biased by the noise of that render.

`E[f(render)] = f(E render) + f'' variance / 2 + ...`: a squared error grows by the variance, which the scene's
parameters change, too. The product of the residuals of two independent renders does not (docs/noisy_renders.md).
"""

from __future__ import annotations

from torch import Tensor, nn

from torchtransient.losses.comparison import Reduction, check_mask, check_pair, check_reduction, counted, reduce
from torchtransient.losses.measured import LIGHT, Light, reads


@reads(first=LIGHT, second=LIGHT, target=LIGHT)
def two_render_loss(
    first: Light, second: Light, target: Light, *, mask: Tensor | None = None, reduction: Reduction = "mean"
) -> Tensor:
    """`Re[(first - target) conj(second - target)]` of each element, real or complex, any shape: a squared error.

    `first` and `second`: two renders of the same scene with different seeds. Independent noise of both has no part in
    the mean, so that value and gradient are unbiased, at any number of samples: that of the squared error of a render
    without noise (of the same target: noise of the target stays). May be negative, as unbiased estimates of small
    numbers are. Symmetric in the renders. Raises ShapeError, UnitError.
    """
    where = "two_render_loss"
    check_reduction(reduction, where)
    first, other = check_pair(first, target, where, complex_too=True, names="first and target")
    second, target = check_pair(second, target, where, complex_too=True, names="second and target")
    mask = check_mask(mask, target, where)
    a, b = (counted(render, mask) - counted(truth, mask) for render, truth in ((first, other), (second, target)))
    product = a.real * b.real + a.imag * b.imag if a.is_complex() and b.is_complex() else (a * b).real
    return reduce(product, reduction, where, mask)


class TwoRenderLoss(nn.Module):
    """`two_render_loss(first, second, target)` with its reduction held."""

    def __init__(self, reduction: Reduction = "mean") -> None:
        super().__init__()
        check_reduction(reduction, "TwoRenderLoss")
        self.reduction = reduction

    def forward(self, first: Light, second: Light, target: Light, mask: Tensor | None = None) -> Tensor:
        return two_render_loss(first, second, target, mask=mask, reduction=self.reduction)
