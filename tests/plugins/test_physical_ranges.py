"""Ranges that parameters of surfaces, media, lights and sensors have, by where they stand; and their ends."""

from __future__ import annotations

import math

import mitsuba as mi
import numpy as np
import pytest

from torchtransient import plugins
from torchtransient.plugins import physical_ranges as ranges
from torchtransient.plugins.physical_ranges import described_ranges, physical_range

VARIANT = "llvm_ad_mono"
VALUE = {"type": "uniform", "value": 0.25}


def test_ends_of_ranges():
    """Closed ones take what single precision makes of their ends, open ones end before them."""
    share, angle, length = ranges.SHARE, ranges.ANGLE, ranges.LENGTH
    assert [share.above(x) for x in (0.5, 1.0, 1 + 0.9e-5, 1 + 1.1e-5, 2.0)] == [False, False, False, True, True]
    assert [share.below(x) for x in (0.5, 0.0, -0.9e-5, -1.1e-5, -2.0)] == [False, False, False, True, True]
    assert [angle.above(x) for x in (0.0, 179.999999, 180.0, 181.0)] == [False, False, True, True]
    assert [angle.below(x) for x in (181.0, 1e-9, 0.0, -1.0)] == [False, False, True, True]
    assert not length.above(1e30) and not length.above(math.inf) and length.below(-1.0)


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


def test_what_has_no_range():
    mi.set_variant("llvm_ad_spectral")
    colour = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.1, 0.2, 0.3]}}
    params = mi.traverse(mi.load_dict({"type": "scene", **on_a_disk(colour=colour)}))
    (key,) = (key for key in params.properties if "reflectance" in key)
    assert physical_range(params, key) is None
    assert physical_range(params, "colour.bsdf.reflectance.none") is None
    assert physical_range(params, "colour.to_world") is None
