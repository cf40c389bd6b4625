"""Quanta sensors: binary frames that say whether at least one photon came."""

from __future__ import annotations

import torch
from torch import Tensor

from torchtransient.errors import UnitError
from torchtransient.floating import holds, in_single
from torchtransient.sensing.base.layout import TIME, check_count, check_transient, reals
from torchtransient.sensing.base.policies import GradPolicy
from torchtransient.sensing.base.sensor import RandomSensor
from torchtransient.sensing.numerics.draws import WHOLE_FLOAT32, check_rates
from torchtransient.sensing.spad.spad import log_of_firing


@in_single
def frames_to_rate(counts: Tensor, frames: int) -> Tensor:
    """Photons per frame from the number of frames that saw any: -log(1 - counts / frames). Differentiable.

    Args:
        counts: any shape.
        frames: number of frames.

    Returns:
        Shape of `counts`; for a pixel that fired in every frame the rate of a share 1 - 1/(2 frames).

    Raises:
        UnitError: for more counts than frames.
    """
    number = check_count(frames, "frames", "frames_to_rate")
    (counts,) = reals("frames_to_rate", counts=counts)
    # a normal surrogate goes beyond all frames by some standard deviations, of which half the root is the largest
    if not holds(~(counts > number + 1 + 3 * number**0.5)):
        raise UnitError(
            f"frames_to_rate: expected at most as many counts as the {number} frames, got {float(counts.max()):g}. "
            "Give the frames of the sensor that counted: BinaryFrames.frames."
        )
    return -torch.log1p(-(counts / number).clamp(0, 1 - 1 / (2 * number)))


class BinaryFrames(RandomSensor):
    """Quanta sensor: counts of binary frames that saw a photon, from the mean photons of one frame.

    Every bin along T is a gate or moment of its own, exposed `frames` times: independent binomials with probability 1 -
    exp(-mean). All four policies. Source: Fossum et al., Sensors 16 (2016).

    Args:
        frames: number of frames.
        grad: gradient policy.

    Input and output are (..., C, T, H, W).
    """

    takes, gives = ("electrons",), "counts"

    def __init__(self, frames: int, *, grad: GradPolicy = "expected") -> None:
        super().__init__(grad)
        self.frames = check_count(frames, "frames", "BinaryFrames")

    def expected(self, x: Tensor) -> Tensor:
        return -torch.expm1(-check_rates(check_transient(x, "BinaryFrames"), "BinaryFrames")) * self.frames

    def variance(self, x: Tensor) -> Tensor:
        check_rates(x, "BinaryFrames")
        variance: Tensor = -torch.expm1(-x) * torch.exp(-x) * self.frames
        return variance

    def sample(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        check_transient(x, "BinaryFrames")
        check_rates(x, "BinaryFrames")
        # beyond 2^24 trials the variance of torch.binomial in float32 is 13 to 38 % too large
        exact = torch.float64 if self.frames > WHOLE_FLOAT32 or x.dtype == torch.float64 else torch.float32
        work = x.detach().to(exact)
        p = -torch.expm1(-work)
        return torch.binomial(torch.full_like(p, float(self.frames)), p, generator=generator).to(x.dtype)

    def log_prob(self, measurement: Tensor, x: Tensor) -> Tensor:
        n, r = measurement.double(), check_rates(x, "BinaryFrames").double()
        hit = n > 0
        fire = log_of_firing(torch.where(hit, r, 0.5))
        value = torch.where(hit, n * fire, torch.zeros_like(r)) - r * (self.frames - n)
        total = torch.lgamma(torch.tensor(self.frames + 1.0, dtype=torch.float64))
        value = value + (total - torch.lgamma(n + 1) - torch.lgamma(self.frames - n + 1))
        return value.sum(TIME).to(x.dtype)
