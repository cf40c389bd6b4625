"""What scenes are reduced to: plain data, told apart by every number, and what has no description."""

from __future__ import annotations

import os
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import torch

import torchtransient as tt
from support.sweeps import together
from tools.small_room import GREY, make_room
from torchtransient.errors import SceneError
from torchtransient.plugins.dictionaries import Pixels
from torchtransient.rendering import description, ready_scenes
from torchtransient.rendering.description import (
    DictDescription,
    _names_files,
    _same,
    _to_plain,
    _xml_value,
    describe_dict,
    describe_xml,
    same_description,
)
from torchtransient.rendering.node_checks import MOST_LEVELS
from torchtransient.rendering.probe import PIXELS, _crop
from torchtransient.rendering.ready_scenes import described_for_time

VARIANT = "llvm_ad_rgb"


# ------------------------------------------------------------------------------------------------------ dictionaries


def plain(value):
    return _to_plain({"x": value}, "", 9)["x"]


def test_plain_data_of_every_kind(tmp_path):
    leaf = torch.arange(6.0).reshape(2, 3).requires_grad_()
    assert type(plain(np.float32(0.5))) is float and plain(np.array(3)) == 3 and plain(True) is True
    assert plain(tmp_path) == str(tmp_path) and plain("text") == "text"
    assert np.array_equal(plain(leaf), leaf.detach().numpy()) and isinstance(plain(leaf), np.ndarray)
    given = np.arange(3.0)
    taken = plain(given)
    given += 1
    assert taken.tolist() == [0, 1, 2]
    assert plain([1, 2]) == [1.0, 2.0] and plain([(400.0, 0.1), (500.0, 0.2)]) == [[400.0, 0.1], [500.0, 0.2]]
    assert isinstance(plain(np.eye(4).tolist()), np.ndarray) and isinstance(plain([[1, 2, 3]]), np.ndarray)
    assert isinstance(plain([[[1, 2]]]), np.ndarray)


def test_plain_data_of_mitsuba_and_drjit():
    assert plain(mi.Color3f(1, 2, 3)) == [1, 2, 3] and plain(mi.ScalarPoint3f(1, 2, 3)) == [1, 2, 3]
    assert plain(mi.Float(2.5)) == 2.5 and plain(dr.scalar.ArrayXf(1, 2)) == [1, 2]
    tensor = plain(mi.TensorXf(np.arange(6.0), (2, 3)))
    assert isinstance(tensor, np.ndarray) and tensor.tolist() == [[0, 1, 2], [3, 4, 5]]
    assert plain(mi.TensorXf([1.0, 2.0])) == [1, 2]
    matrix = np.array([[1.0, 2, 3, 4], [0, 1, 5, 6], [0, 0, 1, 7], [0, 0, 0, 1]])
    for made in (mi.ScalarTransform4f(matrix), mi.Transform4f(matrix)):
        assert np.array_equal(plain(made), matrix)
    assert plain(mi.ScalarTransform3f(np.eye(3))).shape == (3, 3)
    pixels = plain(mi.Bitmap(np.arange(12, dtype=np.float32).reshape(2, 2, 3)))
    assert isinstance(pixels, Pixels) and np.array(pixels.values).ravel().tolist() == list(range(12))


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


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (None, "expected a value at x, got None. Leave the entry out"),
        ({3: 1}, "keys must be strings, got 3 at x"),
        ([[1, 2], [3]], r"the list at x is not an array of numbers"),
        (["a", 1], r"the list at x is not an array of numbers"),
        ({"y": {"z": [["a"]]}}, r"the list at x\.y\.z is not an array"),
        (object(), "the object at x cannot be described, and a scene must be rebuilt"),
        (SimpleNamespace(detach=1), "the SimpleNamespace at x cannot be described"),
    ],
)
def test_what_has_no_description(value, words):
    with pytest.raises(SceneError, match=rf"tt\.load: {words}"):
        plain(value)


def test_several_transforms_are_no_transform():
    several = mi.Transform4f().translate(mi.Point3f([1, 2], 0, 0))
    with pytest.raises(SceneError, match=r"expected one transform at x, got matrices of shape \(4, 4, 2\)"):
        plain(several)


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


# ---------------------------------------------------------------------------------------------------------- equality


@together(
    "a, b, same",
    [
        ({"a": 1, "b": 2}, {"a": 1, "b": 2}, True), ({"a": 1, "b": 2}, {"b": 2, "a": 1}, False),
        ({"a": 1}, {"a": 1, "b": 2}, False), ({"a": {"b": 1}}, {"a": {"b": 3}}, False), ({"a": 1}, 1, False),
        (1, 1.0, True), (1, 2, False), (True, True, True), (True, 1, False), (0, False, False), ("a", "a", True),
        ("a", "b", False), ([1.0, 2.0], [1.0, 2.0], True), ([1.0], [1.0, 2.0], False),
        (np.array([1.0, np.nan]), np.array([1.0, np.nan]), True), (np.array([1.0]), np.array([2.0]), False),
        (np.array([1.0]), np.array([1], np.float32), False), (np.array([1.0]), [1.0], False),
        ([1.0], np.array([1.0]), False), (np.array(["a"]), np.array(["a"]), True),
        (np.array([1, 2]), np.array([1, 2]), True),
    ],
)  # fmt: skip
def test_what_is_the_same(a, b, same):
    assert _same(a, b) is same


def test_pictures_are_the_same_with_their_settings():
    values = np.arange(12.0, dtype=np.float32).reshape(2, 2, 3)
    one = Pixels(values, False, "")
    assert _same(one, Pixels(values.copy(), False, ""))
    for other in (Pixels(values, True, ""), Pixels(values, False, "rgb"), Pixels(values + 1, False, "")):
        assert not _same(one, other)


def test_files_are_looked_up_where_the_scene_was_loaded():
    """The folder counts where a file may be named."""
    named, other = {"type": "scene", "a": {"filename": "a.ply"}}, {"type": "scene", "a": {"profile": 3, "name": "file"}}
    assert _names_files(named) and not _names_files(other)
    for tree, same in ((named, False), (other, True)):
        assert same_description(DictDescription(tree, "/here"), DictDescription(dict(tree), "/there")) is same
        assert same_description(DictDescription(tree, "/here"), DictDescription(dict(tree), "/here"))
    assert not same_description(DictDescription(named, "/here"), DictDescription(other, "/here"))


# --------------------------------------------------------------------------------------------------------------- XML


def test_values_of_parameters():
    assert [_xml_value("k", value) for value in (True, np.bool_(False), 3, np.float32(0.5), "text")] == [
        "true", "false", "3", "0.5", "text",
    ]  # fmt: skip
    with pytest.raises(SceneError, match="XML parameter 'k' must be a string or a number, got list"):
        _xml_value("k", [1])


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


def test_files_in_files_are_looked_at(tmp_path, monkeypatch):
    """As many inside of each other as Mitsuba takes and one more; names have parameters, the longest ones first."""
    looked = []
    monkeypatch.setattr(description, "check_special", lambda path, *_: looked.append(path.name))
    (tmp_path / "a.xml").write_text('<s><include filename="a.xml"/></s>', encoding="utf-8")
    describe_xml(tmp_path / "a.xml", {})
    assert looked == ["a.xml"] * 17
    looked.clear()
    (tmp_path / "b.xml").write_text(
        '<s><default name="part" value="x"/><default name="partner" value="y"/>'
        '<include filename="$partner-$part.xml"/><include filename="z.xml"/></s>', encoding="utf-8"
    )  # fmt: skip
    (tmp_path / "z.xml").write_text("<s><include filename='$part.xml'/></b>", encoding="utf-8")
    describe_xml(tmp_path / "b.xml", {"part": 3})
    assert looked == ["y-3.xml", "z.xml", "3.xml"]
    # Levels count through files.
    inside = "<b>" * 60 + "</b>" * 60
    (tmp_path / "c.xml").write_text(f"<s>{'<b>' * 3}<include filename='d.xml'/>{'</b>' * 3}</s>", encoding="utf-8")
    (tmp_path / "d.xml").write_text(inside, encoding="utf-8")
    with pytest.raises(SceneError, match=r"d\.xml: expected elements at most 64 levels deep"):
        describe_xml(tmp_path / "c.xml", {})
    (tmp_path / "d.xml").write_text(inside[3:-4], encoding="utf-8")
    describe_xml(tmp_path / "c.xml", {})


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
    tree = described_for_time(mi.load_dict(room, optimize=False)).tree
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


@pytest.mark.parametrize(
    ("given", "described"),
    [
        ({"type": "box"}, {"type": "box"}),
        ({"type": "tent", "radius": 1.5}, {"type": "tent", "radius": 1.5}),
        ({"type": "lanczos", "lobes": 4}, {"type": "lanczos", "lobes": 4}),
        ({"type": "catmullrom"}, {"type": "catmullrom"}),
    ],
)
def test_filters_of_ready_scenes(given, described):
    room = make_room() | {"integrator": {"type": "path", "max_depth": 5}}
    room["sensor"]["film"] = {"type": "hdrfilm", "width": 3, "height": 2, "rfilter": given}
    tree = described_for_time(mi.load_dict(room, optimize=False)).tree
    films = [entry["film"] for entry in tree.values() if isinstance(entry, dict) and "film" in entry]
    assert [film["rfilter"] for film in films] == [described]
    assert [entry["max_depth"] for entry in tree.values() if isinstance(entry, dict) and "max_depth" in entry] == [5]


class Said:
    """Stands in for an integrator that says other things of itself."""

    hide_emitters = False

    def __init__(self, *names, kind="PathIntegrator"):
        self.names, self.class_name = names, lambda: kind

    def __str__(self):
        return "Path[\n" + "".join(f"  {name} = 3,\n" for name in self.names) + "]"


def test_what_of_ready_scenes_is_not_described():
    """Classes that are not known, what says nothing of its depths, films that are no pictures, and cameras in fog."""
    both = ("max_depth", "rr_depth")
    assert ready_scenes._integrator(Said(*both)) == {"type": "path", **dict.fromkeys(both, 3), "hide_emitters": False}
    for other in (Said("max_depth"), Said("rr_depth"), Said(), Said(*both, kind="DirectIntegrator")):
        assert ready_scenes._integrator(other) is None
    assert ready_scenes._rfilter(mi.load_dict({"type": "mitchell"})) is None
    film = {"type": "hdrfilm", "width": 4, "height": 3, "rfilter": {"type": "box"}}
    assert ready_scenes._film(mi.load_dict(film))["width"] == 4
    for other in (film | {"rfilter": {"type": "mitchell"}}, film | {"type": "transient_hdr_film"}):
        assert ready_scenes._film(mi.load_dict(other)) is None
    assert ready_scenes._sampler(SimpleNamespace(class_name=lambda: "SamplerOfOthers")) is None
    camera = {"type": "perspective", "film": film}
    found = ready_scenes._sensor(mi.load_dict(camera))
    assert (found["type"], found["film"]["height"], found["sampler"]["type"]) == ("perspective", 3, "independent")
    for other in (camera | {"type": "radiancemeter", "film": film | {"width": 1, "height": 1}},
                  camera | {"film": film | {"type": "transient_hdr_film"}},
                  camera | {"medium": {"type": "homogeneous"}}):  # fmt: skip
        assert ready_scenes._sensor(mi.load_dict(other)) is None


def test_ready_scenes_that_stay_as_they_are():
    assert described_for_time(mi.load_dict(make_room(), optimize=False)) is None


# ------------------------------------------------------------------------------------------------ tried with less


@pytest.mark.parametrize(
    ("given", "cropped"),
    [
        # In the middle of what is shown.
        ({"width": 100, "height": 60}, {"x": (100, (100 - PIXELS) // 2), "y": (60, (60 - PIXELS) // 2)}),
        ({}, {"x": (768, (768 - PIXELS) // 2), "y": (576, (576 - PIXELS) // 2)}),
        ({"width": 100, "height": 1, "crop_width": 50, "crop_offset_x": 20}, {"x": (100, 20 + (50 - PIXELS) // 2)}),
        ({"width": PIXELS + 1, "height": PIXELS}, {"x": (PIXELS + 1, 0)}),
        ({"width": 100, "height": 1, "crop_width": 50, "crop_offset_x": 50}, {"x": (100, 50 + (50 - PIXELS) // 2)}),
        # What is wrong is refused as it is.
        ({"width": 100, "height": 1, "crop_width": 50, "crop_offset_x": 51}, {}),
        ({"width": 100, "height": 1, "crop_width": 50, "crop_offset_x": -1}, {}),
        ({"width": 100.0, "height": 1}, {}), ({"width": True, "height": 1}, {}), ({"exhaustive_scan": True}, {}),
    ],
)  # fmt: skip
def test_films_of_scenes_that_are_tried(given, cropped):
    props = dict(given)
    _crop(props)
    for side, along in (("width", "x"), ("height", "y")):
        if along in cropped:
            whole, first = cropped[along]
            assert (props[side], props[f"crop_{side}"], props[f"crop_offset_{along}"]) == (whole, PIXELS, first)
        else:
            assert {key: props.get(key) for key in (side, f"crop_{side}")} == {
                key: given.get(key) for key in (side, f"crop_{side}")
            }


# --------------------------------------------------------------------------------------------------------- of a call


def test_samples_over_seconds():
    """Of all pixels of all films, each with its number of samples."""
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
