"""A small scene description of every plugin that has parameters: Mitsuba's (3.9.1) and those of this library.

For tests and pages that go through all plugins. Needs an active variant. Left out are ``measured`` and
``measured_polarized``, whose tables come in files of their own, and plugins without parameters.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

LEFT_OUT = ("measured", "measured_polarized", "blender", "serialized", "mesh_attribute")


def every_plugin(folder: Path) -> dict[str, dict[str, Any]]:
    """Descriptions for ``mi.load_dict`` by plugin name; small files that some of them read are written to ``folder``.

    A plugin that cannot stand alone (an area light, a shape group) is inside the description of its name.
    """
    return {**shapes(folder), **sensors(), **emitters(), **bsdfs(), **textures(), **media()}


def _bitmap() -> dict[str, Any]:
    import mitsuba as mi

    return {"type": "bitmap", "bitmap": mi.Bitmap(np.full((4, 4, 3), 0.5, dtype=np.float32)), "raw": True}


def _grid(channels: int = 1) -> dict[str, Any]:
    import mitsuba as mi

    return {"type": "gridvolume", "grid": mi.VolumeGrid(np.ones((3, 3, 3, channels), dtype=np.float32))}


def shapes(folder: Path) -> dict[str, dict[str, Any]]:
    """Shapes, those that read files and shape groups included."""
    import mitsuba as mi

    curve, obj, ply = folder / "curve.txt", folder / "triangle.obj", folder / "cube.ply"
    curve.write_text("\n".join(f"{x} 0 0 0.1" for x in range(6)), encoding="utf-8")
    obj.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", encoding="utf-8")
    mi.load_dict({"type": "cube"}).write_ply(str(ply))
    ball = np.linalg.norm(np.stack(np.meshgrid(*[np.linspace(-1, 1, 6)] * 3), -1), axis=-1)[..., None] - 0.5
    blobs = {
        "centers": mi.TensorXf([[0.0, 0.0, 0.0]]),
        "scales": mi.TensorXf([[1.0, 1.0, 1.0]]),
        "quaternions": mi.TensorXf([[0.0, 0.0, 0.0, 1.0]]),
        "opacities": mi.TensorXf([[1.0]]),
    }
    group = {"type": "shapegroup", "part": {"type": "cube"}}
    copy = {"type": "instance", "of": {"type": "ref", "id": "group"}}
    return {
        **{name: {"type": name} for name in ("rectangle", "sphere", "disk", "cylinder", "cube")},
        **{name: {"type": name, "filename": str(curve)} for name in ("bsplinecurve", "linearcurve")},
        "obj": {"type": "obj", "filename": str(obj)},
        "ply": {"type": "ply", "filename": str(ply)},
        "mesh_arrays": {
            "type": "mesh_arrays",
            "vertices": mi.TensorXd(np.ravel(np.eye(3))[None]),
            "faces": mi.TensorXd([[0, 1, 2]]),
        },
        "sdfgrid": {"type": "sdfgrid", "grid": mi.TensorXf(ball.astype(np.float32))},
        **{name: {"type": name, **blobs} for name in ("ellipsoids", "ellipsoidsmesh")},
        "instance": {"type": "scene", "group": group, "copy": copy},
    }


def sensors() -> dict[str, dict[str, Any]]:
    """Sensors, each with a film."""
    film = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}}
    camera = {"type": "perspective"}
    return {
        **{name: {"type": name, "film": film} for name in ("perspective", "orthographic", "radiancemeter", "distant")},
        "thinlens": {"type": "thinlens", "aperture_radius": 0.1, "focus_distance": 1.0},
        "batch": {"type": "batch", "first": camera, "second": camera},
        "irradiancemeter": {"type": "rectangle", "sensor": {"type": "irradiancemeter", "film": film}},
        "nlos_capture_meter": _scan(),
        "transient_hdr_film": {**camera, "film": {"type": "transient_hdr_film"}},
        "phasor_hdr_film": {**camera, "film": {"type": "phasor_hdr_film"}},
        "gated_hdr_film": {**camera, "film": {"type": "gated_hdr_film", "gates": "gaussian 1 0.1"}},
        "rate_hdr_film": {
            **camera, "film": {"type": "rate_hdr_film", "rate_start": -1.0, "rate_width": 1.0, "rate_bins": 2}
        },
        "slow_phasor_hdr_film": {
            **camera, "film": {"type": "slow_phasor_hdr_film", "frequencies": "0.5, 1.0", "slow_times": "0.0, 0.1"}
        },
        "beat_hdr_film": {
            **camera,
            "film": {
                "type": "beat_hdr_film", "bin_width_opl": 0.1, "chirp_bandwidth": 1e9, "chirp_duration": 1e-6,
                "chirp_wavelength": 1.55e-6,
            },
        },
    }  # fmt: skip


def _scan() -> dict[str, Any]:
    """A relay wall whose scan has all that one can have."""
    import mitsuba as mi

    points = mi.TensorXf([[0.1, 0.2, 0.0]])
    meter = {
        "type": "nlos_capture_meter",
        "film": {"type": "transient_hdr_film", "width": 1, "height": 1, "rfilter": {"type": "box"}},
        "sensor_origin": [0.0, 0.0, 1.0],
        "points": points,
        "laser_points": points,
        "laser_origin": [0.5, 0.0, 1.0],
    }
    return {"type": "rectangle", "sensor": meter}


def emitters() -> dict[str, dict[str, Any]]:
    """Emitters; those that need one sit on a shape."""
    on_shapes = ("area", "directionalarea", "diff_directionalarea", "angulararea")
    return {
        **{name: {"type": "rectangle", "emitter": {"type": name}} for name in on_shapes},
        "point": {"type": "point"},
        "laser_beam": {"type": "laser_beam"},
        "spot": {"type": "spot", "texture": _bitmap()},
        "projector": {"type": "projector", "irradiance": _bitmap()},
        "directional": {"type": "directional", "direction": [0, 0, 1]},
        "constant": {"type": "constant"},
        "envmap": {"type": "envmap", "bitmap": _bitmap()["bitmap"]},
        "sunsky": {"type": "sunsky", "sun_direction": [0.0, 0.6, 0.8]},
        "sunsky_at_a_time": {"type": "sunsky"},
        "timed_sunsky": {"type": "timed_sunsky"},
    }


_PRINCIPLED = dict.fromkeys(
    ("spec_trans", "anisotropic", "sheen", "sheen_tint", "spec_tint", "flatness"), 0.1
)  # lobes of weight zero have no parameters


def bsdfs() -> dict[str, dict[str, Any]]:
    """Surfaces; those that hold others hold diffuse ones or a mirror."""
    paint, mirror = {"type": "diffuse"}, {"type": "conductor"}
    plain = (
        "diffuse", "dielectric", "thindielectric", "roughdielectric", "conductor", "roughconductor", "plastic",
        "roughplastic", "pplastic", "hair", "polarizer", "retarder", "circular", "diff_dielectric",
        "diff_rough_dielectric", "diff_plastic", "diff_rough_plastic", "diff_conductor", "diff_polarizer",
        "diff_retarder", "diff_circular", "diff_rough_conductor", "diff_pplastic", "diff_hair",
    )  # fmt: skip
    thick = {"metallic": 0.1, "clearcoat": 0.1, "clearcoat_gloss": 0.1, **_PRINCIPLED}
    thin = {"diff_trans": 0.1, **_PRINCIPLED}
    return {
        **{name: {"type": name} for name in plain},
        **{name: {"type": name, **thick} for name in ("principled", "diff_principled")},
        **{name: {"type": name, **thin} for name in ("principledthin", "diff_principled_thin")},
        "blendbsdf": {"type": "blendbsdf", "a": paint, "b": mirror, "weight": 0.5},
        "mask": {"type": "mask", "nested": paint, "opacity": 0.5},
        "twosided": {"type": "twosided", "nested": paint},
        "bumpmap": {"type": "bumpmap", "arbitrary": _bitmap(), "nested": paint},
        "normalmap": {"type": "normalmap", "normalmap": _bitmap(), "nested": paint},
        "retroreflector": {"type": "retroreflector", "share": 0.7},
        "delayed": {"type": "delayed", "nested": paint, "lifetime": 1.0, "elastic_fraction": 0.2},
    }


def textures() -> dict[str, dict[str, Any]]:
    """Textures and spectra."""
    return {
        "bitmap": _bitmap(),
        "checkerboard": {"type": "checkerboard"},
        "volume": {"type": "volume", "volume": _grid()},
        "rgb": {"type": "rgb", "value": [0.5, 0.4, 0.3]},
        "uniform": {"type": "uniform", "value": 0.5},
        "d65": {"type": "d65"},
        "regular": {"type": "regular", "wavelength_min": 400.0, "wavelength_max": 700.0, "values": "1,2,3"},
        "irregular": {"type": "irregular", "wavelengths": "400,700", "values": "1,2"},
        "blackbody": {"type": "blackbody", "temperature": 5000.0},
        "rawconstant": {"type": "rawconstant", "value": 0.4},
        "rigid_motion": {"type": "rigid_motion", "linear": [1.0, 0.5, 0.2]},
    }


def media() -> dict[str, dict[str, Any]]:
    """Participating media, volumes and phase functions."""
    return {
        "homogeneous": {"type": "homogeneous", "phase": {"type": "hg"}},
        "heterogeneous": {"type": "heterogeneous", "sigma_t": _grid(), "albedo": 0.5},
        "gridvolume": _grid(),
        "constvolume": {"type": "constvolume", "value": 0.5},
        "blendphase": {"type": "blendphase", "a": {"type": "hg"}, "b": {"type": "isotropic"}, "weight": 0.4},
        "tabphase": {"type": "tabphase", "values": "1,2,3"},
        "sggx": {"type": "sggx", "S": _grid(6)},
    }
