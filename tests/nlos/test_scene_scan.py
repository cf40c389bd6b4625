"""Where rays of a scan end, in numbers of one's own: beside the wall, off their points, before it."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

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


# ---------------------------------------------------------------------------------------------------- numbers of bounds


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


@pytest.mark.parametrize("moved", ["sensor_points", "laser_points"])
def test_points_that_carry_gradients_are_looked_at(moved):
    scan = tt.nlos.Scan.grid(tt.nlos.Wall.plane(), (3, 2), kind="single")
    scan = replace(scan, **{moved: getattr(scan, moved).clone().requires_grad_()})
    scene = tt.load(tt.nlos.capture_scene(tt.scenes.nlos_z(), scan), variant="llvm_ad_mono")
    with no_gradient_is_lost():
        tt.nlos.renderer.check_scan(scene, scan)
