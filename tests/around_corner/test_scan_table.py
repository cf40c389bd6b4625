"""Where a scan looks and where its laser falls, by geometry; and which light is found how, in words."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.nlos_scenes import film, plane, scan_scene, transform
from support.plain_scenes import camera
from torchtransient.errors import SceneError, TorchTransientWarning
from torchtransient.interfaces import CaptureType
from torchtransient.plugins.around_corner import scan_table
from torchtransient.plugins.around_corner.division import Division, explanation
from torchtransient.plugins.transport.strategy import Local

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


def test_one_direction_or_those_of_scanned_points(monkeypatch):
    scene = mi.load_dict(scan_scene({"a": plane()}, "confocal"))
    sensor = scene.sensors()[0]
    single = np.array(scan_table.aims_of(scene, sensor, CaptureType.SINGLE, None)).ravel()
    np.testing.assert_allclose(single / np.linalg.norm(single), np.array([0.3, 0.1, -0.25]) / 0.4031129, rtol=1e-4)
    aims = np.array(scan_table.aims_of(scene, sensor, CaptureType.CONFOCAL, None))
    points = np.array(scan_table.scanned_points(scene, sensor))
    np.testing.assert_allclose(aims, points - np.array([[-0.5], [0.0], [0.25]]), rtol=1e-5, atol=1e-6)
    # A pixel that the laser is said to look at is for captures that do not light the scanned points.
    monkeypatch.setattr(type(sensor), "spots", lambda self: mi.Point3f(9, 8, 7))
    again = np.array(scan_table.aims_of(scene, sensor, CaptureType.CONFOCAL, None))
    np.testing.assert_array_equal(again, aims)
    single = np.array(scan_table.aims_of(scene, sensor, CaptureType.SINGLE, None)).ravel()
    np.testing.assert_allclose(single, [9.5, 8, 6.75], rtol=1e-5)


def test_the_laser_is_aimed_once():
    sensor = Local(laser_points="given")
    with pytest.raises(SceneError, match="a confocal capture lights its scanned points"):
        scan_table._check_aimed_once(sensor, CaptureType.CONFOCAL, None)
    with pytest.raises(SceneError, match="both say where the laser points"):
        scan_table._check_aimed_once(sensor, CaptureType.EXHAUSTIVE, 20.0)
    scan_table._check_aimed_once(sensor, CaptureType.EXHAUSTIVE, None)
    scan_table._check_aimed_once(Local(laser_points=None), CaptureType.CONFOCAL, None)
    scan_table._check_aimed_once(Local(), CaptureType.EXHAUSTIVE, 179.0)


def test_as_many_aims_as_a_capture_asks_for():
    grid = Local(laser_scan_width=2, laser_scan_height=3, laser_count=lambda: 6)
    sensor = Local(film=lambda: grid)
    right = [(CaptureType.SINGLE, 1), (CaptureType.EXHAUSTIVE, 6), (CaptureType.CONFOCAL, 1), (CaptureType.CONFOCAL, 7)]
    for capture, count in right:
        scan_table.check_count(mi.Vector3f(mi.Float([1.0] * count), 0, 0), sensor, capture)
    seven = mi.Vector3f(mi.Float([1.0] * 7), 0, 0)
    with pytest.raises(SceneError, match="one laser spot, got 7"):
        scan_table.check_count(seven, sensor, CaptureType.SINGLE)
    with pytest.raises(SceneError, match=r"2 x 3 laser positions, and the laser 7 points"):
        scan_table.check_count(seven, sensor, CaptureType.EXHAUSTIVE)


def test_a_scan_has_one_laser():
    lasers = [Local(id=lambda name=name: name) for name in ("a", "b")]
    assert scan_table.laser_of(Local(emitters=lambda: lasers[:1])) is lasers[0]
    for emitters, told in ((lasers, r"got 2 \('a', 'b'\)"), ([], r"got 0 \(none\)")):
        with pytest.raises(SceneError, match=told):
            scan_table.laser_of(Local(emitters=lambda emitters=emitters: emitters))


def test_rays_that_meet_nothing():
    scan_table._check_hit(np.array([1.0, 2.0]), "laser")
    with pytest.warns(TorchTransientWarning, match="2 of the laser's 3 rays meet nothing"):
        scan_table._check_hit(np.array([1.0, np.inf, np.inf]), "laser")
    with pytest.raises(SceneError, match="sensor meets nothing in the scene with any of its 2 rays"):
        scan_table._check_hit(np.array([np.inf, np.inf]), "sensor")
    scan_table._check_not_at(mi.Float([0.1, 2.0]), "laser", "to_world")
    with pytest.raises(SceneError, match="the laser stands in a point that it aims at; move it by its to_world"):
        scan_table._check_not_at(mi.Float([0.0, 2.0]), "laser", "to_world")


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


def test_walls_that_lie_in_one_plane():
    """Points that span flat shapes; of curved ones there are none."""
    pose = transform().translate([0.3, 0.2, 0.5]).rotate([1, 2, 0.5], 40).scale([2, 3, 1])
    disk, sheet = (mi.load_dict({"type": kind, "to_world": pose}) for kind in ("disk", "rectangle"))
    matrix = np.array(pose.matrix)
    expected = np.stack([matrix[:3, 3], matrix[:3, 3] + matrix[:3, 0], matrix[:3, 3] + matrix[:3, 1]])
    np.testing.assert_allclose(scan_table._corners(disk), expected, rtol=1e-5, atol=1e-6)
    assert scan_table._corners(mi.load_dict({"type": "sphere"})) is None
    assert scan_table._in_one_plane([disk, sheet]) and not scan_table._in_one_plane([])
    tilted = mi.load_dict({"type": "rectangle", "to_world": transform().translate([0.3, 0.2, 0.5])})
    assert not scan_table._in_one_plane([disk, tilted])
    assert not scan_table._in_one_plane([disk, mi.load_dict({"type": "sphere"})])


def table_of(kind="single", **arguments):
    scene = mi.load_dict(scan_scene({"a": plane()}, kind, **arguments))
    integrator = scene.integrator()
    return integrator.scan_table(scene, integrator.contents(scene, scene.sensors()[0]))


def test_points_that_stand_for_a_scan():
    """Five in a row at most, with the normals on the side that is looked at."""
    turned = {"type": "rectangle", "to_world": transform().rotate([0, 1, 0], 180).scale([0.5, 0.5, 1]),
              "bsdf": {"type": "twosided", "nested": {"type": "diffuse"}}}  # fmt: skip
    for wall, flip in ((None, 1), (turned, -1)):
        points, normals = table_of(film=film(bins=2) | {"width": 7, "height": 2}, wall=wall).reference_points()
        columns, rows = (np.array([0, 2, 3, 4, 6]) + 0.5) / 7 - 0.5, (np.arange(2) + 0.5) / 2 - 0.5
        expected = np.stack([np.tile(columns * flip, 2), np.repeat(rows, 5), np.zeros(10)], 1)
        np.testing.assert_allclose(points, expected, atol=1e-6)
        np.testing.assert_allclose(normals, np.tile([0, 0, 1], (10, 1)), atol=1e-6)


def test_scans_that_meet_nothing(monkeypatch):
    """Have no points that stand for them, and say so; where some meet something these do, and nothing is said."""
    told = []
    monkeypatch.setattr(scan_table, "_check_hit", lambda t, what: told.append((len(t), what)))
    table = table_of(film=film(bins=2) | {"width": 7, "height": 2})
    assert len(table.reference_points()[0]) == 10 and told == [(1, "laser")]
    told.clear()
    table.hits.t = mi.Float([1.0] * 2 + [dr.inf] * 12)
    assert len(table.reference_points()[0]) == 1 and told == []
    table.hits.t = dr.full(mi.Float, dr.inf, 14)
    assert len(table.reference_points()[0]) == 0 and told == [(10, "sensor")]


def test_the_spot_of_a_beam():
    """What the wall scatters of its energy, or of one joule; the way from the laser where it counts."""
    table = table_of(laser={"type": "laser_beam", "energy": 2.5})
    spots = table.spots
    way = np.array([-0.2, 0.1, 0.0]) - [-0.5, 0.0, 0.25]
    length = np.linalg.norm(way)
    assert spots.length[0] == pytest.approx(length, rel=1e-5)
    np.testing.assert_allclose(np.array(spots.origin).ravel(), [-0.5, 0, 0.25], atol=1e-6)
    assert np.array(spots.lit_interactions().wi)[2, 0] == pytest.approx(0.25 / length, rel=1e-5)
    for legs in (False, True):
        for energy in (False, True):
            points = spots.points(legs, energy=energy)
            np.testing.assert_allclose(np.array(points.p).ravel(), [-0.2, 0.1, 0], atol=1e-6)
            assert points.value[0][0] == pytest.approx(0.9 / np.pi * (2.5 if energy else 1), rel=1e-5)
            assert points.leg[0] == pytest.approx(length if legs else 0, rel=1e-5)
    assert spots.energy([], mi.UInt32(0), mi.Float([0.5, 0]), True)[0].numpy().tolist() == [5, 0]
    assert len(spots.arrays()) == 10


def test_spots_that_are_more_than_points():
    """Of walls that are not diffuse, or not flat."""
    assert table_of().lambertian_spots(True).leg[0] > 0 and table_of().lambertian_spots(False).leg[0] == 0
    plate = {"type": "rectangle", "to_world": transform().scale([0.5, 0.5, 1])}
    assert table_of(wall=plate | {"bsdf": {"type": "roughconductor"}}).lambertian_spots(True) is None
    ball = {"type": "sphere", "center": [0, 0, 2.0], "radius": 2.05, "flip_normals": True}
    points = mi.TensorXf(np.float32([[[0.1, 0.1, -0.045]]]))
    scene = scan_scene({"a": plane()}, "single", film(1, bins=2), wall=ball)
    scene["wall"]["sensor"]["points"] = points
    scene = mi.load_dict(scene)
    table = scene.integrator().scan_table(scene, scene.integrator().contents(scene, scene.sensors()[0]))
    assert table.wall is None and table.lambertian_spots(True) is None


def test_overlaps_are_looked_for_once(monkeypatch):
    """As long as elements that are kept are the same; with the wall, which is another table, once more."""
    calls = []
    monkeypatch.setattr(scan_table, "overlaps", lambda *given: calls.append(given[1]) or ["a"])
    scene = mi.load_dict(scan_scene({"a": plane()}))
    integrator = scene.integrator()
    first, second = (integrator.scan_table(scene, integrator.contents(scene, scene.sensors()[0])) for _ in range(2))
    assert first.overlaps(False) == second.overlaps(False) == ["a"] and len(calls) == 1
    assert {shape.id() for shape in calls[0].shapes} == {"a"}
    second.overlaps(True)
    first.overlaps(True)
    assert len(calls) == 2 and {shape.id() for shape in calls[1].shapes} == {"a", "wall"}
    first.elements(first.wall).key = b""
    first.overlaps(False)
    first.overlaps(False)
    assert len(calls) == 4


def test_planes_of_walls_are_those_to_rounding(monkeypatch):
    """A millionth of their extent and no more."""
    for height, flat in ((0.0, True), (4e-7, True), (1e-5, False)):
        sheets = [mi.load_dict({"type": "rectangle", "to_world": transform().translate([x, 0, z])})
                  for x, z in ((-1, 0.0), (1, height))]  # fmt: skip
        assert scan_table._in_one_plane(sheets) is flat
    # So much itself is flat.
    monkeypatch.setattr(scan_table, "FLAT", 0.0)
    assert scan_table._in_one_plane([mi.load_dict({"type": "rectangle"})])
    monkeypatch.undo()
    # Of their largest coordinate, where that is larger.
    for x, flat in ((1000, True), (-1000, True), (0, False)):
        sheets = [mi.load_dict({"type": "rectangle", "to_world": transform().translate([x + dx, 0, z])})
                  for dx, z in ((-1, 0.0), (1, 3e-4))]  # fmt: skip
        assert scan_table._in_one_plane(sheets) is flat


THIRD, CHAINS = "three bounces from hidden samples", "4 to 7 bounces from chains"


@pytest.mark.parametrize(("asked", "shared", "words"), [
    ((0, None), range(3, 8), [THIRD, CHAINS, "8 and more bounces from paths"]),
    ((0, None), range(3, 4), [THIRD, "4 and more bounces from paths"]),
    ((0, 9), range(3, 8), [THIRD, CHAINS, "8 to 9 bounces from paths"]),
    ((0, 8), range(3, 8), [THIRD, CHAINS, "8 bounces from paths"]),
    ((0, 7), range(3, 8), [THIRD, CHAINS]),
    ((0, 3), range(3, 4), [THIRD, "no later light"]),
    ((3, 3), range(0), ["three bounces from paths, since reasons", "no later light"]),
    ((0, 4), range(0), ["three bounces from paths, since reasons", "4 bounces from paths"]),
    ((4, 5), range(4, 6), ["three bounces is not asked for", "4 to 5 bounces from chains"]),
    ((5, 6), range(0), ["three bounces is not asked for", "5 to 6 bounces from paths"]),
    ((0, 2), range(0), ["three bounces is not asked for", "no later light"]),
])  # fmt: skip
def test_which_light_is_found_how(asked, shared, words):
    division = Division(shared, 0, "reasons")
    integrator = Local(division=lambda *_: division, asked_bounces=lambda: asked, third_bounce="auto")
    said = explanation(integrator, None, None).split("; ")
    assert len(said) == len(words)
    assert all(word in one for word, one in zip(words, said, strict=True)), said
    integrator.third_bounce = "paths"
    asks = "as third_bounce asks for" in explanation(integrator, None, None)
    assert asks == ("since reasons" in words[0])


@pytest.mark.parametrize(("shared", "first", "last", "lights_itself", "longest"), [
    (range(3, 8), 0, 8, False, 8), (range(3, 8), 0, 7, False, 0), (range(3, 8), 0, 7, True, 2),
    (range(3, 8), 3, 7, True, 0), (range(4, 8), 0, 7, False, 3), (range(5, 8), 4, 6, True, 4),
    (range(5, 8), 5, 6, True, 0), (range(3, 4), 0, 4, True, 4),
])  # fmt: skip
def test_what_is_left_for_paths(shared, first, last, lights_itself, longest):
    """What comes before the shared light: two bounces only where a wall lights itself; or all of it, up to the last."""
    division = Division.of(shared, first, last, lights_itself)
    assert (division.longest, division.walks, division.third_bounce) == (longest, longest > 0, 3 in shared)
    assert division.chained == range(max(shared.start, 4), max(shared.stop, 4))


@pytest.mark.parametrize("key", ["laser.to_world", "wall.to_world"])
def test_what_of_spots_is_attached(key):
    """What the table says, and no other field of the interaction: lanes tell those."""
    scene = mi.load_dict(scan_scene({"a": plane()}, "single"))
    params = mi.traverse(scene)
    dr.enable_grad(params[key])
    params.update()
    integrator = scene.integrator()
    spots = integrator.scan_table(scene, integrator.contents(scene, scene.sensors()[0])).spots
    assert dr.grad_enabled(spots.si.p) and dr.grad_enabled(spots.length)
    assert not any(dr.grad_enabled(getattr(spots.si, name)) for name in ("t", "wi", "dn_du", "dn_dv"))
    assert [dr.grad_enabled(each) for each in (spots.ray.d, spots.si.n)] == [key[0] == "l", key[0] == "w"]
