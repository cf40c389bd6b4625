"""Recipes as YAML and JSON, and the text that stands for one."""

from __future__ import annotations

import json
import shutil
import sys

import numpy as np
import pytest
import torch

import torchtransient as tt
from support.text_files import RECIPES
from torchtransient.errors import MissingPackageError, SceneError, StorageError, UnitError

D = tt.data

TEXT, CAPTURE = RECIPES["scene"], RECIPES["capture"]


def test_a_file_is_its_recipe(tmp_path):
    recipe = D.Recipe.read(TEXT)
    assert recipe.n == 12 and list(recipe.vary) == ["red.reflectance.value", "small-box.to_world", "small-box.type"]
    recipe.to_yaml(tmp_path / "again.yaml")
    again = D.Recipe.read(tmp_path / "again.yaml")
    assert again == recipe and again.key() == recipe.key() and again.to_dict() == recipe.to_dict()
    assert again.draw(3)["red.reflectance.value"] == recipe.draw(3)["red.reflectance.value"]
    scene = tt.scenes.cornell_box(resolution=8)
    by_hand = D.Recipe(
        scene,
        {
            "red.reflectance.value": D.Uniform(0.05, 0.9),
            "small-box.to_world": D.Compose([D.Turn([0, 1, 0]), D.Offset([-0.2, 0, 0], [0.2, 0, 0])]),
            "small-box.type": D.Choice(["cube", "sphere"]),
        },
        variant="llvm_ad_mono", time_axis=tt.TimeAxis(2.0, 0.2, 60), spp=4, n=12, labels=["depth"],
        device="vl53l8_like",
    )  # fmt: skip
    assert by_hand.key() == recipe.key()


@pytest.mark.parametrize(
    "named, given, used",
    [
        ("independent", None, "owen"), (None, None, "owen"), ("multijitter", None, "multijitter"),
        ("independent", "scene", "independent"), ("multijitter", "owen", "owen"),
    ],
)  # fmt: skip
def test_the_sampler_is_settled_when_a_recipe_is_made(named, given, used):
    scene = tt.scenes.cornell_box(resolution=4, num_bins=20, bin_width_opl=0.5)
    if named is None:
        del scene["sensor"]["sampler"]
    else:
        scene["sensor"]["sampler"]["type"] = named
    recipe = D.Recipe(scene, spp=1, variant="llvm_ad_mono", sampler=given)
    assert recipe.to_dict().get("sampler", "scene") == (given or used)
    again = D.Recipe.from_dict(recipe.to_dict())
    assert again == recipe and again.key() == recipe.key()
    assert recipe.maker().kept(recipe.structure(0)).renderer(seed=0).stats.sampler == used


def test_scenes_of_several_samplers_and_varied_ones_keep_theirs():
    scene = tt.scenes.cornell_box(resolution=4)
    other = tt.scenes.cornell_box(resolution=4, sampler="multijitter")
    assert D.Recipe(D.OneOf([scene, other])).settings.sampler == "auto"
    varied = D.Recipe(scene, {"sensor.sampler.type": D.Choice(["independent", "multijitter"])})
    assert varied.settings.sampler == "scene"
    samplers = {varied.maker().kept(varied.structure(i)).renderer(seed=0, spp=4).stats.sampler for i in range(12)}
    assert samplers == {"independent", "multijitter"}


def test_files_that_say_nothing_of_samplers_keep_those_of_their_scenes(tmp_path):
    """As recipes of versions without the setting were rendered: the same numbers, and the same key."""
    scene = tt.scenes.cornell_box(resolution=4, num_bins=60, bin_width_opl=0.5)
    scene["sensor"]["sampler"] = {"type": "independent", "sample_count": 4}
    new = D.Recipe(scene, variant="llvm_ad_mono")
    written = new.to_dict()
    assert written.pop("sampler") == "owen"
    old = D.Recipe.from_dict(written)
    assert old.to_dict() == written and old == D.Recipe(scene, variant="llvm_ad_mono", sampler="scene")
    renderer = tt.TransientRenderer(tt.load(scene, "llvm_ad_mono"), sampler="independent")
    with torch.no_grad():
        plain = renderer(seed=old.sample(0).seed).steady.numpy()
    assert np.array_equal(old.sample(0).arrays["steady"], plain)
    D.generate(old, tmp_path, 1, workers=0, progress=False)
    with pytest.raises(StorageError, match=r"sampler is None there and 'owen' here.*sampler='scene'"):
        D.generate(new, tmp_path, 1, workers=0, progress=False)


def changed(**entries):
    import yaml

    data = yaml.safe_load(TEXT)
    return D.Recipe.from_dict({name: entry for name, entry in (data | entries).items() if entry is not None})


def test_devices_in_files(tmp_path):
    """YAML and JSON, beside the recipe."""
    device = tt.sensing.device("vl53l8_like")
    device.to_yaml(tmp_path / "mine.yaml")
    (tmp_path / "mine.json").write_text(json.dumps(device.to_dict()))
    for name in ("mine.yaml", "mine.json"):
        plain = {"scene": {"builtin": "cornell_box"}, "variant": "llvm_ad_mono", "device": name}
        assert D.Recipe.from_dict(plain, tmp_path).device == device
    assert changed(device=device.to_dict()).device == device


def test_scenes_weights_pictures_and_gates_are_written(monkeypatch):
    scene = tt.scenes.cornell_box(resolution=4)
    pixels = np.arange(4 * 5 * 3, dtype=np.float32).reshape(4, 5, 3) / 60
    textured = scene | {"red": {"type": "diffuse", "reflectance": {"type": "bitmap", "data": pixels, "raw": True}}}
    gates = [tt.Gate.gaussian(8.0, 2.0)]
    recipe = D.Recipe(D.OneOf({"a": scene, "b": textured}, [1, 3]), variant="llvm_ad_rgb", spp=2, gates=gates)
    again = D.Recipe.from_dict(json.loads(json.dumps(recipe.to_dict())))
    assert again == recipe and again.key() == recipe.key()
    assert again.scenes.weights == [1, 3] and list(again.settings.gates) == gates
    with pytest.raises(SceneError, match="finite numbers and plain data"):
        D.Recipe(scene, {"red.reflectance": D.Choice([float("nan")])}).to_dict()
    monkeypatch.setitem(sys.modules, "yaml", None)
    with pytest.raises(MissingPackageError, match="YAML needs PyYAML"):
        recipe.to_yaml()


def test_keys_tell_recipes_apart():
    base = changed().key()
    assert changed(n=13).key() == base
    axis = {"start_opl": 2, "bin_width_opl": 0.2, "num_bins": 61}
    others = [
        changed(seed=1), changed(spp=8), changed(labels=[]), changed(device=None), changed(variant="llvm_ad_rgb"),
        changed(vary={}), changed(temporal_filter="tent"), changed(time_axis=axis),
        changed(scene={"builtin": "cornell_box", "resolution": 9}),
    ]  # fmt: skip
    assert len({base, *(one.key() for one in others)}) == len(others) + 1


XML = """<scene version="3.0.0">
  <default name="albedo" value="0.5"/>
  <integrator type="transient_path"/>
  <sensor type="perspective"><film type="transient_hdr_film"><integer name="width" value="4"/>
    <integer name="height" value="4"/><integer name="temporal_bins" value="8"/><float name="bin_width_opl" value="1"/>
    <float name="start_opl" value="0"/></film></sensor>
  <shape type="obj" id="thing"><string name="filename" value="thing.obj"/>
    <bsdf type="diffuse"><spectrum name="reflectance" value="$albedo"/></bsdf></shape>
  <emitter type="point" id="lamp"><point name="position" x="0" y="0" z="0"/></emitter>
</scene>"""
OBJ = "v -1 -1 3\nv 1 -1 3\nv 0 1 3\nf 1 3 2\n"


def write(folder, mesh=OBJ):
    folder.mkdir()
    (folder / "scene.xml").write_text(XML)
    (folder / "thing.obj").write_text(mesh)
    (folder / "recipe.yaml").write_text(
        "scene: scene.xml\nvariant: llvm_ad_mono\nspp: 2\nvary:\n  $albedo: {uniform: [0.1, 0.9]}\n"
        "  thing.to_world: {offset: [[0, 0, 0], [0, 0, 1]]}\n"
    )
    return D.Recipe.read(folder / "recipe.yaml")


@pytest.mark.slow
def test_xml_scenes_their_files_and_places(tmp_path):
    recipe = write(tmp_path / "a")
    assert recipe.exchanged == ["$albedo"]
    sample = recipe.sample(0)
    assert 0.1 <= float(sample.values["$albedo"]) <= 0.9 and sample.arrays["transient"].sum() > 0
    # The same elsewhere; another where a file that it names has changed.
    shutil.copytree(tmp_path / "a", tmp_path / "moved")
    assert D.Recipe.read(tmp_path / "moved" / "recipe.yaml").key() == recipe.key()
    assert write(tmp_path / "b", OBJ.replace("0 1 3", "0 2 3")).key() != recipe.key()
    recipe.to_yaml(tmp_path / "whole.yaml")
    again = D.Recipe.read(tmp_path / "whole.yaml")
    assert np.array_equal(again.sample(0).arrays["transient"], sample.arrays["transient"])
    (tmp_path / "a" / "scene.xml").write_text(XML.replace("0.5", "0.6"))
    with pytest.raises(SceneError, match="has changed"):
        D.Recipe.read(tmp_path / "whole.yaml")


DEFAULT = '<default name="mesh" value="other.obj"/>'


def changes(recipe_of, file):
    """Whether the key follows what is in a file."""
    before = recipe_of().key()
    kept = file.read_text()
    file.write_text(kept.replace("0 1 3", "0 2 3"))
    after = recipe_of().key()
    file.write_text(kept)
    assert recipe_of().key() == before
    return before != after


@pytest.mark.slow
def test_keys_follow_files_wherever_they_are_named(tmp_path, monkeypatch):
    folder = tmp_path / "a"
    write(folder)
    (folder / "other.obj").write_text(OBJ)
    (folder / "inner.xml").write_text(
        '<scene version="3.0.0"><shape type="obj"><string name="filename" value="other.obj"/></shape></scene>'
    )
    texts = {
        "single quotes": XML.replace('"thing.obj"', "'other.obj'"),
        "default": XML.replace('"thing.obj"', '"$mesh"').replace("<default", f"{DEFAULT}<default", 1),
        "include": XML.replace("</scene>", '<include filename="inner.xml"/></scene>'),
    }
    for name, text in texts.items():
        (folder / "scene.xml").write_text(text)
        assert changes(lambda: D.Recipe.read(folder / "recipe.yaml"), folder / "other.obj"), name
    (folder / "scene.xml").write_text(XML.replace('"thing.obj"', '"$mesh"'))
    choice = "parameters: {mesh: thing.obj}\nvary: {$mesh: {choice: [thing.obj, other.obj]}}\n"
    for entries in ("parameters: {mesh: other.obj}\n", choice):
        (folder / "other.yaml").write_text("scene: scene.xml\nvariant: llvm_ad_mono\n" + entries)
        assert changes(lambda: D.Recipe.read(folder / "other.yaml"), folder / "other.obj"), entries
    (folder / "dict.yaml").write_text(
        "variant: llvm_ad_mono\nscene: {type: scene, thing: {type: obj, filename: thing.obj}}\n"
        "vary: {thing.filename: {choice: [thing.obj, other.obj]}}\n"
    )
    assert changes(lambda: D.Recipe.read(folder / "dict.yaml"), folder / "other.obj")
    # Names are those beside the recipe, not in the folder that it is read from.
    key = D.Recipe.read(folder / "dict.yaml").key()
    monkeypatch.chdir(folder)
    assert D.Recipe.read(folder / "dict.yaml").key() == key


def test_captures_are_the_same_elsewhere(tmp_path):
    folder = tmp_path / "a"
    folder.mkdir()
    (folder / "letter.obj").write_text(OBJ)
    (folder / "recipe.yaml").write_text(CAPTURE.replace("shape: rectangle", "file: letter.obj"))
    recipe = D.Recipe.read(folder / "recipe.yaml")
    assert recipe.scan.kind == "confocal"
    shutil.copytree(folder, tmp_path / "b")
    assert D.Recipe.read(tmp_path / "b" / "recipe.yaml").key() == recipe.key()
    assert changes(lambda: D.Recipe.read(folder / "recipe.yaml"), folder / "letter.obj")
    recipe.to_yaml(tmp_path / "again.yaml")
    again = D.Recipe.read(tmp_path / "again.yaml")
    assert again == recipe and again.key() == recipe.key()


@pytest.mark.parametrize(
    "text, error, words",
    [
        ("scene: {builtin: cornell_box}\ngates: 3\n", SceneError, "not what it should be"),
        ("scene: {builtin: cornell_box}\nlabels: 3\n", SceneError, "not what it should be"),
        ("scene: {one_of: 3}\nspp: 3\n", SceneError, "not what it should be"),
        ("scene: {builtin: cornell_box}\nfrequencies: {a: 3}\n", SceneError, "not what it should be"),
        ("scene: {a: 3}\nspp: 3\n", SceneError, "'type', 'builtin'"),
        ("scene: {type: scene, xml: {type: sphere}}\nvary: {xml.type: {uniform: [0, .inf]}}\n", UnitError, "finite"),
        ("sceen: a\nvary: {}\n", SceneError, "Did you mean 'scene'"),
        ("vary: {}\nspp: 3\n", SceneError, "'scene', or 'hidden'"),
        ("scene: {builtin: cornel_box}\nspp: 3\n", SceneError, "cornell_box"),
        ("scene: {builtin: cornell_box, resolutoin: 3}\nspp: 3\n", SceneError, "resolutoin"),
        ("scene: {builtin: cornell_box}\nvary: {a: {unifrm: [0, 1]}}\n", SceneError, "unknown distribution 'unifrm'"),
        ("scene: {builtin: cornell_box}\nspp: 0\n", SceneError, "spp"),
        ("scene: {builtin: cornell_box}\nformat: torchtransient recipe 7\n", SceneError, "recipe 1"),
        ("scene: [\n", StorageError, "YAML"),
        ("scene: {builtin: cornell_box}\ntime_axis: {start_opl: 1}\n", SceneError, "bin_width_opl"),
    ],
)  # fmt: skip
def test_what_is_wrong_with_a_file(text, error, words):
    with pytest.raises(error, match=words):
        D.Recipe.read(text)
