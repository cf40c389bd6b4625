"""Gradient cases of phasor films: no temporal filter stands between a path length and the loss."""

from __future__ import annotations

from support.gradient_cases.cases_media import SIGMA_T, block, homogeneous
from support.gradient_cases.cases_polar import METAL, metal_room
from support.gradient_cases.problem import Case
from support.gradient_cases.scenes import area_light, glass_slab, room
from support.gradient_cases.unknowns import move, set_color

ROW = "through a phasor film: albedo, light, geometry, index"
GRID = {"frequency_first": 0.0, "frequency_step": 0.37, "frequency_count": 5}
LIST = {"frequencies": "1.3, 0.21, -0.45"}


def seen_as_phasors(scene, **frequencies):
    """The scene with a phasor film in place of its histogram."""
    size = {key: scene["sensor"]["film"][key] for key in ("width", "height", "rfilter")}
    film = {"type": "phasor_hdr_film", **size, **(frequencies or GRID)}
    return {**scene, "sensor": {**scene["sensor"], "film": film}}


def lit_by_a_panel(**frequencies):
    """The room under an area light, whose emission the camera's paths find too."""
    return seen_as_phasors(room(light=area_light(), side_reflectance=0.2), **frequencies)


def glass():
    """A smooth slab: its index acts through direction, Fresnel weight and path length."""
    return seen_as_phasors(glass_slab({"type": "diff_dielectric", "int_ior": 1.5, "ext_ior": 1.0}))


CASES = [
    Case("phasor_albedo", ROW, lambda: seen_as_phasors(room()), set_color("side.bsdf.reflectance.value"), 0.8, 0.02),
    Case(
        "phasor_wall_distance",
        ROW,
        lambda: seen_as_phasors(room()),
        move("wall.to_world", (0, 0, 1)),
        0.0,
        2e-3,
        spp=2048,
    ),
    Case("phasor_area_light_moves", ROW, lit_by_a_panel, move("light.to_world", (0.2, 0.1, 1)), 0.0, 5e-3, spp=4096),
    Case(
        "phasor_fog_density",
        ROW,
        lambda: seen_as_phasors(block(homogeneous()), frequencies="0.0, 0.13"),
        set_color(SIGMA_T),
        0.8,
        0.02,
        spp=8192,
    ),
    Case(
        "phasor_polarized_metal_moves",
        ROW,
        lambda: seen_as_phasors(metal_room(METAL), **LIST),
        move("wall.to_world", (0, 0, 1)),
        0.0,
        2e-3,
        "llvm_ad_mono_polarized",
        spp=2048,
    ),
    Case("phasor_glass_index", ROW, glass, set_color("slab.bsdf.eta"), 1.5, 4e-3, spp=8192),
]
