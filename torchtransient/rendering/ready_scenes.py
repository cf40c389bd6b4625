"""Ready scenes of Mitsuba that were made for steady pictures, as descriptions that take a time axis.

Seeds of samplers are left out: whoever renders brings one.

A film belongs to its sensor and an integrator to its scene; neither is exchanged in what is loaded. So cameras with a
steady film and steady path tracers are described by what they show of themselves, and all else is taken as it is.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from torchtransient.plugins.node_walk import objects_of
from torchtransient.rendering.description import DictDescription, describe_dict
from torchtransient.rendering.taken import Taken
from torchtransient.rendering.translation import pixels_of, shown_properties
from torchtransient.rendering.variant import active_variant

_INTEGRATORS = {
    "PathIntegrator": "path", "VolumetricPathIntegrator": "volpath", "VolpathMisIntegratorImpl": "volpathmis",
}  # fmt: skip
# Cameras with the parameters that they show and read under one name.
_CAMERAS = {
    "PerspectiveCamera": ("perspective", ("principal_point_offset_x", "principal_point_offset_y")),
    "ThinLensCamera": ("thinlens", ("aperture_radius", "focus_distance")),
    "OrthographicCamera": ("orthographic", ()),
}
_SAMPLERS = {
    "IndependentSampler": "independent", "StratifiedSampler": "stratified", "MultijitterSampler": "multijitter",
    "OrthogonalSampler": "orthogonal", "LowDiscrepancySampler": "ldsampler",
}  # fmt: skip


def described_for_time(scene: Any) -> DictDescription | None:
    """A description of a ``mi.Scene`` whose integrator or film is steady; None where there is nothing of that kind."""
    import mitsuba as mi

    tree: dict[str, Any] = {"type": "scene"}
    with active_variant(scene.variant_name()):
        for number, (name, value) in enumerate(objects_of(scene)):
            found = None
            if isinstance(value, mi.Integrator):
                found = _integrator(value)
            elif isinstance(value, mi.Sensor):
                found = _sensor(value)
            tree[value.id() or f"{name}_{number}"] = found or Taken(value, value.id() or name)
    return describe_dict(tree) if any(isinstance(entry, dict) for entry in tree.values()) else None


def _integrator(value: Any) -> dict[str, Any] | None:
    plugin, said = _INTEGRATORS.get(value.class_name()), shown_properties(value)
    if plugin is None or not {"max_depth", "rr_depth"} <= said.keys():
        return None
    # Without a bound it is -1, as a number without sign.
    depths = {name: int(said[name]) for name in ("max_depth", "rr_depth")}
    depths = {name: -1 if depth >= 2**31 else depth for name, depth in depths.items()}
    return {"type": plugin, **depths, "hide_emitters": bool(value.hide_emitters)}


def _sensor(value: Any) -> dict[str, Any] | None:
    """A camera in vacuum with a steady film; None for other sensors."""
    import mitsuba as mi

    known, film, sampler = _CAMERAS.get(value.class_name()), _film(value.film()), _sampler(value.sampler())
    if known is None or film is None or sampler is None or value.get_medium() is not None:
        return None
    plugin, names = known
    shown = mi.traverse(value)
    camera = {
        "type": plugin,
        "near_clip": float(value.near_clip()),
        "far_clip": float(value.far_clip()),
        "shutter_open": float(value.shutter_open()),
        "shutter_close": float(value.shutter_open()) + float(value.shutter_open_time()),
        "to_world": np.array(shown["to_world"].matrix, dtype=np.float64).reshape(4, 4),
        **{name: float(np.ravel(shown[name])[0]) for name in names},
    }
    if "x_fov" in shown:
        camera |= {"fov": float(np.ravel(shown["x_fov"])[0]), "fov_axis": "x"}
    return camera | {"film": film, "sampler": sampler}


def _film(film: Any) -> dict[str, Any] | None:
    rfilter = _rfilter(film.rfilter())
    if film.class_name() != "HDRFilm" or film.sensor_response_function() is not None or rfilter is None:
        return None
    (width, height), (crop_width, crop_height) = film.size(), film.crop_size()
    left, top = film.crop_offset()
    return {
        "type": "hdrfilm",
        "width": int(width), "height": int(height), "crop_width": int(crop_width), "crop_height": int(crop_height),
        "crop_offset_x": int(left), "crop_offset_y": int(top), "sample_border": bool(film.sample_border()),
        "pixel_format": pixels_of(film), "rfilter": rfilter,
    }


def _rfilter(rfilter: Any) -> dict[str, Any] | None:
    kind, radius = rfilter.class_name(), float(rfilter.radius())
    found: dict[str, dict[str, Any]] = {
        "BoxFilter": {"type": "box"},
        "TentFilter": {"type": "tent", "radius": radius},
        "GaussianFilter": {"type": "gaussian", "stddev": radius / 4},
        "CatmullRomFilter": {"type": "catmullrom"},
        "LanczosSincFilter": {"type": "lanczos", "lobes": round(radius)},
    }
    return found.get(kind)


def _sampler(sampler: Any) -> dict[str, Any] | None:
    plugin, said = _SAMPLERS.get(sampler.class_name()), shown_properties(sampler)
    if plugin is None:
        return None
    found: dict[str, Any] = {"type": plugin, "sample_count": int(sampler.sample_count())}
    if "jitter" in said:
        found["jitter"] = said["jitter"].strip() in ("1", "true")
    return found
