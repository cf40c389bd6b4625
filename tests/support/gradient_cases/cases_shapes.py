"""Gradient cases of shapes that move before every kind of light, mirror and glass."""

from __future__ import annotations

from support.gradient_cases.problem import Case
from support.gradient_cases.scenes import camera, glass_slab, mirror_room, room, transform
from support.gradient_cases.unknowns import move, move_vertices, rotate

CASES = [
    Case("wall_distance", "shape to_world", room, move("wall.to_world", (0, 0, 1)), 0.0, 2e-3, spp=2048),
    Case("wall_tilt", "shape to_world", room, rotate("wall.to_world", (0, 1, 0)), 0.0, 0.1, spp=4096, fd_spp=32768),
    Case(
        "side_moves",
        "shape to_world",
        room,
        move("side.to_world", (-1, 0, 0.4)),
        0.0,
        2e-2,
        spp=4096,
        fd_spp=16384,
    ),
    Case(
        "mesh_vertices",
        "mesh vertex positions",
        lambda: room(
            wall2={
                "type": "cube",
                "to_world": transform().translate([0, 0, -0.5]).scale([2, 2, 0.52]),
                "bsdf": {"type": "diffuse", "reflectance": 0.4},
            }
        ),
        move_vertices("wall2.vertex_positions", (0, 0, 1)),
        0.0,
        2e-3,
        spp=2048,
    ),
    Case(
        "wall_under_sky",
        "shape to_world",
        lambda: room(light={"type": "constant", "radiance": 1.0}, sensor=camera(start=2.0)),
        move("wall.to_world", (0, 0, 1)),
        0.0,
        4e-3,
        spp=8192,
    ),
    Case(
        "wall_in_sunlight",
        "shape to_world",
        lambda: room(
            light={"type": "directional", "direction": [-0.3, 0.1, -1.0], "irradiance": 3.0}, sensor=camera(start=4.0)
        ),
        move("wall.to_world", (0, 0, 1)),
        0.0,
        2e-3,
        spp=2048,
    ),
    Case(
        "mirror_tilts",
        "mirror: to_world",
        lambda: mirror_room(),
        rotate("wall.to_world", (0, 1, 0)),
        0.0,
        0.05,
        spp=4096,
    ),
    Case(
        "rough_mirror_moves",
        "shape to_world",
        lambda: mirror_room({"type": "roughconductor", "alpha": 0.2, "distribution": "ggx"}),
        move("wall.to_world", (0, 0, 1)),
        0.0,
        4e-3,
        spp=32768,
    ),
    Case(
        "thin_glass_tilts",
        "shape to_world",
        lambda: glass_slab({"type": "thindielectric", "int_ior": 1.5}, "rectangle"),
        rotate("slab.to_world", (0, 1, 0)),
        0.0,
        0.5,
        spp=8192,
        fd_spp=65536,
    ),
    Case(
        "ball_moves",
        "shape to_world",
        lambda: room(
            ball={
                "type": "sphere",
                "center": [0, 0, -2.0],
                "radius": 2.2,
                "bsdf": {"type": "diffuse", "reflectance": 0.5},
            }
        ),
        move("ball.to_world", (0, 0, 1)),
        0.0,
        2e-3,
        spp=2048,
    ),
    Case("wall_rgb", "shape to_world", room, move("wall.to_world", (0, 0, 1)), 0.0, 2e-3, "llvm_ad_rgb", 2048),
]
