"""Distances by the largest coordinate, on whichever side of the origin it lies."""

import mitsuba as mi
import numpy as np
import pytest

from torchtransient.plugins.sampling.rays import past, shortest

VARIANT = "llvm_ad_mono"


def test_they_grow_with_the_largest_coordinate():
    mi.set_variant(VARIANT)
    points = mi.Point3f([0, 3, -700, 2], [0, -5, 20, 99], [0, 4, 1, -99])
    reach = 1 + np.array([0, 5, 700, 99])
    np.testing.assert_allclose(past(points).numpy(), reach * mi.math.RayEpsilon, rtol=1e-6)
    np.testing.assert_allclose(shortest(points).numpy(), reach * 1e-6, rtol=1e-6)


def test_mitsubas_rays_start_as_far_off():
    mi.set_variant(VARIANT)
    si = mi.load_dict({"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -700.0])})
    si = si.ray_intersect(mi.Ray3f([0.5, 0.25, -690], [0, 0, -1]))
    assert si.spawn_ray(mi.Vector3f(0, 0, 1)).o.z[0] + 700 == pytest.approx(past(si.p)[0], rel=1e-3)
