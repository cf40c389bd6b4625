"""The direction of a sun: what is refused, and what stays as it is."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import pytest

from support.gradient_cases.scenes import camera, room
from torchtransient import plugins
from torchtransient.errors import GradientError

SKY = {"type": "sunsky", "sun_direction": [0.0, 0.6, 0.8]}


@pytest.fixture(autouse=True)
def rgb():
    mi.set_variant("llvm_ad_rgb")
    plugins.sync()


def check_refused(description):
    scene = mi.load_dict(description, optimize=False)
    params = mi.traverse(scene)
    direction = mi.Vector3f(params["light.sun_direction"])
    dr.enable_grad(direction)
    params["light.sun_direction"] = direction
    params.update()
    adjoint = dr.ones(mi.TensorXf, scene.sensors()[0].film().cube_shape())
    with pytest.raises(GradientError, match="sun_direction"):
        scene.integrator().render_backward(scene, params, (None, adjoint), spp=16)


def test_it_is_refused_in_media():
    fog = {"type": "cube", "bsdf": {"type": "null"}, "interior": {"type": "homogeneous", "sigma_t": 0.3}}
    description = room(light=SKY, fog=fog)
    description["integrator"] = {"type": "transient_prbvolpath", "max_depth": 3}
    check_refused(description)


def test_it_needs_a_slope():
    check_refused(room(light=SKY, sensor=camera(filter="box")))
