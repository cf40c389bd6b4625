"""Photon shot noise: Poisson counts of a given mean, in the dtype and on the device given."""

from __future__ import annotations

import torch
from torch import Tensor

from torchtransient.errors import UnitError
from torchtransient.floating import in_single
from torchtransient.sensing.base.layout import check_generator, check_transient, going_together, reals
from torchtransient.sensing.base.sensor import RandomSensor

# float32 counts whole numbers up to here; torch.poisson beyond it draws even numbers only.
_EXACT_FLOAT32 = 2.0**24


@in_single
def poisson(mean: Tensor, generator: torch.Generator | None = None) -> Tensor:
    """Poisson counts with the given mean (any shape), without gradient; dtype and device are kept.

    Half precision gives float32. Float32 above 2^24 is drawn in float64, then rounded to the dtype of `mean`. Raises
    UnitError for negative or non-finite means: negative lobes of a filter have to be dealt with where they arise.
    """
    (mean,) = reals("poisson", mean=mean)
    check_generator(generator, "poisson")
    mean = mean.detach()
    low, high = torch.aminmax(mean) if mean.numel() else (mean.new_zeros(()), mean.new_zeros(()))
    if not bool(low >= 0) or not bool(torch.isfinite(high)):
        raise UnitError(f"poisson: expected finite means >= 0, got values from {float(low):g} to {float(high):g}.")
    if mean.dtype == torch.float32 and float(high) > _EXACT_FLOAT32 / 2:
        return torch.poisson(mean.double(), generator=generator).to(mean.dtype)
    return torch.poisson(mean, generator=generator)


@in_single
def poisson_log_prob(counts: Tensor, mean: Tensor) -> Tensor:
    """Log-probability of counts under Poisson means, elementwise; finite gradients at mean 0 with count 0.

    A count above 0 where the mean is 0 has log-probability -inf. Shapes broadcast.
    """
    counts, mean = going_together("poisson_log_prob", counts=counts, mean=mean)
    empty = counts == 0
    # where on the input: xlogy(0, 0) has a NaN gradient
    log_mean = torch.where(empty, torch.ones_like(mean), mean).log()
    return counts * log_mean - mean - torch.lgamma(counts + 1)


class ShotNoise(RandomSensor):
    """Poisson counts of a mean (..., C, T, H, W), in counts. Fano factor 1. All four gradient policies."""

    takes, gives = ("electrons",), "counts"

    def expected(self, x: Tensor) -> Tensor:
        return check_transient(x, "ShotNoise")

    def variance(self, x: Tensor) -> Tensor:
        return x

    def sample(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        return poisson(check_transient(x, "ShotNoise"), generator)

    def log_prob(self, measurement: Tensor, x: Tensor) -> Tensor:
        return poisson_log_prob(measurement, x).sum(-3)
