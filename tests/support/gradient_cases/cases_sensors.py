"""Gradient cases of sensors: poses, lenses, plane cameras, meters on shapes, several at once."""

from __future__ import annotations

from support.gradient_cases.problem import Case
from support.gradient_cases.scenes import camera, film, room, transform
from support.gradient_cases.unknowns import move, rotate, set_color


def lens(**arguments):
    """A wide lens near the wall, out of focus."""
    return room(
        sensor={**camera(near=0.5), "type": "thinlens", "aperture_radius": 0.3, "focus_distance": 3.0, **arguments}
    )


def plane_camera():
    """An orthographic camera that sees the middle of the wall, scaled along its axis too."""
    sensor = {**camera(near=0.1), "type": "orthographic"}
    del sensor["fov"]
    sensor["to_world"] = sensor["to_world"] @ transform().scale([0.4, 0.4, 2.0])
    return room(sensor=sensor)


def batch():
    """Two cameras on one film."""
    first, second = camera(near=0.5), camera(origin=(0.4, 0.2, 3.5))
    for sensor in (first, second):
        sensor["film"] = {"type": "hdrfilm", "rfilter": {"type": "box"}}
    return room(sensor={"type": "batch", "film": film(), "first": first, "second": second})


def meter():
    """An irradiance meter that faces a wall without an end, lit from between: no ray meets an edge or a shadow."""
    scene = room(depth=2, light={"type": "point", "position": [0.5, 0.0, 1.0], "intensity": 10.0})
    del scene["sensor"], scene["side"]
    scene["wall"]["to_world"] = transform().scale(200.0)
    scene["meter"] = {
        "type": "rectangle",
        "to_world": transform().translate([0.2, 0.1, 2.0]).rotate([0, 1, 0], 180).scale(0.2),
        "sensor": {"type": "irradiancemeter", "film": film(start=2.5, bins=500, size=1)},
    }
    return scene


CASES = [
    Case(
        "sensor_rotation",
        "sensor pose",
        lambda: room(sensor=camera(near=1.0)),
        rotate("sensor.to_world", (0, 1, 0)),
        0.0,
        0.1,
        spp=2048,
        fd_spp=16384,
    ),
    Case(
        "sensor_fov",
        "sensor pose",
        lambda: room(sensor=camera(near=1.0)),
        set_color("sensor.x_fov"),
        10.0,
        0.05,
        spp=2048,
    ),
    Case(
        "lens_aperture",
        "aperture and focus of a thin lens",
        lens,
        set_color("sensor.aperture_radius"),
        0.3,
        5e-3,
        spp=4096,
        fd_spp=8192,
    ),
    Case(
        "lens_focus",
        "aperture and focus of a thin lens",
        lens,
        set_color("sensor.focus_distance"),
        3.0,
        2e-2,
        spp=4096,
        fd_spp=8192,
    ),
    Case(
        "orthographic_moves",
        "sensor pose",
        plane_camera,
        move("sensor.to_world", (0.5, 0, 1)),
        0.0,
        2e-3,
        spp=2048,
        fd_spp=4096,
    ),
    Case(
        "batch_child_moves",
        "sensor pose",
        batch,
        move("sensor.second.to_world", (0.5, 0, 1)),
        0.0,
        2e-3,
        spp=2048,
        fd_spp=4096,
    ),
    Case(
        "meter_moves",
        "shape of an irradiance meter",
        meter,
        move("meter.to_world", (0, 0, 1)),
        0.0,
        5e-3,
        spp=262144,
        seeds=8,
    ),
]
