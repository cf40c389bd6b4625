"""Rays of the children of a ``batch``, which are asked one by one where one of them is attached."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from support.lights_and_sensors import film, looking_down
from support.surface_samples import activate
from torchtransient.plugins.sensors.origin import sample_rays, views


def test_children_of_an_attached_batch_start_the_rays_of_the_batch():
    """They are asked one by one, and get the numbers that the batch would hand on."""
    activate("llvm_ad_rgb")
    children = {
        name: {"type": kind, "film": film(steady=True), "fov": fov, "near_clip": 0.1, **more, **looking_down(height)}
        for name, kind, fov, height, more in (
            ("first", "perspective", 20.0, 4.0, {}), ("second", "thinlens", 35.0, 3.0, {"aperture_radius": 0.2}),
            ("third", "perspective", 50.0, 2.0, {}),
        )
    }  # fmt: skip
    batch = mi.load_dict({"type": "batch", "film": film(size=(3, 1)), **children})
    x, y, u, v = mi.Float([0.1, 0.3, 0.4, 0.6, 0.7, 0.95]), mi.Float(0.2), mi.Float(0.3), mi.Float(0.8)
    given = {"time": mi.Float(0.0), "wavelength": mi.Float(0.5)}
    given |= {"position": mi.Point2f(x, y), "aperture": mi.Point2f(u, v)}
    plain, weight = sample_rays(batch, views(batch, given["position"], None), **given)
    params = mi.traverse(batch)
    key = next(key for key in dict(params) if key.endswith("second.to_world"))
    shift = mi.Float(0.0)
    dr.enable_grad(shift)
    params[key] = mi.Transform4f(params[key]) @ mi.Transform4f().translate(mi.Vector3f(shift, 0, 0))
    params.update()
    rays, weights = sample_rays(batch, views(batch, given["position"], None), **given)
    for one, other in ((rays.o, plain.o), (rays.d, plain.d), (weights, weight)):
        np.testing.assert_allclose(np.array(one), np.broadcast_to(np.array(other), np.shape(one)), rtol=1e-5, atol=1e-6)
    dr.forward(shift)
    moved = np.abs(np.array(dr.grad(rays.o))).max(0)
    np.testing.assert_allclose(moved, [0, 0, 1, 1, 0, 0], atol=1e-5)
