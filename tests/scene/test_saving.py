"""``scene.save``: what is written loads again with the same parameters, the same keys and the same picture."""

from __future__ import annotations

import os
import re

import mitsuba as mi
import numpy as np
import pytest
import torch

import torchtransient as tt
from tools.every_plugin import every_plugin
from tools.small_room import COLOUR, VARIANT, make_room, pose

TEXTURE, VERTICES, PLACE = "wall.bsdf.reflectance.data", "box.vertex_positions", "wall.to_world"


def textured_room():
    room = make_room()
    pixels = np.linspace(0.1, 0.9, 48, dtype=np.float32).reshape(4, 4, 3)
    room["wall"]["bsdf"]["reflectance"] = {"type": "bitmap", "raw": True, "data": pixels}
    return room


def picture(scene, **more):
    renderer = tt.TransientRenderer(scene, spp=16, temporal_filter="tent", physics="ignore", **more)
    return renderer(seed=3).transient.detach()


def changed(scene, keys):
    """Other values than the described ones, where numbers may be anything between them and one half."""
    table = scene.parameters()
    start = tt.TransientRenderer(scene, parameters=keys, physics="ignore").values
    assert all(table[key].differentiable for key in keys)
    found = {}
    for key in keys:
        value = start[key].detach().clone()
        noise = torch.rand(value.shape, generator=torch.Generator().manual_seed(1))
        found[key] = (
            value * (0.7 + 0.2 * noise)
            if not key.endswith("to_world")
            else value @ torch.tensor(pose(0.1, 0.05, -0.2), dtype=torch.float32)
        )
    return found


@pytest.mark.slow
def test_an_optimised_scene_has_the_same_picture(tmp_path):
    variant = VARIANT
    scene = tt.load(textured_room(), variant=variant)
    values = changed(scene, [TEXTURE, VERTICES, PLACE, "light.position", COLOUR])
    expected = picture(scene, parameters=values)
    path = scene.save(tmp_path / "found.xml", values)
    assert {file.suffix for file in (tmp_path / "found_files").iterdir()} == {".exr", ".ply"}
    assert not torch.equal(picture(scene), expected)
    again = tt.load(path, variant=variant)
    assert list(again.parameters()) == list(scene.parameters())
    torch.testing.assert_close(picture(again), expected, rtol=1e-4, atol=1e-5)
    with mi.variant_context(variant), tt.threads(2):  # one alone waits for ever for the pictures that Mitsuba reads
        ready = mi.load_file(str(path))
    with mi.variant_context(variant):
        torch.testing.assert_close(picture(ready), expected, rtol=1e-4, atol=1e-5)
    # Once more to the same place, with nothing left of before.
    again.save(path)
    torch.testing.assert_close(picture(tt.load(path, variant=variant)), expected, rtol=1e-4, atol=1e-5)


def test_a_mesh_is_one_file(tmp_path):
    """Beside the XML lies what it names, whether the mesh came as arrays or from a file."""
    room = make_room()
    corners = np.array([[-1, -1, 0.1], [1, -1, 0.1], [0, 1, 0.1]], np.float32)
    room["star"] = {"type": "mesh_arrays", "vertices": corners, "faces": np.array([[0, 1, 2]])}
    scene, key = tt.load(room, variant=VARIANT), "star.vertex_positions"
    for name in ("first", "second"):
        path = scene.save(tmp_path / f"{name}.xml", {key: corners * 0.5})
        assert [file.name for file in (tmp_path / f"{name}_files").iterdir()] == ["star.ply"]
        assert f'value="{name}_files/star.ply"' in path.read_text()
        scene = tt.load(path, variant=VARIANT)


def test_a_grid_is_a_file(tmp_path):
    """And the values of it that were found."""
    room = make_room()
    room["integrator"]["type"] = "transient_prbvolpath"
    values = np.linspace(0.5, 2.0, 24, dtype=np.float32).reshape(2, 3, 4, 1)
    sigma = {"type": "gridvolume", "grid": values, "to_world": pose(0.1, -0.3, 0.2, 0.6)}
    medium = {"type": "heterogeneous", "sigma_t": sigma, "albedo": 0.7}
    room["box"] |= {"bsdf": {"type": "null"}, "interior": medium}
    scene, key = tt.load(room, variant=VARIANT), "box.interior_medium.sigma_t.data"
    path = scene.save(tmp_path / "fog.xml", {key: torch.tensor(values) * 2})
    again = tt.TransientRenderer(tt.load(path, variant=VARIANT), parameters=[key])
    assert torch.equal(again.values[key].detach(), torch.tensor(values) * 2)


@pytest.mark.slow
def test_spectral_colours_that_were_found(tmp_path):
    """Values are coefficients of spectra there; the file has the colours that they belong to."""
    variant = "llvm_ad_spectral"
    room = textured_room()
    room["wall"]["bsdf"]["reflectance"] = {
        "type": "bitmap", "bitmap": np.random.default_rng(0).uniform(0.1, 0.9, (4, 4, 3)).astype(np.float32)
    }  # fmt: skip
    scene = tt.load(room, variant=variant)
    with mi.variant_context(variant):
        colour = np.array(mi.srgb_model_fetch(mi.ScalarColor3f(0.2, 0.55, 0.4))).ravel()
    texture = tt.TransientRenderer(scene, parameters=[TEXTURE], physics="ignore").values[TEXTURE].detach()
    values = {COLOUR: torch.tensor(colour), TEXTURE: texture.flip(0)}
    expected = picture(scene, parameters=values)
    again = tt.load(scene.save(tmp_path / "found.xml", values), variant=variant)
    torch.testing.assert_close(picture(again), expected, rtol=1e-3, atol=1e-5)
    assert not torch.allclose(picture(scene), expected, rtol=1e-2)


def test_a_scene_from_a_file(tmp_path):
    """Children without a name keep the keys that they have; files come along; values of `$names` are in it."""
    (tmp_path / "from").mkdir()
    (tmp_path / "to").mkdir()
    (tmp_path / "from" / "tri.obj").write_text("v -1 -1 0\nv 1 -1 0\nv 0 1 0\nf 1 2 3\n")
    text = """<scene version="3.0.0"><default name="grey" value="0.5"/>
    <integrator type="transient_path"><integer name="max_depth" value="3"/></integrator>
    <sensor type="perspective"><transform name="to_world"><lookat origin="0, 0, 4" target="0, 0, 0" up="0, 1, 0"/>
    </transform><film type="transient_hdr_film"><integer name="width" value="4"/><integer name="height" value="3"/>
    <rfilter type="box"/><integer name="temporal_bins" value="24"/><float name="bin_width_opl" value="0.25"/>
    <float name="start_opl" value="6"/></film></sensor>
    <bsdf type="twosided" id="paint"><bsdf type="diffuse"><spectrum name="reflectance" value="$grey"/></bsdf></bsdf>
    <shape type="obj"><string name="filename" value="tri.obj"/><ref id="paint"/></shape>
    <shape type="sphere"><point name="center" x="0.4" y="0.1" z="0.5"/><float name="radius" value="0.3"/>
    <ref id="paint"/></shape>
    <emitter type="point"><point name="position" x="-0.5" y="0.25" z="4"/><rgb name="intensity" value="9, 8, 7"/>
    </emitter>
    </scene>"""
    (tmp_path / "from" / "scene.xml").write_text(text)
    scene = tt.load(tmp_path / "from" / "scene.xml", variant=VARIANT, grey=0.7)
    place = torch.tensor([0.2, 0.3, 4.0])
    path = scene.save(tmp_path / "to" / "scene.xml", {"emitter.position": place})
    again = tt.load(path, variant=VARIANT)
    assert list(again.parameters()) == list(scene.parameters())
    assert np.allclose(again.parameters()["emitter.position"].value, place)
    expected = picture(scene, parameters={"emitter.position": place})
    assert expected.sum() > 0 and torch.equal(picture(again), expected)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cornell_box", "etalon_slab", "milk_bottle", "nlos_room"])
def test_scenes_of_the_library(tmp_path, name):
    made = getattr(tt.scenes, name)(*([tmp_path / "bottle.ply"] if name == "milk_bottle" else []))
    scene = tt.load({"type": "scene", **made}, variant=VARIANT)
    again = tt.load(scene.save(tmp_path / "scene.xml"), variant=VARIANT)
    assert list(again.parameters()) == list(scene.parameters())
    if "sensor" in made:
        a, b = (tt.TransientRenderer(s, spp=1, max_depth=4, physics="ignore")(seed=0).transient for s in (scene, again))
        assert a.abs().max() > 0 and float((a - b).abs().mean()) < 1e-4 * float(a.abs().mean())
    mi.set_variant(VARIANT)
    assert isinstance(mi.load_file(str(tmp_path / "scene.xml")), mi.Scene)


@pytest.mark.slow
def test_every_parameter_of_every_plugin(tmp_path):
    """All are written and come back with the parameters that they had; each parameter with another value, too."""
    mi.set_variant(VARIANT)
    plugins, refused = every_plugin(tmp_path), {}
    assert len(plugins) > 80
    for name, node in plugins.items():
        scene = tt.load(node if node["type"] == "scene" else {"type": "scene", "thing": node}, variant=VARIANT)
        table = scene.parameters()
        # Only some values are poses, or of length one.
        keys = [key for key in table.differentiable() if not key.endswith(("to_world", "normals", "direction"))]
        for key in ("", *keys):
            value = 0.83 * torch.as_tensor(table[key].value, dtype=torch.float32) if key else None
            try:
                path = scene.save(tmp_path / "scene.xml", {key: value} if key else {})
            except tt.errors.SceneError as error:
                refused[f"{name}.{key.rsplit('.', 1)[-1]}"] = str(error)
                continue
            found = tt.load(path, variant=VARIANT).parameters()
            assert found.keys() == table.keys(), name
            if key:
                np.testing.assert_allclose(found[key].value, value, rtol=1e-5, atol=1e-6, err_msg=f"{name}: {key}")
    # Curves come as files, and there is none for ellipsoids.
    blobs = {f"{kind}.{key}" for kind in ("ellipsoids", "ellipsoidsmesh") for key in ("", "data", "opacities")}
    assert refused.keys() == blobs | {"bsplinecurve.control_points", "linearcurve.control_points"}
    assert all("cannot be said in XML" in text and str(tmp_path) not in text for text in refused.values())


def test_what_cannot_be_said_is_refused_and_nothing_is_written(tmp_path):
    scene = tt.load(textured_room(), variant=VARIANT)
    with pytest.raises(tt.errors.SceneError, match=r"name of an XML file.*found\.json"):
        scene.save(tmp_path / "found.json")
    with pytest.raises(tt.errors.SceneError, match="there is no folder"):
        scene.save(tmp_path / "no" / "found.xml")
    with pytest.raises(tt.errors.SceneError, match="has no parameter"):
        scene.save(tmp_path / "found.xml", {"wall.colour": 1.0})
    with pytest.raises(tt.errors.ShapeError, match=r"light.position"):
        scene.save(tmp_path / "found.xml", {"light.position": torch.zeros(2, 3)})
    odd = {COLOUR: float("nan")}, {COLOUR: torch.tensor([0.1, -torch.inf, torch.nan])}
    for given, got in zip(odd, ("nan.", "-inf (2 of 3)."), strict=True):
        words = re.escape(f"scene.save: value of {COLOUR!r}: expected finite numbers, got {got}")
        with pytest.raises(tt.errors.UnitError, match=f"^{words}$"):
            scene.save(tmp_path / "found.xml", given)
    room = make_room()
    room["box"] = mi.load_dict({"type": "sphere"})
    with pytest.raises(tt.errors.SceneError, match="was taken as it is"):
        tt.load(room).save(tmp_path / "found.xml")
    dollar = make_room()
    dollar["sensor"]["film"]["irf"] = "$x"
    with pytest.raises(tt.errors.SceneError):
        tt.load(dollar, variant=VARIANT).save(tmp_path / "found.xml")
    spectral = tt.load(make_room(), variant="llvm_ad_spectral")
    with pytest.raises(tt.errors.SceneError, match=r"box\.bsdf\.reflectance\.value.*cannot be said in XML"):
        spectral.save(tmp_path / "found.xml", {COLOUR: torch.tensor([0.001, -0.5, 20.0])})
    assert not list(tmp_path.iterdir())


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
