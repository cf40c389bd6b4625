"""Gradient cases of curves and ellipsoids, and of what the texture coordinates of a light place."""

from __future__ import annotations

import tempfile
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from support.gradient_cases.cases_instances import grouped, squashed
from support.gradient_cases.cases_normals import MIRROR
from support.gradient_cases.problem import Case
from support.gradient_cases.scenes import camera, mirror_room, room, transform

# Goes when the process does.
_FOLDER = tempfile.TemporaryDirectory(prefix="shapes")
ELLIPSOIDS, CURVES = "ellipsoids: data, opacities", "curves: control points"
DIFFUSE = {"type": "diffuse", "reflectance": 0.5}


def file_of(name, text):
    """The path of a file for a plugin to read."""
    path = Path(_FOLDER.name) / name
    path.write_text(text)
    return str(path)


def seen_wall(shape, bsdf=DIFFUSE):
    """A shape that fills the view in place of the wall."""
    light = {"type": "point", "position": [0.3, 0.2, 4.0], "intensity": 10.0}
    scene = room(light=light, sensor=camera(fov=6.0)) | {"wall": shape | {"bsdf": bsdf}}
    del scene["side"]
    return scene


def mirror(shape):
    """A shape in place of the mirror of the mirror room."""
    return mirror_room() | {"wall": shape | {"bsdf": MIRROR}}


def ellipsoid(kind="ellipsoids", **arguments):
    """One ellipsoid, turned by 20 degrees."""
    data = [[0.0, 0.0, -2.0, 2.2, 2.0, 2.0, 0.0, 0.17364818, 0.0, 0.98480775]]
    return {"type": kind, "data": mi.TensorXf(np.array(data, dtype=np.float32)), "extent": 1.0} | arguments


def clamped():
    """An ellipsoid that ends where its opacity has faded."""
    opacities = mi.TensorXf(np.array([[0.9]], dtype=np.float32))
    return ellipsoid(extent=1.0, extent_adaptive_clamping=True, opacities=opacities)


def curve(kind):
    """A thick curve along y whose radius changes."""
    points = [(0.2 * y, y, -radius, radius) for y, radius in ((-6, 1.5), (-3, 1.8), (0, 2.0), (2.5, 1.9), (5, 1.8))]
    text = "\n".join(" ".join(map(str, point)) for point in points)
    return {"type": kind, "filename": file_of(f"{kind}.txt", text)}


def along(key, direction):
    """Change every ``len(direction)`` numbers of a parameter by ``x`` times ``direction``."""

    def apply(params, x):
        value = params[key]
        step = mi.Float(np.resize(np.array(direction, dtype=np.float32), dr.width(value)))
        changed = mi.Float(value.array if dr.is_tensor_v(value) else value) + step * x
        params[key] = type(value)(changed, value.shape) if dr.is_tensor_v(value) else changed

    return apply


# --------------------------------------------------------------------------------------------------- patterns of lights

QUAD = """v -1 -1 0
v 1 -1 0
v 1 1 0
v -1 1 0
vt 0.2 0.2
vt 0.8 0.2
vt 0.8 0.8
vt 0.2 0.8
f 1/1 2/2 3/3
f 1/1 3/3 4/4
"""


BARE = "v -1 -1 0\nv 1 -1 0\nv 1 1 0\nv -1 1 0\nf 1 2 3\nf 1 3 4\n"


def lit_by_mesh(text, emitter, name):
    """The room lit by a mesh of two triangles."""
    light = {
        "type": "obj",
        "filename": file_of(name, text),
        "to_world": transform().translate([1.2, 0.2, 1.5]).rotate([0, 1, 0], 200).scale(0.5),
        "emitter": emitter,
    }
    scene = room(light=light, depth=3, sensor=camera(start=4.5))
    del scene["side"]
    return scene


def patterned_light():
    """One with a smooth pattern."""
    y, x = np.mgrid[0:8, 0:8] / 8
    pixels = (1 + 0.8 * np.sin(3 * x + 1) * np.cos(2 * y)).astype(np.float32)[..., None]
    radiance = {"type": "bitmap", "bitmap": mi.Bitmap(pixels), "raw": True}
    return lit_by_mesh(QUAD, {"type": "area", "radiance": radiance}, "quad.obj")


def bare_light(kind="area", **arguments):
    """One without texture coordinates."""
    return lit_by_mesh(BARE, {"type": kind, "radiance": 3.0, **arguments}, "bare.obj")


SMOOTH = """v -1 -1 0
v 1 -1 0
v 1 1 0
v -1 1 0
vn -0.2 -0.2 0.9
vn 0.2 -0.2 0.9
vn 0.2 0.2 0.9
vn -0.2 0.2 0.9
f 1//1 2//2 3//3
f 1//1 3//3 4//4
"""


def smooth_light(kind="area", **arguments):
    """One with normals at its vertices, which are not those of its faces."""
    return lit_by_mesh(SMOOTH, {"type": kind, "radiance": 3.0, **arguments}, "smooth.obj")


def change_pattern(direction):
    def apply(params, x):
        along("light.vertex_texcoords", direction)(params, x)
        # Mitsuba keeps the map by which it samples patterns until positions change; the renderer tells it that they
        # have.
        params["light.vertex_positions"] = params["light.vertex_positions"] + 1e-7

    return apply


def shift_and_move(params, x):
    along("light.vertex_texcoords", (1.0, 0.4))(params, x + 0)
    along("light.vertex_positions", (0.3, 0.1, 0.5))(params, x + 0)


MOVED = (0.3, 0, 1, 0, 0, 0, 0, 0, 0, 0)
TURNED = (0, 0, 0, 0.3, 0.2, 1, 0.3, 1, 0.5, 0)
BENT = (0.1, 0, 1, 0.2, 0.3, 0.1, -0.5, 0.1, -0.2, 0, 0.7, 0, 0, 0.2, 0.4, -0.1, 0.3, 0, 0.2, 0.1)

# Of four corners, none as its neighbours.
CONE = {"kind": "angulararea", "cutoff_angle": 80.0, "beam_width": 5.0}
GROWS = (-0.3, 0.1, 0, 0.6, 0, 0.1, 0.5, 0.4, 0, 0, 0.8, -0.1)

CASES = [
    Case("ellipsoid_changes", ELLIPSOIDS, lambda: seen_wall(ellipsoid()), along("wall.data", TURNED), 0.0, 2e-4),
    Case("ellipsoid_mirror_moves", ELLIPSOIDS, lambda: mirror(ellipsoid()), along("wall.data", MOVED), 0.0, 2e-4),
    Case(
        "ellipsoid_in_an_instance",
        ELLIPSOIDS,
        lambda: grouped(mirror(ellipsoid()), to_world=squashed()),
        along("group.wall.data", TURNED),
        0.0,
        5e-4,
        fd_spp=4096,
    ),
    Case("ellipsoid_opacity", ELLIPSOIDS, lambda: seen_wall(clamped()), along("wall.opacities", (1,)), 0.0, 1e-3),
    Case(
        "linear_curve_bends",
        CURVES,
        lambda: mirror(curve("linearcurve")),
        along("wall.control_points", BENT),
        0.0,
        1e-3,
    ),
    Case("spline_bends", CURVES, lambda: mirror(curve("bsplinecurve")), along("wall.control_points", BENT), 0.0, 1e-3),
    Case(
        "pattern_and_light_move",
        "texture coordinates of a light",
        patterned_light,
        shift_and_move,
        0.0,
        1e-2,
        spp=4096,
        fd_spp=32768,
    ),
    # The area element is not that of the coordinates: these grow on a shape that stays.
    Case(
        "pattern_grows",
        "texture coordinates of a light",
        patterned_light,
        change_pattern((0, 0, 1, 0, 1, 0.6, 0, 0.6)),
        0.0,
        2e-2,
        spp=4096,
        fd_spp=65536,
    ),
    Case(
        "bare_light_grows",
        "area light shape",
        bare_light,
        along("light.vertex_positions", GROWS),
        0.0,
        1e-2,
        spp=2048,
    ),
    Case(
        "smooth_light_with_a_cone_grows", "area light shape", lambda: smooth_light(**CONE),
        along("light.vertex_positions", GROWS), 0.0, 1e-2, spp=4096,
    ),
    Case(
        "smooth_light_with_a_cone_bends", "area light shape", lambda: smooth_light(**CONE),
        along("light.vertex_normals", GROWS), 0.0, 2e-2, spp=4096,
    ),
]  # fmt: skip
