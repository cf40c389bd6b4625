"""Gradient cases with participating media, for the matrix of gradient tests."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from support.gradient_cases.problem import Case
from support.gradient_cases.scenes import area_light, room, transform
from support.gradient_cases.unknowns import move, move_point, move_vertices, scale_texture, set_color


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
    # Scattering points see the rim of the wall: far away, it casts no moving silhouette.
    scene["wall"]["to_world"] = transform().scale(20)
    return scene


SPHERE = {"type": "sphere", "center": [0, 0, 1], "radius": 0.6}
COLUMN = {"type": "cylinder", "p0": [0, -30, 1], "p1": [0, 30, 1], "radius": 0.6}


def ball(medium, shape=SPHERE, **arguments):
    """A ball of medium, or a column, before the wall; nothing else casts a shadow."""
    scene = block(medium, **arguments)
    scene["block"] = {key: value for key, value in scene["block"].items() if key != "to_world"} | shape
    del scene["side"]
    return scene


def under_the_sky(medium):
    """A ball of medium before a wall without a rim, below a sky that is dark towards the horizon."""
    sky = np.zeros((32, 64, 3), np.float32)
    sky[:8] = np.linspace(1.5, 0.5, 8)[:, None, None]
    pose = transform().rotate([1, 0, 0], 90)
    scene = ball(medium, light={"type": "envmap", "bitmap": mi.Bitmap(sky), "to_world": pose}, depth=3)
    u = (np.arange(64) + 0.5) / 64 - 0.5
    reflectance = np.clip((0.45 - np.hypot(u[:, None], u)) / 0.3, 0, 0.5).astype(np.float32)
    texture = {"type": "bitmap", "data": mi.TensorXf(reflectance[..., None]), "raw": True}
    scene["wall"] |= {"to_world": transform().scale(3), "bsdf": {"type": "diffuse", "reflectance": texture}}
    scene["sensor"]["film"] |= {"temporal_bins": 400, "bin_width_opl": 0.05}
    return scene


def inside_a_ball(medium):
    """The camera in a ball of thin fog, and a ball of ``medium`` in there; the light stands beside it."""
    light = {"type": "point", "position": [1.9, 0.0, 4.0], "intensity": 10.0}
    scene = ball(medium, {"type": "sphere", "center": [0, 0, 2.8], "radius": 0.4}, light=light, depth=3)
    scene["fog"] = homogeneous(0.4, 0.9, 0.3)
    fog = {"type": "ref", "id": "fog"}
    null = {"type": "null"}
    scene["around"] = {"type": "sphere", "center": [0, 0, 3.5], "radius": 1.5, "bsdf": null, "interior": fog}
    scene["block"]["exterior"] = scene["sensor"]["medium"] = fog
    return scene


def fog(medium, light=None, **arguments):
    """The plain room filled with a medium, which the sensor stands in: every surface has it on both sides."""
    scene = room(light=light, **({"depth": 4} | arguments))
    scene["integrator"]["type"] = "transient_prbvolpath"
    scene["fog"] = medium
    scene["wall"]["to_world"] = transform().scale(20)
    scene["sensor"]["medium"] = {"type": "ref", "id": "fog"}
    for name in ("wall", "side"):
        scene[name]["interior"] = scene[name]["exterior"] = {"type": "ref", "id": "fog"}
    return scene


def sparse():
    """A grid with cells of hardly any density and with many at the maximum."""
    return np.array([0.02, 0.02, 1.0, 1.0, 1.0, 0.3, 0.02, 1.0, 0.02]).repeat(3).reshape(3, 3, 3)


def pool(medium, bsdf):
    """A tilted slab of glass that is filled with a medium, before the wall."""
    scene = block(medium, bsdf, light={"type": "point", "position": [1.8, 0.0, 2.0], "intensity": 10.0})
    pose = transform().translate([0, 0, 2.2]).rotate([0, 1, 0], 30).scale([0.8, 0.8, 0.3])
    scene["block"]["to_world"] = pose
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


def flakes():
    """Flakes that lie in no axis of the scene: how much light they stop depends on its direction."""
    S = np.broadcast_to(np.float32([0.3, 0.6, 0.9, 0.05, -0.1, 0.08]), (2, 2, 2, 6))
    return {"type": "sggx", "S": volume(S)}


def turn_flakes(key):
    """Change all six entries of the flakes' matrix."""

    def apply(params, x):
        change = np.tile(np.float32([0.5, -0.3, 0.4, 0.2, 0.1, -0.1]), 8)
        params[key] = mi.TensorXf(params[key].array + mi.Float(change) * x, params[key].shape)

    return apply


def blended():
    parts = {"a": {"type": "hg", "g": 0.7}, "b": {"type": "isotropic"}}
    return homogeneous() | {"phase": {"type": "blendphase", "weight": 0.4, **parts}}


SLOW = ("slow",)
SIGMA_T, ALBEDO = "block.interior_medium.sigma_t.value.value", "block.interior_medium.albedo.value.value"
PHASE = "block.interior_medium.phase_function."
GRID, ALBEDO_GRID = "block.interior_medium.sigma_t.data", "block.interior_medium.albedo.data"
FORWARD = (0, 0, 1)

BLOCKS = {
    "plain": lambda: block(homogeneous()),
    "coloured": lambda: block(coloured()),
    "black": lambda: block(homogeneous(albedo=0.0)),
    "blended": lambda: block(blended()),
    "clouds of flakes": lambda: block(clouds(phase=flakes())),
    "clouds": lambda: block(clouds()),
    "sparse": lambda: block(clouds(sparse())),
    "albedo grid": lambda: block(clouds(albedo=volume(sparse()))),
    "fog": lambda: fog(homogeneous(0.3)),
    # Deeper paths have vertices that come as close to the moving wall as they like: right, and of unbounded variance.
    "fog, scattered once": lambda: fog(homogeneous(0.3), depth=2),
    "fog and lamp": lambda: fog(homogeneous(0.1), **wide_lamp()),
    "ball": lambda: ball(homogeneous(1.0, 0.9), depth=2),
    "dense": lambda: block(homogeneous(1.5, 0.9, 0.0)),
    "column and lamp": lambda: ball(homogeneous(1.0, 0.9), COLUMN, **lamp()),
    "ball under the sky": lambda: under_the_sky(homogeneous(1.0, 0.9, 0.3)),
    "inside a ball": lambda: inside_a_ball(homogeneous(1.5, 0.8, 0.0)),
    "smooth glass": smooth_pool,
    "rough glass": rough_pool,
}


def with_phasors():
    """The block seen by a phasor film."""
    scene = block(homogeneous())
    size = {key: scene["sensor"]["film"][key] for key in ("width", "height", "rfilter")}
    scene["sensor"]["film"] = {"type": "phasor_hdr_film", **size, "start_opl": 6.0, "frequencies": "0.1, 0.35, 0.6"}
    return scene


def over_metal():
    """The block before a wall of metal, which polarizes."""
    scene = block(homogeneous())
    scene["wall"]["bsdf"] = {"type": "roughconductor", "material": "Al", "alpha": 0.5}
    return scene


BLOCKS |= {"phasors": with_phasors, "metal": over_metal}


def case(name, row, scene, apply, value, step, **arguments):
    return Case("medium_" + name, row, BLOCKS[scene], apply, value, step, **arguments)


def lengths(name, scene, apply, step=2e-3, value=0.0, **arguments):
    return case(name, "path lengths in media", scene, apply, value, step, **arguments)


CASES = [
    case("sigma_t", "medium extinction", "plain", set_color(SIGMA_T), 0.8, 0.02),
    case("sigma_t_rough", "medium extinction", "rough glass", set_color(SIGMA_T), 0.8, 0.02),
    case(
        "sigma_t_rgb", "medium extinction", "coloured", set_rgb(SIGMA_T, 1), 0.8, 0.05,
        variant="llvm_ad_rgb", fd_spp=8192,
    ),
    case("albedo", "medium albedo", "plain", set_color(ALBEDO), 0.7, 0.02, spp=4096, fd_spp=4096),
    case("albedo_zero", "medium albedo", "black", set_color(ALBEDO), 0.0, 0.02),
    case("g", "phase function", "plain", set_color(PHASE + "g"), 0.4, 0.02),
    case("blend", "phase function", "blended", set_color(PHASE + "weight.value.value"), 0.4, 0.02, tags=SLOW),
    case("flakes_in_clouds", "flakes (sggx)", "clouds of flakes", turn_flakes(PHASE + "S.data"), 0.0, 0.02),
    case("grid_sparse", "density and albedo grids", "sparse", scale_texture(GRID), 0.0, 0.02),
    case(
        "albedo_grid", "density and albedo grids", "albedo grid", scale_texture(ALBEDO_GRID), 0.0, 0.02,
        spp=4096, fd_spp=4096, tags=SLOW,
    ),
    lengths("wall_behind", "plain", move("wall.to_world", FORWARD)),
    lengths("wall_in_fog", "fog, scattered once", move("wall.to_world", FORWARD)),
    lengths("wall_behind_grid", "clouds", move("wall.to_world", FORWARD), tags=SLOW),
    lengths("wall_behind_column", "column and lamp", move("wall.to_world", FORWARD), spp=4096),
    lengths("wall_under_the_sky", "ball under the sky", move("wall.to_world", FORWARD), spp=8192, tags=SLOW),
    lengths("camera_in_ball", "inside a ball", move("sensor.to_world", FORWARD), spp=4096, seeds=24, tags=SLOW),
    lengths("ball", "ball", move("block.to_world", FORWARD), step=8e-3, spp=16384, tags=SLOW),
    lengths("light_in_fog", "fog", move_point("light.position", FORWARD)),
    lengths("lamp_in_fog", "fog and lamp", move("light.to_world", FORWARD), step=4e-3, spp=4096, fd_spp=4096),
    lengths("camera_in_fog", "fog", move("sensor.to_world", FORWARD), tags=SLOW),
    lengths("index_smooth", "smooth glass", set_color("block.bsdf.eta"), value=1.3),
    lengths("index_rough", "rough glass", set_color("block.bsdf.eta"), value=1.3, tags=SLOW),
    case(
        "polar_sigma_t", "medium extinction", "metal", set_color(SIGMA_T), 0.8, 0.05,
        variant="llvm_ad_mono_polarized", fd_spp=8192, tags=SLOW,
    ),
    lengths(
        "polar_wall", "metal", move("wall.to_world", FORWARD), variant="llvm_ad_mono_polarized", spp=4096,
        fd_spp=4096, tags=SLOW,
    ),
    # Vertices in a moving medium see each other at any distance.
    lengths(
        "block_moves", "dense", move_vertices("block.vertex_positions", FORWARD), step=8e-3, spp=32768, tags=SLOW
    ),
    lengths("boundary", "plain", thicken("block.vertex_positions"), step=2e-2, tags=SLOW),
]  # fmt: skip
