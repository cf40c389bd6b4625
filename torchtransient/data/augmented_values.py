"""Values of a sample that stay true when its image is mapped.

By their keys alone: a stored sample has no plugins to ask. Tests compare the names with the table of parameters
(plugins/parameter_effect.py).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from torchtransient.data.operations import PixelMap
from torchtransient.errors import SceneError
from torchtransient.plugins.mitsuba_compat import VERTEX_COLUMNS

# True in a mirror and for every camera, textures of surfaces too, which follow the coordinates `uv`.
UNAFFECTED = frozenset(
    (
        "reflectance", "transmittance", "diffuse_reflectance", "specular_reflectance", "specular_transmittance",
        "base_color", "opacity", "weight", "quantum_yield", "elastic_fraction", "metallic", "spec_trans", "spec_tint",
        "sheen", "sheen_tint", "clearcoat", "clearcoat_gloss", "anisotropic", "flatness", "diff_trans", "specular",
        "alpha", "alpha_u", "alpha_v", "roughness", "longitudinal_roughness", "azimuthal_roughness", "eumelanin",
        "pheomelanin", "sigma_a", "eta", "k", "int_ior", "ext_ior", "material", "delta", "lifetime", "albedo",
        "sigma_t", "scale", "g", "radiance", "intensity", "irradiance", "energy", "sky_scale", "sun_scale", "turbidity",
        "temperature", "wavelengths", "cutoff_angle", "beam_width", "radius", "aperture_radius", "focus_distance",
        "near_clip", "far_clip", "share",
    )
)  # fmt: skip
# Textures of projectors, in the projector's frame.
_THROWN = frozenset(("intensity", "irradiance", "energy"))
# Of the world: false in a mirror, true for another camera.
OF_THE_WORLD = frozenset(
    (
        "position", "positions", "direction", "center", "linear", "angular", "p0", "p1", "control_points", "data",
        "grid", "extent",
        "opacities", "value", "values", "sun_direction", "theta", "left_handed", "normalmap", "nested_texture",
        "texture", "S", "to_uv", "filename", "bsdf", "scale_tilt", "volume", "color0", "color1", "latitude",
        "longitude", "timezone", "year", "month", "day", "hour", "minute", "second", *VERTEX_COLUMNS, *_THROWN,
    )
)  # fmt: skip
# Of cameras and of other objects.
POSES = frozenset(("to_world", "origin", "target", "up"))
ANGLES_OF_VIEW = frozenset(("x_fov", "fov", "focal_length"))
PRINCIPAL_POINT = frozenset(("principal_point_offset_x", "principal_point_offset_y"))
# Arguments of the stages of a device without pixels and directions.
OF_DEVICES = frozenset(
    (
        "probability", "tau_s", "dead_time_s", "period_s", "frames", "depth", "cycles", "kind", "gate", "delays_s",
        "widths_s", "rise_s", "fall_s", "leakage", "electrons_per_unit", "fwhm_s", "delay_s", "width_s", "tails_s",
        "fractions", "frequencies_hz", "contrast", "background_e", "floor", "pulse_energy_j", "wavelength_m",
        "repetition_rate_hz", "exposure_s", "quantum_efficiency", "ambient_rate_hz", "dark_count_rate_hz",
        "full_well_e", "read_noise_e", "ktc_noise_e", "excess_noise", "dark_e", "gain_e_per_dn", "bits",
        "black_level_dn", "shot_noise", "signed", "time_fwhm_s", "jitter_fwhm_s", "sweeps", "dnl_std", "offset_bins",
        "f_number", "filter_bandwidth_m", "spectral_irradiance_w_m2_nm",
        "light_duty", "transmission", "pixel_area_m2", "solid_angle_sr", "gate_duty", "extinction_ratio",
        "spads", "coincidence", "photons_per_unit", "looks", "window_s", "exponent", "longest_s", "counted_from",
        "background", "bandwidth_hz", "duration_s",
    )
)  # fmt: skip
# Last parts of the keys of textures, spectra and volumes.
_LEAVES = frozenset(("value", "values", "data", "color0", "color1"))


def check_values(
    values: Mapping[str, Any] | None, drawn: PixelMap, cameras: Sequence[str], kept: Sequence[str]
) -> None:
    """Check that a map leaves the values of a sample true.

    Args:
        values: drawn values of the sample by key, or None.
        drawn: map of the pixels.
        cameras: names of the camera in keys, () for unknown.
        kept: keys that are known to stay true.

    Raises:
        SceneError: for a value that becomes false, or is not known to stay true.
    """
    for key, value in (values or {}).items():
        # Arguments of a device may be maps of pixels.
        is_map = key.startswith("device.") and getattr(value, "ndim", 0) >= 2
        if key not in kept and (is_map or not stays_true(key, drawn, cameras)):
            named = "" if cameras else ', say what the camera is called, sensor="sensor",'
            raise SceneError(
                f"Augment: the value {key!r} is not true of the augmented sample, or is not known to be. Read the "
                f"data set without values, TransientDataset(..., fields=[...]){named} or name it in kept_values= if "
                "it stays true."
            )


def stays_true(key: str, drawn: PixelMap, cameras: Sequence[str]) -> bool:
    """Return True for a value that is known to stay true.

    Args:
        key: key of the value in the ``vary`` of the recipe.
        drawn: map of the pixels.
        cameras: names of the camera in keys.

    Returns:
        Truth value.
    """
    parts = key.split(".")
    if len(parts) < 2:
        # A scene, a scan, a whole node, a $name.
        return False
    last = parts[-1]
    # Texture, spectrum or volume that the number belongs to; the first part is a name of the scene.
    name = next((part for part in reversed(parts[2:]) if part not in _LEAVES), parts[1])
    if parts[0] == "device":
        return len(parts) > 2 and last in OF_DEVICES
    if last in ANGLES_OF_VIEW or last in PRINCIPAL_POINT:
        return not (drawn.changes_scale if last in ANGLES_OF_VIEW else drawn.changes_intrinsics)
    if name in UNAFFECTED and not (last == "data" and name in _THROWN):
        return True
    if any(key.startswith(f"{camera}.") for camera in cameras):
        return last == "to_world" and not drawn.turns
    if drawn.mirror is not None:
        return False
    if last in POSES:
        return bool(cameras) or not drawn.turns
    return name in OF_THE_WORLD or (bool(cameras) and "film" not in parts)
