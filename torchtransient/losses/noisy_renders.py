"""Losses of Monte Carlo renders, whose noise biases every loss that is not linear in them.

`E[f(render)] = f(E render) + f'' variance / 2 + ...`: a squared error grows by the variance, which depends on the
scene's parameters. The product of the residuals of two independent renders does not (docs/noisy_renders.md).
"""

from __future__ import annotations

import math
from dataclasses import KW_ONLY, dataclass

from torch import Tensor

from torchtransient.checks import finite, positive, shown
from torchtransient.errors import UnitError
from torchtransient.losses.checks import Reduction, check_mask, check_pair, check_whole, counted, real_product, reduce
from torchtransient.losses.loss_module import LossModule
from torchtransient.losses.results import LIGHT, Light, reads

# Mitsuba's indices of samples have 32 bits.
_MOST_SAMPLES = 2**32


@reads(first=LIGHT, second=LIGHT, target=LIGHT)
def two_render_loss(
    first: Light, second: Light, target: Light, *, mask: Tensor | None = None, reduction: Reduction = "mean"
) -> Tensor:
    """Compute the unbiased squared error of a render by two: `Re[(first - target) conj(second - target)]`. ::

        out = renderer({key: torch.stack([x, x])}, seed=(1, 2))
        loss = two_render_loss(out.transient[0], out.transient[1], target)

    Value and gradient have the mean of the squared error of a render without noise, at any number of samples; noise of
    the target stays. May be negative. Symmetric in the renders.

    Args:
        first: render, real or complex, any shape.
        second: render of the same scene with another seed.
        target: measurement of the same shape.
        mask: elements that count.
        reduction: "mean" over elements that count, "sum", or "none".

    Returns:
        Unit of the renders, squared; scalar, or the shape of the target for "none".

    Raises:
        ShapeError: for different shapes.
    """
    where = "two_render_loss"
    first, target = check_pair(first, target, where, complex_too=True, names="first and target")
    second, target = check_pair(second, target, where, complex_too=True, names="second and target")
    first = first.to(target.dtype)
    mask = check_mask(mask, target, where)
    a, b = (counted(render, mask) - counted(target, mask) for render in (first, second))
    return reduce(real_product(a, b), reduction, where, mask)


class TwoRenderLoss(LossModule, function=two_render_loss, by_place=("reduction",)):
    """`two_render_loss` with its reduction held."""

    def forward(self, first: Light, second: Light, target: Light, *, mask: Tensor | None = None) -> Tensor:  # type: ignore[override]
        return self.loss(first, second, target, mask=mask)


@dataclass(frozen=True)
class SampleSchedule:
    """Samples per pixel over the steps of a fit: few first, where noise averages out, more where bias is left. ::

        schedule = SampleSchedule(64, 512, steps)
        out = renderer(values, spp=schedule(step), seed=step)

    Doubled in equal parts, since every other number of samples is compiled and recorded anew.

    Args:
        first: samples up to the share `hold` of the steps.
        last: samples from the end on; (64, 100, 10) ends at 100.
        steps: number of steps.
        hold: share of the steps with `first`, in [0, 1].

    Raises:
        UnitError: for `last` below `first` and a `hold` out of range.
    """

    first: int
    last: int
    steps: int
    _: KW_ONLY
    hold: float = 0.6

    def __post_init__(self) -> None:
        for name in ("first", "last", "steps"):
            object.__setattr__(self, name, check_whole(name, getattr(self, name), "SampleSchedule", UnitError))
        if self.last < self.first or not 0 <= self.hold <= 1:
            raise UnitError(f"expected first <= last and hold between 0 and 1, got {self}.")

    def __call__(self, step: int) -> int:
        """Return the samples per pixel of a step, counted from 0."""
        doublings = math.ceil(math.log2(self.last / self.first))
        share = step / self.steps
        if share < self.hold or doublings == 0:
            return self.first
        done = doublings if share >= 1 else 1 + math.floor((share - self.hold) / (1 - self.hold) * doublings)
        return min(self.last, self.first << done)

    @staticmethod
    def needed(spp: int, bias: float, allowed: float) -> int:
        """Return the samples per pixel at which the bias of a loss, which falls as one over them, is small enough.

        Args:
            spp: samples per pixel at which the bias was measured.
            bias: bias of the loss; of a squared error `squared_loss(first, target) - two_render_loss(first, second,
                target)`.
            allowed: bias to reach, in the same unit; a tenth of the noise of the target in the loss, for instance.

        Returns:
            `spp` doubled as often as needed, at least `spp`.

        Raises:
            UnitError: if more than 2^32 samples would be needed, which no renderer takes.
        """
        where = "SampleSchedule.needed"
        number = check_whole("spp", spp, where, UnitError)
        ratio = finite(f"{where}: bias", bias) / positive(f"{where}: allowed", allowed)
        # a quotient may be infinite
        doublings = math.ceil(math.log2(min(ratio, 2.0**64))) if ratio > 1 else 0
        found = number << doublings
        if doublings and found > _MOST_SAMPLES:
            raise UnitError(
                f"{where}: more than 2^32 samples bring a bias of {shown(bias)} down to {shown(allowed)}. Allow a "
                "tenth of what the noise of the target makes of the loss."
            )
        return found
