"""A list of the arrivals of a few paths, before anything is summed up."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.nlos_scenes import film, plane, scan_scene
from support.plain_scenes import camera, load
from torchtransient.errors import SceneError, VariantError
from torchtransient.plugins.integrators import pilot
from torchtransient.plugins.integrators.job import Pass, seed_array
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


@pytest.mark.slow
def test_a_pilot_from_within_glass_that_is_attached():
    """Lengths there are times its index, of which nobody asks for a derivative."""
    ball = {"type": "sphere", "center": [0, 0, 4.0], "radius": 0.5, "bsdf": {"type": "dielectric", "int_ior": 1.5}}
    lamp = {"type": "point", "intensity": 3.0, "position": [0, 0, 2.0]}
    scenes = [load(camera(6, 4, bins=3, fov=10.0), {"wall": WALL, "lamp": lamp, "ball": ball}) for _ in range(2)]
    params = mi.traverse(scenes[1])
    dr.enable_grad(params["ball.bsdf.eta"])
    params.update()
    expected, found = map(events_of, scenes)
    assert len(found.opl) and found.opl.tolist() == expected.opl.tolist()
    assert found.energy.tolist() == expected.energy.tolist()


def test_at_least_one_sample_a_pixel():
    events = events_of(lit_wall(), paths=1, pixels=1000)
    assert (events.size, events.paths) == ((6, 4), 24)


@pytest.mark.slow
def test_more_events_than_there_was_room_for(monkeypatch):
    """None is lost; where memory is short there are fewer paths."""
    inside = {"type": "sphere", "radius": 9.0, "flip_normals": True, "bsdf": {"type": "diffuse", "reflectance": 0.9}}
    scene = load(camera(2, 2, bins=3), {"room": inside | {"emitter": {"type": "area", "radiance": 1.0}}})
    expected = events_of(scene)
    assert expected.depth.max() > 8
    monkeypatch.setattr(pilot, "_EVENTS_PER_PATH", 3)
    found = events_of(scene)
    assert found.paths == expected.paths
    order, other = np.lexsort((found.depth, found.path)), np.lexsort((expected.depth, expected.path))
    np.testing.assert_array_equal(found.depth[order], expected.depth[other])
    monkeypatch.setattr(pilot, "_MAX_EVENTS", 3 * 40)
    assert events_of(scene).paths < 40


def test_light_of_one_number_of_bounces_stays_alone():
    mi.set_variant("llvm_ad_mono")
    scene = mi.load_dict(scan_scene({"a": plane()}, "single", filter_bounces=3))
    events = events_of(scene, pixels=1000)
    assert set(events.depth) == {3} and events.size == (4, 4)


def started(kind, size, spp):
    """(primary rays of a pilot's film of ``size`` before a scan of 7 x 5 points, those of the whole film)."""
    laser = {"exhaustive_scan": True, "laser_scan_width": 7, "laser_scan_height": 5} if kind == "exhaustive" else {}
    settings = film(kind="confocal", bins=2, width=7.0) | {"width": 7, "height": 5} | laser
    scene = mi.load_dict(scan_scene({"a": plane()}, kind, settings))
    integrator = scene.integrator()
    with dr.suspend_grad():
        sensor, whole = integrator.resolve(scene, 0)
        contents = integrator.contents(scene, sensor)
        found = []
        for small, (width, height), samples in ((pilot._PilotFilm(whole, size), size, spp), (whole, (7, 5), 1)):
            job = Pass(0, 0, height, samples, samples * width * height, seed_array(3))
            found.append(integrator.start(scene, contents, sensor, small, job))
        dr.eval(found[0].leg, found[1].leg)
    return found


def test_pixels_of_a_small_film_stand_for_the_middle_of_what_they_cover():
    """The point that is looked at, and the spot that follows it."""
    mi.set_variant("llvm_ad_mono")
    small, whole = started("confocal", (3, 2), 2)
    pixels = [row * 7 + column for row in (1, 3) for column in (1, 3, 5)]
    assert list(np.array(small.spot)) == list(np.repeat(pixels, 2))
    assert list(np.array(whole.spot)) == list(range(35))
    np.testing.assert_array_equal(np.array(small.leg.t), np.array(whole.leg.t)[np.array(small.spot)])
    assert len(set(np.array(small.leg.t))) == 3  # two rows as far above the sensor as below it
    assert set(np.array(started("single", (3, 2), 2)[0].spot)) == {0}


def test_pilots_of_exhaustive_scans_draw_one_laser_position_a_path():
    mi.set_variant("llvm_ad_mono")
    small, whole = started("exhaustive", (3, 2), 700)
    counts = np.bincount(np.array(small.spot), minlength=35)
    assert counts.shape == (35,) and counts.sum() == 4200
    assert abs(counts - 120).max() < 5 * 120**0.5  # uniform, five standard deviations
    assert list(np.array(whole.spot)[:36]) == [*range(35), 0]


def test_how_many_bounces_are_asked_for():
    """The smallest and the largest number: where lights are sampled, their own way is a segment more."""
    mi.set_variant("llvm_ad_mono")

    def asked(**settings):
        return mi.load_dict(scan_scene({"a": plane()}, "single", **settings)).integrator().asked_bounces()

    lights = {"nlos_laser_sampling": False}
    assert asked(max_depth=5) == asked(max_depth=6, **lights) == (0, 5)
    assert asked(max_depth=-1, min_bounces=2) == asked(max_depth=-1, min_bounces=2, **lights) == (2, None)
    assert asked(max_depth=7, filter_bounces=3) == asked(max_depth=7, filter_bounces=3, **lights) == (3, 3)
    assert asked(max_depth=7, filter_depth=4, **lights) == (3, 3)
    assert asked(max_depth=7, discard_direct_paths=True) == (2, 7)
    assert asked(max_depth=7, discard_direct_paths=True, min_bounces=4) == (4, 7)


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
