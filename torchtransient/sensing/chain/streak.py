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

from torchtransient.axes import TimeAxis
from torchtransient.checks import of_class
from torchtransient.sensing.base.layout import check_number
from torchtransient.sensing.base.policies import GradPolicy
from torchtransient.sensing.cameras.electronics import PixelElectronics
from torchtransient.sensing.chain.compose import Compose
from torchtransient.sensing.numerics.time_convolution import Boundary
from torchtransient.sensing.optics.spatial_psf import LensBlur
from torchtransient.sensing.response.impulse_response import GaussianResponse, ImpulseResponse
from torchtransient.sensing.timing.sweep_jitter import SweepJitter as SweepJitter


class StreakCamera(Compose):
    """A streak camera on photoelectrons per bin and exposure (..., C, T, H, W), output in electrons, the same shape.

    ``time_fwhm_s``: resolution along time; ``spatial_fwhm_px`` of optics and tube, ``phosphor_fwhm_px`` behind the
    gain, 0 leaves a stage out; ``jitter_fwhm_s`` and ``sweeps`` of the sweep; ``excess_noise`` of the channel plate;
    ``read_noise_e``, ``full_well_e``, ``gain_e_per_dn``, ``bits``: the camera, referred to photoelectrons.
    ``boundary``: of the window in time, for spread and jitter; "periodic" keeps a constant background constant, while
    light close to one end shows a trace at the other; "zero" loses what leaves.
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
        boundary: Boundary = "periodic",
        grad: GradPolicy = "expected",
    ) -> None:
        of_class("StreakCamera: axis", axis, TimeAxis)
        time_fwhm_s = check_number(time_fwhm_s, "time_fwhm_s", "StreakCamera")
        spatial_fwhm_px = check_number(spatial_fwhm_px, "spatial_fwhm_px", "StreakCamera")
        phosphor_fwhm_px = check_number(phosphor_fwhm_px, "phosphor_fwhm_px", "StreakCamera")
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
            ImpulseResponse(GaussianResponse(time_fwhm_s), axis, boundary=boundary) if time_fwhm_s > 0 else None,
            SweepJitter(jitter_fwhm_s, axis, sweeps=sweeps, boundary=boundary),
            PixelElectronics(excess_noise=excess_noise),
            LensBlur(phosphor_fwhm_px, "replicate") if phosphor_fwhm_px > 0 else None,
            camera,
        ]
        super().__init__([s for s in stages if s is not None], grad=grad)
        self.boundary: Boundary = boundary
        self.axis, self.num_bins = axis, axis.num_bins
