"""Jitter of a sweep: all pixels of an exposure start a little early or late, alike."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchtransient.axes import TimeAxis
from torchtransient.errors import UnitError
from torchtransient.sensing.base.layout import (
    TIME,
    bin_width_of,
    check_choice,
    check_count,
    check_seconds,
    check_transient,
)
from torchtransient.sensing.base.policies import GradPolicy
from torchtransient.sensing.base.sensor import RandomSensor
from torchtransient.sensing.counts.moved_counts import shifted
from torchtransient.sensing.numerics.time_convolution import Boundary, convolve_time
from torchtransient.sensing.response.response_shapes import FWHM_PER_SIGMA, normal_integral


class SweepJitter(RandomSensor):
    """Shifts the time axis of (..., C, T, H, W) by normal jitter, a number of sweeps averaged.

    ``jitter_fwhm_s`` of one sweep; ``sweeps`` averaged per exposure. Each item in front of C draws its own shifts, all
    its pixels share them. A shift by a part of a bin is linear interpolation, which broadens by less than a bin.
    ``expected``: the mean over the jitter, exactly. ``boundary`` "periodic": what is shifted out of the window comes in
    at its other end, so that constant light stays constant; "zero": it is lost, and darkness moves in.

    The draw is a random *linear* map that does not depend on the input, so that every policy but ``expected`` gives
    its ordinary gradient, which is unbiased for any loss.
    """

    gives = "the same"

    def __init__(
        self,
        jitter_fwhm_s: float,
        axis: TimeAxis | None = None,
        *,
        bin_width_s: float | None = None,
        sweeps: int = 1,
        boundary: Boundary = "periodic",
        grad: GradPolicy = "expected",
    ) -> None:
        super().__init__(grad)
        me = type(self).__name__
        check_choice(boundary, Boundary, "boundary", me)
        self.boundary: Boundary = boundary
        self.jitter_fwhm_s = check_seconds(jitter_fwhm_s, "jitter_fwhm_s", me)
        self.bin_width_s = bin_width_of(axis, bin_width_s, me)
        self.num_bins = None if axis is None else axis.num_bins
        self.sweeps = check_count(sweeps, "sweeps", me)

    @property
    def sigma_bins(self) -> float:
        """Standard deviation of one shift, in bins."""
        return self.jitter_fwhm_s / FWHM_PER_SIGMA / self.bin_width_s

    def expected(self, x: Tensor) -> Tensor:
        self._check(x)
        if self.sigma_bins == 0:
            return x
        reach = math.ceil(6 * self.sigma_bins) + 1
        lags = torch.arange(-reach, reach + 1, dtype=torch.float64, device=x.device)
        # Mean of the tent max(0, 1 - |shift - lag|): second difference of the integral of the normal cumulative, on
        # the side where that keeps its digits.
        low = -lags.abs()
        ramp = self.sigma_bins * normal_integral(torch.stack([low - 1, low, low + 1]) / self.sigma_bins)
        kernel = ramp[0] - 2 * ramp[1] + ramp[2]
        return convolve_time(x, kernel / kernel.sum(), -reach, boundary=self.boundary)

    def forward(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        return self.expected(x) if self.grad == "expected" else self._shifted(x, generator)

    def sample(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        with torch.no_grad():
            return self._shifted(x, generator)

    def _shifted(self, x: Tensor, generator: torch.Generator | None) -> Tensor:
        self._check(x)
        if self.sigma_bins == 0:
            return x
        items = x.shape[:-4]
        noise = torch.randn((*items, self.sweeps), generator=generator, device=x.device, dtype=torch.float64)
        shifts = (noise * self.sigma_bins).clamp(-6 * self.sigma_bins, 6 * self.sigma_bins)
        reach = math.ceil(6 * self.sigma_bins) + 1
        lags = torch.arange(-reach, reach + 1, dtype=torch.float64, device=x.device)
        weights = (1 - (shifts.unsqueeze(-1) - lags).abs()).clamp(min=0).mean(-2).to(x.dtype)
        result = torch.zeros_like(x)
        for k, lag in enumerate(range(-reach, reach + 1)):
            if bool((weights[..., k] > 0).any()):
                result = result + weights[..., k].reshape(*items, 1, 1, 1, 1) * shifted(x, lag, self.boundary)
        return result

    def _check(self, x: Tensor) -> None:
        check_transient(x, type(self).__name__)
        if self.sigma_bins > x.shape[TIME]:
            raise UnitError(
                f"{type(self).__name__}: expected jitter below the window of {x.shape[TIME] * self.bin_width_s:g} s, "
                f"got jitter_fwhm_s={self.jitter_fwhm_s!r}. Picoseconds? 1 ps is 1e-12."
            )
