"""From radiance to expected detections: laser, optics, pixel, ambient light and dark counts."""

from __future__ import annotations

import math
from dataclasses import KW_ONLY, dataclass

import torch
from torch import Tensor

from torchtransient.axes import TimeAxis
from torchtransient.checks import MOST_MADE
from torchtransient.errors import UnitError
from torchtransient.floating import in_single
from torchtransient.sensing.checks import (
    TIME,
    bins_from,
    check_broadcast,
    check_count,
    check_number,
    check_one_of,
    check_transient,
)
from torchtransient.sensing.parameters import check_map, keep_map, kept_map, over_time
from torchtransient.sensing.sensor import Sensor
from torchtransient.tensor_record import TensorRecord
from torchtransient.units import SPEED_OF_LIGHT

_DARKEST = 1e3  # f-number of a pinhole; millimetres over metres are a thousand times those of lenses
_MOST_WATTS = 1e3  # on average, of a laser; nanojoules taken for joules are megawatts
_MOST_IRRADIANCE = 20.0  # W / (m^2 nm), ten suns; per micrometre and per metre are thousands
_LONGEST_S = 3600.0  # exposure of one histogram; megahertz taken for hertz make a million of it

PLANCK_J_S = 6.626_070_15e-34  # exact by the definition of the kilogram (SI)


def photon_energy_j(wavelength_m: float) -> float:
    """Energy of one photon: h c / wavelength.

    Args:
        wavelength_m: wavelength in metres, 10 nm to 1 mm.

    Returns:
        Joules.

    Raises:
        UnitError: for other wavelengths, such as those in nanometres.
    """
    wavelength = check_number(wavelength_m, "wavelength_m", "photon_energy_j", open_low=True)
    if not 1e-8 <= wavelength < 1e-3:
        raise UnitError(f"photon_energy_j: expected wavelength_m in metres, got {wavelength!r}. 532 nm is 532e-9.")
    return PLANCK_J_S * SPEED_OF_LIGHT / wavelength


@dataclass(frozen=True)
class Optics:
    """Lens and pixel.

    Attributes:
        f_number: focal length over diameter of the aperture.
        pixel_area_m2: active area of a pixel in m^2.
        transmission: share of light that filters and lenses let through.
        solid_angle_sr: solid angle of the light on the pixel in steradians, in place of the f-number, for sensors that
            are not behind a lens.

    Raises:
        UnitError: outside the ranges.
        ArgumentError: unless one of f-number and solid angle is given.
    """

    _: KW_ONLY
    f_number: float | None = None
    pixel_area_m2: float = 100e-12
    transmission: float = 1.0
    solid_angle_sr: float | None = None

    def __post_init__(self) -> None:
        check_one_of("Optics", {"f_number=": self.f_number, "solid_angle_sr=": self.solid_angle_sr})
        if self.f_number is not None:
            check_number(self.f_number, "f_number", "Optics", low=0.1, high=_DARKEST)
        if self.solid_angle_sr is not None:
            check_number(self.solid_angle_sr, "solid_angle_sr", "Optics", high=2 * math.pi, open_low=True)
        # a pixel larger than 1 cm^2 is most likely given in square micrometres
        check_number(self.pixel_area_m2, "pixel_area_m2", "Optics", high=1e-4, open_low=True)
        check_number(self.transmission, "transmission", "Optics", high=1.0)

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


@in_single
def ambient_photon_rate(
    optics: Optics,
    albedo: float | Tensor,
    *,
    spectral_irradiance_w_m2_nm: float,
    filter_bandwidth_m: float,
    wavelength_m: float,
    illumination: float | Tensor = 1.0,
) -> float | Tensor:
    """Ambient photons per second on a pixel that sees a diffuse surface in the sun: for `PhotonBudget`.

        rate = irradiance x bandwidth x illumination x albedo / pi x etendue / photon energy

    A Lambertian surface that fills the pixel (radiance E albedo / pi) and light of one wavelength are assumed; light of
    the sky belongs to the irradiance.

    Args:
        optics: lens and pixel.
        albedo: albedo of the surface, a number or a map (H, W), (..., C, H, W), between 0 and 1.
        spectral_irradiance_w_m2_nm: spectral irradiance of the sun on a surface that faces it, W / (m^2 nm), constant
            over the filter.
        filter_bandwidth_m: bandwidth of the filter in metres, 1 um and less.
        wavelength_m: wavelength in metres.
        illumination: cosine of the angle between sun and normal times the share of the sun that is not in shadow, a
            number or a map, 0 to 1.

    Returns:
        Photons per second: a number of numbers, a map of maps, differentiable in both.

    Raises:
        UnitError: outside the ranges.
        ShapeError: for maps that do not broadcast.
    """
    where = "ambient_photon_rate"
    energy = photon_energy_j(wavelength_m)
    irradiance = check_number(spectral_irradiance_w_m2_nm, "spectral_irradiance_w_m2_nm", where)
    if irradiance > _MOST_IRRADIANCE:
        raise UnitError(
            f"{where}: expected spectral_irradiance_w_m2_nm of at most {_MOST_IRRADIANCE:g} W / (m^2 nm), got "
            f"{irradiance:g}. The sun has up to 2.2; 1300 W / (m^2 um), or 1.3e9 W / m^3, are 1.3 of them."
        )
    bandwidth = check_number(filter_bandwidth_m, "filter_bandwidth_m", where)
    if bandwidth > 1e-6:
        raise UnitError(f"{where}: expected filter_bandwidth_m in metres, got {bandwidth!r}. 10 nm is 10e-9.")
    reflected = check_map(albedo, "albedo", where, high=1.0)
    lit = check_map(illumination, "illumination", where, high=1.0)
    if isinstance(reflected, Tensor) and isinstance(lit, Tensor):
        check_broadcast(where, albedo=reflected, illumination=lit)
    return irradiance * bandwidth * 1e9 / math.pi * optics.etendue_m2_sr / energy * reflected * lit


@dataclass(frozen=True, eq=False, repr=False)
class BudgetReport(TensorRecord):
    """Sources of the detections of a pixel. Rates per laser cycle, before pile-up and dead time.

    Attributes:
        signal_per_cycle: detections of laser light, (..., C, H, W).
        ambient_per_cycle: detections of ambient light in the whole window, a number, or a map where the budget has
            maps.
        dark_per_cycle: dark counts in the whole window, a number, or a map where the budget has maps.
        cycles: laser cycles of the exposure.
        exposure_s: duration of the exposure in seconds.
    """

    _: KW_ONLY
    signal_per_cycle: Tensor
    ambient_per_cycle: float | Tensor
    dark_per_cycle: float | Tensor
    cycles: int
    exposure_s: float

    @property
    def background_per_cycle(self) -> float | Tensor:
        """Ambient light and dark counts together: a number, or a map."""
        return self.ambient_per_cycle + self.dark_per_cycle

    @property
    def signal_to_background(self) -> Tensor:
        """Ratio of signal and background detections; infinite without background."""
        signal = self.signal_per_cycle
        background = torch.as_tensor(self.background_per_cycle, dtype=signal.dtype, device=signal.device)
        some = background > 0
        ratio = signal / torch.where(some, background, torch.ones_like(background))
        return torch.where(some, ratio, torch.full_like(ratio, math.inf))

    @property
    def piles_up(self) -> Tensor:
        """Mask of pixels with detections in more than 5 % of the cycles, above which first-photon pile-up shows."""
        return self.signal_per_cycle + self.background_per_cycle > 0.05


class PhotonBudget(Sensor):
    """Expected detections per laser cycle and bin of a transient (..., C, T, H, W) of radiance.

        rate = transient x pulse_energy_j x etendue x quantum_efficiency / photon energy + background

    The transient is rendered with an emitter of unit energy: W / (m^2 sr) per bin for a source of 1 W fired as one
    pulse of 1 J, so that times the pulse energy it is J / (m^2 sr). The background is spread evenly over the bins.

    Maps are (H, W), or broadcast to (..., C, H, W). An `nn.Parameter` is kept as one and learnt; other maps are
    buffers, in float64 (a map from a network: `torch.func.functional_call(budget, {name: map}, x)`). Learnt rates are
    in hertz, which no optimizer's steps suit: learn their logarithm (docs/photon_counting.md). A learnt number that has
    left its range is a UnitError of the next measurement. Not modelled: angle dependence of the filter, speckle;
    vignetting is a map of the efficiency as far as it acts on ambient and laser light alike.

    Args:
        optics: lens and pixel.
        pulse_energy_j: energy of a pulse in joules.
        wavelength_m: wavelength in metres.
        repetition_rate_hz: laser cycles per second.
        cycles: laser cycles of the exposure, or
        exposure_s: duration of the exposure in seconds.
        quantum_efficiency: probability that a photon is detected, a number or a map.
        ambient_rate_hz: ambient photons on the pixel per second, after the optics (detected: times the quantum
            efficiency), a number or a map; see `ambient_photon_rate`.
        dark_count_rate_hz: dark counts of a pixel per second, a number or a map; see `hot_pixel_rates`.
        axis: axis of the light, or
        bin_width_s: its bin width in seconds.

    Raises:
        UnitError: outside the ranges, for wavelengths in nanometres, for a window longer than a laser period, for more
            than 1 kW on average, for exposures of more than an hour or of less than one cycle.
        ShapeError: for maps of other images.
    """

    takes, gives = ("radiance",), "rate"

    dark_count_rate_hz: Tensor
    ambient_rate_hz: float | Tensor
    quantum_efficiency: float | Tensor

    def __init__(
        self,
        optics: Optics,
        *,
        pulse_energy_j: float,
        wavelength_m: float,
        repetition_rate_hz: float,
        cycles: int | None = None,
        exposure_s: float | None = None,
        quantum_efficiency: float | Tensor = 1.0,
        ambient_rate_hz: float | Tensor = 0.0,
        dark_count_rate_hz: float | Tensor = 0.0,
        axis: TimeAxis | None = None,
        bin_width_s: float | None = None,
    ) -> None:
        super().__init__()
        where = "PhotonBudget"
        if not isinstance(optics, Optics):
            raise UnitError(f"{where}: expected optics such as Optics(f_number=2.0), got {optics!r}.")
        self.optics = optics
        self.pulse_energy_j = check_number(pulse_energy_j, "pulse_energy_j", where, high=1e3)
        self.photon_energy_j = photon_energy_j(wavelength_m)
        self.wavelength_m = float(wavelength_m)
        self.repetition_rate_hz = check_number(repetition_rate_hz, "repetition_rate_hz", where, open_low=True)
        keep_map(self, "quantum_efficiency", check_map(quantum_efficiency, "quantum_efficiency", where, high=1.0))
        keep_map(self, "ambient_rate_hz", check_map(ambient_rate_hz, "ambient_rate_hz", where))
        dark = check_map(dark_count_rate_hz, "dark_count_rate_hz", where)
        keep_map(self, "dark_count_rate_hz", dark if isinstance(dark, Tensor) else torch.tensor(dark).double())
        self.bin_width_s, self.num_bins = bins_from(axis, bin_width_s, where)
        check_one_of(where, {"cycles=": cycles, "exposure_s=": exposure_s})
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
    def background_counts(self) -> float | Tensor:
        """Ambient and dark counts of a bin in the whole exposure, before pile-up: a number, or a map."""
        ambient = kept_map(self, "ambient_rate_hz") * kept_map(self, "quantum_efficiency", high=1.0)
        counts = torch.as_tensor(ambient + kept_map(self, "dark_count_rate_hz")) * (self.bin_width_s * self.cycles)
        return counts if counts.ndim else float(counts)

    @property
    def detections_per_unit(self) -> float | Tensor:
        """Detections per cycle for a radiance of 1 in a bin: a number, or a map where the efficiency is one."""
        photons = self.pulse_energy_j * self.optics.etendue_m2_sr / self.photon_energy_j
        return photons * kept_map(self, "quantum_efficiency", high=1.0)

    @in_single
    def signal(self, x: Tensor) -> Tensor:
        """Expected detections of laser light per cycle and bin, without background.

        Args:
            x: radiance (..., C, T, H, W).
        """
        check_transient(x, "PhotonBudget")
        window_s = x.shape[TIME] * self.bin_width_s
        # 1 in 1e6 for rates such as 1/(T dt) that were rounded on the way
        if window_s * self.repetition_rate_hz > 1 + 1e-6:
            raise UnitError(
                f"PhotonBudget: expected the window to fit into a laser period of {1 / self.repetition_rate_hz:g} s, "
                f"got {window_s:g} s. Lower repetition_rate_hz or use fewer bins."
            )
        scale = over_time(self.detections_per_unit, x, "quantum_efficiency", "PhotonBudget")
        return x * (scale.to(x.dtype) if isinstance(scale, Tensor) else scale)

    def _background_hz(self, x: Tensor) -> tuple[float | Tensor, Tensor]:
        """Ambient and dark detections per second, over the time of `x`, float64."""
        where = "PhotonBudget"
        ambient = over_time(kept_map(self, "ambient_rate_hz"), x, "ambient_rate_hz", where)
        efficiency = kept_map(self, "quantum_efficiency", high=1.0)
        ambient = ambient * over_time(efficiency, x, "quantum_efficiency", where)
        dark = over_time(kept_map(self, "dark_count_rate_hz"), x, "dark_count_rate_hz", where)
        return ambient, torch.as_tensor(dark)

    def expected(self, x: Tensor) -> Tensor:
        signal = self.signal(x)
        ambient_hz, dark_hz = self._background_hz(x)
        return signal + ((ambient_hz + dark_hz) * self.bin_width_s).to(x.dtype)

    @in_single
    def report(self, x: Tensor) -> BudgetReport:
        """Signal and background of every pixel.

        Args:
            x: radiance (..., C, T, H, W).

        Returns:
            Numbers, or maps where the budget has them.
        """
        signal = self.signal(x).sum(TIME)
        window_s = x.shape[TIME] * self.bin_width_s

        def shown(rate_hz: float | Tensor) -> float | Tensor:
            total = torch.as_tensor(rate_hz, dtype=torch.float64) * window_s
            return total.squeeze(TIME) if total.ndim >= 3 else float(total)

        ambient_hz, dark_hz = self._background_hz(x)
        return BudgetReport(
            signal_per_cycle=signal,
            ambient_per_cycle=shown(ambient_hz),
            dark_per_cycle=shown(dark_hz),
            cycles=self.cycles,
            exposure_s=self.exposure_s,
        )


def hot_pixel_rates(
    height: int,
    width: int,
    *,
    median_hz: float,
    log_std: float = 0.5,
    hot_fraction: float = 0.01,
    hot_factor: float = 100.0,
    generator: torch.Generator | None = None,
) -> Tensor:
    """Draw a map of dark count rates: log-normal around `median_hz`, some pixels `hot_factor` times that.

    Args:
        height, width: size of the map in pixels.
        median_hz: median in Hz.
        log_std: standard deviation of the natural logarithm.
        hot_fraction: share of hot pixels.
        hot_factor: rate of a hot pixel over that of others, at least 1.
        generator: source of randomness.

    Returns:
        (H, W) float64 in Hz, for `PhotonBudget(dark_count_rate_hz=...)`.
    """
    median = check_number(median_hz, "median_hz", where := "hot_pixel_rates")
    spread = check_number(log_std, "log_std", where)
    fraction = check_number(hot_fraction, "hot_fraction", where, high=1.0)
    factor = check_number(hot_factor, "hot_factor", where, low=1.0)
    size = [check_count(side, "height and width", where, low=0, most=MOST_MADE) for side in (height, width)]
    rates = median * torch.exp(spread * torch.randn(size, dtype=torch.float64, generator=generator))
    hot = torch.rand(size, dtype=torch.float64, generator=generator) < fraction
    return torch.where(hot, rates * factor, rates)
