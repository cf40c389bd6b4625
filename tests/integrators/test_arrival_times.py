"""When light of the sky arrives, against closed forms, and the sphere of each scene that it comes from."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from support.plain_scenes import camera, load
from support.runs import T

VARIANT = "llvm_ad_rgb"


def one_arrival(scene, spp=16, seed=0):
    """Mean arrival in metres, total, for a scene of one pixel with a narrow view."""
    film = scene.sensors()[0].film()
    bins = np.array(scene.integrator().render(scene, spp=spp, seed=seed)[1], dtype=float)[0, 0, :, 0]
    centers = film.start_opl + (np.arange(bins.size) + 0.5) * film.bin_width_opl
    assert film.energy_before == 0.0 and film.energy_after == 0.0
    return centers @ bins / bins.sum(), bins.sum()


def wall(z=0.0, size=3.0):
    return {
        "type": "rectangle",
        "to_world": T().translate([0, 0, z]).scale(size),
        "bsdf": {"type": "diffuse", "reflectance": 0.5},
    }


def narrow(**arguments):
    return camera(**({"fov": 0.01, "width": 1, "height": 1, "bins": 12000, "bin_width": 1e-3} | arguments))


@pytest.mark.parametrize(("sky", "z"), [("constant", 0.2), ("envmap", 0.9)])
def test_visible_sky_arrives_from_the_sphere_around_the_scene(sky, z):
    """A camera inside the sphere, and one outside of it, which the wave reaches before t = 0."""
    light = (
        {"type": "constant"}
        if sky == "constant"
        else {"type": "envmap", "bitmap": mi.Bitmap(np.ones((2, 4, 3), np.float32))}
    )
    sensor = narrow(near_clip=0.2, start=-1.0)
    sensor["to_world"] = T().look_at(origin=[0, 0, z], target=[0, 0, 10], up=[0, 1, 0])
    arrival, total = one_arrival(load(sensor, {"wall": wall(z=-1.0, size=1.0), "sky": light}, max_depth=2))
    assert total == pytest.approx(1, rel=1e-5)
    assert arrival == pytest.approx(np.sqrt(2.0) - (z + 1.0), abs=6e-4)


