"""What a parameter moves is told by what reads its numbers: textures, volumes in textures, attributes of shapes."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import torch

import torchtransient as tt
from support.gradient_cases.scenes import area_light, room
from torchtransient.errors import GradientError
from torchtransient.plugins.parameters import ALMOST_BLACK, ParameterTracker

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


@pytest.fixture(autouse=True)
def variant():
    mi.set_variant(VARIANT)


# ------------------------------------------------------------------------------------------------------- black numbers


@pytest.mark.parametrize("source", SOURCES)
def test_black_inside_a_normal_map_is_refused(source):
    def turned(texture):
        nested = {"type": "diffuse", "reflectance": texture}
        return {"type": "normalmap", "normalmap": bitmap(0.5, 0.5, 1.0), "nested": nested}

    shape = SOURCES[source](turned, (0.0,))
    scene = mi.load_dict({"type": "scene", "thing": shape})
    params = mi.traverse(scene)
    key = next(k for k in params.keys() if k.endswith((NAME, ".data")) and "normalmap" not in k)  # noqa: SIM118
    for number, refused in ((0.0, True), (ALMOST_BLACK, False)):
        value = params[key] * 0 + number
        dr.enable_grad(value)
        params[key] = value
        params.update()
        tracker = ParameterTracker(scene)
        if refused:
            with pytest.raises(GradientError, match="normalmap"):
                tracker.check_black()
        else:
            tracker.check_black()


# -------------------------------------------------------------------------------------------------- against differences


@pytest.mark.slow
def test_slope_where_a_lobe_vanishes():
    """The plugin is exchanged for what its texture reads off the shape, and numbers that are zero are lifted."""
    paint = {"type": "principled", "roughness": 0.5, "base_color": 0.7, "spec_trans": READER}
    paint = {"type": "normalmap", "normalmap": {"type": "rgb", "value": [0.55, 0.48, 0.98]}, "nested": paint}
    described = room(bsdf=paint, light=area_light(), side_reflectance=0.95)
    described["wall"][NAME] = {"type": "uniform", "value": 0.0}
    scene = tt.load(described, variant=VARIANT)
    key = f"wall.{NAME}.value"
    assert "diff_principled" in scene.parameters()[key].reason
    renderer = tt.TransientRenderer(scene, parameters=[key], spp=8192, grad_seed="same")

    def brightness(x, seed):
        return renderer(values={key: x}, seed=seed).steady.double().sum()

    found, expected = [], []
    for seed in range(6):
        x = torch.zeros((), requires_grad=True)
        brightness(x, seed).backward()
        found.append(float(x.grad))
        with torch.no_grad():
            here, near, far = (brightness(torch.tensor(0.1 * k), seed) for k in range(3))
        expected.append(float(4 * near - 3 * here - far) / 0.2)
    found, expected = np.array(found), np.array(expected)
    error = (found - expected).std(ddof=1) / np.sqrt(6)
    assert abs(found.mean() - expected.mean()) < 4 * error + 0.02 * abs(expected.mean())
    assert error < 0.1 * abs(expected.mean())
