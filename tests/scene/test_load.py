"""`tt.load` and `tt.Scene`: what is taken, what is refused and how, and that a scene survives its process."""

from __future__ import annotations

import copy
import pickle

import mitsuba as mi
import numpy as np
import pytest
import torch

import torchtransient as tt
from support.sweeps import together
from support.text_files import SCENE
from tools.small_room import COLOUR, VARIANT, make_room, pose


@pytest.fixture
def xml(tmp_path):
    path = tmp_path / "peer.xml"
    path.write_text(SCENE)
    return path


def show(scene, keys=(), seed=0, **settings):
    renderer = tt.TransientRenderer(scene, parameters=list(keys), **{"spp": 16, **settings})
    return renderer(seed=seed).transient.detach()


def test_peer_xml_is_the_same_scene_as_the_dictionary(xml):
    scene = tt.load(xml, variant=VARIANT)
    keys = ["shape.bsdf.reflectance.value"]
    from_xml, from_dict = show(scene, keys), show(tt.load(make_room(), variant=VARIANT), [COLOUR])
    assert from_xml.abs().max() > 0
    close = torch.isclose(from_xml, from_dict, rtol=1e-3, atol=1e-4)
    assert close.float().mean() > 0.99


def test_xml_parameters(xml):
    assert tt.TransientRenderer(tt.load(xml, variant=VARIANT))(seed=0).stats.spp == 8
    assert tt.TransientRenderer(tt.load(str(xml), variant=VARIANT, spp=4))(seed=0).stats.spp == 4


def test_nameless_xml_children_have_stable_names(xml):
    first, second = (list(tt.load(xml, variant=VARIANT).parameters()) for _ in range(2))
    assert first == second
    assert "shape.vertex_positions" in first and "light.position" in first
    assert not any(key.startswith("object_") for key in first)


def test_files_are_found_beside_the_xml_and_where_a_dictionary_was_loaded(xml, tmp_path, monkeypatch):
    (tmp_path / "tri.obj").write_text("v -1 -1 0\nv 1 -1 0\nv 0 1 0\nf 1 2 3\n")
    shape = '<shape type="obj" id="tri"><string name="filename" value="tri.obj"/></shape></scene>'
    xml.write_text(SCENE.replace("</scene>", shape))
    monkeypatch.chdir(tmp_path)
    described = tt.load({**make_room(), "tri": {"type": "obj", "filename": "tri.obj"}}, variant=VARIANT)
    monkeypatch.chdir("/")
    for scene in (tt.load(xml, variant=VARIANT), described):
        assert scene.parameters()["tri.vertex_positions"].shape == (3, 3)


@pytest.mark.parametrize(
    "write",
    [
        lambda: pose(scale=3.0).tolist(),
        lambda: mi.ScalarTransform4f(pose(scale=3.0)),
        lambda: mi.Transform4f(mi.Matrix4f(pose(scale=3.0))),
        lambda: torch.tensor(pose(scale=3.0)),
    ],
    ids=["nested lists", "scalar transform", "transform", "torch tensor"],
)
def test_forms_of_transforms_vectors_and_colours(write, room_scene):
    expected = show(room_scene)
    room = make_room()
    room["wall"]["to_world"] = write()
    room["light"]["position"] = mi.Point3f(-0.5, 0.25, 4.0)
    room["box"]["bsdf"]["reflectance"]["value"] = mi.Color3f(0.8, 0.5, 0.2)
    room["wall"]["bsdf"]["reflectance"] = np.float64(0.5)
    scene = tt.load(room, variant=VARIANT)
    assert torch.equal(show(scene), expected)


def test_pixels_given_as_bitmap_array_and_tensor():
    pixels = np.linspace(0.1, 0.9, 48, dtype=np.float32).reshape(4, 4, 3)

    def with_texture(**entry):
        room = make_room()
        room["wall"]["bsdf"]["reflectance"] = {"type": "bitmap", "raw": True, **entry}
        return show(tt.load(room, variant=VARIANT))

    bitmap, tensor = mi.Bitmap(pixels), mi.TensorXf(pixels)
    expected = with_texture(data=pixels)
    assert torch.equal(with_texture(bitmap=bitmap), expected)
    assert torch.equal(with_texture(data=tensor), expected)
    assert torch.equal(with_texture(data=torch.tensor(pixels)), expected)


def test_eight_bit_textures_are_linear_and_have_derivatives():
    """Of one bounce the light is linear in the albedo: albedo times derivative adds up to the light (Euler)."""
    encoded = np.full((2, 2, 3), 128, dtype=np.uint8)
    room = make_room()
    room["wall"]["bsdf"]["reflectance"] = {"type": "bitmap", "bitmap": mi.Bitmap(encoded)}
    room["box"]["bsdf"] = {"type": "diffuse", "reflectance": 0.0}
    room["integrator"]["max_depth"] = 2
    scene, key = tt.load(room, variant=VARIANT), "wall.bsdf.reflectance.data"
    info = scene.parameters()[key]
    assert info.differentiable and info.value.dtype == np.float32
    renderer = tt.TransientRenderer(scene, parameters=[key], spp=16, grad_seed="same")
    albedo = renderer.values[key]
    # 128 / 255 in sRGB is 0.2159 linear.
    torch.testing.assert_close(albedo.detach(), torch.full((2, 2, 3), 0.21586), rtol=0, atol=1e-4)
    image = renderer(seed=1).transient
    image.sum().backward()
    assert float((albedo.grad * albedo.detach()).sum()) == pytest.approx(float(image.detach().sum()), rel=1e-4)
    # A picture that is asked for with a derivative is the same.
    torch.testing.assert_close(image.detach(), show(scene, seed=1), rtol=1e-5, atol=1e-9)


def test_later_changes_of_the_dictionary_have_no_effect(room_scene):
    room = make_room()
    scene = tt.load(room, variant=VARIANT)
    room["light"]["intensity"] = 0.0
    room["wall"]["to_world"][:] = 0
    assert torch.equal(show(scene), show(room_scene))


def test_pickle_and_copies(room_scene):
    expected = show(room_scene)
    assert torch.equal(show(pickle.loads(pickle.dumps(room_scene))), expected)
    assert copy.deepcopy(room_scene) is room_scene and copy.copy(room_scene) is room_scene


# ------------------------------------------------------------------------------------------------ overrides


def steady_room() -> dict:
    room = make_room()
    room["integrator"] = {"type": "path", "max_depth": 3}
    film = {"type": "hdrfilm", "width": 4, "height": 3, "pixel_format": "rgb", "rfilter": {"type": "box"}}
    room["sensor"]["film"] = film
    return room


def test_steady_film_and_integrator_are_taken_with_a_time_axis(room_scene):
    axis = tt.TimeAxis(start_opl=6.0, bin_width_opl=0.25, num_bins=24)
    renderer = tt.TransientRenderer(tt.load(steady_room(), variant=VARIANT), time_axis=axis, spp=16)
    out = renderer(seed=0)
    assert out.stats.integrator == "transient_path" and out.axis == axis
    assert torch.equal(out.transient, show(room_scene))


def test_scene_without_film_or_integrator():
    room = steady_room()
    del room["integrator"], room["sensor"]["film"]
    axis = tt.TimeAxis(start_opl=6.0, bin_width_opl=0.25, num_bins=2)
    renderer = tt.TransientRenderer(tt.load(room, variant=VARIANT), time_axis=axis, spp=1, max_depth=2)
    assert renderer(seed=0).transient.shape == (3, 2, 576, 768)


def test_time_axis_replaces_the_films(room_scene):
    axis = tt.TimeAxis(start_opl=7.0, bin_width_opl=0.5, num_bins=6)
    out = tt.TransientRenderer(room_scene, time_axis=axis, spp=16)(seed=0)
    assert out.axis == axis and out.transient.shape == (3, 6, 3, 4)
    fine = show(room_scene)[:, 4:16].reshape(3, 6, 2, 3, 4).sum(2)
    torch.testing.assert_close(out.transient, fine)


def test_max_depth_replaces_the_integrators(room_scene):
    direct = show(room_scene, max_depth=2)
    assert 0 < direct.sum() < show(room_scene).sum()


def test_foreign_integrator_is_refused():
    room = make_room()
    room["integrator"] = {"type": "ptracer"}
    with pytest.raises(tt.errors.SceneError, match=r"ptracer.*transient_path"):
        tt.TransientRenderer(tt.load(room, variant=VARIANT))


# --------------------------------------------------------------------------------------------------- errors


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('type="cube"', 'type="cuboid"', r"peer\.xml \(line 25.*cuboid"),
        ('name="fov"', 'name="fow"', r"peer\.xml \(line 9.*fow"),
        ('<ref id="grey"/>', '<ref id="gray"/>', r"gray"),
        ('value="$spp"', 'value="$samples"', r"peer\.xml \(line 12.*samples"),
        ('value="24"', 'value="0"', r"peer\.xml \(line 13.*temporal_bins"),
    ],
    ids=["unknown plugin", "unknown property", "broken reference", "undefined parameter", "value out of range"],
)
def test_faults_in_xml_name_file_and_line(xml, old, new, message):
    assert old in SCENE
    xml.write_text(SCENE.replace(old, new))
    with pytest.raises(tt.errors.SceneError, match=f"(?s){message}"):
        tt.TransientRenderer(tt.load(xml, variant=VARIANT))


def test_properties_that_nothing_reads_are_said_with_what_to_do():
    room = make_room()
    room["integrator"] |= {"nlos_hidden_geometry_sampling_max_depth": 3, "nlos_laser_sampling": True, "max_dept": 4}
    with pytest.raises(tt.errors.SceneError, match="node \"integrator\": 'transient_path' does not read") as caught:
        tt.load(room, variant=VARIANT).parameters()
    text = str(caught.value)
    assert "parser.cpp" not in text and "'max_dept' = 4" in text and "Misspelt" in text
    assert "Leave 'nlos_hidden_geometry_sampling_max_depth' out: hidden geometry is sampled at all depths" in text
    assert "'nlos_laser_sampling': transient_nlos_path reads such" in text


# ----------------------------------------------------------------------------- lists of numbers of our own plugins


def phasor_room(frequencies):
    room = make_room()
    room["sensor"]["film"] = {"type": "phasor_hdr_film", "width": 4, "height": 3, "frequencies": frequencies}
    return room


@together("count", [1, 3, 16])
@together("kind", [tuple, np.array, torch.tensor])
def test_frequencies_as_a_list_of_any_length(count, kind):
    """Mitsuba takes lists of three only."""
    row = [0.1 * k for k in range(count)]
    scene = tt.load(phasor_room(kind(row)), variant=VARIANT)
    renderer = tt.TransientRenderer(pickle.loads(pickle.dumps(scene)), spp=1)
    assert renderer.frequencies.frequencies == pytest.approx(row, abs=1e-6)
    if kind in (tuple, np.array):
        assert renderer.frequencies.frequencies == tuple(row)
        assert scene.same_description(tt.load(phasor_room(", ".join(map(repr, row)))))
    assert tt.plan(scene, "phasor", pilot=False).renderer(spp=1).frequencies == renderer.frequencies


def test_pulses_and_decays_as_lists():
    room = make_room()
    opl, values = [0.0, 0.1, 0.4, 2.0], [0, 1, 0.3, 0]
    room["sensor"]["film"] |= {"irf": "tabulated", "irf_opl": opl, "irf_values": np.array(values)}
    decay = {"decay_opl": tuple(opl), "decay_values": values}
    room["wall"]["bsdf"] = {"type": "delayed", "nested": {"type": "diffuse"}, **decay}
    written = copy.deepcopy(room)
    written["sensor"]["film"] |= {"irf_opl": "0 0.1 0.4 2", "irf_values": "0 1 0.3 0"}
    written["wall"]["bsdf"] |= {"decay_opl": "0 0.1 0.4 2", "decay_values": "0, 1, 0.3, 0"}
    a, b = (tt.render(tt.load(each, variant=VARIANT), spp=2, seed=0).transient for each in (room, written))
    assert torch.equal(a, b) and a.sum() > 0


def test_meshes_that_cannot_be_merged():
    """Mitsuba merges meshes of one surface, and stops where their normals point to different sides."""
    shape = {"type": "cube", "bsdf": {"type": "ref", "id": "paint"}, "to_world": pose(0.0, 0.0, 1.0, 0.1)}
    paint = {"type": "diffuse", "id": "paint", "reflectance": {"type": "rgb", "value": 0.5}}
    scene = {"paint": paint, **make_room(), "a": shape, "b": shape | {"flip_normals": True}}
    loaded, key = tt.load(scene, variant=VARIANT), "paint.reflectance.value"
    images = [tt.render(loaded, values, spp=64, seed=0).steady for values in ({}, {key: torch.full((3,), 0.5)})]
    assert float(images[0].sum()) == pytest.approx(float(images[1].sum()), rel=1e-5)


@pytest.mark.parametrize("key", ["integrator", "film"])
def test_an_unknown_plugin_is_not_replaced(key):
    scene = make_room()
    (scene if key == "integrator" else scene["sensor"])[key] = {"type": "transientpath"}
    with pytest.raises(tt.errors.SceneError, match=f"'{key}': expected .* got 'transientpath'"):
        tt.render(tt.load(scene, variant=VARIANT), spp=1)


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


def test_files_in_files_count_their_levels(tmp_path):
    outer = f"<s>{'<b>' * 3}<include filename='d.xml'/>{'</b>' * 3}</s>"
    (tmp_path / "c.xml").write_text(outer, encoding="utf-8")
    for levels, deep in ((59, False), (60, True)):
        (tmp_path / "d.xml").write_text("<b>" * levels + "</b>" * levels, encoding="utf-8")
        if deep:
            with pytest.raises(tt.errors.SceneError, match=r"d\.xml: expected elements at most 64 levels deep"):
                tt.load(tmp_path / "c.xml")
        else:
            tt.load(tmp_path / "c.xml")


def test_response_curves_of_a_file(xml):
    """A flat lamp and a flat wall: channels are in the ratio of the areas of their curves."""
    film = '<film type="transient_hdr_film">'
    curves = '<spectrum name="far" value="650:0, 700:1, 750:0"/><spectrum name="near" value="400:0, 450:2, 500:0"/>'
    assert film in SCENE
    xml.write_text(SCENE.replace(film, film + curves))
    out = tt.render(tt.load(xml, variant="llvm_ad_spectral"), seed=0, spp=256)
    assert out.channels == ("far", "near") and out.transient.shape == (2, 24, 3, 4)
    assert float(out.steady[1].mean() / out.steady[0].mean()) == pytest.approx(2, rel=0.1)
