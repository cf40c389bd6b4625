"""A plan speaks of one scene: for another one it is refused, for the same one it works however that was loaded."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest
import torch

import torchtransient as tt
from tools.small_room import WALL_POSE, make_room
from torchtransient.errors import GradientError, SceneError
from torchtransient.gates import gates_to_text

VARIANT = "llvm_ad_rgb"
XML = """<scene version="3.0.0"><default name="fov" value="20"/>
    <integrator type="transient_path"/>
    <sensor type="perspective"><float name="fov" value="$fov"/><film type="transient_hdr_film">
        <integer name="width" value="2"/><integer name="height" value="2"/>
        <integer name="temporal_bins" value="4"/><float name="bin_width_opl" value="4"/></film></sensor>
    <shape type="rectangle"/><emitter type="point"/></scene>"""


def planned(scene):
    return tt.plan(scene, pilot=False, time_axis="scene")


def moved(room):
    room["box"]["to_world"] = np.array(room["box"]["to_world"]) + np.eye(4)[:, ::-1] * 1e-3


def without_box(room):
    del room["box"]


def other_film(room):
    room["sensor"]["film"]["temporal_bins"] = 25


@pytest.mark.parametrize("change", [moved, without_box, other_film])
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
        lambda: pickle.loads(pickle.dumps(tt.load(make_room(), variant=VARIANT))),
    ],
    ids=["dictionary", "loaded", "other variant", "pickle"],
)
def test_the_same_scene_loaded_again(same):
    plan = planned(make_room())
    for each in (plan, pickle.loads(pickle.dumps(plan)), copy.deepcopy(plan)):
        renderer = tt.TransientRenderer(same(), effects=each)
        assert renderer.scene.variant == plan.variant == VARIANT
        assert renderer.axis == plan.time_axis


# ------------------------------------------------------------------------------------- the sensor of a plan


def seen_twice():
    """The room, and as its second sensor the same one from further away with another window."""
    room = make_room()
    far = copy.deepcopy(room["sensor"])
    far["film"] |= {"start_opl": 1.0, "temporal_bins": 12}
    return room | {"far": far}


def test_a_renderer_takes_the_sensor_of_its_plan():
    scene = tt.load(seen_twice(), variant=VARIANT)
    plan = tt.plan(scene, sensor=1, pilot=False, time_axis="scene")
    for renderer in (
        tt.TransientRenderer(scene, effects=plan, spp=1),
        tt.TransientRenderer(scene, effects=plan, spp=1, sensors=1),
        plan.renderer(spp=1),
    ):
        expected = tt.render(scene, sensors=1, spp=1, seed=0, max_depth=plan.max_depth)
        assert torch.equal(renderer(seed=0).transient, expected.transient) and renderer.axis.num_bins == 12
    assert plan.renderer(spp=1, sensors=[1])(seed=0).transient.shape[0] == 1
    assert plan.to_dict()["sensor"] == 1


# ------------------------------------------------------------------- choices that a caller makes for a plan are kept

GATES = {
    "rectangular gate": [tt.Gate.gaussian(8.0, 0.5), tt.Gate.rectangular(7.0, 9.0)],
    "tabulated gate": [tt.Gate.tabulated([7.0, 9.0], [1.0, 1.0])],
}


def test_a_box_that_was_asked_for_stays_one():
    """An explicit box of the renderer stays one too: no tent replaces it in silence."""
    own = tt.plan(make_room(), pilot=False, time_axis="scene")
    assert own.renderer(parameters=[WALL_POSE]).effective_filter == "tent"
    asked = tt.plan(make_room(), pilot=False, time_axis="scene", temporal_filter="box")
    for plan in (asked, pickle.loads(pickle.dumps(asked))):
        renderer = plan.renderer(parameters=[WALL_POSE], spp=1)
        assert renderer.effective_filter == "box"
        with pytest.raises(GradientError, match="'box' has no slope"):
            renderer(seed=0)
        assert plan.renderer(parameters=[WALL_POSE], temporal_filter="tent").effective_filter == "tent"
        assert plan.renderer(gates=GATES["rectangular gate"]).gates is not None


@pytest.mark.parametrize(("kind", "of_scene"), [("rectangular gate", True), ("tabulated gate", False)])
def test_gates_without_a_slope_are_refused_at_once(kind, of_scene):
    room, gates = make_room(), GATES[kind]
    settings = {"pilot": False, "gates": None if of_scene else gates}
    if of_scene:
        room["sensor"]["film"] = {"type": "gated_hdr_film", "width": 4, "height": 3, "gates": gates_to_text(gates)}
    message = rf"{WALL_POSE}.*'{kind}' has no slope.*rise from zero"
    with pytest.raises(GradientError, match=message):
        tt.plan(room, "gates", parameters=[WALL_POSE], **settings)
    renderer = tt.plan(room, "gates", **settings).renderer(parameters=[WALL_POSE], spp=1)
    assert not renderer.has_slope_for([WALL_POSE]) and renderer.has_slope_for([])
    with pytest.raises(GradientError, match=message):
        renderer(seed=0)
    with torch.no_grad():
        assert renderer(seed=0).gated.shape[1] == len(gates)
    pulse = tt.Pulse.gaussian(0.2)
    pulsed = tt.plan(room, "gates", parameters=[WALL_POSE], pulse=pulse, **settings).renderer(spp=1)
    assert pulsed.has_slope_for([WALL_POSE])


# ----------------------------------------------------------------------------------------------------- descriptions


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
