"""Lights shine as bright as they are, wherever on them their brightness lies.

A point of a white plane is lit by every kind of light that paths can run into. Lights are sampled as well, so that the
light is the same only if what is sampled and what has a density are all that shines.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from support.marks import long
from support.runs import T
from torchtransient import plugins

VARIANT = "llvm_ad_rgb"
SIGMAS = 4.5
# Sides of the film. All of its pixels see one point, each with other samples.
PIXELS = 16


@pytest.fixture(autouse=True)
def _variant():
    mi.set_variant(VARIANT)
    plugins.register_module("support.toy_integrators")


def image(rows, seed=1):
    """An image of five rows, some of whose texels are black, or of which only the given rows are not."""
    values = np.random.default_rng(seed).uniform(0, 10, (5, 4, 3)) ** 2
    values[1, 2] = values[3, 0] = 0
    return np.where(np.isin(np.arange(5), rows)[:, None, None], values, 0).astype(np.float32)


EVERYWHERE = range(5)


def bitmap(rows=EVERYWHERE, **more):
    return {"type": "bitmap", "data": mi.TensorXf(image(rows)), "raw": True, **more}


def checkerboard():
    return {"type": "checkerboard", "color0": 9.0, "color1": 0.0, "to_uv": T2().scale([3, 1])}


def volume():
    grid = np.random.default_rng(2).uniform(0, 10, (3, 3, 3)).astype(np.float32)
    return {"type": "volume", "volume": {"type": "gridvolume", "grid": mi.VolumeGrid(grid)}}


def T2():
    return mi.ScalarTransform3f()


def facing_down(scale=0.6):
    return T().translate([0.2, 0.1, 1.0]).rotate([0, 1, 0], 170).scale(scale)


def MIRROR():
    return T().scale([-1, 1, 1])


def lying():
    return T().translate([-0.5, 0.5, 0.8]).rotate([0, 1, 0], 90).scale(0.5)


def mesh(texcoords, **more):
    """A square of four triangles."""
    vertices = [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0], [0, 0, 0]]
    corners = np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
    # No vertex is shared, so that each triangle has a piece of the texture of its own.
    arrays = {"vertices": np.array(vertices, np.float32)[corners.ravel()], "faces": np.arange(12.0).reshape(4, 3)}
    if texcoords is not None:
        arrays["texcoords"] = np.array(texcoords, np.float32).reshape(12, 2)
    return {"type": "mesh_arrays", **{k: mi.TensorXf(v.astype(np.float32)) for k, v in arrays.items()}, **more}


PIECE = np.array([[0, 0], [1, 0], [0.5, 1]])
QUARTERS = np.array([[[0, 0], [1, 0], [0.5, 0.5]], [[1, 0], [1, 1], [0.5, 0.5]], [[1, 1], [0, 1], [0.5, 0.5]],
                     [[0, 1], [0, 0], [0.5, 0.5]]])  # fmt: skip


def area(shape, radiance, kind="area", **more):
    shape = {"type": shape} if isinstance(shape, str) else shape
    return {"to_world": facing_down(), **shape, "emitter": {"type": kind, "radiance": radiance}, **more}


def smooth(texcoords):
    normals = np.tile([0.3, 0.0, 1.0], (12, 1)) / np.hypot(0.3, 1)
    return mesh(texcoords, normals=mi.TensorXf(normals.astype(np.float32)))


def sky(rows, **more):
    return {"type": "envmap", "bitmap": mi.Bitmap(image(rows)), "to_world": T().rotate([1, 0, 0], 90), **more}


LIGHTS = {
    "rectangle": lambda: area("rectangle", bitmap()),
    "rectangle, repeated": lambda: area("rectangle", bitmap(to_uv=T2().scale(2.5))),
    "rectangle, clamped": lambda: area("rectangle", bitmap(rows=(2,), to_uv=T2().scale(2.5), wrap_mode="clamp")),
    "rectangle from behind": lambda: area("rectangle", bitmap(), flip_normals=True, to_world=T().translate([0, 0, 1])),
    "volume": lambda: area("rectangle", volume()),
    "cylinder": lambda: area("cylinder", bitmap(), to_world=lying()),
    "checkered sphere": lambda: area("sphere", checkerboard(), to_world=facing_down(0.5)),
    "sphere around": lambda: area("sphere", bitmap(), flip_normals=True, to_world=T().scale(9)),
    "mesh": lambda: area(mesh(QUARTERS), bitmap()),
    "mesh of repeated texture": lambda: area(mesh(2 * QUARTERS), bitmap()),
    "mesh of equal triangles": lambda: area(mesh([PIECE] * 4), bitmap()),
    "mesh on a line of the texture": lambda: area(mesh(QUARTERS * [1, 0]), bitmap()),
    "mesh with normals": lambda: area(smooth([PIECE] * 4), bitmap()),
    "mirrored cylinder": lambda: area("cylinder", 5.0, to_world=lying() @ MIRROR()),
    "mirrored angular cylinder": lambda: area("cylinder", 5.0, "angulararea", to_world=lying() @ MIRROR()),
    "angular mesh": lambda: area(mesh([PIECE] * 4), bitmap(), "angulararea"),
    "sky": lambda: sky(EVERYWHERE),
    "sky, compensated": lambda: sky(EVERYWHERE, mis_compensation=True),
    "sky of the first row": lambda: sky((0,)),
    "sky of the poles": lambda: sky((0, 4)),
    "even sky": lambda: {"type": "constant", "radiance": 3.0},
    "sunless sky": lambda: {"type": "sunsky", "sun_direction": [0.0, 0.6, 0.8], "sun_scale": 0.0},
}  # fmt: skip


def scene_of(light, integrator="transient_prbvolpath"):
    sensor = {
        "type": "perspective", "fov": 1e-3, "near_clip": 0.1,
        "to_world": T().look_at(origin=[3, 0, 0.5], target=[0, 0, 0], up=[0, 0, 1]),
        "film": {
            "type": "transient_hdr_film", "width": PIXELS, "height": PIXELS, "rfilter": {"type": "box"},
            "temporal_bins": 1, "bin_width_opl": 40.0,
        },
    }  # fmt: skip
    return {
        "type": "scene", "integrator": {"type": integrator, "max_depth": 2}, "sensor": sensor, "light": light,
        "plane": {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": 1.0}},
    }  # fmt: skip


def mean_of(pixels):
    """Mean and standard error by colour."""
    pixels = np.asarray(pixels, dtype=float).reshape(PIXELS**2, -1)
    return pixels.mean(axis=0), pixels.std(axis=0, ddof=1) / PIXELS


def lit_by(light, integrator):
    scene = mi.load_dict(scene_of(light, integrator), optimize=False)
    return mean_of(scene.integrator().render(scene, seed=3, spp=512)[0])


QUICK = ["mesh of repeated texture", "mesh of equal triangles", "sky of the first row"]


@pytest.mark.parametrize("name", long(LIGHTS, QUICK))
def test_sampled_lights_are_those_that_paths_find(name):
    (found, error), (both, own) = (
        lit_by(LIGHTS[name](), kind) for kind in ("transient_found_lights", "transient_prbvolpath")
    )
    assert (error < 0.04 * found).all()
    assert (np.abs(both - found) < SIGMAS * np.hypot(error, own)).all()


