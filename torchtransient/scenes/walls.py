"""Open scenes with one wall: the moving wall, the light over a plane, glass slabs. Lengths in metres."""

from __future__ import annotations

from torchtransient.checks import count, finite, positive
from torchtransient.errors import ArgumentError
from torchtransient.scenes.parts import SceneDict, diffuse, perspective, transient_film, transient_path
from torchtransient.scenes.transforms import look_at, rotate, scale, translate


def moving_wall(
    z: float = 0.0,
    *,
    side_panel: bool = False,
    panel_reflectance: float = 0.8,
    wall_reflectance: float = 0.5,
    intensity: float = 10.0,
    resolution: int = 8,
    num_bins: int = 400,
    start_opl: float = 6.0,
    bin_width_opl: float = 0.01,
    spp: int = 256,
    max_depth: int = 6,
) -> SceneDict:
    """Return a diffuse square at height `z` under a camera at z = 4 and a point light at (0.5, 0, 4).

    The wall fills the film (field of view 10 degrees). Keys for gradients: `wall.to_world`,
    `wall.bsdf.reflectance.value`, `side.bsdf.reflectance.value`, `light.position`. For the derivative of the arrival
    time with respect to `z`: each of the two legs grows by the cosine between it and the wall's normal, about -2
    together.

    Args:
        z: height of the wall, metres.
        side_panel: add a fixed diffuse panel beside it, which brings several bounces.
        panel_reflectance: albedo of the panel.
        wall_reflectance: albedo of the wall.
        intensity: intensity of the light, W/sr.
        resolution: pixels of a side.
        num_bins: bins of the film.
        start_opl: start of the film, metres of optical path.
        bin_width_opl: width of a bin, metres of optical path.
        spp: samples per pixel.
        max_depth: segments of the longest path.
    """
    film = transient_film(resolution, num_bins, start_opl, bin_width_opl)
    scene: SceneDict = {
        "type": "scene",
        "integrator": transient_path(max_depth),
        "sensor": perspective(look_at([0.0, 0.0, 4.0], [0.0, 0.0, 0.0]), 10.0, film, spp),
        "light": {"type": "point", "position": [0.5, 0.0, 4.0], "intensity": finite("intensity", intensity)},
        "wall": {
            "type": "rectangle",
            "to_world": translate([0.0, 0.0, finite("z", z)]),
            "bsdf": diffuse(wall_reflectance),
        },
    }
    panel = diffuse(panel_reflectance)
    if side_panel:
        to_world = translate([1.6, 0.0, 1.2]) @ rotate([0, 1, 0], -60) @ scale(0.4)
        scene["side"] = {"type": "rectangle", "to_world": to_world, "bsdf": panel}
    return scene


def light_over_plane(
    height: float = 1.0,
    reflectance: float = 0.5,
    intensity: float = 1.0,
    *,
    half_extent: float = 1000.0,
    num_bins: int = 200,
    start_opl: float = 0.0,
    bin_width_opl: float = 0.05,
    spp: int = 4096,
) -> SceneDict:
    """Return a point light and an irradiance meter at the same place above a diffuse plane.

    The plane is z = 0. The meter is a square of side 2e-4 `height` facing the plane; the light hangs 1e-4 `height`
    below it, so that the meter casts no shadow on the plane. Film: one pixel, direct light only. Closed form:
    `closed_forms.light_over_plane`.

    Args:
        height: height of meter and light over the plane, metres.
        reflectance: albedo of the plane.
        intensity: intensity of the light, W/sr.
        half_extent: half a side of the plane, metres.
        num_bins: bins of the film.
        start_opl: start of the film, metres of optical path.
        bin_width_opl: width of a bin, metres of optical path.
        spp: samples per pixel.
    """
    h = positive("height", height)
    meter = translate([0.0, 0.0, h]) @ rotate([0, 1, 0], 180) @ scale(1e-4 * h)
    return {
        "type": "scene",
        "integrator": transient_path(2),
        "light": {"type": "point", "position": [0.0, 0.0, h * (1 - 1e-4)], "intensity": finite("intensity", intensity)},
        "plane": {
            "type": "rectangle",
            "to_world": scale(positive("half_extent", half_extent)),
            "bsdf": diffuse(reflectance),
        },
        "meter": {
            "type": "rectangle",
            "to_world": meter,
            "bsdf": diffuse(0.0),
            "sensor": {
                "type": "irradiancemeter",
                "sampler": {"type": "independent", "sample_count": count("spp", spp)},
                "film": transient_film(1, num_bins, start_opl, bin_width_opl),
            },
        },
    }


def etalon_slab(
    thickness: float = 0.5,
    index: float = 1.5,
    *,
    light: str = "behind",
    radiance: float = 1.0,
    resolution: int = 2,
    num_bins: int = 400,
    start_opl: float = 0.0,
    bin_width_opl: float = 0.05,
    spp: int = 1024,
    max_depth: int = 32,
) -> SceneDict:
    """Return a smooth glass slab met head-on by the camera, with an area light behind or in front of it.

    The slab fills 0 <= z <= thickness, the camera stands at z = thickness + 1 and looks along -z through a field of
    view of 0.1 degrees. Closed form: `closed_forms.etalon_slab`.

    Args:
        thickness: thickness of the slab, metres.
        index: index of refraction of the glass.
        light: "behind", a black emitting square at z = -1: the camera sees the transmitted orders, after 2 m of air; or
            "front", at z = thickness + 2, behind the camera: it sees the reflected orders, after 3 m of air.
        radiance: emitted radiance.
        resolution: pixels of a side.
        num_bins: bins of the film.
        start_opl: start of the film, metres of optical path.
        bin_width_opl: width of a bin, metres of optical path.
        spp: samples per pixel.
        max_depth: segments of the longest path.
    """
    d = positive("thickness", thickness)
    if light == "behind":
        emitter_to_world = translate([0.0, 0.0, -1.0])
    elif light == "front":
        emitter_to_world = translate([0.0, 0.0, d + 2.0]) @ rotate([0, 1, 0], 180)
    else:
        raise ArgumentError(f"etalon_slab: expected light='behind' or light='front', got {light!r}")
    film = transient_film(resolution, num_bins, start_opl, bin_width_opl)
    # The cube's faces are pairs of triangles; one ray in 1e4 would slip through the diagonal if the camera looked along
    # it.
    slab_to_world = translate([3.0, 0.0, d / 2]) @ scale([10.0, 10.0, d / 2])
    return {
        "type": "scene",
        "integrator": transient_path(max_depth, 1000),
        "sensor": perspective(look_at([0.0, 0.0, d + 1.0], [0.0, 0.0, 0.0]), 0.1, film, spp),
        "slab": {
            "type": "cube",
            "to_world": slab_to_world,
            "bsdf": {"type": "dielectric", "int_ior": positive("index", index), "ext_ior": 1.0},
        },
        "light": {
            "type": "rectangle",
            "to_world": emitter_to_world @ scale(10.0),
            "bsdf": diffuse(0.0),
            "emitter": {"type": "area", "radiance": finite("radiance", radiance)},
        },
    }


def glass_slab_before_wall(
    index: float = 1.5,
    *,
    tilt_deg: float = 35.0,
    wall_reflectance: float = 0.5,
    intensity: float = 10.0,
    resolution: int = 8,
    num_bins: int = 400,
    start_opl: float = 6.0,
    bin_width_opl: float = 0.01,
    spp: int = 256,
    max_depth: int = 5,
) -> SceneDict:
    """Return a tilted smooth glass slab between a camera at z = 4 and a diffuse wall at z = 0.

    The point light at (1.8, 0, 2) reaches the wall past the slab, which is 0.5 m thick. Its index changes direction,
    Fresnel weight and optical path length of the camera's light. Key for the gradient: the slab's `eta`.

    Args:
        index: index of refraction of the glass.
        tilt_deg: turn of the slab, degrees.
        wall_reflectance: albedo of the wall.
        intensity: intensity of the light, W/sr.
        resolution: pixels of a side.
        num_bins: bins of the film.
        start_opl: start of the film, metres of optical path.
        bin_width_opl: width of a bin, metres of optical path.
        spp: samples per pixel.
        max_depth: segments of the longest path.
    """
    film = transient_film(resolution, num_bins, start_opl, bin_width_opl)
    slab = translate([0.0, 0.0, 2.4]) @ rotate([0, 1, 0], tilt_deg) @ scale([0.8, 0.8, 0.25])
    return {
        "type": "scene",
        "integrator": transient_path(max_depth),
        "sensor": perspective(look_at([0.0, 0.0, 4.0], [0.0, 0.0, 0.0]), 6.0, film, spp),
        "light": {"type": "point", "position": [1.8, 0.0, 2.0], "intensity": finite("intensity", intensity)},
        "slab": {
            "type": "cube",
            "to_world": slab,
            "bsdf": {"type": "dielectric", "int_ior": positive("index", index), "ext_ior": 1.0},
        },
        "wall": {"type": "rectangle", "to_world": scale(3.0), "bsdf": diffuse(wall_reflectance)},
    }
