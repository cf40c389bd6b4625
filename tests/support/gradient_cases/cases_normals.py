"""Gradient cases of what shapes do not speak of: normals that a mirror follows, distance grids, thin glass."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from support.gradient_cases.problem import Case
from support.gradient_cases.scenes import camera, glass_slab, mirror_room, room, transform
from support.gradient_cases.unknowns import move, set_color

MIRROR = {"type": "conductor", "material": "none", "specular_reflectance": 0.9}


def mirror_mesh():
    """The mirror as a mesh with normals at its vertices."""
    scene = mirror_room()
    scene["wall"] = {"type": "cube", "to_world": transform().translate([0, 0, -0.1]).scale([1, 1, 0.1]), "bsdf": MIRROR}
    return scene


def tilt_normals(key):
    def apply(params, x):
        normals = dr.unravel(mi.Normal3f, params[key])
        params[key] = dr.ravel(dr.normalize(normals + mi.Normal3f(0, x, 0)))

    return apply


def bumpy_mirror():
    """A mirror whose normals a texture holds."""
    pixels = np.full((2, 2, 3), (0.5, 0.5, 1.0), dtype=np.float32)
    normals = {"type": "bitmap", "bitmap": mi.Bitmap(pixels), "raw": True}
    return mirror_room({"type": "normalmap", "normalmap": normals, "nested": MIRROR})


def tilt_texture(key):
    def apply(params, x):
        pixels = params[key]
        up = mi.Float(np.tile([0.0, 1.0, 0.0], 4).astype(np.float32))
        params[key] = mi.TensorXf(pixels.array + up * x, pixels.shape)

    return apply


def distance_grid():
    """The wall as the zero of a grid of signed distances: a slab that is wider than the view."""
    z = np.linspace(-1.0, 1.0, 8, dtype=np.float32)
    grid = np.broadcast_to(np.abs(z) - 0.5, (8, 8, 8)).transpose(2, 1, 0)[..., None]
    scene = room(sensor=camera(fov=6.0), light={"type": "point", "position": [0.3, 0.2, 4.0], "intensity": 10.0})
    del scene["side"]
    scene["wall"] = {
        "type": "sdfgrid",
        "grid": mi.TensorXf(np.ascontiguousarray(grid)),
        "to_world": transform().scale([4, 4, 1]).translate([-0.5, -0.5, -0.5]),
        "bsdf": {"type": "diffuse", "reflectance": 0.5},
    }
    return scene


def with_numbers(scene, bsdf, numbers):
    """The wall of a scene as a mesh with numbers at its vertices, which its surface reads."""
    pose = transform().translate([0, 0, -0.1]).scale([1, 1, 0.1])
    wall = mi.load_dict({"type": "cube", "to_world": pose, "bsdf": bsdf})
    wall.add_attribute("vertex_numbers", numbers.shape[1], numbers.reshape(-1).tolist())
    return {**scene, "wall": wall}


def mirror_of_numbers():
    """A mirror whose normals stand at the vertices of its mesh."""
    normals = {"type": "mesh_attribute", "name": "vertex_numbers"}
    bsdf = {"type": "normalmap", "normalmap": normals, "nested": MIRROR}
    return with_numbers(mirror_room(), bsdf, np.tile([0.5, 0.5, 1.0], (24, 1)))


def tilt_numbers(key):
    def apply(params, x):
        params[key] = params[key] + mi.Float(np.tile([0.0, 1.0, 0.0], 24).astype(np.float32)) * x

    return apply


CASES = [
    Case(
        "mirror_normals_in_an_attribute",
        "normal map of a mirror",
        mirror_of_numbers,
        tilt_numbers("wall.vertex_numbers"),
        0.0,
        2e-3,
        spp=2048,
    ),
    Case(
        "mirror_normals", "mesh vertex normals", mirror_mesh, tilt_normals("wall.vertex_normals"), 0.0, 4e-3, spp=2048
    ),
    Case(
        "mirror_normal_map",
        "normal map of a mirror",
        bumpy_mirror,
        tilt_texture("wall.bsdf.normalmap.data"),
        0.0,
        2e-3,
        spp=2048,
    ),
    Case(
        "distance_grid_moves",
        "shape to_world",
        distance_grid,
        move("wall.to_world", (0, 0, 1)),
        0.0,
        5e-4,  # there is so little noise that differences over longer steps show the corners of the tent
        spp=2048,
    ),
    Case(
        "thin_glass_index",
        "eta of thindielectric",
        lambda: glass_slab({"type": "thindielectric", "int_ior": 1.5}, "rectangle"),
        set_color("slab.bsdf.eta"),
        1.5,
        0.1,
        spp=2048,
        fd_spp=8192,
    ),
]
