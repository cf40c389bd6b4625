"""Unphysical values: one warning each, with key and number, or an error where one is asked for."""

from __future__ import annotations

import copy
import pickle
import warnings

import numpy as np
import pytest
import torch

import torchtransient as tt
from tools.small_room import COLOUR, GREY, VARIANT, WALL_POSE, pose
from torchtransient.errors import PhysicsError, PhysicsWarning


def said(function, *arguments, **keywords):
    """(result, messages)"""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        result = function(*arguments, **keywords)
    return result, [str(one.message) for one in caught if issubclass(one.category, PhysicsWarning)]


def loaded(room):
    return tt.load(room, variant=VARIANT)


FOG = {"type": "homogeneous", "sigma_t": 1.0}
SURFACES = {
    "a number": ({"type": "diffuse", "reflectance": 1.5}, "wall.bsdf.reflectance.value", "1.5"),
    "negative": ({"type": "diffuse", "reflectance": -0.5}, "wall.bsdf.reflectance.value", "-0.5"),
    "a texture": (
        {"type": "diffuse", "reflectance": {"type": "bitmap", "raw": True, "bitmap": np.full((2, 2, 3), 1.25)}},
        "wall.bsdf.reflectance.data",
        "1.25",
    ),
    "inside a texture": (
        {"type": "diffuse", "reflectance": {"type": "checkerboard", "color1": 2.0}},
        "wall.bsdf.reflectance.color1.value",
        "2",
    ),
    "inside another": (
        {"type": "twosided", "bsdf": {"type": "conductor", "specular_reflectance": 1.5}},
        "wall.bsdf.brdf_0.specular_reflectance.value",
        "1.5",
    ),
    "a mask": (
        {"type": "mask", "opacity": 1.5, "bsdf": {"type": "diffuse"}},
        "wall.bsdf.opacity.value",
        "1.5",
    ),
}


def test_a_light_that_no_path_meets(room):
    """Mitsuba's path tracers leave it out without a word."""
    room["lamp"] = {
        "type": "rectangle",
        "to_world": pose(z=3.0, scale=0.2),
        "emitter": {"type": "directionalarea", "id": "beam"},
    }
    scene = loaded(room)
    _, messages = said(tt.TransientRenderer, scene, parameters=[COLOUR], spp=4)
    assert len(messages) == 1 and "angulararea" in messages[0] and "beam" in messages[0]


@pytest.mark.parametrize("case", SURFACES)
def test_surfaces_of_the_description(room, case):
    room["wall"]["bsdf"], key, number = SURFACES[case]
    scene = loaded(room)
    _, messages = said(tt.TransientRenderer, scene, spp=1)
    assert len(messages) == 1 and key in messages[0] and f"reaches {number}," in messages[0]
    assert said(tt.TransientRenderer, scene, spp=1)[1] == []
    assert said(tt.TransientRenderer, loaded(room), spp=1, physics="ignore")[1] == []
    with pytest.raises(PhysicsError, match="share of the light and reaches"):
        tt.TransientRenderer(scene, spp=1, physics="error")


BYTES = """ply
format ascii 1.0
element vertex 3
property float x
property float y
property float z
property uchar r
property uchar g
property uchar b
element face 1
property list uchar int vertex_indices
end_header
-3 -3 0 0 51 153
3 -3 0 0 51 153
0 3 0 0 51 153
3 0 1 2
"""


def test_colours_of_a_mesh_file(room, tmp_path):
    """Bytes are 0 to 255, which the texture that reads them can scale; so are values that are given later."""
    (tmp_path / "wall.ply").write_text(BYTES)
    colour = {"type": "mesh_attribute", "name": "vertex_color"}
    paint = {"type": "diffuse", "reflectance": colour}
    room["wall"] = {"type": "ply", "filename": str(tmp_path / "wall.ply"), "bsdf": paint}
    _, messages = said(tt.TransientRenderer, loaded(room), spp=1)
    assert len(messages) == 1 and "'wall.vertex_color'" in messages[0] and "reaches 153," in messages[0]
    assert "1/255" in messages[0]
    with pytest.raises(PhysicsError, match="reaches 153"):
        tt.TransientRenderer(loaded(room), spp=1, physics="error")
    colour["scale"] = 1 / 255
    scene, key = loaded(room), "wall.vertex_color"
    assert said(tt.TransientRenderer, scene, spp=1)[1] == []
    assert said(tt.render, scene, {key: _filled(scene, key, 250.0)}, spp=1, seed=0)[1] == []
    with pytest.raises(PhysicsError, match="reaches 300: expected at least 0 and at most 255"):
        tt.render(scene, {key: _filled(scene, key, 300.0)}, spp=1, seed=0, physics="error")


RANGES = {
    "weight of a lobe": ({"type": "principled", "metallic": 1.5}, "metallic.value", "1.5", "at most 1"),
    "roughness": ({"type": "roughconductor", "alpha": -0.1}, "alpha.value", "-0.1", "at least 0"),
    "metal": ({"type": "conductor", "eta": 0.5, "k": -2.0}, "k.value", "-2", "at least 0"),
}


@pytest.mark.parametrize("case", RANGES)
def test_ranges_of_surfaces(room, case):
    room["wall"]["bsdf"], key, number, expected = RANGES[case]
    _, messages = said(tt.TransientRenderer, loaded(room), spp=1)
    assert len(messages) == 1 and f"wall.bsdf.{key}" in messages[0]
    assert f"reaches {number}:" in messages[0] and expected in messages[0]


def _filled(scene, key, value):
    return torch.full(scene.parameters()[key].shape, value)


def test_media_of_the_description(room):
    room["box"]["interior"] = {**FOG, "albedo": 1.5}
    room["box"]["bsdf"] = {"type": "null"}
    room["integrator"] = {"type": "transient_prbvolpath", "max_depth": 3}
    _, messages = said(tt.TransientRenderer, loaded(room), spp=1)
    assert len(messages) == 1 and "box.interior_medium.albedo.value.value" in messages[0]


def test_what_may_be_larger_than_one_is_left_alone(room):
    room["integrator"] = {"type": "transient_prbvolpath", "max_depth": 3}
    room["box"]["interior"] = {**FOG, "albedo": 1.0, "sigma_t": 8.0}
    room["wall"]["bsdf"] = {"type": "diffuse", "reflectance": 1.0}
    room["box"]["bsdf"] = {"type": "roughconductor", "eta": 1.5, "k": 3.0}
    room["reflectance"] = {"type": "point", "position": [0, 0, 4], "intensity": 5.0}
    scene = loaded(room)
    keys = ["wall.bsdf.reflectance.value", "reflectance.intensity.value"]
    assert said(tt.render, scene, {keys[0]: torch.tensor(1.0), keys[1]: torch.full((3,), 50.0)}, spp=1, seed=0)[1] == []


# --------------------------------------------------------------------------------------------------------------- given


def test_values_that_are_given(room):
    scene = loaded(room)
    renderer = tt.TransientRenderer(scene, parameters=[COLOUR, GREY], spp=1)
    assert said(renderer, seed=0)[1] == []
    _, messages = said(renderer, {COLOUR: torch.tensor([0.5, -0.5, 0.2])}, seed=0)
    assert len(messages) == 1 and repr(COLOUR) in messages[0] and "reaches -0.5," in messages[0]
    # The other end is another finding.
    assert len(said(renderer, {COLOUR: torch.tensor([0.5, 1.5, 0.2])}, seed=0)[1]) == 1
    assert said(renderer, {COLOUR: torch.tensor([0.5, 1.4, -0.2])}, seed=0)[1] == []
    assert "reaches 1.5," in said(renderer, {GREY: torch.tensor([0.5, 1.5])}, seed=0)[1][0]
    for twin in (copy.deepcopy(renderer), pickle.loads(pickle.dumps(renderer))):
        assert said(twin, {GREY: 1.5}, seed=0)[1] == []


def test_values_as_an_error(room):
    renderer = tt.TransientRenderer(loaded(room), parameters=[GREY], spp=1, physics="error")
    for _ in range(2):
        with pytest.raises(PhysicsError, match=r"'wall\.bsdf\.reflectance\.value' .* reaches 1\.5,.*physics='warn'"):
            renderer({GREY: 1.5}, seed=0)
    renderer({GREY: 1.0}, seed=0)


# ---------------------------------------------------------------------------------------------------------- transforms


def test_transforms_without_an_inverse(room):
    room["wall"]["to_world"] = pose(scale=3.0) @ np.diag([1.0, 1.0, 0.0, 1.0])
    scene = loaded(room)
    _, messages = said(tt.TransientRenderer, scene, spp=1)
    assert len(messages) == 1 and "'wall.to_world' has no inverse" in messages[0]
    with pytest.raises(PhysicsError, match="no inverse"):
        tt.TransientRenderer(scene, spp=1, physics="error")
    assert said(tt.TransientRenderer, scene, parameters={WALL_POSE: pose(scale=3.0)}, spp=1)[1] == []


# -------------------------------------------------------------------------------------------------------------- windows


def test_a_window_that_misses_the_light(room):
    scene = loaded(room)
    axis = tt.TimeAxis(9.0, 0.25, 16)
    renderer = tt.TransientRenderer(scene, time_axis=axis, spp=64)
    out, messages = said(renderer, seed=0)
    before, after, total = out.stats.energy_before[0], out.stats.energy_after[0], float(out.steady.mean(0).sum())
    missed = (before + after) / total
    assert missed > 0.05
    assert len(messages) == 1 and f"misses {missed:.1%} of the light" in messages[0]
    assert f"{before / total:.1%}" in messages[0]
    assert said(renderer, seed=1)[1] == []
    with pytest.raises(PhysicsError, match="misses"):
        tt.render(scene, time_axis=axis, spp=64, seed=0, physics="error")


def test_a_window_that_holds_the_light(room):
    assert said(tt.render, loaded(room), spp=16, seed=0, physics="error")[1] == []
    short = tt.TimeAxis(6.0, 0.25, 4)
    assert said(tt.render, loaded(room), spp=16, seed=0, time_axis=short, steady=False, physics="error")[1] == []


@pytest.mark.slow
def test_a_sun_without_a_direction(room):
    room["sky"] = {"type": "sunsky", "sun_direction": [0.0, 0.6, 0.8]}
    renderer = tt.TransientRenderer(loaded(room), parameters=["sky.sun_direction"], spp=1, temporal_filter="tent")
    assert said(renderer, {"sky.sun_direction": torch.tensor([0.0, 0.0, 1.0])}, seed=0)[1] == []
    up, tilted = (torch.tensor([x, 0.0, 1.0], requires_grad=True) for x in (0.0, 1e-3))
    out, found = said(renderer, {"sky.sun_direction": up}, seed=0)
    assert len(found) == 1 and "points along the axis of its sky" in found[0]
    out, found = said(renderer, {"sky.sun_direction": tilted}, seed=0)
    out.steady.sum().backward()
    assert found == [] and torch.isfinite(tilted.grad).all()
    found = said(renderer, {"sky.sun_direction": torch.zeros(3)}, seed=0)[1]
    assert len(found) == 1 and "has no length" in found[0]
