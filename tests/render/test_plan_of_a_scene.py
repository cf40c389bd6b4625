"""A plan speaks of one scene: for another one it is refused, for the same one it works however that was loaded."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest

import torchtransient as tt
from torchtransient.errors import SceneError
from torchtransient.testing.small_room import make_room

VARIANT = "llvm_ad_rgb"
XML = """<scene version="3.0.0"><default name="fov" value="20"/>
    <integrator type="transient_path"/>
    <sensor type="perspective"><float name="fov" value="$fov"/><film type="transient_hdr_film">
        <integer name="width" value="2"/><integer name="height" value="2"/>
        <integer name="temporal_bins" value="4"/><float name="bin_width_opl" value="4"/></film></sensor>
    <shape type="rectangle"/><emitter type="point"/></scene>"""


def planned(scene):
    return tt.plan(scene, pilot=False, time_axis="scene")


def brighter(room):
    room["light"]["intensity"] = 11.0


def moved(room):
    room["box"]["to_world"] = np.array(room["box"]["to_world"]) + np.eye(4)[:, ::-1] * 1e-3


def without_box(room):
    del room["box"]


def other_film(room):
    room["sensor"]["film"]["temporal_bins"] = 25


@pytest.mark.parametrize("change", [brighter, moved, without_box, other_film])
def test_a_plan_of_another_scene(change):
    plan, room = planned(make_room()), make_room()
    change(room)
    for scene in (room, tt.load(room), tt.load(room, variant="llvm_ad_mono")):
        with pytest.raises(SceneError, match=r"another scene.*tt\.plan"):
            tt.TransientRenderer(scene, effects=plan)
    with pytest.raises(SceneError, match="another scene"):
        tt.render(room, effects=plan, seed=0)


@pytest.mark.parametrize(
    "same",
    [
        make_room,
        lambda: tt.load(make_room()),
        lambda: tt.load(make_room(), variant="llvm_ad_mono"),
        lambda: copy.deepcopy(tt.load(make_room())),
        lambda: pickle.loads(pickle.dumps(tt.load(make_room(), variant=VARIANT))),
    ],
    ids=["dictionary", "loaded", "other variant", "copy", "pickle"],
)
def test_the_same_scene_loaded_again(same):
    plan = planned(make_room())
    for each in (plan, pickle.loads(pickle.dumps(plan)), copy.deepcopy(plan)):
        renderer = tt.TransientRenderer(same(), effects=each)
        assert renderer.scene.variant == plan.variant == VARIANT
        assert renderer.axis == plan.time_axis


def test_a_dictionary_does_not_depend_on_the_folder(tmp_path, monkeypatch):
    """Unless it names files, which are looked up where it was loaded."""
    plain, textured = make_room(), make_room()
    textured["wall"]["bsdf"] = {"type": "diffuse", "reflectance": {"type": "bitmap", "filename": "wall.png"}}
    first = [tt.load(plain), tt.load(textured)]
    monkeypatch.chdir(tmp_path)
    assert tt.load(plain).same_description(first[0])
    assert not tt.load(textured).same_description(first[1])


def test_files_and_their_parameters(tmp_path):
    path = tmp_path / "scene.xml"
    path.write_text(XML, encoding="utf-8")
    plan = planned(tt.load(path, fov=30))
    assert tt.TransientRenderer(tt.load(str(path), fov=30), effects=plan).axis == plan.time_axis
    for other in (tt.load(path), tt.load(path, fov=31), make_room()):
        with pytest.raises(SceneError, match="another scene"):
            tt.TransientRenderer(other, effects=plan)
    path.write_text(XML.replace("point", "constant"), encoding="utf-8")
    with pytest.raises(SceneError, match="another scene"):
        tt.TransientRenderer(path, effects=plan)
    # what the plan was made for is still there
    assert plan.renderer(spp=1)(seed=0).steady.shape == (1, 2, 2)
