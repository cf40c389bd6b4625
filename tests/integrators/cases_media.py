"""Gradient cases with participating media, for the matrix of gradient tests."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from gradient_cases import Case, area_light, camera, move, move_point, room, scale_texture, set_color, transform


def homogeneous(sigma_t=0.8, albedo=0.7, g=0.4, **arguments):
    return {
        "type": "homogeneous",
        "sigma_t": sigma_t,
        "albedo": albedo,
        "phase": {"type": "hg", "g": g},
        **arguments,
    }


def volume(data, low=(-1.0, -1.0, 0.5), size=(2.0, 2.0, 1.5)):
    data = np.asarray(data, dtype=np.float32)
    pose = transform().translate(list(low)).scale(list(size))
    return {"type": "gridvolume", "data": mi.TensorXf(data.reshape(*data.shape[:3], -1)), "to_world": pose}


def clouds(density=None, **arguments):
    if density is None:
        density = np.random.default_rng(1).uniform(0.2, 1.0, (3, 3, 3))
    return {"type": "heterogeneous", "sigma_t": volume(density), "albedo": 0.7, **arguments}


def block(medium, bsdf=None, **arguments):
    """A block of medium before the wall of the plain room."""
    scene = room(
        bsdf={"type": "diffuse", "reflectance": 0.5},
        block={
            "type": "cube",
            "to_world": transform().translate([0, 0, 1.25]).scale([1, 1, 0.75]),
            "bsdf": bsdf or {"type": "null"},
            "interior": medium,
        },
        **({"depth": 4} | arguments),
    )
    scene["integrator"]["type"] = "transient_prbvolpath"
    return scene


def fog(medium, light=None, **arguments):
    """The plain room filled with a medium, which the sensor stands in: every surface has it on both sides."""
    scene = room(light=light, **({"depth": 4} | arguments))
    scene["integrator"]["type"] = "transient_prbvolpath"
    scene["fog"] = medium
    scene["sensor"]["medium"] = {"type": "ref", "id": "fog"}
    for name in ("wall", "side"):
        scene[name]["interior"] = scene[name]["exterior"] = {"type": "ref", "id": "fog"}
    return scene


ROW_DENSITY, ROW_ALBEDO, ROW_PHASE = "medium extinction", "medium albedo", "phase function"
ROW_GRID, ROW_LENGTHS = "density and albedo grids", "path lengths in media"

BLOCK = "block.interior_medium."


def sparse():
    """A grid with cells of no density and with many at the maximum."""
    return np.array([0.0, 0.0, 1.0, 1.0, 1.0, 0.3, 0.0, 1.0, 0.0]).repeat(3).reshape(3, 3, 3)


def pool(medium, bsdf):
    """A tilted slab of glass that is filled with a medium, before the wall."""
    scene = block(medium, bsdf, light={"type": "point", "position": [1.8, 0.0, 2.0], "intensity": 10.0})
    pose = transform().translate([0, 0, 2.2]).rotate([0, 1, 0], 30).scale([0.8, 0.8, 0.3])
    scene["block"]["to_world"] = pose
    scene["wall"]["to_world"] = transform().scale(3)
    return scene


def rough_pool(eta=1.3):
    return pool(homogeneous(), {"type": "diff_rough_dielectric", "alpha": 0.3, "int_ior": eta, "ext_ior": 1.0})


def smooth_pool(eta=1.3):
    return pool(homogeneous(), {"type": "diff_dielectric", "int_ior": eta, "ext_ior": 1.0})


def lamp(shape="rectangle"):
    return {"light": area_light(shape)}


def wide_lamp():
    """A lamp beside the camera's field of view."""
    pose = transform().translate([1.0, 0.2, 2.0]).rotate([0, 1, 0], 215).scale(0.5)
    return {"light": {"type": "rectangle", "to_world": pose, "emitter": {"type": "area", "radiance": 9.0}}, "depth": 3}


def set_rgb(key, channel):
    """One channel of a colour."""

    def apply(params, x):
        colour = mi.Color3f(params[key])
        colour[channel] = x
        params[key] = colour

    return apply


def coloured():
    return homogeneous({"type": "rgb", "value": [0.4, 0.8, 0.2]}, {"type": "rgb", "value": [0.9, 0.3, 0.6]}, scale=2.0)


def thicken(key):
    """Move the front of the block towards the camera."""

    def apply(params, x):
        p = dr.unravel(mi.Point3f, params[key])
        p.z += dr.select(p.z > 1.25, x, 0)
        params[key] = dr.ravel(p)

    return apply


def blended():
    parts = {"a": {"type": "hg", "g": 0.7}, "b": {"type": "isotropic"}}
    return homogeneous() | {"phase": {"type": "blendphase", "weight": 0.4, **parts}}


def case(name, row, scene, apply, value, step, **arguments):
    return Case(name, row, scene, apply, value, step, **arguments)


CASES = [
    case("medium_sigma_t", ROW_DENSITY, lambda: block(homogeneous()), set_color(BLOCK + "sigma_t.value.value"), 0.8, 0.02),
    case("medium_sigma_t_rgb", ROW_DENSITY, lambda: block(coloured()), set_rgb(BLOCK + "sigma_t.value.value", 1), 0.8, 0.05, variant="llvm_ad_rgb", spp=1024, fd_spp=8192),
    case("medium_sigma_t_fog", ROW_DENSITY, lambda: fog(homogeneous(0.3)), set_color("sensor.medium.sigma_t.value.value"), 0.3, 0.05, spp=4096, fd_spp=16384),
    case("medium_albedo", ROW_ALBEDO, lambda: block(homogeneous()), set_color(BLOCK + "albedo.value.value"), 0.7, 0.02),
    case("medium_albedo_zero", ROW_ALBEDO, lambda: block(homogeneous(albedo=0.0)), set_color(BLOCK + "albedo.value.value"), 0.0, 0.02),
    case("medium_g", ROW_PHASE, lambda: block(homogeneous()), set_color(BLOCK + "phase_function.g"), 0.4, 0.02),
    case("medium_blend", ROW_PHASE, lambda: block(blended()), set_color(BLOCK + "phase_function.weight.value.value"), 0.4, 0.02),
    case("medium_grid", ROW_GRID, lambda: block(clouds()), scale_texture(BLOCK + "sigma_t.data"), 0.0, 0.02),
    case("medium_grid_sparse", ROW_GRID, lambda: block(clouds(sparse())), scale_texture(BLOCK + "sigma_t.data"), 0.0, 0.02),
    case("medium_albedo_grid", ROW_GRID, lambda: block(clouds(albedo=volume(sparse()))), scale_texture(BLOCK + "albedo.data"), 0.0, 0.02),
    case("medium_sigma_t_smooth", ROW_DENSITY, smooth_pool, set_color(BLOCK + "sigma_t.value.value"), 0.8, 0.02),
    case("medium_sigma_t_rough", ROW_DENSITY, rough_pool, set_color(BLOCK + "sigma_t.value.value"), 0.8, 0.02),
    case("medium_wall_behind", ROW_LENGTHS, lambda: block(homogeneous()), move("wall.to_world", (0, 0, 1)), 0.0, 2e-3),
    case("medium_wall_in_fog", ROW_LENGTHS, lambda: fog(homogeneous(0.3)), move("wall.to_world", (0, 0, 1)), 0.0, 2e-3),
    case("medium_wall_grid", ROW_LENGTHS, lambda: block(clouds()), move("wall.to_world", (0, 0, 1)), 0.0, 2e-3),
    case("medium_light", ROW_LENGTHS, lambda: fog(homogeneous(0.3)), move_point("light.position", (0, 0, 1)), 0.0, 2e-3),
    case("medium_light_block", ROW_LENGTHS, lambda: block(homogeneous()), move_point("light.position", (0, 0, 1)), 0.0, 2e-3),
    case("medium_lamp", ROW_LENGTHS, lambda: fog(homogeneous(0.1), **wide_lamp()), move("light.to_world", (0, 0, 1)), 0.0, 4e-3, spp=4096),
    case("medium_ball", ROW_LENGTHS, lambda: fog(homogeneous(0.3), **lamp("sphere")), move("light.to_world", (0, 0, 1)), 0.0, 2e-3),
    case("medium_lamp_block", ROW_LENGTHS, lambda: block(homogeneous(), **lamp()), move("light.to_world", (1, 0, 0)), 0.0, 2e-3),
    case("medium_camera", ROW_LENGTHS, lambda: block(homogeneous()), move("sensor.to_world", (0, 0, 1)), 0.0, 2e-3),
    case("medium_camera_fog", ROW_LENGTHS, lambda: fog(homogeneous(0.3)), move("sensor.to_world", (0, 0, 1)), 0.0, 2e-3),
    case("medium_index_smooth", ROW_LENGTHS, smooth_pool, set_color("block.bsdf.eta"), 1.3, 2e-3),
    case("medium_index_rough", ROW_LENGTHS, rough_pool, set_color("block.bsdf.eta"), 1.3, 2e-3),
    case("medium_boundary", ROW_LENGTHS, lambda: block(homogeneous()), thicken("block.vertex_positions"), 0.0, 2e-2),
]  # fmt: skip
