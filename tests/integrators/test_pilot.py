"""A list of the arrivals of a few paths, before anything is summed up."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.nlos_scenes import plane, scan_scene
from support.plain_scenes import camera, load
from torchtransient.errors import SceneError, VariantError
from torchtransient.plugins.integrators.pilot import pilot_events

VARIANT = "llvm_ad_rgb"
WALL = {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.2, 0.5, 0.9]}}}


def lit_wall(intensity=3.0, **arguments):
    """A wall that fills the view, lit by a point: one arrival a path, of two bounces' length."""
    lamp = {"type": "point", "intensity": intensity, "position": [0, 0, 2.0]}
    return load(camera(6, 4, bins=3, fov=10.0), {"wall": WALL, "lamp": lamp}, **arguments)


def events_of(scene, **changes):
    return pilot_events(scene, scene.integrator(), 0, **({"seed": 1, "pixels": 8, "paths": 200} | changes))


def test_arrivals_of_a_lit_wall():
    scene = lit_wall()
    events = events_of(scene)
    # 3 x 2 pixels of 33 samples.
    assert (events.size, events.paths) == ((3, 2), 6 * 33)
    assert sorted(events.path) == list(range(198))
    np.testing.assert_array_equal(events.pixel, events.path // 33)
    assert set(events.depth) == {2}
    # From the camera 4 m away to the wall, and on to the lamp 2 m off, a little aside.
    assert events.opl.min() > 6 and events.opl.max() < 6.15
    image = np.array(scene.integrator().render(scene, seed=4, spp=256)[0], dtype=np.float64)
    assert events.energy.sum() == pytest.approx(image.mean(), rel=0.01)
    assert events.energy.min() > 0
    again, other = events_of(scene), events_of(scene, seed=2)
    np.testing.assert_array_equal(again.opl, events.opl)
    assert not np.array_equal(other.opl, events.opl)


def test_a_pilot_of_a_scene_whose_sensor_is_attached():
    """It asks for no derivatives, and leaves none behind."""
    expected, scene = events_of(lit_wall()), lit_wall()
    params, x = mi.traverse(scene), mi.Float(0)
    dr.enable_grad(x)
    pose = params["sensor.to_world"]
    shift = mi.Transform4f().translate(mi.Vector3f(x, 0, 0))
    params["sensor.to_world"] = mi.AffineTransform4f(pose.matrix @ shift.matrix)
    params.update()
    found = events_of(scene)
    np.testing.assert_allclose(found.opl, expected.opl, rtol=1e-6)
    np.testing.assert_allclose(found.energy, expected.energy, rtol=1e-5)


def test_light_of_one_number_of_bounces_stays_alone():
    mi.set_variant("llvm_ad_mono")
    scene = mi.load_dict(scan_scene({"a": plane()}, "single", filter_bounces=3))
    events = events_of(scene, pixels=1000)
    assert set(events.depth) == {3} and events.size == (4, 4)


def test_scans_of_pairs_need_laser_sampling():
    mi.set_variant("llvm_ad_mono")
    laser = {"type": "spot"}
    scene = mi.load_dict(scan_scene({"a": plane()}, "exhaustive", laser=laser, nlos_laser_sampling=False))
    with pytest.raises(SceneError, match="exhaustive captures need nlos_laser_sampling"):
        scene.integrator().render(scene, spp=1)


def test_polarization_is_not_asked_about():
    mi.set_variant("llvm_ad_mono_polarized")
    scene = lit_wall()
    with pytest.raises(VariantError, match="load the scene in 'llvm_ad_mono'"):
        events_of(scene)
