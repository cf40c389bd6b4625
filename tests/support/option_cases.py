"""Every option with a number, a truth value or a name of Mitsuba's plugins and this library's, in small scenes: what
tests write wrong values into.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch

from tools.small_room import make_room, pose

NAN, INF = math.nan, math.inf
# What people write, and what arithmetic leaves behind.
NUMBERS = {
    "0": 0, "-1": -1, "2^31": 2**31, "2^32": 2**32, "2^63": 2**63, "1e30": 1e30, "10^30": 10**30, "nan": NAN,
    "inf": INF, "1.5": 1.5, "-0.5": -0.5,
}  # fmt: skip
OTHERS = {
    "'x'": "x", "''": "", "True": True, "np.int64(5)": np.int64(5), "torch.tensor(3)": torch.tensor(3), "[]": [],
    "{}": {}, "None": None, "[1, 2]": [1, 2], "5 zeros": np.zeros(5), "1j": 1j,
}  # fmt: skip
VALUES = NUMBERS | OTHERS

_AXIS = {"temporal_bins": 8, "bin_width_opl": 1.0, "start_opl": 6.0}
_FILM = {"width": 2, "height": 2, "rfilter": {"type": "box"}}
_SIZE = (
    "width", "height", "crop_width", "crop_height", "crop_offset_x", "crop_offset_y", "sample_border",
    "laser_scan_width", "laser_scan_height", "exhaustive_scan",
)  # fmt: skip
_IOR = ("int_ior", "ext_ior")
_ALPHA = ("alpha", "alpha_u", "alpha_v", "distribution", "sample_visible")
_PAINT = {"type": "diffuse"}
_DEPTH = ("max_depth", "rr_depth", "hide_emitters")
_TRANSIENT = (*_DEPTH, "camera_unwarp", "discard_direct_light", "temporal_filter", "gaussian_stddev")
_CAMERA = (
    "fov", "fov_axis", "near_clip", "far_clip", "shutter_open", "shutter_close", "principal_point_offset_x",
    "focal_length", "to_world",
)  # fmt: skip
_PULSE = ("pulse", "pulse_fwhm_opl", "pulse_center_opl", "irf_decay_opl", "steady")
_LOBES = (
    "base_color", "roughness", "anisotropic", "spec_trans", "eta", "spec_tint", "sheen", "sheen_tint", "flatness",
    "diffuse_reflectance_sampling_rate",
)  # fmt: skip

# (place in the scene, node, options)
OPTIONS: list[tuple[str, dict[str, Any], tuple[str, ...]]] = [
    ("film", {"type": "transient_hdr_film", **_FILM, **_AXIS},
     (*_SIZE, *_AXIS, "temporal_filter", "gaussian_stddev", *_PULSE)),
    ("film", {"type": "phasor_hdr_film", **_FILM, "frequencies": "0.5,1"},
     (*_SIZE, "frequencies", "start_opl")),
    ("film", {"type": "phasor_hdr_film", **_FILM}, ("wl_mean", "wl_sigma", "temporal_bins", "bin_width_opl")),
    ("film", {"type": "phasor_hdr_film", **_FILM, "frequency_first": 0.5, "frequency_step": 0.1, "frequency_count": 2},
     ("frequency_first", "frequency_step", "frequency_count")),
    ("film", {"type": "gated_hdr_film", **_FILM, "gates": "gaussian 7 0.5"}, (*_SIZE, "gates", "start_opl")),
    ("film", {"type": "hdrfilm", **_FILM}, (*_SIZE, "pixel_format")),
    *[("sampler", {"type": name, "sample_count": 4}, ("sample_count", "seed", *more))
      for name, more in {"independent": (), "stratified": ("jitter",), "multijitter": ("jitter",),
                         "orthogonal": ("jitter", "strength"), "ldsampler": ()}.items()],
    ("rfilter", {"type": "tent"}, ("radius",)),
    ("rfilter", {"type": "gaussian"}, ("stddev",)),
    ("rfilter", {"type": "lanczos"}, ("lobes",)),
    ("rfilter", {"type": "mitchell"}, ("A", "B", "C")),
    ("integrator", {"type": "transient_path", "max_depth": 3}, _TRANSIENT),
    ("integrator", {"type": "transient_prbvolpath", "max_depth": 3}, _TRANSIENT),
    ("integrator", {"type": "path", "max_depth": 3}, _DEPTH),
    ("sensor", {"type": "perspective"}, _CAMERA),
    ("sensor", {"type": "orthographic"}, ("near_clip", "far_clip", "to_world")),
    ("sensor", {"type": "thinlens", "aperture_radius": 0.1, "focus_distance": 4.0},
     ("aperture_radius", "focus_distance", *_CAMERA)),
    ("sensor", {"type": "radiancemeter"}, ("origin", "direction")),
    ("sensor", {"type": "distant"}, ("direction", "target")),
    ("emitter", {"type": "point"}, ("position", "intensity", "to_world")),
    ("emitter", {"type": "spot"}, ("intensity", "cutoff_angle", "beam_width", "to_world")),
    ("emitter", {"type": "projector", "irradiance": 1.0}, ("irradiance", "fov", "scale", "to_world")),
    ("emitter", {"type": "directional", "direction": [0, 0, -1]}, ("irradiance", "direction")),
    ("emitter", {"type": "constant"}, ("radiance",)),
    ("emitter", {"type": "envmap", "bitmap": np.ones((4, 8, 3), np.float32)},
     ("scale", "mis_compensation", "to_world", "bitmap")),
    ("emitter", {"type": "sunsky"},
     ("turbidity", "albedo", "sun_scale", "sky_scale", "sun_aperture", "sun_direction", "latitude", "longitude",
      "timezone", "year", "month", "day", "hour", "minute", "second", "complex_sun")),
    ("emitter", {"type": "timed_sunsky"},
     ("start_year", "start_month", "start_day", "end_year", "end_month", "end_day", "window_start_time",
      "window_end_time", "turbidity", "sun_aperture")),
    ("shape", {"type": "rectangle"}, ("to_world", "flip_normals")),
    ("shape", {"type": "sphere"}, ("radius", "center", "to_world", "flip_normals")),
    ("shape", {"type": "cylinder"}, ("radius", "p0", "p1")),
    ("shape", {"type": "disk"}, ("to_world",)),
    ("shape", {"type": "rectangle", "emitter": {"type": "angulararea"}},
     ("emitter.cutoff_angle", "emitter.beam_width", "emitter.radiance")),
    ("shape", {"type": "rectangle", "emitter": {"type": "area"}}, ("emitter.radiance",)),
    ("shape", {"type": "mesh_arrays", "vertices": np.eye(3), "faces": np.array([[0, 1, 2]])},
     ("vertices", "faces", "face_normals", "flip_normals", "normals", "texcoords")),
    ("shape", {"type": "sdfgrid", "grid": np.ones((3, 3, 3, 1), np.float32)}, ("grid", "normals", "to_world")),
    ("bsdf", {"type": "diffuse"}, ("reflectance",)),
    ("bsdf", {"type": "dielectric"}, (*_IOR, "specular_reflectance", "specular_transmittance")),
    ("bsdf", {"type": "thindielectric"}, _IOR),
    ("bsdf", {"type": "roughdielectric"}, (*_IOR, *_ALPHA)),
    ("bsdf", {"type": "conductor"}, ("eta", "k", "material")),
    ("bsdf", {"type": "roughconductor"}, ("eta", "k", "material", *_ALPHA)),
    ("bsdf", {"type": "plastic"}, (*_IOR, "diffuse_reflectance", "nonlinear")),
    ("bsdf", {"type": "roughplastic"}, (*_IOR, "alpha", "distribution", "nonlinear")),
    ("bsdf", {"type": "pplastic"}, (*_IOR, *_ALPHA)),
    ("bsdf", {"type": "hair"},
     (*_IOR, "azimuthal_roughness", "longitudinal_roughness", "scale_tilt", "eumelanin", "pheomelanin", "sigma_a",
      "scale")),
    ("bsdf", {"type": "polarizer"}, ("theta", "transmittance", "polarizing")),
    ("bsdf", {"type": "retarder"}, ("theta", "delta", "transmittance")),
    ("bsdf", {"type": "circular"}, ("theta", "left_handed")),
    ("bsdf", {"type": "principled"},
     (*_LOBES, "metallic", "clearcoat", "clearcoat_gloss", "specular", "clearcoat_sampling_rate",
      "main_specular_sampling_rate")),
    ("bsdf", {"type": "principledthin"},
     (*_LOBES, "diff_trans", "diffuse_transmittance_sampling_rate", "specular_reflectance_sampling_rate",
      "specular_transmittance_sampling_rate")),
    ("bsdf", {"type": "blendbsdf", "a": _PAINT, "b": {"type": "conductor"}, "weight": 0.5}, ("weight",)),
    ("bsdf", {"type": "mask", "nested": _PAINT}, ("opacity",)),
    ("bsdf", {"type": "twosided", "nested": _PAINT}, ("allow_transmission",)),
    ("bsdf", {"type": "bumpmap", "arbitrary": {"type": "checkerboard"}, "nested": _PAINT},
     ("scale", "flip_invalid_normals")),
    ("bsdf", {"type": "retroreflector"}, ("share", "alpha", "reflectance")),
    ("bsdf", {"type": "delayed", "nested": _PAINT, "lifetime": 1.0},
     ("lifetime", "lifetime_s", "elastic_fraction", "tau", "decay_opl", "decay_values")),
    ("texture", {"type": "bitmap", "bitmap": np.full((4, 4, 3), 0.5, np.float32)},
     ("to_uv", "wrap_mode", "filter_type", "raw", "accel", "format", "bitmap", "data")),
    ("texture", {"type": "checkerboard"}, ("color0", "color1", "to_uv")),
    ("texture", {"type": "rgb", "value": [0.5, 0.4, 0.3]}, ("value",)),
    ("texture", {"type": "uniform", "value": 0.5}, ("value", "wavelength_min", "wavelength_max")),
    ("texture", {"type": "regular", "wavelength_min": 400.0, "wavelength_max": 700.0, "values": "1,2,3"},
     ("wavelength_min", "wavelength_max", "values")),
    ("texture", {"type": "irregular", "wavelengths": "400,700", "values": "1,2"}, ("wavelengths", "values")),
    ("texture", {"type": "blackbody", "temperature": 5000.0}, ("temperature", "wavelength_min", "wavelength_max")),
    ("texture", {"type": "d65"}, ("scale",)),
    ("texture", {"type": "rawconstant", "value": 0.5}, ("value",)),
    ("texture", {"type": "volume", "volume": {"type": "constvolume", "value": 0.5}}, ("volume.value",)),
    ("medium", {"type": "homogeneous", "phase": {"type": "hg"}},
     ("sigma_t", "albedo", "scale", "has_spectral_extinction", "sample_emitters", "phase.g")),
    ("medium", {"type": "heterogeneous", "albedo": 0.5,
                "sigma_t": {"type": "gridvolume", "grid": np.ones((3, 3, 3, 1), np.float32)}},
     ("albedo", "scale", "sigma_t.max_value", "sigma_t.wrap_mode", "sigma_t.grid", "sigma_t.raw")),
    ("medium", {"type": "homogeneous", "phase": {"type": "tabphase", "values": "1,2,3"}}, ("phase.values",)),
    ("medium", {"type": "homogeneous",
                "phase": {"type": "blendphase", "a": {"type": "hg"}, "b": {"type": "isotropic"}, "weight": 0.5}},
     ("phase.weight",)),
]  # fmt: skip


def scene(place: str, node: dict[str, Any]) -> dict[str, Any]:
    """The small room with a node in one of its places: a few pixels and samples."""
    room = make_room()
    sensor = room["sensor"]
    sensor["film"] |= {**_FILM, **_AXIS}
    sensor["sampler"]["sample_count"] = 2
    if place in ("film", "sampler"):
        sensor[place] = node
    elif place == "rfilter":
        sensor["film"]["rfilter"] = node
    elif place == "sensor":
        room["sensor"] = {**{key: sensor[key] for key in ("film", "sampler")}, **node}
        if "origin" not in node and "direction" not in node:
            room["sensor"].setdefault("to_world", sensor["to_world"])
    elif place == "integrator":
        room["integrator"] = node
    elif place == "emitter":
        room["light"] = node
    elif place == "shape":
        room["box"] = {"to_world": pose(0.0, 0.0, 1.0, 0.3), **node}
    elif place == "bsdf":
        room["box"]["bsdf"] = node
    elif place == "texture":
        room["box"]["bsdf"] = {"type": "diffuse", "reflectance": node}
    elif place == "medium":
        room["integrator"]["type"] = "transient_prbvolpath"
        room["box"] = {"type": "cube", "to_world": pose(0.4, 0, 0.5, 0.3), "bsdf": {"type": "null"}, "interior": node}
    else:
        raise ValueError(place)
    return room


def with_option(place: str, node: dict[str, Any], option: str, value: Any) -> dict[str, Any]:
    """The scene in which an option (``"phase.g"``: of a child) has a value."""
    *parents, name = option.split(".")
    node = dict(node)
    inner = node
    for parent in parents:
        inner[parent] = dict(inner[parent])
        inner = inner[parent]
    inner[name] = value
    return scene(place, node)


def cases() -> list[tuple[str, dict[str, Any], str, str]]:
    """(place, node, option, name of the value) for all."""
    return [(place, node, option, value) for place, node, options in OPTIONS for option in options for value in VALUES]
