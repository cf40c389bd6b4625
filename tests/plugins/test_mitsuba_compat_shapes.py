"""What Mitsuba 3.9.1 does wrong with shapes that move, on Mitsuba alone: as in ``test_mitsuba_compat.py``."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from torchtransient import plugins
from torchtransient.plugins import mitsuba_compat as compat
from torchtransient.plugins.node_walk import bsdfs_below, bsdfs_of_scene


@pytest.fixture(autouse=True)
def mono():
    mi.set_variant("llvm_ad_mono")
    plugins.sync()


def slope(scene, key, change, what):
    """Derivative of a number of the interaction with the first surface along a slanted ray, as a parameter changes."""
    params = mi.traverse(scene)
    before = params[key]
    x = mi.Float(0)
    dr.enable_grad(x)
    params[key] = change(type(before)(before), x)
    params.update()
    ray = mi.Ray3f(mi.Point3f(0.1, 0.2, 4), dr.normalize(mi.Vector3f(0.1, 0, -1)))
    si = scene.ray_intersect_preliminary(ray).compute_surface_interaction(ray)
    dr.backward(what(si), flags=dr.ADFlag.Default | dr.ADFlag.AllowNoGrad)
    return float(dr.grad(x)[0])


def distance(si):
    return si.t


def tilt(si):
    return si.n.x


def turn(pose, x):
    return mi.AffineTransform4f(pose) @ mi.AffineTransform4f().rotate(mi.Vector3f(0, 1, 0), x)


def copied(shape):
    """A scene with an instance of a shape."""
    return mi.load_dict(
        {
            "type": "scene",
            "group": {"type": "shapegroup", "part": shape},
            "copy": {"type": "instance", "group": {"type": "ref", "id": "group"}},
        }
    )


def test_normals_of_an_instance_are_detached():
    alone = mi.load_dict({"type": "scene", "part": {"type": "rectangle"}})
    copy = copied({"type": "rectangle"})
    lengths = [slope(alone, "part.to_world", turn, distance), slope(copy, "copy.to_world", turn, distance)]
    assert lengths[0] == pytest.approx(lengths[1], rel=1e-4)
    assert slope(alone, "part.to_world", turn, tilt) == pytest.approx(np.pi / 180, rel=1e-4)
    assert slope(copy, "copy.to_world", turn, tilt) == 0


def ellipsoid(extent=1.0):
    data = mi.TensorXf(np.array([[0, 0, -2, 2, 2, 2, 0, 0, 0, 1]], dtype=np.float32))
    return {"type": "ellipsoids", "data": data, "extent": extent}


def linear_curve(folder):
    path = folder / "curve.txt"
    path.write_text("0 -3 -2 2\n0 3 -2 2\n")
    return {"type": "linearcurve", "filename": str(path)}


def lifted(step):
    """A parameter moved along z, which it has at every ``step``-th place."""

    def change(value, x):
        return value + mi.Float(np.resize(np.eye(step, dtype=np.float32)[2], dr.width(value))) * x

    return change


def test_hits_of_ellipsoids_and_linear_curves_do_not_follow_the_shape(tmp_path):
    for shape, key, step in ((ellipsoid(), "data", 10), (linear_curve(tmp_path), "control_points", 4)):
        scene = mi.load_dict({"type": "scene", "it": shape})
        assert slope(scene, f"it.{key}", lifted(step), distance) == 0
        assert compat.leaves_hits_detached(scene.shapes()[0])
    ball = mi.load_dict({"type": "scene", "it": {"type": "sphere", "center": [0, 0, -2], "radius": 2}})
    lift = slope(ball, "it.to_world", lambda pose, x: mi.AffineTransform4f().translate([0, 0, x]) @ pose, distance)
    assert lift == pytest.approx(-1, abs=0.1)
    assert not compat.leaves_hits_detached(ball.shapes()[0])


def test_ellipsoids_do_not_show_what_they_are_made_of():
    """Why every shape of a group is asked for its BSDF: a walk does not find those of ellipsoids."""
    scene = copied(ellipsoid() | {"bsdf": {"type": "conductor"}})
    assert [bsdf.class_name() for bsdf in bsdfs_of_scene(scene)] == ["SmoothConductor"]
    assert "SmoothConductor" not in [bsdf.class_name() for bsdf in bsdfs_below(scene)]


