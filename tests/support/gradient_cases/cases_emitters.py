"""Gradient cases of emitters: what they emit, where they are."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from support.gradient_cases.problem import Case
from support.gradient_cases.scenes import area_light, camera, room, transform
from support.gradient_cases.unknowns import move, move_point, scale_texture, set_color


def picture_sky():
    """An environment map with a gradient in it."""
    data = np.linspace(0.5, 1.5, 8 * 16, dtype=np.float32).reshape(8, 16, 1)
    return {"type": "envmap", "bitmap": mi.Bitmap(np.repeat(data, 3, axis=2))}


def projector():
    """A projector beside the camera, aimed at the wall."""
    pose = transform().look_at([0.5, 0, 4], [0, 0, 0], [0, 1, 0])
    return {"type": "projector", "irradiance": 2.0, "fov": 40.0, "to_world": pose, "scale": 1.0}


def lamp_under_a_sky(integrator="transient_path"):
    """An area light and light from everywhere."""
    scene = room(light=area_light(), sky=picture_sky(), sensor=camera(start=2.0), side_reflectance=0.2)
    scene["integrator"]["type"] = integrator
    return scene


def color_beside_a_pose(params, x):
    """The pose is asked for beside the colour, and stays."""
    set_color("wall.bsdf.reflectance.value")(params, x)
    # Opaque: Dr.Jit detaches what is multiplied by a zero that it knows.
    move("light.to_world", (1, 0, 0))(params, dr.opaque(mi.Float, 0) * x)


def angular_light():
    """An area light that emits into a cone with a soft rim."""
    lamp = area_light()
    lamp["emitter"] = {"type": "angulararea", "radiance": 9.0, "cutoff_angle": 60.0, "beam_width": 5.0}
    return lamp


def sky_with_sun():
    return {"type": "sunsky", "sun_direction": [0.3, 0.4, 0.7]}


def turn_sun(params, x):
    # Not of unit length on the way: Mitsuba reads angles from it as if it were.
    params["light.sun_direction"] = mi.Vector3f(params["light.sun_direction"]) + mi.Vector3f(0.3, -0.2, 0.5) * x


CASES = [
    Case(
        "area_radiance",
        "emitter radiance or intensity",
        lambda: room(light=area_light()),
        set_color("light.emitter.radiance.value"),
        9.0,
        0.5,
    ),
    Case("point_position", "point and spot light position", room, move_point("light.position", (0, 0.3, 1)), 0.0, 4e-3),
    Case(
        "spot_position",
        "point and spot light position",
        lambda: room(
            light={
                "type": "spot",
                "intensity": 10.0,
                "cutoff_angle": 30.0,
                "beam_width": 5.0,
                "to_world": transform().look_at([0.5, 0, 4], [0.2, 0, 0], [0, 1, 0]),
            }
        ),
        move("light.to_world", (0.3, 0, 1)),
        0.0,
        4e-3,
    ),
    Case(
        "area_light_moves",
        "area light shape",
        lambda: room(light=area_light(), side_reflectance=0.2),
        move("light.to_world", (0.2, 0.1, 1)),
        0.0,
        5e-3,
        spp=4096,
    ),
    Case(
        "sphere_light_moves",
        "area light shape",
        lambda: room(light=area_light("sphere", 0.15), side_reflectance=0.2),
        move("light.to_world", (0.2, 0.1, 1)),
        0.0,
        5e-3,
        spp=4096,
    ),
    Case(
        "sky_texture",
        "environment radiance",
        lambda: room(light=picture_sky(), sensor=camera(start=2.0)),
        scale_texture("light.data"),
        0.0,
        0.05,
        spp=4096,
    ),
    Case(
        "sun_direction",
        "direction of the sun",
        lambda: room(light=sky_with_sun(), sensor=camera(start=2.0, bins=400)),
        turn_sun,
        0.0,
        0.01,
        variant="llvm_ad_rgb",
        spp=4096,
    ),
    Case("color_beside_a_lamp_and_a_sky", "area light shape", lamp_under_a_sky, color_beside_a_pose, 0.5, 0.05),
    Case(
        "angular_light_moves",
        "area light shape",
        lambda: room(light=angular_light(), side_reflectance=0.2),
        move("light.to_world", (0.2, 0.1, 1)),
        0.0,
        5e-3,
        spp=4096,
    ),
]
