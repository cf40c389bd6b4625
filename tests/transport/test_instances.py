"""Interactions with instances of shape groups: every number of them follows the pose, the shape and the ray."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.gradient_cases.cases_curves import file_of
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
def test_interactions_follow_what_moves():
    scene, names = scene_of(), ("second", "shapes")
    params = mi.traverse(scene)

    def fields_at(x):
        move(params, x, names)
        return fields_of(interaction(scene, rays(x), mi.RayFlags.All))

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
    assert np.abs(found[0][6]) > 0.01


def test_distance_to_where_a_ray_leaves():
    """A ball in an instance, seen from outside: not the distance to where the ray enters."""
    scene = scene_of("sheet", "egg", "tube")
    params = mi.traverse(scene)

    def distance(x):
        move(params, x, ("first",))
        ray = rays(x)
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


