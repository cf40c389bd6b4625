"""Devices by name. Like the named ones, not them: typical numbers with their sources, and assumptions marked so.

Optics and laser power belong to a set-up, not to a detector; those here make a transient of unit radiance a sensible
number of photons and are meant to be changed (`Device.changed("PhotonBudget", pulse_energy_j=...)`).
"""

from __future__ import annotations

from typing import Any

from torchtransient.checks import shown
from torchtransient.errors import ArgumentError
from torchtransient.sensing.devices import Device

_AXIS = "@axis"


# 20 of the finest steps, 17 ps, apart; the first opens late enough for its edge to lie in the window
_GATES_S = [round(0.68e-9 + 0.34e-9 * k, 14) for k in range(64)]


def _chip_budget(cycles: int, repetition_rate_hz: float) -> dict[str, Any]:
    """Budget of consumer chips, which say little about their insides: the same assumptions for all of them."""
    return {
        "kind": "PhotonBudget",
        "optics": {"kind": "Optics", "f_number": 2.0, "pixel_area_m2": 1e-8, "transmission": 0.6},
        "pulse_energy_j": 2e-10,
        "wavelength_m": 940e-9,
        "repetition_rate_hz": repetition_rate_hz,
        "cycles": cycles,
        "quantum_efficiency": 0.15,
        "ambient_rate_hz": 1e6,
        "dark_count_rate_hz": 1e4,
        "axis": _AXIS,
    }


def _zone() -> dict[str, Any]:
    """SPADs that share the light of a zone, each with a dead time of its own; their counts are summed."""
    spad = {"kind": "SynchronousSPAD", "cycles": "@cycles", "dead_time_s": 10e-9, "axis": _AXIS}
    return {"kind": "MacroPixel", "detector": spad, "spads": 100}


def _pulse(response: dict[str, Any]) -> dict[str, Any]:
    """Shape of the light: in front of the budget, which adds what is constant."""
    return {"kind": "ImpulseResponse", "response": response, "axis": _AXIS}


def _jitter(response: dict[str, Any]) -> dict[str, Any]:
    """Jitter of detections: behind the detector."""
    return {"kind": "DetectionJitter", "response": response, "axis": _AXIS}


def _counter(
    name: str, label: str, bin_width_s: float, jitter_fwhm_s: float, sources: tuple[str, ...], **counting: Any
) -> Device:
    """Counter; ``counting``: arguments of its `SynchronousSPAD`, none where it counts once per cycle."""
    often = "several detections" if counting else "one detection"
    return Device(
        name=name,
        description=f"{label}: a TCSPC histogrammer behind any detector, {often} per laser cycle. Takes the "
        "expected detections per cycle and bin, in counts.",
        sources=sources,
        stages=(
            {"kind": "SynchronousSPAD", "cycles": 100_000, **counting},
            _jitter({"kind": "GaussianResponse", "fwhm_s": jitter_fwhm_s}),
            {
                "kind": "TDC",
                "code_widths": {"kind": "tdc_code_widths", "num_bins": "@num_bins", "dnl_std": 0.005, "seed": 1},
            },
        ),
        bin_width_s=bin_width_s,
        num_bins=1024,
    )


_COUNTERS = (
    _counter(
        "picoharp300_like",
        "PicoHarp 300",
        64e-12,
        28e-12,
        (
            "PicoQuant, T2 mode (tcspc.com glossary): 4 ps resolution, 16 of them summed to one bin of 64 ps; dead "
            "time 95 ns, longer than the window of 65.5 ns, so that a cycle has one detection. Laser periods shorter "
            "than 161 ns begin with the input still dead, which is not modelled",
            "PicoQuant PHLib, phdefin.h: histograms of 65536 channels, of which this takes 1024",
            "assumed: timing uncertainty 12 ps rms, 28 ps fwhm; differential non-linearity 0.5 % rms (seed 1); 1e5 "
            "cycles",
        ),
    ),
    _counter(
        "hydraharp400_like",
        "HydraHarp 400",
        16e-12,
        28e-12,
        (
            "DESY, Tango device server of the HydraHarp 400: converters of 12.5 million counts per second, hence a "
            "dead time of 80 ns, longer than the window of 16.4 ns, so that a cycle has one detection. Laser periods "
            "shorter than 97 ns begin with the input still dead, which is not modelled",
            "PicoQuant HHLib: histograms of 65536 channels, of which this takes 1024",
            "assumed: resolution 1 ps, 16 of them summed to one bin; timing uncertainty 12 ps rms, 28 ps fwhm; "
            "differential non-linearity 0.5 % rms (seed 1); 1e5 cycles",
        ),
    ),
    _counter(
        "multiharp150_like",
        "MultiHarp 150, 80 ps model",
        80e-12,
        106e-12,
        (
            "Wahl et al., Photon arrival time tagging with many channels, sub-nanosecond deadtime (Rev. Sci. Instrum. "
            "2020, arXiv 2001.02424): resolution 80 ps, dead time 650 ps",
            "PicoQuant MultiHarp manual 3.1: base resolution 5, 10 or 80 ps by model; histograms of 65536 bins, of "
            "which this takes 1024",
            "assumed: timing uncertainty 45 ps rms, 106 ps fwhm; differential non-linearity 0.5 % rms (seed 1); 1e5 "
            "cycles. The detector's own dead time, mostly longer, is not in it",
        ),
        dead_time_s=650e-12,
        axis=_AXIS,
    ),
)

_SINGLE_PHOTON = (
    Device(
        name="mpd_spad_like",
        description="A fast thin-junction SPAD module with a TCSPC counter, one pixel scanned over the scene; first "
        "photon per cycle, afterpulses. Takes radiance, gives counts.",
        sources=(
            "O'Toole, Lindell & Wetzstein, Confocal non-line-of-sight imaging (Nature 2018), supplement: Micro Photon "
            "Devices PDM, active area 100 um x 100 um, 27 ps jitter, 40.9 dark counts per second, dead time 75 ns, "
            "afterpulsing 0.1 %; laser of 670 nm with 0.11 mW at 10 MHz, hence 11 pJ every 100 ns; bins of 4 ps "
            "summed to 16 ps. The whole system had 60 ps",
            "assumed: the pulse of the laser and all else in front of the detector 53 ps, so that 27 and 60 ps are "
            "those of the sources; 35 % efficiency at 670 nm; diffusion tail of 10 % with 60 ps; afterpulse time "
            "constant 30 ns; f/3, transmission 0.7; 1e4 ambient photons per second; 1e5 cycles, 1024 bins",
        ),
        stages=(
            _pulse({"kind": "GaussianResponse", "fwhm_s": 53e-12}),
            {
                "kind": "PhotonBudget",
                "optics": {"kind": "Optics", "f_number": 3.0, "pixel_area_m2": 1e-8, "transmission": 0.7},
                "pulse_energy_j": 11e-12,
                "wavelength_m": 670e-9,
                "repetition_rate_hz": 10e6,
                "cycles": 100_000,
                "quantum_efficiency": 0.35,
                "ambient_rate_hz": 1e4,
                "dark_count_rate_hz": 40.9,
                "axis": _AXIS,
            },
            {"kind": "SynchronousSPAD", "cycles": "@cycles"},
            _jitter({"kind": "TailedResponse", "fwhm_s": 27e-12, "tails_s": [60e-12], "fractions": [0.1]}),
            {
                "kind": "Afterpulsing",
                "probability": 0.001,
                "tau_s": 30e-9,
                "dead_time_s": 75e-9,
                "period_s": "@period_s",
                "background": "@background",
                "axis": _AXIS,
            },
        ),
        bin_width_s=16e-12,
        num_bins=1024,
    ),
    Device(
        name="vl53l8_like",
        description="A consumer time-of-flight chip: zones of summed SPADs, 128 bins of 250 ps, eye-safe infrared. "
        "Takes radiance, gives counts; render one pixel per zone (4 x 4, 65 degrees across the diagonal).",
        sources=(
            "STMicroelectronics VL53L8CX data sheet DS14161: 940 nm, 4 x 4 or 8 x 8 zones, 65 degrees diagonal, 4 m",
            "STMicroelectronics driver, vl53lmz_plugin_cnh.h: bins of 37.5348 mm one way, hence 250.4 ps; a pulse "
            "lies within 10 bins, here six standard deviations of 1 ns fwhm",
            "Public frames of a VL53L8 by sidsoma (MIT licence, 2025): 4 x 4 zones of 128 bins, some 40 of them "
            "filled; by the driver the chip hands out at most 75 bins of 16 zones at a time",
            "assumed: pulse and jitter together 1 ns, of which the detectors' jitter has 0.2 ns and the pulse 0.98 ns; "
            "a zone of 100 SPADs of 10 um (1e-8 m2) that share its light evenly, dead for 10 ns each, all of whose "
            "detections are counted; 15 % efficiency; 0.2 nJ at 5 MHz, 2e5 cycles; crosstalk 0.5 %; f/2, transmission "
            "0.6; 1e6 ambient photons and 1e4 dark counts per second and zone",
        ),
        stages=(
            _pulse({"kind": "GaussianResponse", "fwhm_s": 0.98e-9}),
            _chip_budget(200_000, 5e6),
            _zone(),
            _jitter({"kind": "GaussianResponse", "fwhm_s": 0.2e-9}),
            {"kind": "Crosstalk", "probability": 0.005},
        ),
        bin_width_s=250.4e-12,
        num_bins=128,
    ),
    Device(
        name="tmf882x_like",
        description="A consumer time-of-flight chip with fine bins: zones of summed SPADs, 128 bins of 88 ps, 1.7 m. "
        "Takes radiance, gives counts; render one pixel per zone (3 x 3, 63 degrees).",
        sources=(
            "ams OSRAM TMF8820/21/28 data sheet DS000693: 3 x 3 zones (others 4 x 4, 3 x 6, 8 x 8), 10 to 5000 mm, 63 "
            "degrees",
            "Public frames by sidsoma (MIT licence, 2025): 3 x 3 zones of 128 bins of 88 ps, time zero in bin 13. The "
            "echo of a wall in one of them, median of fits to nine zones: core of 129 ps, tails of 103 ps in 75 % and "
            "of 549 ps in 24 % of the light, 1.1 to 1.6 % of the peak left over (rms)",
            "Public drivers: 537 x 1024 = 549888 pulses per measurement by default",
            "assumed: of the core of 129 ps 100 ps are jitter of the detectors; the other 81 ps and the tails are the "
            "pulse's. 940 nm; a zone of 100 SPADs of 10 um (1e-8 m2) that share its light evenly, dead for 10 ns each, "
            "all of whose detections are counted; 15 % efficiency; 0.2 nJ at 20 MHz; f/2, transmission 0.6; 1e6 "
            "ambient photons and 1e4 dark counts per second and zone; no crosstalk",
        ),
        stages=(
            _pulse(
                {
                    "kind": "TailedResponse",
                    "fwhm_s": 81e-12,
                    "tails_s": [103e-12, 549e-12],
                    "fractions": [0.75, 0.24],
                }
            ),
            _chip_budget(549_888, 20e6),
            _zone(),
            _jitter({"kind": "GaussianResponse", "fwhm_s": 100e-12}),
        ),
        bin_width_s=88e-12,
        num_bins=128,
    ),
    Device(
        name="spad512s_like",
        description="A gated SPAD array of binary frames, in step with a pulsed laser: 64 gates one after another, 255 "
        "frames each. Takes radiance, gives how many frames saw a photon, (..., C, 64, H, W); photons per frame by "
        "tt.sensing.frames_to_rate(counts, 255).",
        sources=(
            "Pi Imaging SPAD512S (dealer's page, axiomoptics.com): 512 x 512 pixels, 50 % at 520 nm, below 25 dark "
            "counts per second, no read noise, 100 000 binary frames per second (10 us each), gates of 6 ns in steps "
            "of 17 ps",
            "assumed: f/2, transmission 0.7; 1 nJ at 20 MHz, hence 200 pulses per frame; pixels of 16.38 um with a "
            "fill factor of 10.5 % (2.8e-11 m2); gate edges of 0.2 ns; 64 gates 0.34 ns (20 steps) apart from 0.68 ns "
            "on, 255 frames each; 1e3 ambient photons per second; light in 600 bins of 50 ps",
        ),
        stages=(
            {
                "kind": "PhotonBudget",
                "optics": {"kind": "Optics", "f_number": 2.0, "pixel_area_m2": 2.8e-11, "transmission": 0.7},
                "pulse_energy_j": 1e-9,
                "wavelength_m": 520e-9,
                "repetition_rate_hz": 20e6,
                "cycles": 200,
                "quantum_efficiency": 0.5,
                "ambient_rate_hz": 1e3,
                "dark_count_rate_hz": 25.0,
                "axis": _AXIS,
            },
            {
                "kind": "GatedIntegration",
                "delays_s": _GATES_S,
                "widths_s": 6e-9,
                "rise_s": 0.2e-9,
                "electrons_per_unit": "@cycles",
                "axis": _AXIS,
            },
            {"kind": "BinaryFrames", "frames": 255},
        ),
        bin_width_s=50e-12,
        num_bins=600,
    ),
)

_CAMERAS = (
    Device(
        name="kinect_v2_like",
        description="A consumer indirect time-of-flight camera: pixels of two taps, three modulation frequencies with "
        "three phase steps each. Takes electrons per unit of radiance and bin, gives the differences of the taps in "
        "electrons, (..., C, 9, H, W); depth by tt.sensing.read_itof(frames, (120e6, 80e6, 16e6), 3, "
        "readout='differential', max_depth_m=8).",
        sources=(
            "libfreenect2, driver by the OpenKinect project: phases of 0, 120 and 240 degrees, 3 of them at each of "
            "16, 80 and 120 MHz, which repeat together after 18.7 m; also Jaremo Lawin et al. (ECCV 2016). Signed "
            "frames of 11 bits, packed unevenly, which is left out here",
            "Sell & O'Connor, The Xbox One system on a chip and Kinect sensor (IEEE Micro 2014); Bamji et al. (IEEE "
            "JSSC 2015): differential pixels of two taps",
            "assumed: square codes; one contrast of 0.6 for all frequencies (Bamji et al., IEEE JSSC 2015, go up to "
            "130 MHz); full well 60 000 electrons, 20 electrons read noise; each tap with 10 bit, 60 electrons per "
            "number, black level 16, hence differences of 11 bit; 2e4 electrons per unit and frequency, 500 of "
            "background; light in 1200 bins of 50 ps",
        ),
        stages=(
            {
                "kind": "ItofCorrelation",
                "code": {"kind": "TwoTapCode", "code": {"kind": "square_code", "num_taps": 3}},
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
            {"kind": "TapDifference"},
        ),
        bin_width_s=50e-12,
        num_bins=1200,
    ),
    Device(
        name="imx250mzr_like",
        description="A polarization camera with a mosaic of four linear analysers. Takes Stokes vectors in electrons, "
        "(..., 4, C, T, H, W), gives raw electrons (..., C, T, H, W); see PolarizationMosaic.stokes.",
        sources=(
            "Teledyne DALSA Genie Nano manual, M2450-Polarized: IMX250MZR, 3.45 um pixels, 12 bit, full well 11 000 "
            "electrons, hence 2.7 per number; dynamic range 76.4 dB, hence a read noise of 1.7 electrons",
            "Sony's flyer, as users quote it: extinction ratio 300 at 525 nm, 425 at 430 nm. A commercial mosaic "
            "imager had a contrast above 300 at 532 nm, but 20 to 30 in broad light (Montana State University, 2020)",
            "Beckhoff TwinCAT Vision and others: 90 and 45 over 135 and 0 degrees",
            "assumed: transmission 0.8; black level 16",
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
            "Velten et al., Imaging the propagation of light through scenes at picosecond resolution (CACM 2016): "
            "frames of 1.85 ps; their page Visualizing light at trillion FPS: 480 frames",
            "Hamamatsu C5680, their camera: 2 ps nominal resolution (Wikipedia, Femto-photography). An earlier set-up "
            "with it is reported to have had 15 ps in effect (Velten et al., Nature Communications 2012)",
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
        bin_width_s=1.85e-12,
        num_bins=480,
    ),
)

_DEVICES = (*_COUNTERS, *_SINGLE_PHOTON, *_CAMERAS)

DEVICES = {d.name: d for d in _DEVICES}


def device(name: str) -> Device:
    """Return the device of a name; `DEVICES` holds them all.

    Args:
        name: name of the device.

    Raises:
        ArgumentError: for another name.
    """
    if not isinstance(name, str) or name not in DEVICES:
        raise ArgumentError(f"device: expected one of {', '.join(sorted(DEVICES))}, got {shown(name)}.")
    return DEVICES[name]
