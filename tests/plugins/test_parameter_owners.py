"""Numbers are what reads them, wherever they come from: textures, volumes in textures, attributes of shapes."""

from __future__ import annotations

import contextlib

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.gradient_cases.scenes import room
from torchtransient.errors import GradientError

VARIANT = "llvm_ad_mono"
NAME = "vertex_numbers"
READER = {"type": "mesh_attribute", "name": NAME}


def volume(*numbers):
    data = np.full((2, 2, 2, len(numbers)), numbers, dtype=np.float32)
    return {"type": "volume", "volume": {"type": "gridvolume", "grid": mi.VolumeGrid(data), "raw": True}}


def bitmap(*numbers):
    data = np.full((2, 2, len(numbers)), numbers, dtype=np.float32)
    return {"type": "bitmap", "bitmap": mi.Bitmap(data), "raw": True}


def with_bitmap(bsdf_of, numbers):
    return {"type": "cube", "bsdf": bsdf_of(bitmap(*numbers))}


def with_volume(bsdf_of, numbers):
    return {"type": "cube", "bsdf": bsdf_of(volume(*numbers))}


def with_attribute(bsdf_of, numbers):
    mesh = mi.load_dict({"type": "cube", "bsdf": bsdf_of(READER)})
    mesh.add_attribute(NAME, len(numbers), list(numbers) * mesh.vertex_count())
    return mesh


def with_texture_of_the_shape(bsdf_of, numbers):
    return {"type": "cube", "bsdf": bsdf_of(READER), NAME: bitmap(*numbers)}


def with_volume_of_the_shape(bsdf_of, numbers):
    return {"type": "sphere", "bsdf": bsdf_of(READER), NAME: volume(*numbers)}


SOURCES = {
    "bitmap": with_bitmap,
    "volume": with_volume,
    "attribute": with_attribute,
    "texture of the shape": with_texture_of_the_shape,
    "volume of the shape": with_volume_of_the_shape,
}


@pytest.mark.parametrize("source", SOURCES)
def test_black_inside_a_normal_map_is_refused(source):
    def turned(texture):
        nested = {"type": "diffuse", "reflectance": texture}
        return {"type": "normalmap", "normalmap": bitmap(0.5, 0.5, 1.0), "nested": nested}

    mi.set_variant(VARIANT)
    scene = mi.load_dict(room(depth=2, thing=SOURCES[source](turned, (0.0,))), optimize=False)
    params = mi.traverse(scene)
    key = next(k for k in params.keys() if k.endswith((NAME, ".data")) and "normalmap" not in k)  # noqa: SIM118
    adjoint = dr.ones(mi.TensorXf, scene.sensors()[0].film().cube_shape())
    for number in (0.0, 0.01)[: 1 + (source == "bitmap")]:
        value = params[key] * 0 + number
        dr.enable_grad(value)
        params[key] = value
        params.update()
        refused = pytest.raises(GradientError, match="normalmap") if number == 0 else contextlib.nullcontext()
        with refused:
            scene.integrator().render_backward(scene, params, (None, adjoint), seed=0, spp=4)
