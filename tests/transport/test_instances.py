"""Interactions with instances of shape groups: every number of them follows the pose, the shape and the ray."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.gradient_cases.cases_curves import file_of
from support.marks import long
from support.walks import attached_distance, attached_interaction

VARIANT = "llvm_ad_mono"
STEP = 1e-3
FIELDS = ("t", "p", "n", "shading", "s", "uv", "dp_du", "dp_dv", "wi")
# Stretched along slanted axes, one of them mirrored, and shifted.
POSES = {
    "first": np.array([[1.1, 0.2, -0.1, -2.0], [0.1, 0.9, 0.3, 0.2], [-0.2, 0.1, 1.2, 0.1], [0, 0, 0, 1.0]]),
    "second": np.array([[-0.9, 0.1, 0.2, 2.1], [0.2, 1.2, -0.1, -0.3], [0.1, 0.2, 0.8, -0.2], [0, 0, 0, 1.0]]),
}
DATA = np.array([[0.1, 1.1, 0.2, 0.3, 0.4, 0.25, 0.1, 0.2, 0.3, 0.92]], dtype=np.float32)
TUBE = "-1.5 -1.5 0 0.2\n-0.6 -1.3 0.1 0.25\n0.2 -1.5 0 0.2\n1.1 -1.4 0.2 0.3\n"
# In the space of the group: on the ball, the sheet, the ellipsoid and the curve.
PLACES = np.array([[0.2, -0.1, 0.4], [-0.5, -0.6, -0.3], [0.15, 1.2, 0.3], [-0.25, -1.4, 0.15]])
# Mitsuba's distances of ellipsoids are too coarse for differences of much else.
OTHERS = [0, 1, 3, 4, 5, 7, 8, 9]
# Its tangents along curves have wrong derivatives, which bump maps alone would ask for.
STRAIGHT = [0, 1, 4, 5, 8, 9]


def scene_of(*without):
    shapes = {
        "ball": {"type": "sphere", "center": [0.1, -0.2, 0.1], "radius": 0.5},
        "sheet": {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([-0.4, -0.5, -0.3]).scale(0.9)},
        "egg": {"type": "ellipsoids", "data": mi.TensorXf(DATA), "extent": 1.2},
        "tube": {"type": "bsplinecurve", "filename": file_of("tube in a group.txt", TUBE)},
    }
    group = {"type": "shapegroup", **{name: shape for name, shape in shapes.items() if name not in without}}
    copies = {
        name: {"type": "instance", "to_world": mi.ScalarTransform4f(pose), "group": {"type": "ref", "id": "group"}}
        for name, pose in POSES.items()
    }
    wall = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 6, 0])}
    return mi.load_dict({"type": "scene", "group": group, **copies, "wall": wall}, optimize=False)


def rays(x):
    """To the places in the first instance, in the second one, to the wall, beyond everything."""
    targets = [pose[:3, :3] @ place + pose[:3, 3] for pose in POSES.values() for place in PLACES]
    targets = np.array([*targets, [0.1, 6.2, 0.0], [30.0, 0.0, 0.0]]).T
    rng = np.random.default_rng(2)
    start = targets + rng.normal(size=targets.shape) * 0.15 + np.array([[0], [0], [4]])
    moved, turned = rng.normal(size=(2, *targets.shape))
    d = dr.normalize(mi.Vector3f(targets - start) + mi.Vector3f(turned) * x)
    return mi.Ray3f(mi.Point3f(start) + mi.Vector3f(moved) * x, d)


def interaction(scene, ray, flags):
    pi = scene.ray_intersect_preliminary(dr.detach(ray))
    return attached_interaction(scene, pi, ray, flags)


def fields_of(si):
    found = {name: getattr(si, name) for name in ("t", "p", "n", "uv", "dp_du", "dp_dv", "wi")}
    found |= {"shading": si.sh_frame.n, "s": si.sh_frame.s}
    return [dr.select(si.is_valid(), found[name], 0) for name in FIELDS]


def numbers(parts):
    dr.eval(parts)
    return [np.array(part) for part in parts]


def move(params, x, names):
    """Poses by some matrix each, and the egg's numbers."""
    rng = np.random.default_rng(4)
    for name, pose in POSES.items():
        motion = rng.normal(size=(4, 4)) * 0.4
        motion[3] = 0
        if name in names:
            matrix = mi.Matrix4f(*pose.ravel().tolist()) + mi.Matrix4f(*motion.ravel().tolist()) * x
            params[f"{name}.to_world"] = mi.AffineTransform4f(matrix)
    if "shapes" in names:
        motion = mi.Float([0.3, 0.2, 0.5, 0.1, -0.1, 0.2, 0, 0, 0, 0])
        params["group.egg.data"] = mi.Float(DATA.ravel()) + motion * (x + 0)
    params.update()


def derivative(x, parts):
    dr.enqueue(dr.ADMode.Forward, x)
    dr.traverse(dr.ADMode.Forward)
    return numbers([dr.grad(part) for part in parts])


def unknown():
    x = mi.Float(0)
    dr.enable_grad(x)
    dr.set_grad(x, 1)
    return x


@pytest.mark.slow
@pytest.mark.parametrize("names", [("first",), ("second", "rays", "shapes")], ids=lambda names: names[0])
def test_interactions_follow_what_moves(names):
    scene = scene_of()
    params = mi.traverse(scene)

    def fields_at(x):
        move(params, x, names)
        return fields_of(interaction(scene, rays(x if "rays" in names else 0.0), mi.RayFlags.All))

    above, below = (numbers(fields_at(mi.Float(x))) for x in (STEP, -STEP))
    x = unknown()
    attached = fields_at(x)
    found = derivative(x, attached)
    for name, one, a, b in zip(FIELDS, found, above, below, strict=True):
        expected = (a - b) / (2 * STEP)
        lanes = STRAIGHT if name == "dp_dv" else OTHERS
        np.testing.assert_allclose(one[..., lanes], expected[..., lanes], rtol=1e-2, atol=1e-2, err_msg=name)
        if name == "t":
            np.testing.assert_allclose(one, expected, rtol=0.1, atol=0.02)
    if names == ("first",):
        assert not any(part[..., 4:].any() for part in found)
    assert np.abs(found[0][2 if names[0] != "second" else 6]) > 0.01


@pytest.mark.slow
def test_points_of_a_sheet_are_carried_along():
    """With ``FollowShape`` a point keeps its place on the shape: it goes where the pose takes it, and the distance is
    that between it and the ray's origin, in lengths of the ray's direction.
    """
    scene = scene_of()
    params, x = mi.traverse(scene), unknown()
    move(params, x, ("first",))
    ray = rays(0.0)
    ray.d *= 2
    si = interaction(scene, ray, mi.RayFlags.All | mi.RayFlags.FollowShape)
    moved, longer = derivative(x, [si.p * 1, si.t])  # inner nodes keep no derivative
    motion = np.random.default_rng(4).normal(size=(4, 4)) * 0.4
    place = np.linalg.inv(POSES["first"]) @ np.append(np.array(si.p)[:, 1], 1)
    assert place[2] == pytest.approx(-0.3, abs=1e-5)
    expected = (motion @ place)[:3]
    np.testing.assert_allclose(moved[:, 1], expected, rtol=1e-3, atol=1e-4)
    d = np.array(ray.d)[:, 1]
    assert longer[1] == pytest.approx(expected @ d / (d @ d), rel=1e-3)
    assert not moved[:, 4:].any() and not longer[4:].any()


@pytest.mark.parametrize("name", long(["first", "rays"], ["first"]))
def test_distance_to_where_a_ray_leaves(name):
    """A ball in an instance, seen from outside: not the distance to where the ray enters."""
    scene = scene_of("sheet", "egg", "tube")
    params = mi.traverse(scene)

    def distance(x):
        move(params, x, (name,))
        ray = rays(x if name == "rays" else 0.0)
        before = dr.detach(ray)
        entry = scene.ray_intersect_preliminary(before)
        pi = scene.ray_intersect_preliminary(mi.Ray3f(before(entry.t + 0.01), before.d))
        pi.t += entry.t + 0.01
        met = pi.is_valid()
        return dr.select(met, attached_distance(scene, pi, ray, met), 0)

    above, below = (np.array(distance(mi.Float(x))) for x in (5 * STEP, -5 * STEP))
    x = unknown()
    (found,) = derivative(x, [distance(x)])
    # The first of the four rays to each instance meets its ball.
    assert np.abs(found[:4]).max() > 0.05
    np.testing.assert_allclose(found, (above - below) / (10 * STEP), rtol=0.02, atol=0.01)


@pytest.mark.slow
def test_idle_lanes_reach_no_pose():
    """What nothing was met by may hold what is no number, or lie at the ray's start: the poses, which all lanes share,
    and its own ray hear nothing of it.
    """
    scene, x = scene_of("egg", "tube"), mi.Float(0)
    params = mi.traverse(scene)
    dr.enable_grad(x)
    move(params, x, ("first",))
    ray = rays(0.0)
    pi = scene.ray_intersect_preliminary(ray)
    missed = ~pi.is_valid()
    lane = dr.arange(mi.UInt32, 10)
    ray.o = dr.select(missed, dr.select(lane < 6, 0, mi.Float(np.nan)), ray.o)
    ray.d = dr.select(missed & (lane >= 6), np.nan, ray.d)
    dr.enable_grad(ray.o)
    flags = mi.RayFlags.All | mi.RayFlags.FollowShape
    si = attached_interaction(scene, pi, ray, flags)
    dr.backward(dr.sum(dr.select(si.is_valid(), si.t + si.n.x + si.p.z, 0)))
    slope = np.array(dr.grad(ray.o))
    assert np.isfinite(dr.grad(x)[0]) and np.isfinite(slope).all() and slope.any()
    assert np.array(missed).sum() == 4 and not slope[:, np.array(missed)].any()
