"""Gradient cases of polarized variants: what changes Mueller matrices, and what turns the frames between them."""

from __future__ import annotations

from dataclasses import replace

from support.gradient_cases.problem import Case
from support.gradient_cases.scenes import area_light, camera, glass_slab, mirror_room, room, transform
from support.gradient_cases.unknowns import move, rotate, set_color

VARIANT = "llvm_ad_mono_polarized"
SPECTRAL = "llvm_ad_spectral_polarized"
METAL = {"type": "roughconductor", "eta": 0.8, "k": 2.5, "alpha": 0.3, "distribution": "ggx"}
PLASTIC = {"type": "pplastic", "alpha": 0.3, "diffuse_reflectance": 0.4, "int_ior": 1.5}

POLARIZER = {"type": "polarizer", "theta": 20.0}
PLATE = {"type": "retarder", "theta": 30.0, "delta": 90.0}


SLOW = {"polar_camera_rolls"}


def polar(name, row, scene, apply, value, step, variant=VARIANT, spp=2048, fd_spp=2048):
    """A case in a polarized variant."""
    tags = ("slow",) if name in SLOW else ()
    return Case(name, row, scene, apply, value, step, variant, spp=spp, fd_spp=fd_spp, tags=tags)


def mirrors():
    """A diffuse wall seen in a smooth metal mirror."""
    return mirror_room({"type": "conductor", "eta": 0.5, "k": 2.0})


def metal_room(bsdf=METAL, side=None, **arguments):
    """The room with a wall of rough metal, and a panel of plastic at its side: paths with two polarizing events."""
    scene = room(bsdf=bsdf, **arguments)
    scene["side"]["bsdf"] = side or PLASTIC
    return scene


def filtered(element, near=0.01):
    """The room of metal through a thin element before the camera, which is tilted; light does not pass it."""
    screen = transform().translate([0, 0, 3.5]).rotate([0, 1, 0], 20).rotate([0, 0, 1], 10).scale(0.15)
    scene = metal_room(
        sensor=camera(near=near), light={"type": "point", "position": [1.5, 0.3, 3.0], "intensity": 10.0}
    )
    return {**scene, "screen": {"type": "rectangle", "to_world": screen, "bsdf": element}}


def from_behind():
    """The room with a wall of two-sided metal that shows its back."""
    scene = metal_room({"type": "twosided", "nested": METAL})
    scene["wall"]["to_world"] = transform().rotate([0, 1, 0], 180)
    return scene


def glass(plugin, **arguments):
    """The slab before a wall of rough metal."""
    scene = glass_slab({"type": plugin, "int_ior": 1.5, "ext_ior": 1.0, **arguments})
    scene["wall"]["bsdf"] = METAL
    return scene


ALBEDO, INDEX, ROUGHNESS = "polarized: albedo, plastic", "polarized: index, real or complex", "polarized: roughness"
ELEMENT = "polarized: polarizer, wave plate, circular polarizer"
MOTION = "polarized: shapes, lights, sensor pose"


def black_plastic(lobe):
    """A wall of plastic of which one lobe is black."""
    black = {**PLASTIC, "type": "diff_pplastic", lobe: {"type": "uniform", "value": 0.0}}
    case = polar(
        f"polar_black_{lobe}",
        ALBEDO,
        lambda: metal_room(black, light=area_light()),
        set_color(f"wall.bsdf.{lobe}.value"),
        0.0,
        0.1,
        spp=8192,
        fd_spp=16384,
    )
    return replace(case, side=1, tags=("slow",))


CASES = [
    polar(
        "polar_albedo",
        ALBEDO,
        lambda: metal_room(side={"type": "diffuse", "reflectance": 0.5}),
        set_color("side.bsdf.reflectance.value"),
        0.5,
        0.02,
        spp=4096,
        fd_spp=4096,
    ),
    black_plastic("diffuse_reflectance"),
    black_plastic("specular_reflectance"),
    replace(
        polar(
            "polar_metal_of_index_zero",
            INDEX,
            lambda: metal_room({**METAL, "type": "diff_rough_conductor", "eta": 0.0}),
            set_color("wall.bsdf.eta.value"),
            0.0,
            0.01,
        ),
        side=1,
    ),
    polar("polar_metal_k", INDEX, metal_room, set_color("wall.bsdf.k.value"), 2.5, 0.02),
    polar(
        "polar_smooth_glass_index",
        INDEX,
        lambda: glass("diff_dielectric"),
        set_color("slab.bsdf.eta"),
        1.5,
        4e-3,
        spp=4096,
        fd_spp=4096,
    ),
    polar("polar_metal_alpha", ROUGHNESS, metal_room, set_color("wall.bsdf.alpha.value"), 0.3, 0.005),
    polar("polar_metal_spectral", ROUGHNESS, metal_room, set_color("wall.bsdf.alpha.value"), 0.3, 0.005, SPECTRAL),
    polar("polar_polarizer_angle", ELEMENT, lambda: filtered(POLARIZER), set_color("screen.bsdf.theta.value"), 20, 0.5),
    polar("polar_plate_angle", ELEMENT, lambda: filtered(PLATE), set_color("screen.bsdf.theta.value"), 30.0, 0.5),
    polar("polar_wall_distance", MOTION, metal_room, move("wall.to_world", (0, 0, 1)), 0.0, 1e-3),
    polar(
        "polar_two_sided_tilts",
        MOTION,
        from_behind,
        rotate("wall.to_world", (0.3, 1, 0)),
        0.0,
        0.1,
        fd_spp=8192,
    ),
    polar("polar_mirror_tilts", MOTION, mirrors, rotate("wall.to_world", (0.3, 1, 0)), 0.0, 0.05),
    polar(
        "polar_polarizer_turns",
        MOTION,
        lambda: filtered(POLARIZER),
        rotate("screen.to_world", (0, 0, 1)),
        0.0,
        0.5,
    ),
    polar(
        "polar_area_light_moves",
        MOTION,
        lambda: metal_room(light=area_light()),
        move("light.to_world", (0.2, 0.1, 1)),
        0.0,
        5e-3,
        spp=4096,
        fd_spp=4096,
    ),
    polar(
        "polar_camera_rolls",
        MOTION,
        lambda: filtered(POLARIZER, near=0.1),
        rotate("sensor.to_world", (0, 0, 1)),
        0.0,
        1.0,
        spp=1024,
        fd_spp=2048,
    ),
]
