"""Ranges that parameters of surfaces, media, lights and sensors have, by where they stand; and their ends."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from torchtransient import plugins
from torchtransient.plugins import parameters as ranges
from torchtransient.plugins.parameters import described_ranges

VARIANT = "llvm_ad_mono"
VALUE = {"type": "uniform", "value": 0.25}


def found(parts):
    """Ranges by key, and the numbers that are there."""
    mi.set_variant(VARIANT)
    plugins.sync()
    scene = mi.load_dict({"type": "scene", **parts}, optimize=False)
    return {key: (one, low, high) for key, one, low, high in described_ranges(mi.traverse(scene))}


def on_a_disk(**bsdfs):
    return {name: {"type": "disk", "bsdf": bsdf} for name, bsdf in bsdfs.items()}


CHECKS = {"type": "checkerboard", "color0": 0.25, "color1": 0.75}


def test_surfaces():
    board = {"type": "diffuse", "reflectance": CHECKS}
    metal = {"type": "roughconductor", "eta": VALUE, "k": VALUE, "alpha": 0.125, "specular_reflectance": 0.5}
    ours = {"type": "diff_conductor", "eta": VALUE, "k": 2.0}
    glass = {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}
    base = {"type": "principled", "roughness": 0.25, "metallic": 0.5, "base_color": 0.75, "spec_trans": 0.5}
    mixed = {"type": "blendbsdf", "weight": 0.25, "a": {"type": "diffuse"}, "b": {"type": "mask", "opacity": 0.125,
             "b": {"type": "diffuse"}}}  # fmt: skip
    table = found(on_a_disk(board=board, metal=metal, ours=ours, glass=glass, base=base, mixed=mixed))
    expected = {
        "board.bsdf.reflectance.color0.value": (ranges.SHARE, 0.25), "metal.bsdf.eta.value": (ranges.OPTICAL, 0.25),
        "board.bsdf.reflectance.color1.value": (ranges.SHARE, 0.75), "metal.bsdf.k.value": (ranges.OPTICAL, 0.25),
        "metal.bsdf.alpha.value": (ranges.ROUGHNESS, 0.125), "ours.bsdf.eta.value": (ranges.OPTICAL, 0.25),
        "metal.bsdf.specular_reflectance.value": (ranges.SHARE, 0.5), "ours.bsdf.k.value": (ranges.OPTICAL, 2.0),
        "glass.bsdf.eta": (ranges.INDEX, 1.5), "base.bsdf.roughness.value": (ranges.ROUGHNESS, 0.25),
        "base.bsdf.metallic.value": (ranges.WEIGHT, 0.5), "base.bsdf.base_color.value": (ranges.SHARE, 0.75),
        "base.bsdf.spec_trans.value": (ranges.WEIGHT, 0.5), "mixed.bsdf.weight.value": (ranges.SHARE, 0.25),
    }  # fmt: skip
    for key, (one, number) in expected.items():
        assert table[key][0] is one, key
        assert table[key][1:] == (pytest.approx(number), pytest.approx(number)), key
    masks = [entry for key, entry in table.items() if key.endswith("opacity.value")]
    assert masks == [(ranges.SHARE, 0.125, 0.125)]
    assert not any("to_uv" in key or "to_world" in key for key in table)


def test_media_lights_and_sensors():
    grid = {"type": "gridvolume", "grid": mi.VolumeGrid(np.float32([[[[0.5], [2.0]], [[3.0], [0.75]]]]))}
    phase = {"type": "blendphase", "weight": 0.25, "a": {"type": "hg", "g": 0.5}, "b": {"type": "isotropic"}}
    fog = {"type": "heterogeneous", "albedo": {"type": "constvolume", "value": 0.75}, "sigma_t": grid, "phase": phase}
    table = found({
        "cube": {"type": "cube", "bsdf": {"type": "null"}, "interior": fog},
        "lamp": {"type": "disk", "emitter": {"type": "area", "radiance": 3.0}},
        "point": {"type": "point", "intensity": 5.0, "position": [0.0, 1.0, -1.0]},
        "sensor": {"type": "thinlens", "fov": 40.0, "aperture_radius": 0.25, "focus_distance": 2.0},
    })  # fmt: skip
    inside = "cube.interior_medium."
    expected = {
        inside + "sigma_t.data": (ranges.EXTINCTION, 0.5, 3.0), "lamp.emitter.radiance.value": (ranges.LIGHT, 3, 3),
        inside + "albedo.value.value": (ranges.SHARE, 0.75, 0.75), "point.intensity.value": (ranges.LIGHT, 5, 5),
        inside + "phase_function.weight.value.value": (ranges.SHARE, 0.25, 0.25),
        "sensor.x_fov": (ranges.ANGLE, 40, 40), "sensor.aperture_radius": (ranges.LENGTH, 0.25, 0.25),
        "sensor.focus_distance": (ranges.LENGTH, 2, 2),
    }  # fmt: skip
    for key, (one, low, high) in expected.items():
        assert table[key] == (one, pytest.approx(low, rel=1e-5), pytest.approx(high, rel=1e-5)), key
    anisotropy = [entry for key, entry in table.items() if key.endswith(".g")]
    assert anisotropy == [(ranges.ANISOTROPY, 0.5, 0.5)]
    assert not any("position" in key or "scale" in key for key in table)


def bitmap(number, channels=1):
    return {"type": "bitmap", "raw": True, "data": mi.TensorXf(np.full((2, 2, channels), number, np.float32))}


def grid(number, channels=1):
    return {"type": "gridvolume", "raw": True, "grid": mi.VolumeGrid(np.full((2, 2, 2, channels), number, np.float32))}


def attribute(**settings):
    return {"type": "mesh_attribute", "name": "vertex_share", **settings}


def triangle(number, surface):
    """A mesh of one triangle with an attribute."""
    mesh = mi.Mesh("mesh", 3, 1, props=mi.Properties() if surface is None else with_surface(surface))
    params = mi.traverse(mesh)
    params["vertex_positions"] = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0]
    params["faces"] = [0, 1, 2]
    params.update()
    mesh.add_attribute("vertex_share", 1, [number, 0.0, 0.5])
    return mesh


def with_surface(surface):
    props = mi.Properties()
    props["bsdf"] = mi.load_dict(surface)
    return props


DIFFUSE = {"type": "diffuse"}
NESTED = {"type": "checkerboard", "color0": {"type": "checkerboard", "color1": {"type": "ref", "id": "shared"}}}
# Where a number comes from: (objects, key of what supplies it, largest number in its range).
SUPPLIERS = {
    "texture of its own": lambda x: (on_a_disk(a={"type": "diffuse", "reflectance": bitmap(x)}), "reflectance.data", 1),
    "texture in textures": lambda x: (
        {"shared": bitmap(x), **on_a_disk(a={"type": "twosided", "b": {"type": "diffuse", "reflectance": NESTED}})},
        ".data", 1,
    ),
    "attribute of a mesh": lambda x: (
        {"mesh": triangle(x, {"type": "diffuse", "reflectance": attribute()})}, "vertex_share", 1,
    ),
    "scaled attribute": lambda x: (
        {"mesh": triangle(x, {"type": "diffuse", "reflectance": attribute(scale=1 / 255)})}, "vertex_share", 255,
    ),
    "attribute that is a texture": lambda x: (
        {"plate": {"type": "rectangle", "vertex_share": bitmap(x), "bsdf": DIFFUSE | {"reflectance": attribute()}}},
        "vertex_share.data", 1,
    ),
    "albedo of a shared medium": lambda x: (
        {"air": {"type": "heterogeneous", "albedo": {"type": "ref", "id": "cells"}, "sigma_t": 1.0}, "cells": grid(x),
         "box": {"type": "cube", "bsdf": {"type": "null"}, "interior": {"type": "ref", "id": "air"}}},
        ".data", 1,
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", SUPPLIERS)
def test_ranges_follow_what_supplies_a_number(case):
    """Through references, textures in textures, and attributes of shapes."""
    for excess in (1.5, -0.5):
        mi.set_variant(VARIANT)
        most = SUPPLIERS[case](0.0)[2]
        objects, key, _ = SUPPLIERS[case](excess * most)
        table = {name: entry for name, entry in found(objects).items() if name.endswith(key)}
        ((limits, low, high),) = table.values()
        assert (limits.low, limits.high) == (0, pytest.approx(most))
        assert limits.above(high) == (excess > 1) and limits.below(low) == (excess < 0)
