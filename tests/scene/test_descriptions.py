"""Reduction of scenes to plain data that differs for every number, and objects without a description."""

from __future__ import annotations

import os

import mitsuba as mi
import numpy as np
import pytest
import torch

import torchtransient as tt
from tools.small_room import GREY, make_room
from torchtransient.errors import SceneError
from torchtransient.scene.checks import MOST_LEVELS
from torchtransient.scene.description import (
    describe_dict,
    describe_xml,
)
from torchtransient.scene.objects import transient_dictionary

VARIANT = "llvm_ad_rgb"


# ------------------------------------------------------------------------------------------------------ dictionaries


def plain(value):
    return describe_dict({"type": "scene", "x": value}).tree["x"]


def test_tensors_of_three_rows_are_no_colours_or_points(capfd):
    """Pixels, voxels and distances arrive as they are, and without a line of nanobind for each kind tried."""
    rng = np.random.default_rng(0)
    pixels = rng.random((3, 4, 3), dtype=np.float32)
    voxels = rng.random((3, 3, 2, 1), dtype=np.float32) - np.float32(0.5)
    grid = {"type": "gridvolume", "data": voxels, "raw": True}
    paint = {
        "wall": {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": {
            "type": "bitmap", "data": pixels, "raw": True}}},
        "floor": {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": {
            "type": "volume", "volume": grid}}},
        "ball": {"type": "sdfgrid", "grid": torch.from_numpy(voxels)},
    }  # fmt: skip
    scene = tt.load({"type": "scene", **paint}, variant=VARIANT)
    values = {key: info.value for key, info in scene.parameters().items()}
    assert np.array_equal(np.array(values["wall.bsdf.reflectance.data"]), pixels)
    assert np.array_equal(np.array(values["floor.bsdf.reflectance.volume.data"]), voxels)
    assert np.array_equal(np.array(values["ball.grid"]).ravel(), voxels.ravel())
    assert capfd.readouterr().err == ""


def test_matrices_that_are_no_transforms():
    """And arrays of Mitsuba whose numbers cannot be read."""
    odd = type("OddTransform", (), {"matrix": np.zeros((3, 4))})()
    with pytest.raises(SceneError, match=r"expected one transform at x, got matrices of shape \(3, 4\)"):
        plain(odd)

    def unreadable(self, dtype=None, copy=None):
        raise TypeError("no numbers")

    strange = type("Strange", (), {"__module__": "mitsuba.strange", "__array__": unreadable})()
    with pytest.raises(SceneError, match="the Strange at x cannot be described as an array"):
        plain(strange)


def nested(levels):
    tree = {"type": "scene"}
    for _ in range(levels - 1):
        tree = {"type": "scene", "inside": tree}
    return tree


def test_dictionaries_as_deep_as_they_may_be():
    describe_dict(nested(MOST_LEVELS))
    with pytest.raises(SceneError, match=rf"at most {MOST_LEVELS} deep, got more at .*inside.*Does one hold itself"):
        describe_dict(nested(MOST_LEVELS + 1))
    with pytest.raises(SceneError, match="expected a dictionary with 'type': 'scene', got 'type': 'cube'"):
        describe_dict({"type": "cube"})


# --------------------------------------------------------------------------------------------------------------- XML




def test_files_in_files_count_their_levels(tmp_path):
    outer = f"<s>{'<b>' * 3}<include filename='d.xml'/>{'</b>' * 3}</s>"
    (tmp_path / "c.xml").write_text(outer, encoding="utf-8")
    for levels, deep in ((59, False), (60, True)):
        (tmp_path / "d.xml").write_text("<b>" * levels + "</b>" * levels, encoding="utf-8")
        if deep:
            with pytest.raises(SceneError, match=r"d\.xml: expected elements at most 64 levels deep"):
                tt.load(tmp_path / "c.xml")
        else:
            tt.load(tmp_path / "c.xml")


def test_files_that_are_no_scenes(tmp_path):
    file = tmp_path / "scene.xml"
    with pytest.raises(SceneError, match=r"no such file seen from"):
        describe_xml(file, {})
    with pytest.raises(SceneError, match=r"a folder seen from"):
        describe_xml(tmp_path, {})
    file.write_text("<scene>\n  <a/>\n </b></scene>", encoding="utf-8")
    with pytest.raises(SceneError, match="not well-formed XML at line 3, column 4: mismatched tag"):
        describe_xml(file, {})
    file.write_bytes(b"<scene>\xff</scene>")
    with pytest.raises(SceneError, match="cannot be read as text"):
        describe_xml(file, {})


def test_elements_as_deep_as_they_may_be(tmp_path):
    """A node of the last level may hold a transform of several parts. Those that have ended count no more."""
    file, most = tmp_path / "scene.xml", 2 * MOST_LEVELS
    file.write_text("<a>" + "<b/>" * most + "<b>" * (most - 1) + "</b>" * (most - 1) + "</a>", encoding="utf-8")
    found = describe_xml(file, {"b": 2, "a": 1.5})
    assert found.parameters == (("a", "1.5"), ("b", "2")) and found.path == str(file.resolve())
    file.write_text("<a>" * most + "<c/>" + "</a>" * most, encoding="utf-8")
    with pytest.raises(SceneError, match=rf"at most {most} levels deep, got more at <c>"):
        describe_xml(file, {})




# ------------------------------------------------------------------------------------------------- ready for pictures


def test_cameras_and_integrators_of_ready_scenes():
    """By what they show of themselves."""
    room = make_room() | {"integrator": {"type": "volpath", "max_depth": -1, "rr_depth": 7, "hide_emitters": True}}
    pose = room["sensor"]["to_world"]
    film = {"type": "hdrfilm", "width": 6, "height": 4, "crop_width": 3, "crop_height": 2, "crop_offset_x": 2,
            "crop_offset_y": 1, "pixel_format": "rgba", "rfilter": {"type": "gaussian", "stddev": 0.4}}  # fmt: skip
    room["sensor"] = {
        "type": "thinlens", "to_world": pose, "fov": 30.0, "aperture_radius": 0.25, "focus_distance": 3.0,
        "near_clip": 0.5, "far_clip": 50.0, "shutter_open": 1.5, "shutter_close": 4.0, "film": film,
        "sampler": {"type": "stratified", "sample_count": 9, "jitter": False},
    }  # fmt: skip
    tree = transient_dictionary(mi.load_dict(room, optimize=False))
    (integrator,) = (entry for entry in tree.values() if isinstance(entry, dict) and entry["type"] == "volpath")
    assert (integrator["max_depth"], integrator["rr_depth"], integrator["hide_emitters"]) == (-1, 7, True)
    (camera,) = (entry for entry in tree.values() if isinstance(entry, dict) and entry["type"] == "thinlens")
    numbers = {"near_clip": 0.5, "far_clip": 50, "shutter_open": 1.5, "shutter_close": 4, "aperture_radius": 0.25,
               "focus_distance": 3}  # fmt: skip
    assert {name: camera[name] for name in numbers} == pytest.approx(numbers)
    assert camera["fov_axis"] == "x" and camera["fov"] == pytest.approx(30.0, rel=1e-5)
    np.testing.assert_allclose(camera["to_world"], pose, atol=1e-6)
    assert camera["sampler"] == {"type": "stratified", "sample_count": 9, "jitter": False}
    assert camera["film"].pop("rfilter") == {"type": "gaussian", "stddev": pytest.approx(0.4, rel=1e-6)}
    assert camera["film"] == {**{key: value for key, value in film.items() if key != "rfilter"}, "sample_border": False}


# --------------------------------------------------------------------------------------------------------- of a call


def test_samples_over_seconds():
    """The rate counts all pixels of all films, each with its number of samples."""
    room = make_room()
    scene = tt.load(room, variant=VARIANT)
    stats = tt.render(scene, {GREY: torch.rand(3) * 0.5}, spp=4, seed=0).stats
    film = room["sensor"]["film"]
    assert stats.samples_per_second * stats.seconds == pytest.approx(3 * 4 * film["width"] * film["height"])
    assert len(stats.seeds) == 3 and 0 < stats.seconds < 100


def test_values_with_gradients_are_saved(tmp_path):
    """The numbers of a renderer's own parameters, few of them and many."""
    room = make_room()
    pixels = np.linspace(0.1, 0.9, 108, dtype=np.float32).reshape(6, 6, 3)
    room["wall"]["bsdf"]["reflectance"] = {"type": "bitmap", "raw": True, "data": pixels}
    keys = ["wall.bsdf.reflectance.data", "wall.to_world"]
    renderer = tt.TransientRenderer(tt.load(room, variant=VARIANT), parameters=keys, temporal_filter="tent")
    with torch.no_grad():
        renderer.values[keys[0]].mul_(0.5)
        renderer.values[keys[1]][0, 3] += 0.25
    path = renderer.scene.save(tmp_path / "scene.xml", renderer.values)
    assert sorted(os.listdir(tmp_path)) == ["scene.xml", "scene_files"]
    again = tt.TransientRenderer(tt.load(path, variant=VARIANT), parameters=keys, temporal_filter="tent")
    for key in keys:
        torch.testing.assert_close(again.values[key], renderer.values[key], rtol=1e-5, atol=1e-6)
    # And taken as the start of another renderer, which has numbers of its own.
    other = tt.TransientRenderer(renderer.scene, parameters=dict(renderer.values), temporal_filter="tent")
    with torch.no_grad():
        renderer.values[keys[0]].zero_()
    torch.testing.assert_close(other.values[keys[0]], again.values[keys[0]], rtol=1e-5, atol=1e-6)
    assert other.values[keys[0]].is_leaf
