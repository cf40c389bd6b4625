"""What a scene contains is looked up once a scene and does not change afterwards."""

from __future__ import annotations

import gc
import weakref

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.gradient_cases.scenes import instances, room
from torchtransient.plugins.node_walk import shapes_of_scene
from torchtransient.plugins.transport.context import Wanted
from torchtransient.plugins.transport.scene_contents import SceneContents

VARIANT = "llvm_ad_mono"


@pytest.fixture
def scene():
    return mi.load_dict(room(depth=3), optimize=False)


def contents_of(scene):
    return scene.integrator().contents(scene, scene.sensors()[0])


def test_does_not_change(scene):
    contents = contents_of(scene)
    with pytest.raises(AttributeError, match="does not change once built"):
        contents.delta = True
    with pytest.raises(AttributeError, match="does not change once built"):
        contents.something = 1


def test_a_world_does_not_change(scene):
    world = scene.integrator().render_context(scene, contents_of(scene))
    with pytest.raises(AttributeError, match="does not change once built"):
        world.max_depth = 3


@pytest.mark.parametrize("names", [("emitter_found", ""), ("emitter_found", "emitter_found"), ("walk", "other")])
def test_strategies_need_names_of_their_own(scene, monkeypatch, names):
    integrator = scene.integrator()
    segment, scattering, connections = integrator.strategies(contents_of(scene))
    for connection, name in zip(connections, names, strict=True):
        connection.name = name
    monkeypatch.setattr(type(integrator), "strategies", lambda *_: (segment, scattering, connections))
    with pytest.raises(ValueError, match="expected a name of its own for each"):
        integrator.render_context(scene, contents_of(scene))


@pytest.mark.slow
def test_built_once_a_scene(scene, monkeypatch):
    """Renders, backward and forward passes, in several launches and for several seeds, share one look-up."""
    built = []

    class Counted(SceneContents):
        def __init__(self, *args):
            built.append(args)
            super().__init__(*args)

    monkeypatch.setattr("torchtransient.plugins.transport.scene_contents.SceneContents", Counted)
    monkeypatch.setattr("torchtransient.plugins.integrators.job.MAX_LANES", 8)
    integrator, params = scene.integrator(), mi.traverse(scene)
    shape = scene.sensors()[0].film().cube_shape()
    for seed in range(2):
        integrator.render(scene, seed=seed, spp=4)
        key = "side.bsdf.reflectance.value"
        value = type(params[key])(params[key])
        dr.enable_grad(value)
        params[key] = value
        params.update()
        integrator.render_backward(scene, params, (None, dr.ones(mi.TensorXf, shape)), seed=seed, spp=4)
        dr.set_grad(params[key], 1.0)
        integrator.render_forward(scene, params, seed=seed, spp=4)
    assert len(built) == 1


def test_sensors_take_turns():
    """Views that are rendered in turn, as by a renderer with several sensors, keep what was looked up for each."""
    description = room(depth=3)
    description["second"] = description["sensor"]
    scene = mi.load_dict(description, optimize=False)
    integrator, (first, second) = scene.integrator(), scene.sensors()
    found = [integrator.contents(scene, sensor) for sensor in (first, second, first, second)]
    assert found[0] is found[2] and found[1] is found[3]


def test_another_bsdf_is_seen():
    scene = mi.load_dict(room(depth=3), optimize=False)
    assert contents_of(scene).delta is False
    wall = next(shape for shape in scene.shapes() if shape.id() == "wall")
    wall.set_bsdf(mi.load_dict({"type": "conductor"}))
    assert contents_of(scene).delta is True


def test_of_another_scene_is_looked_up_anew():
    first, second = (mi.load_dict(room(bsdf=bsdf, depth=3), optimize=False) for bsdf in (None, {"type": "conductor"}))
    integrator = mi.load_dict({"type": "transient_path", "max_depth": 3})
    for scene, delta in ((first, False), (second, True), (first, False)):
        assert integrator.contents(scene, scene.sensors()[0]).delta is delta


def test_keeps_no_scene_alive():
    """The scene owns the integrator: one that kept the scene would never be freed."""
    scene = mi.load_dict(room(depth=3), optimize=False)
    contents_of(scene)
    scene.integrator().parameters(scene)
    integrator = weakref.ref(scene.integrator())
    gc.disable()
    try:
        del scene
        assert integrator() is None
    finally:
        gc.enable()


def test_wanted_follows_what_parameters_move(scene):
    contents, sensor = contents_of(scene), scene.sensors()[0]
    params = mi.traverse(scene)

    def wanted(*keys):
        for key in keys:
            dr.enable_grad(params[key])
            params.set_dirty(key)
        params.update()
        found = Wanted(scene.integrator().parameters(scene).attached(), sensor, contents)
        for key in keys:
            dr.disable_grad(params[key])
        params.update()
        return found

    colour = wanted("side.bsdf.reflectance.value")
    assert colour.carried == ("β",) and not colour.geometry
    pose = wanted("wall.to_world")
    assert pose.geometry and pose.slides_position_only and not pose.ray and pose.carried == ("β", "slope", "w", "o")
    camera = wanted("sensor.to_world")
    assert camera.sensor and camera.ray and not camera.slides_position_only
    assert set(camera.carried) == {"β", "slope", "w", "o", "d"}
    light = wanted("light.position")
    assert light.light and light.geometry and not light.emitter_shape


def around(bsdf, wrapper):
    wrapped = {
        "group": bsdf,
        "mask in a group": {"type": "mask", "opacity": 0.5, "nested": bsdf},
        "mask": {"type": "mask", "opacity": 0.5, "nested": bsdf},
        "twosided": {"type": "twosided", "nested": bsdf},
        "bump map": {"type": "bumpmap", "heights": {"type": "uniform", "value": 0.5}, "nested": bsdf},
    }[wrapper]
    description = instances(wrapped) if "group" in wrapper else room(bsdf=wrapped, depth=3)
    return mi.load_dict(description, optimize=False)


@pytest.mark.parametrize("wrapper", ["group", "mask in a group", "mask", "twosided", "bump map"])
def test_a_lobe_that_joins_is_seen_wherever_it_is(wrapper):
    scene = around({"type": "principled", "eta": 1.4}, wrapper)
    assert contents_of(scene).refraction is None
    params = mi.traverse(scene)
    key = next(key for key in params.properties if key.endswith("spec_trans.value"))
    params[key] = mi.Float(0.9)
    params.update()
    table = contents_of(scene).refraction.read().table
    assert {round(float(index), 5) for index in np.unique(np.array(table))} >= {1.4}


def test_another_bsdf_in_a_group_is_seen():
    scene = around({"type": "diffuse"}, "group")
    assert contents_of(scene).delta is False and len(contents_of(scene).bsdfs) == 2
    plate = next(shape for shape in shapes_of_scene(scene) if shape.id() == "plate")
    plate.set_bsdf(mi.load_dict({"type": "conductor"}))
    assert contents_of(scene).delta is True
