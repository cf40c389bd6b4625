"""Where a scan looks and where its laser falls, by geometry."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from support.nlos_scenes import captures, film, plane, scan_scene, transform
from support.plain_scenes import camera
from torchtransient.errors import SceneError
from torchtransient.interfaces import CaptureType
from torchtransient.plugins.around_corner import scan_table

VARIANT = "llvm_ad_mono"


def test_a_grid_around_the_laser_s_axis():
    """Of a horizontal field of view, column by column to the right and row by row down, as a camera looks."""
    laser = {"exhaustive_scan": True, "laser_scan_width": 5, "laser_scan_height": 3}
    scene = mi.load_dict(scan_scene({"a": plane()}, "exhaustive", film(bins=2) | laser))
    sensor = scene.sensors()[0]
    aims = np.array(scan_table.aims_of(scene, sensor, CaptureType.EXHAUSTIVE, 40.0), dtype=np.float64)
    assert aims.shape == (3, 15)
    to_world = np.array(scene.emitters()[0].world_transform().matrix, dtype=np.float64).reshape(4, 4)[:3, :3]
    local = np.linalg.inv(to_world) @ aims
    np.testing.assert_allclose(local[2], 1, rtol=1e-5)
    half = np.tan(np.radians(20))
    across = -half * np.array([-0.8, -0.4, 0.0, 0.4, 0.8])
    down = -half * 3 / 5 * np.array([-2 / 3, 0.0, 2 / 3])
    np.testing.assert_allclose(local[0].reshape(3, 5), np.tile(across, (3, 1)), rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(local[1].reshape(3, 5), np.tile(down[:, None], (1, 5)), rtol=1e-4, atol=1e-6)
    for fov in (0.0, 180.0, -5.0):
        with pytest.raises(SceneError, match=f"between 0 and 180 degrees, got {fov}"):
            scan_table.aims_of(scene, sensor, CaptureType.EXHAUSTIVE, fov)


def test_one_direction_or_those_of_scanned_points():
    scene = mi.load_dict(scan_scene({"a": plane()}, "confocal"))
    sensor = scene.sensors()[0]
    single = np.array(scan_table.aims_of(scene, sensor, CaptureType.SINGLE, None)).ravel()
    np.testing.assert_allclose(single / np.linalg.norm(single), np.array([0.3, 0.1, -0.25]) / 0.4031129, rtol=1e-4)
    aims = np.array(scan_table.aims_of(scene, sensor, CaptureType.CONFOCAL, None))
    points = np.array(scan_table.scanned_points(scene, sensor))
    np.testing.assert_allclose(aims, points - np.array([[-0.5], [0.0], [0.25]]), rtol=1e-5, atol=1e-6)


def test_points_that_a_camera_sees():
    """At the centres of its pixels; a metre along the axis where a pixel sees nothing."""
    wall = {"type": "rectangle", "to_world": transform().translate([0.6, 0, 0])}
    scene = mi.load_dict({"type": "scene", "sensor": camera(3, 2, bins=2, fov=50.0), "wall": wall})
    sensor = scene.sensors()[0]
    ray = scan_table.scan_rays(sensor)
    o, d = np.array(ray.o, dtype=np.float64), np.array(ray.d, dtype=np.float64)
    half = np.tan(np.radians(25))
    across = d[:2] / -d[2]
    # A camera that looks along -z with y up has +x to its right.
    np.testing.assert_allclose(across[0], np.tile(half * np.array([-2 / 3, 0, 2 / 3]), 2), rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(across[1], np.repeat(half * np.array([1 / 3, -1 / 3]), 3), rtol=1e-4, atol=1e-6)
    points = np.array(scan_table.scanned_points(scene, sensor), dtype=np.float64)
    at_wall = o - d * o[2] / d[2]
    seen = (np.abs(at_wall[0] - 0.6) < 1) & (np.abs(at_wall[1]) < 1)
    assert 0 < seen.sum() < 6
    np.testing.assert_allclose(points, np.where(seen, at_wall, o + d), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(("kind", "count"), [("single", 2), ("exhaustive", 7)])
def test_captures_with_another_number_of_spots(kind, count):
    """One of a single capture, as many as the film has laser positions of an exhaustive one."""
    scene = scan_scene({"a": plane()}, kind, film(2, bins=2, kind=kind))
    scene["wall"]["sensor"]["laser_points"] = mi.TensorXf(np.float32([[0.1 * k, 0.1, 0] for k in range(count)]))
    with pytest.raises(SceneError, match=f"got {count}|laser {count} points"):
        captures(scene, 1, 1)
