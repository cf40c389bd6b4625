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
from torchtransient.plugins.parameters import ALMOST_BLACK, ParameterTracker, attached_effects

VARIANT = "llvm_ad_mono"
NAME = "vertex_numbers"
READER = {"type": "mesh_attribute", "name": NAME}
MIRROR = {"type": "conductor", "material": "none"}


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


def effect_in(shape, group=False):
    """The effect of the numbers of the shape's texture, asked in both ways."""
    if isinstance(shape, dict):
        shape = mi.load_dict(shape)
    if group:
        held = {"type": "shapegroup", "thing": shape}
        scene = mi.load_dict({"type": "scene", "held": held, "copy": {"type": "instance", "group": held}})
    else:
        scene = mi.load_dict({"type": "scene", "thing": shape})
    params = mi.traverse(scene)
    (key,) = (key for key in params.keys() if key.endswith((NAME, ".data")))  # noqa: SIM118 (not a dictionary)
    value = type(params[key])(params[key])
    dr.enable_grad(value)
    params[key] = value
    params.update()
    (by_params,), (by_tracker,) = attached_effects(params), ParameterTracker(scene).attached()
    assert by_params[2] == by_tracker[2]
    return by_tracker[2]


@pytest.mark.parametrize("source", SOURCES)
def test_normals_of_a_mirror(source):
    def turned(nested):
        return lambda texture: {"type": "normalmap", "normalmap": texture, "nested": {"type": nested}}

    mirror, paint = (effect_in(SOURCES[source](turned(nested), (0.5, 0.5, 1.0))) for nested in ("conductor", "diffuse"))
    assert mirror.role == "normal" and mirror.moves_length
    # Of paint, they move where it turns away from the camera and is black.
    assert paint.role == "value" and paint.moves_silhouette and not paint.moves_length


@pytest.mark.parametrize("source", SOURCES)
def test_weights_of_lobes(source):
    def painted(texture):
        return {"type": "principled", "spec_trans": texture}

    lost, kept = (effect_in(SOURCES[source](painted, (weight,))) for weight in (0.0, 0.4))
    assert lost.stand_in == kept.stand_in == "diff_principled"
    assert lost.stand_in_needed and not kept.stand_in_needed


def dark(texture):
    return {"type": "directionalarea", "radiance": texture}


@pytest.mark.parametrize("source", [bitmap, volume])
def test_lights_that_stay_dark(source):
    assert not effect_in({"type": "rectangle", "emitter": dark(source(1.0))}).supported


def test_attributes_of_lights_that_stay_dark():
    mesh = mi.load_dict({"type": "cube", "emitter": dark(READER)})
    mesh.add_attribute(NAME, 1, [1.0] * mesh.vertex_count())
    assert not effect_in(mesh).supported


def test_attributes_inside_groups():
    def turned(texture):
        return {"type": "mask", "nested": {"type": "normalmap", "normalmap": texture, "nested": MIRROR}}

    mesh = with_attribute(turned, (0.5, 0.5, 1.0))
    scene = mi.load_dict(
        {
            "type": "scene",
            "group": {"type": "shapegroup", "thing": mesh},
            "copy": {"type": "instance", "shapegroup": {"type": "ref", "id": "group"}},
        }
    )
    for key in (NAME, f"group.thing.{NAME}"):
        assert ParameterTracker(scene).effect_of(mesh, key).role == "normal"


def test_attributes_that_nothing_reads_are_values():
    mesh = with_attribute(lambda _: {"type": "conductor"}, (0.5,))
    effect = effect_in(mesh)
    assert effect.role == "value" and not effect.moves and not effect.stand_in


def test_where_an_attribute_is():
    mesh = with_attribute(lambda texture: {"type": "diffuse", "reflectance": texture}, (0.5,))
    scene = mi.load_dict({"type": "scene", "thing": mesh})
    place = ParameterTracker(scene).location_of(mesh, NAME)
    assert set(place) == {f"Cube.{NAME}", f"MeshAttribute.{NAME}", "SmoothDiffuse.reflectance", "Cube.bsdf"}


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
@pytest.mark.parametrize("around", ["", "normalmap"])
def test_slope_where_a_lobe_vanishes(around):
    """The plugin is exchanged for what its texture reads off the shape, and numbers that are zero are lifted."""
    paint = {"type": "principled", "roughness": 0.5, "base_color": 0.7, "spec_trans": READER}
    if around:
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
