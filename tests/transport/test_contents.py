"""What a scene contains is looked up once: one that changes after a render renders like one that has changed before."""

from __future__ import annotations

import gc
import weakref

import mitsuba as mi
import numpy as np
import pytest

from support.gradient_cases.scenes import instances, room

VARIANT = "llvm_ad_mono"


@pytest.fixture
def scene():
    return mi.load_dict(room(depth=3), optimize=False)


def rendered(scene, sensor=0, integrator=None):
    return np.array((integrator or scene.integrator()).render(scene, sensor=sensor, seed=3, spp=64)[1])


def assert_change_is_seen(make, change):
    """Of a scene that has been rendered before."""
    scene, expected = make(), make()
    before = rendered(scene)
    change(scene)
    change(expected)
    found = rendered(scene)
    assert np.abs(found - before).max() > 0.01 * before.max()
    np.testing.assert_allclose(found, rendered(expected), rtol=1e-5, atol=1e-6 * before.max())


def test_sensors_take_turns():
    """Each sees what it sees alone."""
    description = room(depth=3)
    description["second"] = description["sensor"] | {"fov": 4.0}
    scene = mi.load_dict(description, optimize=False)
    turns = [rendered(scene, sensor) for sensor in (0, 1, 0, 1)]
    assert np.abs(turns[0] - turns[1]).max() > 0.01 * turns[0].max()
    for sensor, found in zip((0, 1, 0, 1), turns, strict=True):
        np.testing.assert_allclose(found, rendered(mi.load_dict(description, optimize=False), sensor), rtol=1e-5)


def test_another_bsdf_is_seen():
    def change(scene):
        wall = next(shape for shape in scene.shapes() if shape.id() == "wall")
        wall.set_bsdf(mi.load_dict({"type": "conductor"}))

    assert_change_is_seen(lambda: mi.load_dict(room(depth=3), optimize=False), change)


def test_keeps_no_scene_alive():
    """The scene owns the integrator: one that kept the scene would never be freed."""
    scene = mi.load_dict(room(depth=3), optimize=False)
    rendered(scene)
    scene.integrator().parameters(scene)
    integrator = weakref.ref(scene.integrator())
    gc.disable()
    try:
        del scene
        assert integrator() is None
    finally:
        gc.enable()


def around(bsdf, wrapper):
    masked = {"type": "mask", "opacity": 0.5, "nested": bsdf}
    twosided = {"type": "twosided", "nested": bsdf}
    description = instances(masked) if wrapper == "mask in a group" else room(bsdf=twosided, depth=3)
    return mi.load_dict(description, optimize=False)


@pytest.mark.parametrize("wrapper", ["mask in a group", "twosided"])
def test_a_lobe_that_joins_is_seen_wherever_it_is(wrapper):
    """Light that it lets pass runs slower."""

    def change(scene):
        params = mi.traverse(scene)
        params[next(key for key in params.properties if key.endswith("spec_trans.value"))] = mi.Float(0.9)
        params.update()

    assert_change_is_seen(lambda: around({"type": "principled", "eta": 1.4}, wrapper), change)
