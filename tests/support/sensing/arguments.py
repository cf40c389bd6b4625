"""Arguments that hold real numbers, of everything public in `torchtransient.sensing`: one good call of each."""

from __future__ import annotations

import torch

from support.sensing.all_entries import ENTRIES
from torchtransient import sensing
from torchtransient.axes import FrequencyAxis, TimeAxis
from torchtransient.chirps import Chirps

AXIS = TimeAxis.from_seconds(0.0, 1e-10, 12)
RESPONSE = sensing.GaussianResponse(3e-10)
CHIRPS = Chirps(1e9, 1e-5, 1550e-9)
OPTICS = sensing.Optics(f_number=2.0)
SPAD = sensing.SynchronousSPAD(100)


def rand(*shape, low=0.1, high=1.0, seed=0):
    return low + (high - low) * torch.rand(shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


LIGHT = rand(1, 12, 2, 3)
KERNEL = torch.tensor([0.25, 0.5, 0.25], dtype=torch.float64)
COUNTS = (20 * LIGHT).round()
STOKES = torch.cat([1.5 + rand(1, 1, 2, 2, 2), rand(3, 1, 2, 2, 2) - 0.5])
TAPS = rand(1, 4, 2, 2)
ROWS = sensing.linear_analyzers([0.0, 45.0, 90.0, 135.0])
PHASOR = torch.complex(rand(1, 2, 2, 2), rand(1, 2, 2, 2, seed=1))
DELAYS = {"time_s": 1e-9 * rand(5), "mean_s": 1e-10 * rand(1), "sigma_s": 1e-10 * rand(1), "tau_s": 2e-10 * rand(1)}
TIMED = {"axis": AXIS}


def number(value):
    return torch.tensor(value, dtype=torch.float64)


# name: (arguments that hold real numbers, the others)
CALLS = {
    "Afterpulsing": (
        {"probability": number(0.1), "tau_s": number(1e-9), "dead_time_s": number(1e-10), "bin_width_s": number(1e-10),
         "period_s": number(2e-9), "background": rand(2, 3)}, {}),
    "Analyzers": ({"rows": ROWS}, {}),
    "BeatNoise": ({"photons_per_unit": number(20.0), "looks": number(4.0)}, {}),
    "CodedHistogram": ({"codes": rand(3, 12)}, {}),
    "CoherentReceiver": (
        {"photons_per_unit": number(20.0), "looks": number(4.0)},
        {"chirps": CHIRPS, "axis": CHIRPS.time_axis((0.0, 0.4), bins_per_line=4)}),
    "CoincidencePixel": (
        {"window_s": number(1e-9), "weights": rand(4), "bin_width_s": number(1e-10)},
        {"detector": sensing.SynchronousSPAD(100, dead_time_s=2e-9, bin_width_s=1e-10), "spads": 4, "coincidence": 2}),
    "Crosstalk": ({"probability": number(0.01), "diagonal_ratio": number(0.1)}, {}),
    "DetectionJitter": ({"bin_width_s": number(1e-10)}, {"response": RESPONSE}),
    "DetectionSkew": ({"delay_s": 1e-10 * rand(2, 3), "bin_width_s": number(1e-10)}, {}),
    "FourierCode": ({}, {"num_taps": 4, "harmonics_of_one_tap": {1: (0.5, 0.1)}}),
    "FreeRunningSPAD": ({"dead_time_s": number(3e-10), "bin_width_s": number(1e-10)}, {"cycles": 10}),
    "GatedIntegration": (
        {"delays_s": 1e-10 * rand(2), "widths_s": 4e-10 * rand(2), "rise_s": number(1e-11), "fall_s": number(1e-11),
         "leakage": number(0.1), "electrons_per_unit": number(2.0)}, TIMED),
    "GaussianResponse": ({"fwhm_s": number(1e-10), "delay_s": number(1e-10)}, {}),
    "ImpulseResponse": ({"bin_width_s": number(1e-10)}, {"response": RESPONSE}),
    "ItofCalibration": (
        {"phase_offset_rad": number(0.2), "phase_map_rad": rand(2, 3), "depth_map_m": 0.1 * rand(2, 3)}, {}),
    "ItofCorrelation": (
        {"frequencies_hz": number(60e6), "contrast": number(0.5), "background_e": number(2.0),
         "electrons_per_unit": number(2.0)}, {"code": sensing.sine_code(4), **TIMED}),
    "ItofNoise": (
        {"electrons_per_unit": number(2.0), "read_noise_e": number(2.0), "offset_e": rand(2, 2), "std_e": rand(2, 2)},
        {}),
    "LensBlur": ({"fwhm_px": number(1.5)}, {}),
    "MacroPixel": ({"weights": rand(4)}, {"detector": SPAD, "spads": 4}),
    "MeasuredDelays": (
        {"counts": rand(12), "bin_width_s": number(1e-9), "start_s": number(1e-9), "floor": number(0.01)}, {}),
    "MeasuredResponse": (
        {"counts": rand(12), "bin_width_s": number(1e-10), "delay_s": number(1e-10), "floor": number(0.05)}, {}),
    "Optics": (
        {"f_number": number(2.0), "pixel_area_m2": number(1e-10), "transmission": number(0.5)}, {}),
    "PhotonBudget": (
        {"pulse_energy_j": number(1e-9), "wavelength_m": number(5e-7), "repetition_rate_hz": number(1e6),
         "exposure_s": number(1e-3), "quantum_efficiency": rand(2, 3), "ambient_rate_hz": rand(2, 3),
         "dark_count_rate_hz": rand(2, 3), "bin_width_s": number(1e-10)}, {"optics": OPTICS}),
    "PiecewiseLinearCode": (
        {"knots": torch.linspace(0, 0.9, 5).double().expand(3, 5), "values": rand(3, 5), "shifts": rand(3)}, {}),
    "PixelElectronics": (
        {"full_well_e": number(1e4), "read_noise_e": number(2.0), "ktc_noise_e": number(2.0),
         "excess_noise": number(1.2), "dark_e": number(1.0), "gain_e_per_dn": number(2.0),
         "black_level_dn": number(4.0), "gain_map": rand(2, 3), "offset_map_e": rand(2, 3)}, {"bits": 8}),
    "PixelSkew": ({"delay_s": 1e-10 * rand(2, 3), "bin_width_s": number(1e-10)}, {}),
    "PolarizationMosaic": ({"rows": ROWS.reshape(2, 2, 4)}, {}),
    "PowerLawDelays": ({"exponent": number(1.2), "longest_s": number(1e-6)}, {}),
    "Speckle": ({"looks": number(4.0)}, {}),
    "SpatialPSF": ({"psf": rand(3, 3)}, {}),
    "StreakCamera": (
        {"time_fwhm_s": number(2e-10), "spatial_fwhm_px": number(1.5), "phosphor_fwhm_px": number(1.0),
         "jitter_fwhm_s": number(1e-10), "excess_noise": number(1.5), "read_noise_e": number(0.5),
         "full_well_e": number(1e4), "gain_e_per_dn": number(2.0), "black_level_dn": number(1.0)},
        {**TIMED, "bits": 8}),
    "SweepJitter": ({"jitter_fwhm_s": number(1e-10), "bin_width_s": number(1e-10)}, {}),
    "SynchronousSPAD": (
        {"gate": rand(12), "dead_time_s": number(3e-10), "bin_width_s": number(1e-10)}, {"cycles": 10}),
    "TDC": ({"code_widths": 0.9 + 0.2 * rand(12), "offset_bins": number(0.5)}, {}),
    "TailedResponse": (
        {"fwhm_s": number(1e-10), "tails_s": 1e-10 * rand(2), "fractions": 0.4 * rand(2),
         "delay_s": number(1e-10)}, {}),
    "UniformResponse": ({"width_s": number(1e-10), "delay_s": number(1e-10)}, {}),
    # ------------------------------------------------------------------------------------------------- functions
    "add_afterpulses": ({"counts": COUNTS, "probability": number(0.1), "kernel": 0.1 * rand(12)}, {}),
    "add_crosstalk": ({"counts": COUNTS, "probability": number(0.1), "diagonal": number(0.02)}, {}),
    "ambient_photon_rate": (
        {"albedo": rand(2, 3), "spectral_irradiance_w_m2_nm": number(1.3), "filter_bandwidth_m": number(1e-8),
         "wavelength_m": number(7e-7), "illumination": rand(2, 3)}, {"optics": OPTICS}),
    "amplitude_of": ({"phasor": PHASOR}, {}),
    "analyze": ({"stokes": STOKES, "rows": ROWS}, {}),
    "binary_code": (
        {"light_duty": number(0.5), "shifts": rand(3)}, {"gates": [[(0.0, 0.5)], [(0.2, 0.7)], [(0.4, 0.9)]]}),
    "blur_image": ({"x": LIGHT, "psf": rand(3, 3)}, {}),
    "center_of_mass": ({"histogram": COUNTS, "background": number(0.5)}, {}),
    "circular_analyzers": ({"extinction_ratio": number(100.0), "transmission": number(0.5)}, {}),
    "coates": ({"counts": 0.1 * COUNTS, "dead_bins": number(3.0)}, {"cycles": 100}),
    "convolve_time": ({"x": LIGHT, "kernel": KERNEL}, {}),
    "correlate": ({"transient": LIGHT, "weights": rand(4, 12)}, {}),
    "crlb": ({"distance_m": 0.09 * rand(1), "signal": 100 * rand(1), "background": rand(1)},
             {"response": RESPONSE, **TIMED}),
    "decode_code": ({"taps": TAPS}, {"code": sensing.sine_code(4)}),
    "defocus_psf": ({"radius_px": number(1.5)}, {}),
    "demosaic": ({"raw": rand(1, 2, 4, 4)}, {}),
    "depth_of_phase": ({"phase": rand(2, 2), "frequency_hz": number(60e6)}, {}),
    "distance_of_position": ({"position": 10 * rand(2, 3)}, TIMED),
    "detections_with_dead_time": ({"rate": LIGHT, "dead_bins": number(2.5)}, {}),
    "emg_cdf": (DELAYS, {}),
    "emg_survival": (DELAYS, {}),
    "emg_response": ({"fwhm_s": number(1e-10), "tau_s": number(1e-10), "delay_s": number(1e-10)}, {}),
    "equi_depth_edges": ({"counts": COUNTS}, {"depth": 2}),
    "first_photon_log_prob": ({"counts": COUNTS, "rate": 0.1 * LIGHT, "dead_bins": number(3.0)}, {"cycles": 1000}),
    "first_photon_probabilities": ({"rate": LIGHT}, {}),
    "fold_beats": ({"beats": LIGHT}, {"axis": CHIRPS.time_axis((0.0, 0.4))}),
    "first_return": ({"histogram": COUNTS, "threshold": number(5.0)}, {}),
    "fixed_pattern": ({"spread": number(0.1), "center": number(1.0)}, {"shape": (2, 3)}),
    "frames_to_rate": ({"counts": COUNTS}, {"frames": 100}),
    "free_running_rate": ({"rate_hz": 1e6 * rand(3), "dead_time_s": number(1e-8)}, {}),
    "gate_profiles": (
        {"delays_s": 1e-10 * rand(2), "widths_s": 4e-10 * rand(2), "rise_s": number(1e-11), "fall_s": number(1e-11),
         "leakage": number(0.1)}, TIMED),
    "gaussian_noise": ({"variance": LIGHT}, {}),
    "gaussian_psf": ({"fwhm_px": number(1.5)}, {"size": 5}),
    "hot_pixel_rates": (
        {"median_hz": number(100.0), "log_std": number(0.5), "hot_fraction": number(0.1), "hot_factor": number(10.0)},
        {"height": 2, "width": 3}),
    "ktc_noise": ({"capacitance_f": number(1e-14), "temperature_k": number(300.0)}, {}),
    "linear_analyzers": (
        {"angles_deg": 90 * rand(3), "extinction_ratio": number(100.0), "transmission": number(0.5)}, {}),
    "log_matched_filter": (
        {"histogram": COUNTS, "kernel": KERNEL, "signal_to_background": number(100.0)}, {}),
    "measured_code": ({"samples": rand(3, 12) - 0.5}, {}),
    "ml_position": (
        {"histogram": COUNTS, "bin_width_s": number(1e-10), "signal_to_background": number(100.0)},
        {"response": RESPONSE}),
    "mosaic_rows": (
        {"angles_deg": 90 * rand(2, 2), "extinction_ratio": number(100.0), "transmission": number(0.5)}, {}),
    "heterodyne_speed": (
        {"beat": 0.1 * PHASOR, "plain": PHASOR, "frequencies_hz": number(60e6), "duration_s": number(5e-3)},
        {"beats": 2}),
    "multi_return": ({"scores": LIGHT, "threshold": number(0.5)}, {"max_returns": 2}),
    "nonparalyzable_histogram": ({"rate": LIGHT, "dead_bins": number(2.5)}, {}),
    "offset_of": ({"taps": TAPS}, {"num_taps": 4}),
    "paralyzable_histogram": ({"rate": LIGHT, "dead_bins": number(2.5)}, {}),
    "peak_position": ({"scores": LIGHT}, {}),
    "phase_noise_rad": (
        {"amplitude": rand(2, 3), "offset": rand(2, 3), "read_noise_e": number(2.0)}, {"num_taps": 4}),
    "phase_of": ({"phasor": PHASOR}, {}),
    "photon_energy_j": ({"wavelength_m": number(5e-7)}, {}),
    "poisson_log_prob": ({"counts": COUNTS, "mean": LIGHT}, {}),
    "project_physical": ({"stokes": STOKES}, {}),
    "random_code_widths": ({"dnl_std": number(0.01)}, {"num_bins": 12}),
    "range_deviation_m": ({"response_fwhm_s": number(1e-10), "detections": 100 * rand(3)}, {}),
    "range_and_speed": (
        {"beats": torch.stack([LIGHT, LIGHT.flip(1)], 1), "threshold": number(0.0)},
        {"chirps": CHIRPS, "axis": CHIRPS.time_axis((0.0, 0.4)), "bins": "samples"}),
    "read_itof": (
        {"taps": TAPS, "frequencies_hz": number(60e6), "max_depth_m": number(2.4), "min_depth_m": number(0.0)},
        {"num_taps": 4}),
    "resample_counts": (
        {"counts": rand(12), "width_s": number(1e-10), "edges_s": 1e-10 * torch.arange(6.0).double(),
         "start_s": number(1e-11)}, {}),
    "return_rates": ({"distance_m": 0.09 * rand(2, 3), "signal": 100 * rand(2, 3), "background": rand(2, 3)},
                     {"response": RESPONSE, **TIMED}),
    "shift_time": ({"x": LIGHT, "delay_bins": rand(2, 3)}, {}),
    "soft_argmax": ({"scores": LIGHT, "temperature": number(0.5)}, {}),
    "square_code": ({"light_duty": number(0.5), "gate_duty": number(0.4)}, {}),
    "stokes_from": ({"measurements": rand(4, 1, 2, 2, 2), "rows": ROWS}, {}),
    "straight_through": ({"sample": COUNTS, "mean": LIGHT}, {}),
    "tap_phasor": ({"taps": TAPS}, {"num_taps": 4}),
    "tap_weights": ({"frequencies_hz": number(60e6), "contrast": number(0.5)}, {"code": sensing.sine_code(4), **TIMED}),
    "taps_from_phasor": (
        {"phasor": torch.complex(rand(1, 2, 2, 2), rand(1, 2, 2, 2, seed=1)), "frequencies_hz": number(60e6),
         "steady": rand(1, 2, 2), "contrast": number(0.5)},
        {"phasor_axis": FrequencyAxis.from_hertz([0.0, 60e6]), "code": sensing.sine_code(4)}),
    "unambiguous_range_m": ({"frequencies_hz": number(60e6)}, {}),
    "unphysical_part": ({"stokes": STOKES.neg()}, {}),
    "unwrap_depth": (
        {"phase": rand(1, 2, 2, 2), "frequencies_hz": torch.tensor([80e6, 60e6]).double(),
         "max_depth_m": number(7.0), "min_depth_m": number(0.0)}, {}),
    "wrapped_difference": ({"a": 6 * rand(3), "b": 6 * rand(3, seed=1)}, {}),
}  # fmt: skip

CALLS |= {type(entry.make()).__name__: entry.call for entry in ENTRIES if entry.call is not None}

# What takes no real numbers of its own, or takes modules, records and names.
OTHERS = {
    "AddedCounts", "AfterpulseDelays", "AfterpulsingSPAD", "BinaryFrames", "BudgetReport", "CoatesEstimate", "Compose",
    "ComposedResponse", "CorrelationCode", "CramerRaoBound", "Device", "EquiDepthHistogram", "GradPolicy",
    "ItofReading", "MovedCounts", "Moves",
    "PixelGroups", "RandomSensor", "Response", "Returns", "ReversedCode", "ScoreFunction", "Sensor",
    "ShotNoise", "TapDifference", "TwoTapCode", "ZoneSum", "adjoint", "axis_with_margin", "build_stage",
    "counting_chain", "covariance_bound", "deepinv_physics", "device", "distance_to_points", "fourier_codes",
    "hamiltonian_code", "linearity_error", "sine_code",
    # its pulses are arguments of any number
    "apply_pulse",
    # draws and medians have no derivative, and say so
    "poisson", "sample_detections",
}  # fmt: skip

# Arguments that decide and do not flow: thresholds, orders, whole numbers, positions of what is found.
DECIDE = {
    ("multi_return", "threshold"), ("first_return", "threshold"), ("unwrap_depth", "min_depth_m"),
    ("unwrap_depth", "max_depth_m"), ("straight_through", "sample"),
    ("range_and_speed", "threshold"), ("read_itof", "min_depth_m"), ("read_itof", "max_depth_m"),
}  # fmt: skip
