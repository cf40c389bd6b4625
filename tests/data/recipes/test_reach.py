"""The shortest way of light over what moves, in boxes, and whether the time axis holds it."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch

import torchtransient as tt
from torchtransient.data.recipes.distribution import NUMBERS, POSE, Place
from torchtransient.data.recipes.reach import _between, _transformed, check_reach
from torchtransient.errors import SceneError
from torchtransient.scenes.transforms import rotate, scale, translate

AT = Place("ball.to_world", POSE, (4, 4), translate([0.0, 0.0, 1.0]))


def bounds(low, high, valid=True):
    return SimpleNamespace(min=np.array(low, float), max=np.array(high, float), valid=lambda: valid)


def shape(name, low, high):
    return SimpleNamespace(id=lambda: name, bbox=lambda: bounds(low, high))


def scene(emitters=(), eyes=((0.0, 0.0, -4.0),), unwarp=False, sensor_shape=None):
    ball = shape("ball", [-1, -1, 0], [1, 1, 2])
    sensors = [
        SimpleNamespace(
            id=lambda n=n: f"sensor_{n}",
            get_shape=lambda: sensor_shape,
            world_transform=lambda at=at: SimpleNamespace(matrix=translate(list(at))),
        )
        for n, at in enumerate(eyes)
    ]
    return SimpleNamespace(
        scene=SimpleNamespace(
            shapes=lambda: [ball, SimpleNamespace(id=lambda: "none", bbox=lambda: bounds([0] * 3, [0] * 3, False))],
            emitters=lambda: list(emitters),
            sensors=lambda: sensors,
            integrator=lambda: SimpleNamespace(camera_unwarp=unwarp),
        )
    )


def point(name, place, valid=True):
    return SimpleNamespace(id=lambda: name, get_shape=lambda: None, bbox=lambda: bounds(place, place, valid))


def kept(end=20.0, places=(AT,), pulsed=False, scan=None):
    axis = None if end is None else tt.TimeAxis(0.0, end, 1)
    return SimpleNamespace(
        renderer=SimpleNamespace(axis=axis, _pulsed=pulsed), places={place.key: place for place in places}, scan=scan
    )


def leaves(built, of, drawn):
    """The shortest way that is said where the window is too short, None where it is not."""
    try:
        check_reach(built, of, [("of sample 3", drawn)])
    except SceneError as error:
        words = str(error)
        assert "of sample 3 leaves the window" in words
        return float(words.split(" is ")[1].split(" m,")[0])
    return None


LAMP = point("lamp", [0.0, 3.0, 1.0])
MOVED = {"ball.to_world": translate([0.0, 0.0, 11.0])}
# From the lamp to the nearest point of the ball, (0, 1, 10), and from there to the eye: (0, 0, 10).
WAY = np.hypot(2.0, 9.0) + 14.0


def test_the_shortest_way_from_a_light_to_an_eye():
    """Between boxes, one of a million numbers beside it."""
    assert leaves(scene([LAMP]), kept(WAY * (1 + 1e-6)), MOVED) is None
    assert leaves(scene([LAMP]), kept(WAY * (1 - 1e-6)), MOVED) == pytest.approx(WAY, rel=1e-3)
    # As far as the axis goes, exactly.
    eye, lamp = scene([point("lamp", [0, 0, -1])], [(0, 0, -4)]), {"ball.to_world": translate([0, 0, 11.0])}
    assert leaves(eye, kept(25.0), lamp) is None
    assert leaves(eye, kept(np.nextafter(25.0, 0)), lamp) == 25


def test_the_nearest_of_several_lights_and_eyes():
    far = point("far", [90.0, 0.0, 0.0])
    assert leaves(scene([far, LAMP], [(50, 0, 0), (0, 0, -4)]), kept(10.0), MOVED) == pytest.approx(WAY, rel=1e-3)


def test_lights_and_eyes_that_move():
    drawn = MOVED | {"lamp.position": np.array([0.0, 1.0, 6.0]), "sensor_0.to_world": translate([0.0, 0.0, 8.0])}
    assert leaves(scene([LAMP]), kept(5.0), drawn) == pytest.approx(4 + 2)
    drawn = MOVED | {"lamp.to_world": translate([0.0, 1.0, 6.0])}
    assert leaves(scene([LAMP]), kept(5.0), drawn) == pytest.approx(4 + 14)


def test_a_light_that_is_the_thing_itself():
    glowing = SimpleNamespace(id=lambda: "glow", get_shape=lambda: shape("ball", [-1, -1, 0], [1, 1, 2]))
    assert leaves(scene([glowing]), kept(5.0), MOVED) == pytest.approx(14)
    other = SimpleNamespace(id=lambda: "glow", get_shape=lambda: shape("panel", [-1, -1, 15], [1, 1, 15]))
    assert leaves(scene([other]), kept(5.0), MOVED) == pytest.approx(3 + 14)
    seen = scene([LAMP], sensor_shape=shape("wall", [-9, -9, -1], [9, 9, -1]))
    assert leaves(seen, kept(5.0), MOVED) == pytest.approx(np.hypot(2.0, 9.0) + 11, rel=1e-3)


def test_lengths_that_are_counted_to_the_first_thing_seen():
    assert leaves(scene([LAMP], unwarp=True), kept(5.0), MOVED) == pytest.approx(np.hypot(2.0, 9.0), rel=1e-3)


def test_vertices_that_move():
    vertices = np.array([[0.0, 1, 10], [1, 1, 12], [0, -1, 11]])
    place = Place("ball.vertex_positions", NUMBERS, (3, 3), vertices)
    drawn = {"ball.vertex_positions": vertices.ravel()}
    assert leaves(scene([LAMP]), kept(5.0, [place]), drawn) == pytest.approx(WAY, rel=1e-3)


def test_scans_light_and_see_points():
    """Of which an optimiser may have made tensors with a gradient."""
    lit = torch.tensor([[[0.0, 3, 1], [5.0, 5, 1]]], requires_grad=True)
    seen = torch.tensor([[[0.0, 0, -4], [0.0, 0, -9]]], requires_grad=True)
    of = kept(5.0, scan=SimpleNamespace(laser_points=lit, sensor_points=seen))
    assert leaves(scene(), of, MOVED) == pytest.approx(WAY, rel=1e-3)


def test_what_is_not_looked_at():
    sky = point("sky", [0.0, 0.0, 0.0], valid=False)
    other = Place("ball.bsdf.reflectance.value", NUMBERS, (3,), np.zeros(3))
    stranger = Place("cube.to_world", POSE, (4, 4), np.eye(4))
    new = Place("ball.to_world", POSE, (4, 4), None)
    for built, of in (
        (scene([LAMP]), kept(None)),
        (scene([LAMP]), kept(1.0, [])),
        (scene([LAMP]), kept(1.0, pulsed=True)),
        (scene([LAMP, sky]), kept(1.0)),
        (scene([LAMP]), kept(1.0, [other])),
        (scene([LAMP]), kept(1.0, [stranger])),
        (scene([LAMP]), kept(1.0, [new])),
    ):
        drawn = MOVED | {"cube.to_world": MOVED["ball.to_world"], "ball.bsdf.reflectance.value": np.ones(3)}
        assert leaves(built, of, drawn) is None


def _moved(box, *by):
    return box + np.array(by)


def test_boxes():
    box = np.array([[0.0, 1, 2], [1.0, 3, 5]])
    assert _between(box, _moved(box, 0.5, 1, 1)) == 0
    assert _between(box, _moved(box, 2, 0, 0)) == _between(_moved(box, 2, 0, 0), box) == 1
    assert _between(box, _moved(box, 4, 6, 3)) == 5
    turned = _transformed(box, translate([10.0, 0, 0]) @ rotate([0, 0, 1], 90) @ scale(2.0))
    np.testing.assert_allclose(turned, [[10 - 6, 0, 4], [10 - 2, 2, 10]], atol=1e-12)
