"""Chains of detectors from their parts, in the order in which light meets them: photon counters and streak cameras.

A streak camera has a photocathode, a sweep that turns time into place, an intensifier and a camera behind it. The slit
is H or W; both stay. Photoelectrons scatter one by one in the tube, so that they are as Poisson after its spread as
before it, and the stages stand in this order:

    optics and tube spread   `LensBlur` across the slit, `ImpulseResponse` along time: linear, in the mean
    sweep jitter             `SweepJitter`: every sweep starts a little early or late, all pixels alike
    photocathode, channel plate   `PixelElectronics(excess_noise=...)`: shot noise and the spread of the gain
    phosphor                 `LensBlur`: a spot covers several pixels, whose noise is then correlated
    camera                   `PixelElectronics(shot_noise=False, ...)`: read noise, full well, converter

Source: Velten et al., "Femto-photography" (ACM TOG 2013): 2 ps resolution, additive read noise, Poisson photocathode.
"""

from __future__ import annotations

from collections.abc import Sequence

from torchtransient.axes import TimeAxis
from torchtransient.errors import UnitError
from torchtransient.sensing.afterpulsing import Afterpulsing
from torchtransient.sensing.chain.compose import Compose
from torchtransient.sensing.crosstalk import Crosstalk
from torchtransient.sensing.electronics import PixelElectronics
from torchtransient.sensing.impulse_response import ImpulseResponse
from torchtransient.sensing.photon_budget import PhotonBudget
from torchtransient.sensing.responses import GaussianResponse, Response
from torchtransient.sensing.sensor import GradPolicy, Sensor
from torchtransient.sensing.spatial_psf import LensBlur
from torchtransient.sensing.time_convolution import Boundary
from torchtransient.sensing.timing import TDC, DetectionJitter, DetectionSkew, SweepJitter


def counting_chain(
    budget: PhotonBudget,
    detector: Sensor,
    *,
    optics: Sequence[Sensor] = (),
    pulse: Response | ImpulseResponse | None = None,
    jitter: Response | DetectionJitter | None = None,
    skew: DetectionSkew | None = None,
    afterpulsing: Afterpulsing | None = None,
    crosstalk: Crosstalk | None = None,
    converter: TDC | None = None,
    readout: Sequence[Sensor] = (),
    grad: GradPolicy | None = None,
) -> Compose:
    """Make a chain of the parts of a single-photon detector, radiance (..., C, T, H, W) to counts, in their order.

    Light is spread by `optics` and by the laser's `pulse`; `budget` makes detections of it and adds constant light and
    dark counts; `detector` counts them; `jitter` and `skew` move every detection; `afterpulsing` and `crosstalk` add
    others; `converter` gives each of them its code; `readout` makes of the histogram the data that the pixel keeps. The
    reasons: docs/photon_counting.md.

    Args:
        budget: rates of detections.
        detector: `SynchronousSPAD`, `FreeRunningSPAD`, a `MacroPixel` of them, ...
        optics: sensors that spread light over pixels.
        pulse: pulse of the laser; a `Response` is taken for the bins of the budget.
        jitter: jitter of detections; a `Response` is taken for the bins of the budget.
        skew: delays of pixels.
        afterpulsing: afterpulses.
        crosstalk: crosstalk.
        converter: time-to-digital converter.
        readout: `ZoneSum`, `CodedHistogram`, ...
        grad: gradient policy, see `Compose`.

    Raises:
        UnitError: for a detector that makes no counts of rates, and for parts that do not go together: another number
            of cycles, another laser period, other bins, two afterpulses.
    """
    spread = ImpulseResponse(pulse, bin_width_s=budget.bin_width_s) if isinstance(pulse, Response) else pulse
    moves = DetectionJitter(jitter, bin_width_s=budget.bin_width_s) if isinstance(jitter, Response) else jitter
    if (detector.takes, detector.gives) != (("rate",), "counts"):
        raise UnitError(
            f"counting_chain: expected detector to make counts of rates, such as SynchronousSPAD, got {detector!r}."
        )
    light = [*optics] if spread is None else [*optics, spread]
    after = [s for s in (moves, skew, afterpulsing, crosstalk, converter) if s is not None]
    return Compose([*light, budget, detector, *after, *readout], grad=grad)


# ------------------------------------------------------------------------------------------------------- streak cameras


class StreakCamera(Compose):
    """Streak camera on photoelectrons per bin and exposure (..., C, T, H, W), output in electrons, the same shape.

    The mean is exact; gradient policies as those of the stages. Not modelled: curvature of the sweep, space charge.

    Args:
        axis: axis of the light.
        time_fwhm_s: resolution along time in seconds; 0 leaves the stage out.
        spatial_fwhm_px: blur of optics and tube in pixels; 0 leaves the stage out.
        phosphor_fwhm_px: blur behind the gain in pixels; 0 leaves the stage out.
        jitter_fwhm_s: jitter of a sweep in seconds.
        sweeps: sweeps of an exposure.
        excess_noise: excess noise factor F^2 of the channel plate.
        read_noise_e: rms read noise of the camera, referred to photoelectrons, as the following.
        full_well_e: full well in electrons, None for no limit, see `PixelElectronics`.
        gain_e_per_dn: electrons per number of the converter, None without one, see `PixelElectronics`.
        bits: bits of the converter, None without one.
        black_level_dn: number of the converter without charge, see `PixelElectronics`.
        boundary: treatment of the window's ends in time, for spread and jitter; "periodic" keeps a constant background
            constant, while light close to one end shows a trace at the other; "zero" loses what leaves.
        grad: gradient policy.
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
        camera = PixelElectronics(
            shot_noise=False,
            read_noise_e=read_noise_e,
            full_well_e=full_well_e,
            gain_e_per_dn=gain_e_per_dn,
            bits=bits,
            black_level_dn=black_level_dn,
        )
        stages = [
            LensBlur(spatial_fwhm_px, "replicate") if spatial_fwhm_px != 0 else None,
            ImpulseResponse(GaussianResponse(time_fwhm_s), axis, boundary=boundary) if time_fwhm_s != 0 else None,
            SweepJitter(jitter_fwhm_s, axis, sweeps=sweeps, boundary=boundary),
            PixelElectronics(excess_noise=excess_noise),
            LensBlur(phosphor_fwhm_px, "replicate") if phosphor_fwhm_px != 0 else None,
            camera,
        ]
        super().__init__([s for s in stages if s is not None], grad=grad)
        self.boundary: Boundary = boundary
        self.axis, self.num_bins = axis, axis.num_bins
