"""Streak cameras: a photocathode, a sweep that turns time into place, an intensifier and a camera behind it.

The slit is H or W; both stay. Photoelectrons scatter one by one in the tube, so that they are as Poisson after its
spread as before it, and the stages stand in this order:

    optics and tube spread   `LensBlur` across the slit, `ImpulseResponse` along time: linear, in the mean
    sweep jitter             `SweepJitter`: every sweep starts a little early or late, all pixels alike
    photocathode, channel plate   `PixelElectronics(excess_noise=...)`: shot noise and the spread of the gain
    phosphor                 `LensBlur`: a spot covers several pixels, whose noise is then correlated
    camera                   `PixelElectronics(shot_noise=False, ...)`: read noise, full well, converter

Source: Velten et al., "Femto-photography" (ACM TOG 2013): 2 ps resolution, additive read noise, Poisson photocathode.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchtransient.axes import TimeAxis
from torchtransient.errors import ShapeError, UnitError
from torchtransient.sensing.compose import Compose
from torchtransient.sensing.electronics import PixelElectronics
from torchtransient.sensing.impulse_response import GaussianResponse, ImpulseResponse
from torchtransient.sensing.layout import TIME, bin_width_of, check_count, check_seconds, check_transient
from torchtransient.sensing.policies import GradPolicy
from torchtransient.sensing.response_shapes import FWHM_PER_SIGMA, normal_cdf
from torchtransient.sensing.sensor import RandomSensor
from torchtransient.sensing.spatial_psf import LensBlur
from torchtransient.sensing.time_convolution import convolve_time


class SweepJitter(RandomSensor):
    """Shifts the time axis of (..., C, T, H, W) by normal jitter, a number of sweeps averaged.

    ``jitter_fwhm_s`` of one sweep; ``sweeps`` averaged per exposure. Each item in front of C draws its own shifts, all
    its pixels share them. A shift by a part of a bin is linear interpolation, which broadens by less than a bin.
    ``expected``: the mean over the jitter, exactly. What is shifted out of the window is lost.

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
        grad: GradPolicy = "expected",
    ) -> None:
        super().__init__(grad)
        me = type(self).__name__
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
        # Mean of the tent max(0, 1 - |shift - lag|): second difference of the integral of the normal cumulative.
        u = torch.stack([lags - 1, lags, lags + 1]) / self.sigma_bins
        ramp = self.sigma_bins * (u * normal_cdf(u) + torch.exp(-0.5 * u * u) / math.sqrt(2 * math.pi))
        return convolve_time(x, ramp[0] - 2 * ramp[1] + ramp[2], -reach)

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
            if abs(lag) < x.shape[TIME] and bool((weights[..., k] > 0).any()):
                result = result + weights[..., k].reshape(*items, 1, 1, 1, 1) * _moved(x, lag)
        return result

    def _check(self, x: Tensor) -> None:
        check_transient(x, type(self).__name__)
        if self.sigma_bins > x.shape[TIME]:
            raise UnitError(
                f"{type(self).__name__}: expected jitter below the window of {x.shape[TIME] * self.bin_width_s:g} s, "
                f"got jitter_fwhm_s={self.jitter_fwhm_s!r}. Picoseconds? 1 ps is 1e-12."
            )

    def extra_repr(self) -> str:
        return f"jitter_fwhm_s={self.jitter_fwhm_s:g}, sweeps={self.sweeps}, {super().extra_repr()}"


def _moved(x: Tensor, lag: int) -> Tensor:
    """``x`` with every entry ``lag`` bins later, zeros moving in."""
    bins = x.shape[TIME]
    kept = x.narrow(TIME, max(-lag, 0), bins - abs(lag))
    gap = torch.zeros_like(x.narrow(TIME, 0, abs(lag)))
    return torch.cat([gap, kept] if lag >= 0 else [kept, gap], TIME)


class StreakCamera(Compose):
    """A streak camera on photoelectrons per bin and exposure (..., C, T, H, W), output in electrons, the same shape.

    ``time_fwhm_s``: resolution along time; ``spatial_fwhm_px`` of optics and tube, ``phosphor_fwhm_px`` behind the
    gain, 0 leaves a stage out; ``jitter_fwhm_s`` and ``sweeps`` of the sweep; ``excess_noise`` of the channel plate;
    ``read_noise_e``, ``full_well_e``, ``gain_e_per_dn``, ``bits``: the camera, referred to photoelectrons.
    The mean is exact; gradient policies as those of the stages. Not modelled: curvature of the sweep, space charge.
    """

    def __init__(
        self,
        axis: TimeAxis,
        *,
        time_fwhm_s: float = 2e-12,
        spatial_fwhm_px: float = 1.5,
        phosphor_fwhm_px: float = 0.0,
        jitter_fwhm_s: float = 1e-12,
        sweeps: int = 1,
        excess_noise: float = 1.5,
        read_noise_e: float = 0.5,
        full_well_e: float | None = None,
        gain_e_per_dn: float | None = None,
        bits: int | None = None,
        black_level_dn: float = 0.0,
        grad: GradPolicy = "expected",
    ) -> None:
        if not isinstance(axis, TimeAxis):
            raise ShapeError(f"StreakCamera: expected a TimeAxis, got {type(axis).__name__}.")
        camera = PixelElectronics(
            shot_noise=False,
            read_noise_e=read_noise_e,
            full_well_e=full_well_e,
            gain_e_per_dn=gain_e_per_dn,
            bits=bits,
            black_level_dn=black_level_dn,
        )
        stages = [
            LensBlur(spatial_fwhm_px, "replicate") if spatial_fwhm_px > 0 else None,
            ImpulseResponse(GaussianResponse(time_fwhm_s), axis) if time_fwhm_s > 0 else None,
            SweepJitter(jitter_fwhm_s, axis, sweeps=sweeps),
            PixelElectronics(excess_noise=excess_noise),
            LensBlur(phosphor_fwhm_px, "replicate") if phosphor_fwhm_px > 0 else None,
            camera,
        ]
        super().__init__([s for s in stages if s is not None], grad=grad)
        self.axis, self.num_bins = axis, axis.num_bins
