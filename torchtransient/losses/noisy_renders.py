"""Losses of Monte Carlo renders: a loss that is not linear in a render is biased by the noise of that render.

`E[f(render)] = f(E render) + f'' variance / 2 + ...`: a squared error grows by the variance, which the scene's
parameters change, too. The product of the residuals of two independent renders does not (docs/noisy_renders.md).
"""

from __future__ import annotations

import math
from dataclasses import KW_ONLY, dataclass

from torch import Tensor, nn

from torchtransient.checks import finite, shown
from torchtransient.errors import UnitError
from torchtransient.losses.comparison import (
    Reduction,
    check_mask,
    check_pair,
    check_reduction,
    check_whole,
    counted,
    real_product,
    reduce,
)
from torchtransient.losses.results import LIGHT, Light, reads

# Of Mitsuba's indices of samples, 32 bits.
_MOST_SAMPLES = 2**32


@reads(first=LIGHT, second=LIGHT, target=LIGHT)
def two_render_loss(
    first: Light, second: Light, target: Light, *, mask: Tensor | None = None, reduction: Reduction = "mean"
) -> Tensor:
    """`Re[(first - target) conj(second - target)]` of each element, real or complex, any shape: a squared error.

    `first` and `second`: two renders of the same scene with different seeds. Independent noise of both has no part in
    the mean, so that value and gradient are unbiased, at any number of samples: that of the squared error of a render
    without noise (of the same target: noise of the target stays). May be negative, as unbiased estimates of small
    numbers are. Symmetric in the renders. Two renders in one call, and which loss when: docs/noisy_renders.md. Raises
    ShapeError, UnitError.
    """
    where = "two_render_loss"
    check_reduction(reduction, where)
    first, target = check_pair(first, target, where, complex_too=True, names="first and target")
    second, target = check_pair(second, target, where, complex_too=True, names="second and target")
    first = first.to(target.dtype)  # a second one of more precision, or complex
    mask = check_mask(mask, target, where)
    a, b = (counted(render, mask) - counted(target, mask) for render in (first, second))
    return reduce(real_product(a, b), reduction, where, mask)


@dataclass(frozen=True)
class SampleSchedule:
    """Samples per pixel of a fit: few at first, where noise averages out over steps, more where bias is left.

    `schedule(step)`: `first` up to the share `hold` of `steps`, then doubled in equal parts of what is left, and `last`
    from the end on. By doubling, since every other number of samples is compiled and recorded anew; the last doubling
    stops at `last`, so that (64, 100, 10) ends at 100. Numbers only: `renderer(values, spp=schedule(step), seed=step)`.
    Raises UnitError for numbers that are no such schedule.
    """

    first: int
    last: int
    steps: int
    _: KW_ONLY
    hold: float = 0.6

    def __post_init__(self) -> None:
        for name in ("first", "last", "steps"):
            object.__setattr__(self, name, check_whole(name, getattr(self, name), "SampleSchedule", UnitError))
        object.__setattr__(self, "hold", finite("SampleSchedule: hold", self.hold))
        if self.last < self.first or not 0 <= self.hold <= 1:
            raise UnitError(
                f"SampleSchedule: expected first <= last and hold between 0 and 1, got {self.first}, {self.last} and "
                f"{self.hold}."
            )

    def __call__(self, step: int) -> int:
        """Samples per pixel of that step, counted from 0."""
        number = finite("SampleSchedule: step", step)
        if number < 0:
            raise UnitError(f"SampleSchedule: expected a step of 0 or more, got {shown(step)}.")
        doublings = math.ceil(math.log2(self.last / self.first))
        share = number / self.steps
        if share < self.hold or doublings == 0:
            return self.first
        done = doublings if share >= 1 else 1 + math.floor((share - self.hold) / (1 - self.hold) * doublings)
        return min(self.last, self.first << done)

    @staticmethod
    def needed(spp: int, bias: float, allowed: float) -> int:
        """Samples per pixel at which a `bias` of a loss at `spp` is at most `allowed`, which is in its unit.

        The bias of a loss of a render falls with one over the samples; that of a squared error is `squared_loss(first,
        target) - two_render_loss(first, second, target)`. Take a tenth of what the noise of the target makes of the
        loss. By doubling `spp`, at least itself, also where the estimate of the bias is below zero. Raises UnitError,
        also where more than 2^32 samples would be needed, which no renderer takes.
        """
        where = "SampleSchedule.needed"
        number = check_whole("spp", spp, where, UnitError)
        limit = finite(f"{where}: allowed", allowed)
        if limit <= 0:
            raise UnitError(f"{where}: expected allowed above zero, got {shown(allowed)}.")
        ratio = finite(f"{where}: bias", bias) / limit
        # not infinite, which a quotient of numbers may be
        doublings = math.ceil(math.log2(min(ratio, 2.0**64))) if ratio > 1 else 0
        found = number << doublings
        if doublings and found > _MOST_SAMPLES:
            raise UnitError(
                f"{where}: expected a bias at {number} samples that 2^32 bring down to what is allowed, got a bias of "
                f"{shown(bias)} and {shown(allowed)}. Allow a tenth of what the noise of the target makes of the loss."
            )
        return found


class TwoRenderLoss(nn.Module):
    """`two_render_loss(first, second, target)` with its reduction held."""

    def __init__(self, reduction: Reduction = "mean") -> None:
        super().__init__()
        check_reduction(reduction, "TwoRenderLoss")
        self.reduction = reduction

    def forward(self, first: Light, second: Light, target: Light, *, mask: Tensor | None = None) -> Tensor:
        return two_render_loss(first, second, target, mask=mask, reduction=self.reduction)
