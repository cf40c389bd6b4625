"""From radiance to expected detections: laser, optics, pixel, ambient light and dark counts."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchtransient.axes import TimeAxis
from torchtransient.errors import ShapeError, UnitError
from torchtransient.floating import in_single
from torchtransient.sensing.layout import TIME, bin_width_of, check_count, check_number, check_tensor, check_transient
from torchtransient.sensing.sensor import Sensor
from torchtransient.tensor_record import TensorRecord
from torchtransient.units import SPEED_OF_LIGHT

_DARKEST = 1e3  # f-number of a pinhole; millimetres over metres are a thousand times those of lenses
_MOST_WATTS = 1e3  # on average, of a laser; nanojoules taken for joules are megawatts
_LONGEST_S = 3600.0  # exposure of one histogram; megahertz taken for hertz make a million of it

PLANCK_J_S = 6.626_070_15e-34  # exact by the definition of the kilogram (SI)


def photon_energy_j(wavelength_m: float) -> float:
    """Energy of one photon in joules: h c / wavelength. Refuses wavelengths that are none of light: 10 nm to 1 mm."""
    wavelength = check_number(wavelength_m, "wavelength_m", "photon_energy_j", open_low=True)
    if not 1e-8 <= wavelength < 1e-3:
        raise UnitError(f"photon_energy_j: expected wavelength_m in metres, got {wavelength!r}. 532 nm is 532e-9.")
    return PLANCK_J_S * SPEED_OF_LIGHT / wavelength


@dataclass(frozen=True)
class Optics:
    """A lens and a pixel. Lengths in metres.

    `f_number`: focal length over diameter of the aperture; `pixel_area_m2`: active area of a pixel; `transmission`:
    share of light that filters and lenses let through. `solid_angle_sr` replaces what the f-number gives, for sensors
    that are not behind a lens. Raises UnitError outside the ranges.
    """

    f_number: float | None = None
    pixel_area_m2: float = 100e-12
    transmission: float = 1.0
    solid_angle_sr: float | None = None

    def __post_init__(self) -> None:
        if (self.f_number is None) == (self.solid_angle_sr is None):
            raise UnitError("Optics: expected either f_number or solid_angle_sr, got both or neither.")
        if self.f_number is not None:
            check_number(self.f_number, "f_number", "Optics", low=0.1, high=_DARKEST)
        if self.solid_angle_sr is not None:
            check_number(self.solid_angle_sr, "solid_angle_sr", "Optics", high=2 * math.pi, open_low=True)
        # a pixel larger than 1 cm^2 is most likely given in square micrometres
        check_number(self.pixel_area_m2, "pixel_area_m2", "Optics", high=1e-4, open_low=True)
        check_number(self.transmission, "transmission", "Optics", high=1.0)

    @classmethod
    def from_aperture(
        cls, focal_length_m: float, aperture_diameter_m: float, pixel_area_m2: float, transmission: float = 1.0
    ) -> Optics:
        """The optics of a lens of this focal length and aperture."""
        focal = check_number(focal_length_m, "focal_length_m", "Optics", open_low=True)
        diameter = check_number(aperture_diameter_m, "aperture_diameter_m", "Optics", open_low=True)
        if not 0.1 <= focal / diameter <= _DARKEST:
            raise UnitError(
                f"Optics: expected focal_length_m and aperture_diameter_m in one unit, metres, got {focal!r} and "
                f"{diameter!r}, which is f/{focal / diameter:g}. 25 mm are 25e-3."
            )
        return cls(focal / diameter, pixel_area_m2, transmission)

    @property
    def etendue_m2_sr(self) -> float:
        """Radiance (W / m^2 sr) times this is the power on the pixel, on the axis and for distant objects.

        pi A / (4 F^2 + 1) behind a lens (a cone of half angle atan(1/2F) on the pixel: sin^2 = 1/(4 F^2 + 1)).
        """
        if self.f_number is not None:
            angle = math.pi / (4 * self.f_number**2 + 1)
        else:
            angle = float(self.solid_angle_sr or 0.0)
        return angle * self.pixel_area_m2 * self.transmission


@dataclass(frozen=True, eq=False, repr=False)
class BudgetReport(TensorRecord):
    """Where the detections of a pixel come from. Rates per laser cycle, before pile-up and dead time.

    `signal_per_cycle`: (..., C, H, W), detections of laser light; `ambient_per_cycle`, `dark_per_cycle`: the same for
    the whole window; `cycles`; `exposure_s`.
    """

    signal_per_cycle: Tensor
    ambient_per_cycle: float
    dark_per_cycle: float
    cycles: int
    exposure_s: float

    @property
    def background_per_cycle(self) -> float:
        """Ambient light and dark counts together."""
        return self.ambient_per_cycle + self.dark_per_cycle

    @property
    def signal_to_background(self) -> Tensor:
        """Ratio of signal and background detections; infinite without background."""
        return (
            self.signal_per_cycle / self.background_per_cycle
            if self.background_per_cycle > 0
            else torch.full_like(self.signal_per_cycle, math.inf)
        )

    @property
    def piles_up(self) -> Tensor:
        """Whether more than 5 % of the cycles have a detection, above which first-photon pile-up shows: bool."""
        return self.signal_per_cycle + self.background_per_cycle > 0.05


class PhotonBudget(Sensor):
    """Expected detections per laser cycle and bin of a transient (..., C, T, H, W) of radiance.

    rate = transient x pulse_energy_j x etendue x quantum_efficiency / photon energy + background

    The transient is rendered with an emitter of unit energy: W / (m^2 sr) per bin for a source of 1 W fired as one
    pulse of 1 J, so that times the pulse energy it is J / (m^2 sr). `ambient_rate_hz`: ambient photons on the pixel per
    second, after the optics (detected: times the quantum efficiency); `dark_count_rate_hz`: per pixel, a number or a
    map (H, W) for hot pixels. The background is spread evenly over the bins. `repetition_rate_hz` and either `cycles`
    or `exposure_s` give the number of cycles.

    Raises UnitError outside the ranges, for wavelengths in nanometres, for a window longer than a laser period, for
    more than 1 kW on average, for exposures of more than an hour or of less than one cycle.
    Not modelled: vignetting, angle dependence of the filter, speckle.
    """

    takes, gives = ("radiance",), "rate"

    dark_count_rate_hz: Tensor

    def __init__(
        self,
        optics: Optics,
        *,
        pulse_energy_j: float,
        wavelength_m: float,
        repetition_rate_hz: float,
        cycles: int | None = None,
        exposure_s: float | None = None,
        quantum_efficiency: float = 1.0,
        ambient_rate_hz: float = 0.0,
        dark_count_rate_hz: float | Tensor = 0.0,
        axis: TimeAxis | None = None,
        bin_width_s: float | None = None,
    ) -> None:
        super().__init__()
        where = "PhotonBudget"
        if not isinstance(optics, Optics):
            raise UnitError(f"{where}: expected optics to be an Optics, got {optics!r}. Optics(f_number=2.0), say.")
        self.optics = optics
        self.pulse_energy_j = check_number(pulse_energy_j, "pulse_energy_j", where, high=1e3)
        self.photon_energy_j = photon_energy_j(wavelength_m)
        self.repetition_rate_hz = check_number(repetition_rate_hz, "repetition_rate_hz", where, open_low=True)
        self.quantum_efficiency = check_number(quantum_efficiency, "quantum_efficiency", where, high=1.0)
        self.ambient_rate_hz = check_number(ambient_rate_hz, "ambient_rate_hz", where)
        dark = torch.as_tensor(dark_count_rate_hz, dtype=torch.float64)
        if not bool(torch.isfinite(dark).all()) or bool((dark < 0).any()) or dark.ndim not in (0, 2):
            raise UnitError(
                f"{where}: expected dark_count_rate_hz >= 0, a number or (H, W), got {dark_count_rate_hz!r}."
            )
        self.register_buffer("dark_count_rate_hz", dark)
        self.bin_width_s = bin_width_of(axis, bin_width_s, where)
        self.num_bins = None if axis is None else axis.num_bins
        if (cycles is None) == (exposure_s is None):
            raise UnitError(f"{where}: expected either cycles or exposure_s, got both or neither.")
        if exposure_s is not None:
            cycles = self._cycles_of(check_number(exposure_s, "exposure_s", where))
        self.cycles = check_count(cycles or 0, "cycles", where)
        if self.exposure_s > _LONGEST_S:
            raise UnitError(
                f"{where}: expected an exposure of at most {_LONGEST_S:g} s, got {self.exposure_s:g} s: {self.cycles} "
                f"cycles at {self.repetition_rate_hz:g} Hz. 10 MHz are 10e6 Hz, 5 ms are 5e-3 s."
            )
        if self.pulse_energy_j * self.repetition_rate_hz > _MOST_WATTS:
            raise UnitError(
                f"{where}: expected a laser of at most {_MOST_WATTS:g} W on average, got {self.pulse_energy_j!r} J at "
                f"{self.repetition_rate_hz:g} Hz, {self.pulse_energy_j * self.repetition_rate_hz:g} W. 1 nJ is 1e-9 J."
            )

    def _cycles_of(self, exposure_s: float) -> int:
        """Laser cycles of an exposure, rounded. UnitError for less than one."""
        if exposure_s * self.repetition_rate_hz < 1 - 1e-6:
            raise UnitError(
                f"PhotonBudget: expected exposure_s of at least one laser period, {1 / self.repetition_rate_hz:g} s, "
                f"got {exposure_s!r} s. Is repetition_rate_hz ({self.repetition_rate_hz:g}) in hertz? 10 MHz are 10e6."
            )
        return round(exposure_s * self.repetition_rate_hz)

    @property
    def exposure_s(self) -> float:
        """Duration of the exposure, in seconds."""
        return self.cycles / self.repetition_rate_hz

    @property
    def detections_per_unit(self) -> float:
        """Detections per cycle for a radiance of 1 in a bin."""
        photons = self.pulse_energy_j * self.optics.etendue_m2_sr / self.photon_energy_j
        return photons * self.quantum_efficiency

    @in_single
    def signal(self, x: Tensor) -> Tensor:
        """Expected detections of laser light per cycle and bin, without background."""
        check_transient(x, "PhotonBudget")
        window_s = x.shape[TIME] * self.bin_width_s
        # 1 in 1e6 for rates such as 1/(T dt) that were rounded on the way
        if window_s * self.repetition_rate_hz > 1 + 1e-6:
            raise UnitError(
                f"PhotonBudget: expected the window to fit into a laser period of {1 / self.repetition_rate_hz:g} s, "
                f"got {window_s:g} s. Lower repetition_rate_hz or use fewer bins."
            )
        return x * self.detections_per_unit

    def expected(self, x: Tensor) -> Tensor:
        dark = self.dark_count_rate_hz
        check_tensor(x, "PhotonBudget")
        if any(have not in (1, wanted) for have, wanted in zip(dark.shape, x.shape[-2:], strict=False)):
            raise ShapeError(
                f"PhotonBudget: expected an image {tuple(dark.shape)} as in dark_count_rate_hz, got "
                f"{tuple(x.shape[-2:])}. Make the map for this sensor."
            )
        background_hz = self.ambient_rate_hz * self.quantum_efficiency + self.dark_count_rate_hz.double()
        return self.signal(x) + (background_hz * self.bin_width_s).to(x.dtype)

    @in_single
    def report(self, x: Tensor) -> BudgetReport:
        """Signal and background of every pixel (dark counts: the mean over pixels), for a transient of radiance."""
        window_s = x.shape[TIME] * self.bin_width_s
        return BudgetReport(
            signal_per_cycle=self.signal(x).sum(TIME),
            ambient_per_cycle=self.ambient_rate_hz * self.quantum_efficiency * window_s,
            dark_per_cycle=float(self.dark_count_rate_hz.double().mean()) * window_s,
            cycles=self.cycles,
            exposure_s=self.exposure_s,
        )
