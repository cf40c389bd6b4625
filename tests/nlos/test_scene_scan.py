"""Where rays of a scan end, in numbers of one's own: beside the wall, off their points, before it."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import torchtransient as tt
from support.scalars import no_gradient_is_lost
from torchtransient.errors import SceneError, TorchTransientWarning
from torchtransient.nlos import scene_scan
from torchtransient.nlos.scene_scan import Ends

VARIANT = "llvm_ad_mono"
UP = np.array([0.0, 0.0, 1.0])


def looking(targets, origin=(0.5, 0.25, 2.0), met=None, normal=UP):
    """Rays from one place to points of the plane z = 0; ``met``: which of them meet it."""
    targets, origin = np.asarray(targets, float), np.asarray(origin, float)
    ways = targets - origin
    met = np.ones(len(targets), bool) if met is None else np.asarray(met)
    points = np.where(met[:, None], targets, 0.0)
    normals = np.where(met[:, None], np.broadcast_to(normal, targets.shape), 0.0)
    return Ends(
        points, normals, ["wall" if there else "" for there in met], np.broadcast_to(origin, targets.shape).copy(),
        ways / np.linalg.norm(ways, axis=1, keepdims=True),
    )  # fmt: skip


GRID = np.array([[x, y, 0.0] for y in (0.0, 1.0, 2.0) for x in (0.0, 1.0, 2.0, 3.0)])


def test_rays_past_the_wall_end_where_it_would_go_on():
    met = np.ones(12, bool)
    met[[3, 7, 10]] = False
    ends = looking(GRID, met=met)
    # The pixel beside the last one of the first row stands on a plane of its own, turned towards x.
    ends.normals[2] = np.array([-0.6, 0.0, 0.8])
    with pytest.warns(TorchTransientWarning, match="3 of the sensor's 12 rays look past the wall"):
        found, there = scene_scan._on_extended_wall(ends, (3, 4))
    assert there.tolist() == [k for k in range(12) if met[k]]
    np.testing.assert_allclose(found.points[met], GRID[met])
    # Number 10 is next to 9, 11 and 6, all of them on the plane z = 0.
    np.testing.assert_allclose(found.points[10], GRID[10], atol=1e-12)
    np.testing.assert_allclose(found.normals[10], UP)
    # Numbers 3 is next to 2: on the plane through (2, 0, 0) across (-0.6, 0, 0.8). Seven is next to 6 and to 11.
    origin, way = ends.origins[3], ends.directions[3]
    distance = ((ends.points[2] - origin) @ ends.normals[2]) / (way @ ends.normals[2])
    np.testing.assert_allclose(found.points[3], origin + distance * way, atol=1e-12)
    np.testing.assert_allclose(found.normals[3], ends.normals[2])
    np.testing.assert_allclose(found.points[7], GRID[7], atol=1e-12)
    assert found.points[3][2] != 0.0 and found.shapes == ends.shapes


def test_rays_past_a_wall_that_is_higher_than_wide():
    tall = np.array([[x, y, 0.0] for y in range(6) for x in range(2)], dtype=float)
    ends = looking(tall, met=[k != 11 for k in range(12)])
    ends.points[9] = [1.0, 4.0, 0.5]
    with pytest.warns(TorchTransientWarning, match="1 of the sensor's 12 rays"):
        found, _ = scene_scan._on_extended_wall(ends, (6, 2))
    # Number 9 is the pixel before it in its column, number 10 the one beside it, which comes later.
    assert found.points[11][2] == pytest.approx(0.5)


@pytest.mark.parametrize("target, words", [
    # Upwards, along the plane, and towards the back of what the neighbour is on.
    ((3.0, 0.0, 5.0), "1 of them not even"), ((3.0, 0.25, 2.0), "1 of them not even"),
])  # fmt: skip
def test_rays_that_would_never_meet_the_wall(target, words):
    targets = GRID.copy()
    targets[3] = target
    ends = looking(targets, met=[k != 3 for k in range(12)])
    with pytest.raises(SceneError, match=f"1 of the sensor's 12 rays meet nothing in the scene, {words}"):
        scene_scan._on_extended_wall(ends, (3, 4))


def test_rays_that_meet_nothing_at_all_and_everything():
    with pytest.raises(SceneError, match="meets nothing in the scene with any of its 12 rays"):
        scene_scan._on_extended_wall(looking(GRID, met=[False] * 12), (3, 4))
    ends = looking(GRID)
    found, there = scene_scan._on_extended_wall(ends, (3, 4))
    assert found is ends and there.tolist() == list(range(12))


def test_beams_meet_something():
    scene_scan._check_all_meet(looking(GRID))
    ends = looking(GRID, met=[k not in (4, 9) for k in range(12)])
    with pytest.raises(SceneError, match=r"2 of the laser's 12 beams meet nothing .* number 4, from \[0\.5  0\.25 2\."):
        scene_scan._check_all_meet(ends)


@pytest.mark.parametrize("who, what", [("sensor", "sensor points"), ("laser", "laser spots")])
@pytest.mark.parametrize("origin, size", [((1.5, 2.0, 1.0), 5.0), ((0.0, 0.0, 8.0), np.sqrt(89.0))])
def test_rays_end_at_their_points_to_a_thousandth(who, what, origin, size):
    # The extent of the scan, or the longest way to it.
    points = np.array([[0.0, 0, 0], [3.0, 0, 0], [3.0, 4.0, 0]])
    ends = looking(points, origin=origin)
    for share, taken in ((0.99, True), (1.01, False)):
        moved = points + np.array([[0, 0, 0], [0, share * 1e-3 * size, 0], [0, 0, 0]])
        if taken:
            scene_scan._check_same(ends, moved, points, who)
            continue
        with pytest.raises(SceneError, match=f"1 of 3 {what} are not what the {who} .* number 1, .* meets 'wall'"):
            scene_scan._check_same(ends, moved, points, who)
    ends = looking(points, origin=origin, met=[True, True, False])
    with pytest.raises(SceneError, match=f"1 of 3 {what} .* number 2, .* meets nothing. Move {who}_origin"):
        scene_scan._check_same(ends, np.where([[True], [True], [False]], points, 0.0), points, who)


def test_some_rays_of_many():
    ends = looking(GRID, met=[k != 5 for k in range(12)])
    some = ends.of(np.array([5, 2]))
    assert some.shapes == ["", "wall"] and some.missed().tolist() == [0] and ends.missed().tolist() == [5]
    np.testing.assert_allclose(some.points[1], GRID[2])
    np.testing.assert_allclose(some.directions, ends.directions[[5, 2]])


def boxed(low, high, area=1.0, name="thing"):
    def surface_area():
        if area is None:
            raise RuntimeError("not known")
        return area

    return SimpleNamespace(
        bbox=lambda: SimpleNamespace(min=low, max=high), id=lambda: name, surface_area=surface_area,
        class_name=lambda: "Thing",
    )  # fmt: skip


@pytest.mark.parametrize("low, high, before", [
    ((0, 0, 1.0), (1, 1, 2.0), True), ((0, 0, -2.0), (1, 1, -1.0), False), ((0, 0, -2.0), (1, 1, 1e-9), True),
    ((0, 0, -2.0), (1, 1, 0.0), False),
])  # fmt: skip
def test_things_reach_before_the_wall(low, high, before):
    normals = np.broadcast_to(UP, GRID.shape)
    assert scene_scan.reaches_before([boxed(low, high)], GRID, normals) is before
    # Behind one and before another; turned, and the other way round.
    behind = boxed((0, 0, -9.0), (1, 1, -8.0))
    assert scene_scan.reaches_before([behind, boxed(low, high)], GRID, normals) is before
    assert scene_scan.reaches_before([behind], GRID, -normals)
    # A point of the wall that turns to the side counts as much as the first one.
    aside = np.array(normals)
    aside[7] = [1.0, 0, 0]
    assert scene_scan.reaches_before([boxed((3.5, 0, -2.0), (4.0, 1, -1.0))], GRID, aside)
    assert not scene_scan.reaches_before([], GRID, normals)


def test_things_have_areas():
    box = ((0, 0, 1), (1, 1, 2))
    scene_scan._check_areas([boxed(*box, area=0.0, name="a"), boxed(*box, area=2.0, name="b")])
    scene_scan._check_areas([boxed(*box, area=0.0), boxed(*box, area=None)])
    with pytest.raises(SceneError, match=r"finite area, got 'a' \(2 m\^2\), 'b' \(inf m\^2\)"):
        scene_scan._check_areas([boxed(*box, area=2.0, name="a"), boxed(*box, area=np.inf, name="b")])
    with pytest.raises(SceneError, match=r"an area that light falls on, got 'a' \(0 m\^2\), 'b' \(0 m\^2\)"):
        scene_scan._check_areas([boxed(*box, area=0.0, name="a"), boxed(*box, area=0.0, name="b")])


def test_tolerances_of_a_scan():
    points = torch.tensor([[0.0, 0, 0], [3.0, 4.0, 0]], dtype=torch.float64)
    near = tt.nlos.Scan.points(points, kind="confocal", sensor_origin=(0, 0, 1.0), laser_origin=(0, 0, 1.0))
    assert scene_scan.tolerance_of(replace(near, sensor_origin=(0.0, 0.0, 0.5))) == pytest.approx(np.sqrt(25.25) * 1e-3)
    assert scene_scan.tolerance_of(replace(near, sensor_origin=(1.5, 2.0, 0.5))) == pytest.approx(5e-3)
    assert scene_scan.tolerance_of(replace(near, sensor_origin=(0.0, 0.0, 12.0))) == pytest.approx(13e-3)
    with no_gradient_is_lost():
        carrying = replace(near, sensor_points=points.clone().requires_grad_(), laser_points=points.clone())
        assert scene_scan.tolerance_of(carrying) == scene_scan.tolerance_of(near)


# ---------------------------------------------------------------------------------------------------- numbers of bounds


@pytest.mark.parametrize("origin, way", [
    # Behind the plane and away from it, along it from behind, and on it.
    ((0.5, 0.25, -1.0), (0.0, 0.6, -0.8)), ((0.5, 0.25, -1.0), (1.0, 0.0, 0.0)), ((0.5, 0.25, 0.0), (0.0, 0.0, -1.0)),
])  # fmt: skip
def test_rays_that_leave_the_wall_behind(origin, way):
    ends = looking(GRID, met=[k != 3 for k in range(12)])
    ends.origins[3], ends.directions[3] = origin, way
    with pytest.raises(SceneError, match="1 of the sensor's 12 rays meet nothing in the scene, 1 of them not even"):
        scene_scan._on_extended_wall(ends, (3, 4))


def test_a_thousandth_of_a_scan_is_near_enough():
    points = np.array([[0.0, 0, 0], [600.0, 800.0, 0]])
    ends = looking(points, origin=(300.0, 400.0, 1.0))
    scene_scan._check_same(ends, points + np.array([[0, 0, 1.0], [0, 0, 0]]), points, "sensor")
    with pytest.raises(SceneError, match="1 of 2 sensor points"):
        scene_scan._check_same(ends, points + np.array([[0, 0, np.nextafter(1.0, 2)], [0, 0, 0]]), points, "sensor")


def surface(flipped, twosided):
    bsdf = {"type": "diffuse"}
    return {"type": "rectangle", "flip_normals": flipped, "to_world": tt.scenes.transforms.translate([0, 0, 1.5]),
            "bsdf": {"type": "twosided", "bsdf": bsdf} if twosided else bsdf}  # fmt: skip


@pytest.mark.parametrize("flipped", [False, True])
@pytest.mark.parametrize("twosided", [False, True])
def test_rays_end_on_the_side_that_they_come_from(flipped, twosided):
    import mitsuba as mi

    scene = mi.load_dict({"type": "scene", "plate": surface(flipped, twosided)})
    # Upwards onto the plate, and past it on both sides.
    ray = mi.Ray3f(mi.Point3f([0.5, 3.0, 0.25], 0.0, 0.0), mi.Vector3f(0.0, 0.0, [1.0, 1.0, 1.0]))
    if not flipped and not twosided:
        with pytest.raises(SceneError, match="2 of 3 rays end on the back of 'plate'"):
            scene_scan._ends(scene, ray)
        return
    ends = scene_scan._ends(scene, ray)
    assert ends.shapes == ["plate", "", "plate"] and ends.missed().tolist() == [1]
    np.testing.assert_allclose(ends.points[[0, 2]], [[0.5, 0, 1.5], [0.25, 0, 1.5]])
    np.testing.assert_allclose(ends.normals[[0, 2]], [[0, 0, -1], [0, 0, -1]], atol=1e-7)
    np.testing.assert_allclose(ends.directions, [[0, 0, 1]] * 3)


def test_things_without_a_name_have_that_of_their_class():
    box = ((0, 0, 1), (1, 1, 2))
    with pytest.raises(SceneError, match=r"an area that light falls on, got 'Thing' \(0 m\^2\)"):
        scene_scan._check_areas([boxed(*box, area=0.0, name="")])
    unnamed = SimpleNamespace(shapes=lambda: [boxed((0, 0, -1), (1, 1, 0), name="wall"), boxed(*box, name="")])
    scene_scan._check_hidden(unnamed, looking(GRID))
    met = looking(GRID)
    met.shapes[5] = "Thing"
    with pytest.raises(SceneError, match="at least one shape beside the wall, got none"):
        scene_scan._check_hidden(unnamed, met)


@pytest.mark.parametrize("moved", ["sensor_points", "laser_points"])
def test_points_that_carry_gradients_are_looked_at(moved):
    scan = tt.nlos.Scan.grid(tt.nlos.Wall.plane(), (3, 2), kind="single")
    scan = replace(scan, **{moved: getattr(scan, moved).clone().requires_grad_()})
    scene = tt.load(tt.nlos.capture_scene(tt.scenes.nlos_z(), scan), variant="llvm_ad_mono")
    with no_gradient_is_lost():
        tt.nlos.renderer.check_scan(scene, scan)
