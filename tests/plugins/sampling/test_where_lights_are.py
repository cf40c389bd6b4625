"""Lights that are hardly ever drawn, boxes around lights, the sphere that distant light leaves, a sun that moves."""

from __future__ import annotations

import types

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from torchtransient import plugins
from torchtransient.errors import SceneError
from torchtransient.plugins import mitsuba_compat as compat
from torchtransient.plugins.sampling.lights import (
    DistantReference,
    LightBox,
    MovingSun,
    distant_reference,
    is_rare,
    least_probability,
)

VARIANT = "llvm_ad_rgb"


@pytest.fixture(autouse=True)
def rgb():
    mi.set_variant(VARIANT)
    plugins.sync()


def scene_of(**parts):
    return mi.load_dict({"type": "scene", **parts}, optimize=False)


def point(weight=1.0, position=(0.0, 0.0, 0.0)):
    return {"type": "point", "position": list(position), "sampling_weight": weight}


@pytest.mark.parametrize(("weight", "rare"), [(0.0, True), (1.33e-3, True), (1.34e-3, False), (3.0, False)])
def test_lights_with_less_than_a_thousandth_of_their_share(weight, rare):
    """Of three lights, beside weights of 1 and 3: 4/3 of a thousandth, and a little."""
    scene = scene_of(a=point(1.0), b=point(3.0), c=point(weight))
    lights = {emitter.id(): emitter for emitter in scene.emitters()}
    assert is_rare(scene, lights["c"]) == rare and not is_rare(scene, lights["a"])
    assert least_probability(4) == pytest.approx(2.5e-4)


def test_the_nearest_place_where_a_light_could_be():
    lamp = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([1, 2, 3]).scale([0.5, 0.25, 1]),
            "emitter": {"type": "area"}}  # fmt: skip
    scene = scene_of(lamp=lamp, bulb=point(position=(-1.0, 2.0, 5.0)))
    box = LightBox.from_scene(scene, [shape.bsdf() for shape in scene.shapes()])
    # From (-1, 1.75, 3) to (1.5, 2.25, 5).
    places = np.array([[0.0, 2, 4], [1.5, 2.25, 5], [4.5, 2, 9], [-3, 1.75, 1], [0, -0.25, 4], [2.5, 4.25, 7]])
    found = np.array(box.distance(mi.Point3f(places.T)))
    np.testing.assert_allclose(found, np.array([0, 0, 5, np.sqrt(8), 2, 3]) * (1 - 1e-5), rtol=2e-7)


@pytest.mark.parametrize("more", [
    {"sky": {"type": "constant"}}, {"sun": {"type": "directional", "direction": [0, 0, 1]}},
    {"glass": {"type": "sphere", "bsdf": {"type": "dielectric"}}},
    {"beam": {"type": "laser_beam"}},
], ids=lambda more: next(iter(more)))  # fmt: skip
def test_no_box_where_light_comes_from_anywhere_or_sooner(more):
    def box(**parts):
        scene = scene_of(**parts)
        return LightBox.from_scene(scene, [shape.bsdf() for shape in scene.shapes()])

    assert box(bulb=point(), ball={"type": "sphere"}) is not None
    assert box(bulb=point(), ball={"type": "sphere"}, **more) is None
    assert box(ball={"type": "sphere"}) is None


def test_the_plane_that_distant_light_leaves():
    """At its own distance from the middle, towards the light; behind it light is on its way for longer."""
    reference = DistantReference((1.0, 2.0, 3.0), 5.0)
    points = mi.Point3f([1.0, 1, 1], [2, 2, 2.0], [3.0, 8, -2])
    found = np.array(reference.length(points, mi.Vector3f(0, 0, 1)))
    np.testing.assert_allclose(found, [5, 0, 10])
    found = np.array(reference.length(mi.Point3f(4, 6, 3), mi.Vector3f(0.6, 0.8, 0)))
    np.testing.assert_allclose(found, 0, atol=1e-6)
    scene = scene_of(a={"type": "sphere", "center": [1, 0, 0], "radius": 2}, b={"type": "sphere", "center": [5, 0, 0]})
    around = distant_reference(scene)
    # A box from (-1, -2, -2) to (6, 2, 2).
    assert around.center == (2.5, 0, 0) and around.radius == pytest.approx(np.sqrt(3.5**2 + 8), rel=1e-6)
    nothing = distant_reference(scene_of(bulb=point()))
    assert (nothing.center, nothing.radius) == ((0, 0, 0), 0)


# -------------------------------------------------------------------------------------------------------------- a sun


def sunny(aperture=20.0, **more):
    turned = mi.ScalarTransform4f().rotate([1, 0, 0], 30)
    sky = {"type": "sunsky", "sun_direction": [0.0, 0.6, 0.8], "sun_aperture": aperture, "to_world": turned}
    return scene_of(sky=sky, ball={"type": "sphere"}, **more)


def towards(angle):
    """A direction at an angle (degrees) from the sun."""
    about_x = np.array(mi.ScalarTransform4f().rotate([1, 0, 0], angle).matrix)[:3, :3]
    return mi.Vector3f(*(about_x @ [0.0, 0.6, 0.8]).tolist())


def test_directions_into_the_sun():
    """Up to the rim of its disk of 20 degrees, and a thousandth of that more."""
    scene = sunny()
    sun = MovingSun(scene, scene.emitters()[0])
    np.testing.assert_allclose(np.array(sun.direction).ravel(), np.array(towards(0.0)).ravel(), atol=1e-6)
    inside = [bool(sun.contains(towards(angle))[0]) for angle in (0, 9.99, -9.99, 10.005, 10.02, -10.02, 170)]
    assert inside == [True, True, True, True, False, False, False] and not sun.rare
    assert MovingSun.from_context(types.SimpleNamespace(scene=scene, wanted=None)) is None
    assert MovingSun.from_context(types.SimpleNamespace(scene=scene, wanted=types.SimpleNamespace(sky=None))) is None


def test_the_light_that_is_the_suns():
    scene = sunny(lamp=point(), other={"type": "directional", "direction": [0, 0, 1]})
    emitters = {emitter.class_name(): emitter for emitter in scene.emitters()}
    sun = MovingSun(scene, emitters["SunskyEmitter"])
    for name, emitter in emitters.items():
        shines = [bool(sun.shines(mi.EmitterPtr(emitter), towards(angle))[0]) for angle in (1.0, 30.0)]
        assert shines == [name == "SunskyEmitter", False]


def test_directions_turn_with_the_sun():
    """About the axis that it moves around: all in its plane at its own rate, those along the axis not at all."""
    scene = sunny()
    params, x = mi.traverse(scene), mi.Float(0)
    dr.enable_grad(x)
    dr.set_grad(x, 1)
    params["sky.sun_direction"] = mi.Vector3f(0, 0.6 * dr.cos(x) - 0.8 * dr.sin(x), 0.8 * dr.cos(x) + 0.6 * dr.sin(x))
    params.update()
    sun = MovingSun(scene, scene.emitters()[0])
    d = mi.Vector3f([0.0, 0, 1], [1.0, 0, 0], [0.0, 1, 0])
    followed = sun.attach_direction(d, mi.Mask([True, True, True]))
    np.testing.assert_array_equal(np.array(dr.detach(followed)), np.array(d))
    found = np.array(dr.forward_to(followed))
    np.testing.assert_allclose(found, [[0, 0, 0], [0, -1, 0], [1, 0, 0]], atol=1e-5)
    still = sun.attach_direction(d, mi.Mask([False, True, True]))
    assert dr.all(dr.detach(still) == d, axis=None)


def test_the_angle_of_a_sun_that_is_not_described():
    bulb = mi.load_dict(point())
    with pytest.raises(SceneError, match="PointLight: expected 'Sun aperture' in its description, got PointLight"):
        compat.sun_half_angle(bulb)
