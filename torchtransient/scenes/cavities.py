"""Closed cavities with exact transient solutions: furnace, integrating sphere, parallel plates. Lengths in metres.

The solutions are in `torchtransient.testing.closed_forms` under the same names.
"""

from __future__ import annotations

from torchtransient.checks import finite, positive
from torchtransient.scenes.parts import SceneDict, diffuse, perspective, transient_film, transient_path
from torchtransient.scenes.transforms import look_at, rotate, scale, translate

# Of all scenes with a closed form: beyond their depths.
_NO_ROULETTE = 1000


def _camera(resolution: int, num_bins: int, start_opl: float, bin_width_opl: float, spp: int, fov: float) -> SceneDict:
    film = transient_film(resolution, num_bins, start_opl, bin_width_opl)
    return perspective(look_at([0.0, 0.0, 0.0], [0.0, 0.0, -1.0]), fov, film, spp)


def furnace(
    radius: float = 1.0,
    reflectance: float = 0.8,
    radiance: float = 1.0,
    *,
    resolution: int = 2,
    num_bins: int = 400,
    start_opl: float = 0.0,
    bin_width_opl: float = 0.05,
    spp: int = 256,
    max_depth: int = 64,
) -> SceneDict:
    """Return a diffuse sphere that emits from its whole inner side, seen from its centre.

    Every pixel sees the same light. A dark point light at the centre takes the emitter samples, and emission is found
    by BSDF sampling alone, which leaves no noise in the image.

    Args:
        radius: radius of the sphere, metres.
        reflectance: albedo of the wall.
        radiance: emitted radiance.
        resolution: pixels of a side.
        num_bins: bins of the film.
        start_opl: start of the film, metres of optical path.
        bin_width_opl: width of a bin, metres of optical path.
        spp: samples per pixel.
        max_depth: segments of the longest path. The truncation leaves out the energy ``radiance *
            reflectance**max_depth / (1 - reflectance)``.

    Closed form: `closed_forms.furnace`.
    """
    return {
        "type": "scene",
        "integrator": transient_path(max_depth, _NO_ROULETTE),
        "sensor": _camera(resolution, num_bins, start_opl, bin_width_opl, spp, 45.0),
        "wall": {
            "type": "sphere",
            "radius": positive("radius", radius),
            "flip_normals": True,
            "bsdf": diffuse(reflectance),
            "emitter": {"type": "area", "radiance": finite("radiance", radiance), "sampling_weight": 0.0},
        },
        # Not zero: spectral variants refuse a light without any energy. Added to anything in float32 it changes
        # nothing.
        "dark": {"type": "point", "position": [0.0, 0.0, 0.0], "intensity": 1e-30},
    }


def integrating_sphere(
    radius: float = 1.0,
    reflectance: float = 0.8,
    intensity: float = 1.0,
    *,
    resolution: int = 2,
    num_bins: int = 400,
    start_opl: float = 0.0,
    bin_width_opl: float = 0.05,
    spp: int = 256,
    max_depth: int = 64,
) -> SceneDict:
    """Return a diffuse sphere lit by a point source at its centre and seen from there.

    Light reaches the wall at `radius` everywhere with irradiance `intensity / radius**2`, then crosses the sphere along
    independent chords. Closed form: `closed_forms.integrating_sphere_radiance`.

    Args:
        radius: radius of the sphere, metres.
        reflectance: albedo of the wall.
        intensity: intensity of the source, W/sr.
        resolution: pixels of a side.
        num_bins: bins of the film.
        start_opl: start of the film, metres of optical path.
        bin_width_opl: width of a bin, metres of optical path.
        spp: samples per pixel.
        max_depth: segments of the longest path.
    """
    return {
        "type": "scene",
        "integrator": transient_path(max_depth, _NO_ROULETTE),
        "sensor": _camera(resolution, num_bins, start_opl, bin_width_opl, spp, 45.0),
        "light": {"type": "point", "position": [0.0, 0.0, 0.0], "intensity": finite("intensity", intensity)},
        "wall": {
            "type": "sphere",
            "radius": positive("radius", radius),
            "flip_normals": True,
            "bsdf": diffuse(reflectance),
        },
    }


def parallel_plates(
    separation: float = 1.0,
    reflectance: float = 0.8,
    radiance: float = 1.0,
    *,
    half_extent: float = 1000.0,
    resolution: int = 2,
    num_bins: int = 400,
    start_opl: float = 0.0,
    bin_width_opl: float = 0.05,
    spp: int = 256,
    max_depth: int = 64,
) -> SceneDict:
    """Return two emitting diffuse squares that face each other, the camera half-way between them.

    The plates stand at z = -separation / 2 and +separation / 2. The camera looks at one of them through a field of view
    of 0.5 degrees, so that the first leg is separation / 2 to 1e-5. Closed form: `closed_forms.parallel_plates`.

    Args:
        separation: distance of the plates, metres.
        reflectance: albedo of both plates.
        radiance: emitted radiance.
        half_extent: half a side of the squares, metres. Of a flight's energy at most ``(separation / half_extent)**2``
            leaves through the open sides; arrivals before `half_extent` do not notice the edges.
        resolution: pixels of a side.
        num_bins: bins of the film.
        start_opl: start of the film, metres of optical path.
        bin_width_opl: width of a bin, metres of optical path.
        spp: samples per pixel.
        max_depth: segments of the longest path.
    """
    gap = positive("separation", separation)
    size = scale(positive("half_extent", half_extent))

    def plate(to_world: object) -> SceneDict:
        return {
            "type": "rectangle",
            "to_world": to_world,
            "bsdf": diffuse(reflectance),
            "emitter": {"type": "area", "radiance": finite("radiance", radiance)},
        }

    return {
        "type": "scene",
        "integrator": transient_path(max_depth, _NO_ROULETTE),
        "sensor": _camera(resolution, num_bins, start_opl, bin_width_opl, spp, 0.5),
        "back": plate(translate([0.0, 0.0, -gap / 2]) @ size),
        "front": plate(translate([0.0, 0.0, gap / 2]) @ rotate([0, 1, 0], 180) @ size),
    }
