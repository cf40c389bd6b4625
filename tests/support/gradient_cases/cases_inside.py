"""Gradient cases of sensors that stand in glass: its index changes all lengths up to its surface."""

from __future__ import annotations

from support.gradient_cases.problem import Case
from support.gradient_cases.scenes import camera, room, transform
from support.gradient_cases.unknowns import move, set_color

SMOOTH = {"type": "diff_dielectric", "int_ior": 1.5}


def in_a_cube(bsdf=None, sensor=None, depth=3, **more):
    """The camera in a cube of glass before a wall without an end, lit from between the two."""
    scene = room(
        sensor=sensor or camera(origin=(0, 0, 4), near=0.3, start=4.0, bins=400),
        light={"type": "point", "position": [0.5, 0.0, 1.2], "intensity": 10.0}, depth=depth,
    )  # fmt: skip
    del scene["side"]
    scene["wall"]["to_world"] = transform().scale(50)
    # Turned a little: light leaves it at an angle.
    pose = transform().translate([0, 0, 4]).rotate([0, 1, 0], 20).scale([1.0, 1.0, 1.2])
    return {**scene, "body": {"type": "cube", "to_world": pose, "bsdf": bsdf or SMOOTH}, **more}


def drop():
    """A ball of water in the glass, around the camera."""
    water = {"type": "sphere", "center": [0, 0, 4], "radius": 0.5, "bsdf": {**SMOOTH, "int_ior": 1.33, "ext_ior": 1.5}}
    return in_a_cube(drop=water, depth=4)


ROW = "dielectric index, smooth"
CASES = [
    Case("glass_around_camera_index", ROW, in_a_cube, set_color("body.bsdf.eta"), 1.5, 2e-3, spp=4096),
    Case("glass_around_drop_index", ROW, drop, set_color("drop.bsdf.eta"), 1.33 / 1.5, 1e-3, spp=8192),
    Case(
        "glass_around_polarized_camera_index", ROW, in_a_cube, set_color("body.bsdf.eta"), 1.5, 2e-3,
        variant="llvm_ad_mono_polarized", spp=4096,
    ),
    Case(
        "rough_glass_around_camera_index", "dielectric index, rough",
        lambda: in_a_cube({"type": "diff_rough_dielectric", "int_ior": 1.5, "alpha": 0.3}),
        set_color("body.bsdf.eta"), 1.5, 5e-3, spp=1 << 15, seeds=8, tags=("slow",),
    ),
    Case("camera_moves_in_glass", "sensor pose", in_a_cube, move("sensor.to_world", (0.3, 0, 1)), 0.0, 2e-3, spp=4096),
]  # fmt: skip
