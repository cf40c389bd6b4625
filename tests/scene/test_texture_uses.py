"""Textures in places where they cannot be read are refused when a scene is built, by name."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

import torchtransient as tt
from support.gradient_cases.scenes import room
from torchtransient.errors import SceneError

VARIANT = "llvm_ad_rgb"
HEIGHTS = {"type": "constvolume", "value": 0.5}


def bitmap(channels):
    return lambda: {"type": "bitmap", "bitmap": mi.Bitmap(np.full((2, 2, channels), 0.5, np.float32)), "raw": True}


WITHOUT_SLOPE = {
    "checkerboard": {"type": "checkerboard"},
    "volume": {"type": "volume", "volume": HEIGHTS},
    "mesh_attribute": {"type": "mesh_attribute", "name": "vertex_color"},
}
WITH_SLOPE = {
    "bitmap": bitmap(1),
    "bitmap of three channels": bitmap(3),
    "uniform": {"type": "uniform", "value": 0.5},
}


@pytest.fixture(autouse=True)
def variant():
    mi.set_variant(VARIANT)


def bumpy(texture):
    """A room with the bump map inside of something."""
    texture = texture() if callable(texture) else texture
    bump = {"type": "bumpmap", "id": "bumps", "heights": texture | {"id": "heights"}, "nested": {"type": "diffuse"}}
    return room({"type": "twosided", "nested": bump})


@pytest.mark.parametrize("name", WITHOUT_SLOPE)
def test_textures_without_a_slope_are_named(name):
    with pytest.raises(SceneError, match=r"'bumps.*bumpmap.*heights.*bitmap"):
        tt.load(bumpy(WITHOUT_SLOPE[name]), variant=VARIANT).parameters()


@pytest.mark.parametrize("name", WITH_SLOPE)
def test_textures_with_one_are_taken(name):
    assert tt.load(bumpy(WITH_SLOPE[name]), variant=VARIANT).parameters()


# ------------------------------------------------------------------------------------------------------------ channels


def picture(channels):
    return {"type": "bitmap", "data": np.full((2, 2, channels), 0.4, np.float32), "raw": True}


def grid(channels):
    volume = {"type": "gridvolume", "data": np.full((2, 2, 2, channels), 0.4, np.float32), "raw": True}
    return {"type": "volume", "volume": volume}


# A scene with the texture, the variant and what is expected instead.
UNREADABLE = {
    "colours in a spectral variant": (
        lambda: room({"type": "diffuse", "reflectance": picture(3)}), "spectral", r"'reflectance'.*a colour.*raw"
    ),
    "normals of one channel": (
        lambda: room({"type": "normalmap", "normalmap": picture(1), "nested": {"type": "diffuse"}}),
        "rgb",
        "'normalmap'.*three numbers",
    ),
    "a volume of six in a twosided": (
        lambda: room({"type": "twosided", "a": {"type": "diffuse", "reflectance": grid(6)}}), "rgb",
        "'reflectance'.*1 or 3",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", UNREADABLE)
def test_textures_of_other_channels(name):
    make, kind, words = UNREADABLE[name]
    mi.set_variant(f"llvm_ad_{kind}")
    with pytest.raises(SceneError, match=words):
        tt.render(tt.load(make(), variant=f"llvm_ad_{kind}"), spp=1, seed=0)
    # Nothing of it is left to be traced with other scenes.
    assert float(tt.render(tt.load(room(), variant=f"llvm_ad_{kind}"), spp=4, seed=0).steady.sum()) > 0


# ---------------------------------------------------------------------------------------------------------- attributes


def painted(size, bsdf, kind="vertex"):
    """A room whose wall has an attribute of so many numbers at each vertex or face, none for 0."""
    wall = mi.load_dict({"type": "cube", "bsdf": bsdf, "id": "wall"})
    if size:
        count = {"vertex": wall.vertex_count, "face": wall.face_count}[kind]()
        wall.add_attribute(f"{kind}_paint", size, [0.4] * (size * count))
    return {**room(), "wall": wall}


def read(kind="vertex"):
    return {"type": "mesh_attribute", "name": f"{kind}_paint"}


GLOSSY = {"type": "roughconductor", "alpha": 0.2}
MATTE = {"type": "diffuse", "reflectance": 0.5}
# Of a surface that reads an attribute: the sizes that it takes.
READING = {
    "colour of a checkerboard": (
        lambda texture: {"type": "diffuse", "reflectance": {"type": "checkerboard", "color0": texture}}, (1, 3)
    ),
    "weight": (lambda texture: {"type": "blendbsdf", "weight": texture, "a": MATTE, "b": GLOSSY}, (1,)),
    "roughness": (lambda texture: {"type": "twosided", "a": {"type": "roughconductor", "alpha": texture}}, (1,)),
    "normals": (lambda texture: {"type": "normalmap", "normalmap": texture, "nested": MATTE}, (3,)),
}  # fmt: skip


@pytest.mark.parametrize("kind", ["vertex", "face"])
@pytest.mark.parametrize("name", READING)
def test_attributes_that_a_surface_cannot_read(name, kind):
    make, sizes = READING[name]
    for size in (0, 1, 3, 4):
        scene = tt.load(painted(size, make(read(kind)), kind))
        if size in sizes:
            assert scene.parameters()
        else:
            with pytest.raises(SceneError, match=rf"'wall'.*'{kind}_paint'.*zero"):
                scene.parameters()


# -------------------------------------------------------------------------------------------------------------- lights


def glowing(kind):
    """A room under a lamp whose radiance is an attribute of its shape."""
    lamp = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().translate([0.6, 0.2, 2.5]).rotate([0, 1, 0], 200).scale(0.3),
        "emitter": {"type": kind, "radiance": {"type": "mesh_attribute", "name": "vertex_glow"}},
        "vertex_glow": {"type": "uniform", "value": 5.0},
    }
    return room(light=lamp)


@pytest.mark.parametrize("kind", ["area", "angulararea"])
def test_attributes_of_lights_are_named(kind):
    with pytest.raises(SceneError, match=r"'vertex_glow'.*bitmap"):
        tt.load(glowing(kind), variant=VARIANT).parameters()


def test_textured_lights_need_texture_coordinates():
    """Without, the kernels of all scenes that are alive with one would not be traced."""
    corners = np.array([[-0.3, 0.0, 2.5], [0.3, 0.0, 2.5], [0.3, 0.3, 2.5]])
    lamp = tt.scenes.triangle_mesh(corners, np.array([[0, 2, 1]]))
    lamp["emitter"] = {"type": "area", "radiance": bitmap(1)()}
    with pytest.raises(SceneError, match=r"'light'.*texture coordinates"):
        tt.load(room(light=lamp), variant=VARIANT).parameters()
