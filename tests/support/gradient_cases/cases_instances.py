"""Gradient cases of shapes inside instances: their poses, those of the copies, and both at once."""

from __future__ import annotations

from support.gradient_cases.cases_normals import distance_grid, mirror_mesh, tilt_normals
from support.gradient_cases.cases_polar import VARIANT, metal_room
from support.gradient_cases.problem import Case
from support.gradient_cases.scenes import camera, instances, mirror_room, room, transform
from support.gradient_cases.unknowns import move, rotate

BALL = {"type": "sphere", "center": [0, 0, -2.0], "radius": 2.2}
ROW = "instance: to_world, shapes in its group"


def grouped(scene, name="wall", to_world=None):
    """The scene with one of its shapes in a group, and an instance of that."""
    shape = scene.pop(name)
    copy = {"type": "instance", "to_world": to_world or transform(), "group": {"type": "ref", "id": "group"}}
    return {**scene, "group": {"type": "shapegroup", name: shape}, "copy": copy}


def squashed():
    """Stretched along slanted axes, and mirrored."""
    return transform().rotate([0, 1, 0], 10).scale([1.1, -1.2, 0.9]).rotate([0, 1, 0], -10)


def ball(bsdf, base):
    """A base scene with a ball for its wall, in a squashed instance."""
    return grouped({**base, "wall": BALL | {"bsdf": bsdf}}, to_world=squashed())


def turn_both(params, x):
    for key in ("group.wall.to_world", "copy.to_world"):
        rotate(key, (0, 1, 0))(params, x)


def glass_plate():
    return instances({"type": "diff_dielectric", "int_ior": 1.5, "ext_ior": 1.0})


CASES = [
    Case("instance_turns", ROW, lambda: grouped(room()), rotate("copy.to_world", (0, 1, 0)), 0.0, 0.1, fd_spp=16384),
    Case("instance_of_glass_turns", ROW, glass_plate, rotate("copy.to_world", (0, 1, 0)), 0.0, 0.1, fd_spp=4096),
    Case(
        "ball_in_an_instance_moves",
        ROW,
        lambda: ball({"type": "diffuse", "reflectance": 0.5}, room(sensor=camera(fov=6.0))),
        move("group.wall.to_world", (0.3, 0, 1)),
        0.0,
        2e-3,
        fd_spp=4096,
    ),
    Case(
        "instance_and_its_mirror_turn",
        ROW,
        lambda: grouped(mirror_room(), to_world=squashed()),
        turn_both,
        0.0,
        0.05,
    ),
    Case(
        "normals_in_an_instance",
        ROW,
        lambda: grouped(mirror_mesh(), to_world=squashed()),
        tilt_normals("group.wall.vertex_normals"),
        0.0,
        2e-3,
    ),
    Case(
        "instance_of_a_grid_turns", ROW, lambda: grouped(distance_grid()), rotate("copy.to_world", (0, 1, 0)), 0.0, 0.1
    ),
    Case(
        "polar_instance_turns",
        ROW,
        lambda: grouped(metal_room(), to_world=squashed()),
        rotate("copy.to_world", (0, 1, 0.4)),
        0.0,
        0.3,
        VARIANT,
        fd_spp=4096,
    ),
]
