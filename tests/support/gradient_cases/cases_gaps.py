"""Gradient cases with segments of some millimetres: gaps between plates, lights on a wall, corners.

Points so near slide along with the vertex that sees them.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from support.gradient_cases.problem import Case
from support.gradient_cases.scenes import camera, transform
from support.gradient_cases.unknowns import move, rotate

GAP = 5e-3
DIFFUSE = {"type": "diffuse", "reflectance": 0.6}
# Lets light through to every side, so that a gap can be seen and lit without an edge in it.
PAPER = {"type": "principledthin", "base_color": 0.8, "diff_trans": 1.2, "roughness": 1.0, "spec_trans": 0.0}
PLASTIC = {"type": "pplastic", "alpha": 0.4, "diffuse_reflectance": 0.6}
CONE = {"kind": "angulararea", "cutoff_angle": 80.0, "beam_width": 5.0}


def scene_of(depth=4, integrator="transient_path", **parts):
    """Shapes under a point light, unless they bring a ``light`` of their own."""
    light = {"type": "point", "position": [0.5, 0.2, 4], "intensity": 10.0}
    integrator = {"type": integrator, "max_depth": depth, "rr_depth": 100}
    return {"type": "scene", "integrator": integrator, "light": light, **parts}


def plane(pose, bsdf=None, size=2, **more):
    return {"type": "rectangle", "to_world": pose.scale(size), "bsdf": bsdf or DIFFUSE, **more}


def plates(wall=DIFFUSE, plate=PAPER, gap=GAP, **arguments):
    """A sheet of paper before a wall."""
    sheet = plane(transform().translate([0, 0, gap]), plate)
    return scene_of(sensor=camera(fov=8.0), wall=plane(transform(), wall), plate=sheet, **arguments)


def lamp(shape="rectangle", radiance=5.0, kind="area", pose=None, gap=GAP, **arguments):
    """A lamp behind a sheet of paper, wider than what is seen of it."""
    pose = pose or transform().translate([0.05, 0.03, -gap]).scale(0.3)
    light = {"type": shape, "to_world": pose, "emitter": {"type": kind, "radiance": radiance, **arguments}}
    view = camera(fov=4.0, start=3.5, bins=100, width=0.01)
    return scene_of(3, sensor=view, wall=plane(transform(), PAPER), light=light)


def stripes():
    """Radiance that changes from place to place."""
    u = np.linspace(0, 2 * np.pi, 16, endpoint=False, dtype=np.float32)
    pixels = 5 + 4 * np.sin(u)[None, :, None] * np.ones((16, 1, 1), dtype=np.float32)
    return {"type": "bitmap", "bitmap": mi.Bitmap(pixels), "raw": True}


def tube(**arguments):
    """A lamp in the shape of a wide tube that nearly touches the paper along a line."""
    pose = transform().translate([0.05, 0, -GAP - 0.3]).scale([0.3, 1, 0.3]).rotate([1, 0, 0], -90)
    pose = pose.translate([0, 0, -0.5])
    return lamp("cylinder", pose=pose, **arguments)


def corner(gap=GAP, **arguments):
    """The wall close above the floor. Both end far away: their edges would be silhouettes when the floor moves."""
    pose = transform().look_at([3, 0, 1.5 * gap], [0, 0, 1.5 * gap], [0, 0, 1])
    view = camera(fov=2 * float(np.degrees(np.arctan(gap / 6))), start=3.5) | {"to_world": pose}
    wall, floor = plane(transform().rotate([0, 1, 0], 90), size=50), plane(transform(), size=50)
    light = {"type": "point", "position": [1.0, 0.2, 1.0], "intensity": 10.0}
    return scene_of(sensor=view, wall=wall, floor=floor, light=light, **arguments)


def striped_corner():
    """A corner whose floor has stripes of some centimetres, which its surface reads as an attribute of the shape."""
    scene = corner()
    shades = {"type": "mesh_attribute", "name": "vertex_shades", "scale": 0.1}
    scene["floor"]["bsdf"] = {"type": "diffuse", "reflectance": shades}
    scene["floor"]["vertex_shades"] = stripes() | {"to_uv": mi.ScalarTransform3f().scale([1500, 1500])}
    return scene


def with_mirror():
    """A delta lobe in the scene: rays themselves are handed on."""
    return plates(plate={"type": "mask", "opacity": 0.8, "nested": PAPER})


AWAY = move("wall.to_world", (0, 0, 1))
LAMP = move("light.to_world", (0.3, 0.1, 1))
ROW, LIGHT = "shape to_world", "area light shape"
STEP = GAP / 10
# Rays start 1e-4 m beside surfaces: differences of a corner built in two ways are so far apart, at a gap of 1 mm.
OFF = 0.008


def near(name, scene, apply=AWAY, row=ROW, **more):
    """A case of two surfaces that nearly touch."""
    settings = {"value": 0.0, "step": STEP, "spp": 16384, "fd_spp": 16384, "off": OFF} | more
    return Case(f"gap_{name}", row, scene, apply, **settings)


CASES = [
    near("plates", plates),
    near("corner", corner, move("wall.to_world", (1, 0, 0))),
    near("striped_corner", striped_corner, move("wall.to_world", (1, 0, 0)), step=STEP / 4),
    near("through_a_mask", with_mirror),
    near("polarized", lambda: plates(PLASTIC), variant="llvm_ad_mono_polarized"),
    near("lamp", lamp),
    near("lamp_with_a_cone", lambda: lamp(**CONE), spp=8192),
    near("lamp_moves", lamp, LAMP, LIGHT),
    near("lamp_with_stripes_moves", lambda: lamp(radiance=stripes()), LAMP, LIGHT),
    near("lamp_tilts", lamp, rotate("light.to_world", (0, 1, 0)), LIGHT, step=0.1),
    near("tube_moves", tube, LAMP, LIGHT),
    near("tube_with_a_cone_moves", lambda: tube(**CONE), LAMP, LIGHT),
]
