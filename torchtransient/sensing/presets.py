"""Devices by name. Like the named ones, not them: typical numbers with their sources, and assumptions marked so.

Optics and laser power belong to a set-up, not to a detector; those here make a transient of unit radiance a sensible
number of photons and are meant to be changed (`Device.changed("PhotonBudget", pulse_energy_j=...)`).
"""

from __future__ import annotations

from typing import Any

from torchtransient.errors import StorageError
from torchtransient.sensing.devices import Device

_AXIS = "@axis"


def _spad_budget(**changes: Any) -> dict[str, Any]:
    return {
        "kind": "PhotonBudget",
        "optics": {"kind": "Optics", "f_number": 2.0, "pixel_area_m2": 2.0e-9, "transmission": 0.7},
        "pulse_energy_j": 1.0e-9,
        "wavelength_m": 532e-9,
        "repetition_rate_hz": 10e6,
        "cycles": 100_000,
        "axis": _AXIS,
        **changes,
    }


def _counter(name: str, label: str, resolution_s: float, dead_time_s: float, source: str) -> Device:
    return Device(
        name=name,
        description=f"{label}: a TCSPC histogrammer behind any detector, one detection per laser cycle. Takes the "
        "expected detections per cycle and bin, in counts.",
        sources=(
            source,
            f"base resolution {resolution_s * 1e12:g} ps, electrical time uncertainty below 12 ps rms, 65536 bins, "
            f"dead time {dead_time_s * 1e9:g} ns, so that a second photon of a 100 ns cycle is not counted",
            "assumed: differential non-linearity 0.5 % rms; 16 base bins are summed to one of the default axis",
        ),
        stages=(
            {"kind": "ImpulseResponse", "response": {"kind": "GaussianResponse", "fwhm_s": 28e-12}, "axis": _AXIS},
            {
                "kind": "TDC",
                "code_widths": {"kind": "tdc_code_widths", "num_bins": "@num_bins", "dnl_std": 0.005, "seed": 1},
            },
            {"kind": "SynchronousSPAD", "cycles": 100_000},
        ),
        bin_width_s=16 * resolution_s,
        num_bins=1024,
    )


_DEVICES = (
    Device(
        name="mpd_spad_like",
        description="A fast thin-junction SPAD module with a TCSPC counter, one pixel scanned over the scene; first "
        "photon per cycle, afterpulses. Takes radiance, gives counts.",
        sources=(
            "O'Toole, Lindell & Wetzstein, Confocal non-line-of-sight imaging (Nature 2018), detector: Micro Photon "
            "Devices PDM, 27 ps jitter, dead time 75 ns, afterpulsing 0.1 %, laser at 10 MHz",
            "40 % efficiency at 532 nm: detector of Li et al., NLOST (CVPR 2023); 41 dark counts per second: a cooled "
            "module of 100 um of the same maker",
            "assumed: diffusion tail of 10 % with 60 ps; afterpulse time constant 30 ns; f/2, 50 um spot, 1 nJ pulses",
        ),
        stages=(
            _spad_budget(quantum_efficiency=0.4, dark_count_rate_hz=41.0, ambient_rate_hz=1e4),
            {
                "kind": "ImpulseResponse",
                "response": {"kind": "TailedResponse", "fwhm_s": 27e-12, "tails_s": [60e-12], "fractions": [0.1]},
                "axis": _AXIS,
            },
            {"kind": "SynchronousSPAD", "cycles": 100_000},
            {
                "kind": "Afterpulsing",
                "probability": 0.001,
                "tau_s": 30e-9,
                "dead_time_s": 75e-9,
                "period_s": 100e-9,
                "axis": _AXIS,
            },
        ),
        bin_width_s=16e-12,
        num_bins=1024,
    ),
    Device(
        name="vl53l8_like",
        description="A consumer time-of-flight chip: zones of summed SPADs, 128 bins of 250 ps, eye-safe infrared. "
        "Takes radiance, gives counts; render one pixel per zone (4 x 4).",
        sources=(
            "STMicroelectronics VL53L8CX data sheet DS14161: 940 nm, 4 x 4 or 8 x 8 zones, 65 degrees diagonal, 4 m",
            "128 bins of 250 ps, histograms of 4 x 4 zones: public frames of a VL53L8 by sidsoma (MIT licence, 2025)",
            "assumed: pulse and jitter together 1 ns; dead time 10 ns; 15 % efficiency; 5 MHz, 2e5 cycles; crosstalk "
            "0.5 %; f/2 and a zone of 100 SPADs of 10 um",
        ),
        stages=(
            {
                "kind": "PhotonBudget",
                "optics": {"kind": "Optics", "f_number": 2.0, "pixel_area_m2": 1e-8, "transmission": 0.6},
                "pulse_energy_j": 2e-10,
                "wavelength_m": 940e-9,
                "repetition_rate_hz": 5e6,
                "cycles": 200_000,
                "quantum_efficiency": 0.15,
                "ambient_rate_hz": 1e6,
                "dark_count_rate_hz": 1e4,
                "axis": _AXIS,
            },
            {"kind": "ImpulseResponse", "response": {"kind": "GaussianResponse", "fwhm_s": 1e-9}, "axis": _AXIS},
            {"kind": "SynchronousSPAD", "cycles": 200_000, "dead_time_s": 10e-9, "axis": _AXIS},
            {"kind": "Crosstalk", "probability": 0.005},
        ),
        bin_width_s=250e-12,
        num_bins=128,
    ),
    _counter("picoharp300_like", "PicoHarp 300", 4e-12, 95e-9, "PicoQuant PicoHarp 300 manual, technical data"),
    _counter("hydraharp400_like", "HydraHarp 400", 1e-12, 80e-9, "PicoQuant HydraHarp 400 manual, technical data"),
    Device(
        name="kinect_v2_like",
        description="A consumer indirect time-of-flight camera: three modulation frequencies with three taps each. "
        "Takes electrons per unit of radiance and bin, gives electrons, (..., C, 9, H, W); depth by "
        "tt.sensing.read_itof(taps, (120e6, 80e6, 16e6), 3, max_depth_m=8).",
        sources=(
            "Bamji et al., A 0.13 um CMOS system-on-chip for a 512 x 424 time-of-flight image sensor (IEEE JSSC 2015): "
            "up to 130 MHz, modulation contrast 67 % at 50 MHz, 10 um pixels, 10 bit converter",
            "Sell & O'Connor, The Xbox One system on a chip and Kinect sensor (IEEE Micro 2014): several frequencies "
            "unwrapped together; 120, 80 and 16 MHz",
            "assumed: one contrast of 0.6 for all frequencies; full well 60 000 electrons, 20 electrons read noise",
        ),
        stages=(
            {
                "kind": "ItofCorrelation",
                "code": {"kind": "square_code", "num_taps": 3},
                "frequencies_hz": [120e6, 80e6, 16e6],
                "axis": _AXIS,
                "contrast": 0.6,
                "electrons_per_unit": 2e4,
                "background_e": 500.0,
            },
            {
                "kind": "PixelElectronics",
                "full_well_e": 60_000.0,
                "read_noise_e": 20.0,
                "gain_e_per_dn": 60.0,
                "bits": 10,
                "black_level_dn": 16.0,
            },
        ),
        bin_width_s=50e-12,
        num_bins=1200,
    ),
    Device(
        name="imx250mzr_like",
        description="A polarization camera with a mosaic of four linear analysers. Takes Stokes vectors in electrons, "
        "(..., 4, C, T, H, W), gives raw electrons (..., C, T, H, W); see PolarizationMosaic.stokes.",
        sources=(
            "Sony IMX250MZR (Polarsens): 2 x 2 mosaic of 90, 45, 135 and 0 degrees, 3.45 um pixels",
            "Teledyne DALSA Genie Nano M2450-Polarized specifications: full well 11 000 electrons, dynamic range "
            "76.4 dB, hence a read noise of 1.7 electrons; 12 bit",
            "assumed: extinction ratio 300 (reported 100 to 400 over the visible), transmission 0.8",
        ),
        stages=(
            {"kind": "polarsens", "extinction_ratio": 300.0, "transmission": 0.8},
            {
                "kind": "PixelElectronics",
                "full_well_e": 11_000.0,
                "read_noise_e": 1.7,
                "gain_e_per_dn": 2.7,
                "bits": 12,
                "black_level_dn": 16.0,
            },
        ),
    ),
    Device(
        name="streak_2ps_like",
        description="A streak camera of 2 ps resolution. Takes photoelectrons per bin, gives electrons.",
        sources=(
            "Velten et al., Femto-photography: capturing and visualizing the propagation of light (ACM TOG 2013): 2 ps "
            "resolution, additive read noise",
            "assumed: 1 ps jitter of a sweep, 1000 sweeps; excess noise 1.5; spot sizes 1.5 pixels; read noise 0.5",
        ),
        stages=(
            {
                "kind": "StreakCamera",
                "axis": _AXIS,
                "time_fwhm_s": 2e-12,
                "spatial_fwhm_px": 1.5,
                "phosphor_fwhm_px": 1.5,
                "jitter_fwhm_s": 1e-12,
                "sweeps": 1000,
                "excess_noise": 1.5,
                "read_noise_e": 0.5,
            },
        ),
        bin_width_s=1e-12,
        num_bins=512,
    ),
)

DEVICES = {d.name: d for d in _DEVICES}


def device(name: str) -> Device:
    """The device of that name; `DEVICES` holds them all. Raises StorageError for another name."""
    if name not in DEVICES:
        raise StorageError(f"device: expected one of {', '.join(sorted(DEVICES))}, got {name!r}.")
    return DEVICES[name]
