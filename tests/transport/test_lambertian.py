"""Scenes of Lambertian surfaces: the paths and derivatives of those of any BSDF, and shadow rays only where something
can depend on them.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from support.gradient_cases.scenes import room, transform

VARIANT = "llvm_ad_rgb"
pytestmark = pytest.mark.usefixtures("no_leftovers")
def gradient(scene, key):
    """The gradient of the transient times a pattern that differs from bin to bin."""
    params = mi.traverse(scene)
    value = type(params[key])(dr.detach(params[key]))
    dr.enable_grad(value)
    params[key] = value
    params.update()
    shape = scene.sensors()[0].film().cube_shape()
    size = int(np.prod(shape))
    pattern = mi.TensorXf(1 + dr.sin(dr.arange(mi.Float, size) * 0.01), shape)
    scene.integrator().render_backward(scene, params, (None, pattern), seed=3, spp=256)
    return np.array(dr.grad(value)).ravel()


def test_black_texels_of_a_lamp_have_derivatives():
    """Light is linear in the slide of a projecting lamp: derivatives are the same where the slide is black."""

    def by_texel(texels):
        bitmap = mi.Bitmap(np.repeat(np.float32(texels)[:, :, None], 3, axis=2))
        slide = {"type": "bitmap", "bitmap": bitmap, "raw": True, "filter_type": "nearest"}
        pose = transform().look_at(origin=[0.5, 0, 4], target=[0, 0, 0], up=[0, 1, 0])
        lamp = {"type": "spot", "to_world": pose, "intensity": 10.0, "cutoff_angle": 30.0, "texture": slide}
        return gradient(mi.load_dict(room(light=lamp)), "light.texture.data")

    chequered = np.where(np.indices((4, 4)).sum(0) % 2, 1.0, 0.0)
    expected = by_texel(np.ones((4, 4)))
    assert (expected.reshape(16, 3)[chequered.ravel() == 0] > 0).any()
    np.testing.assert_allclose(by_texel(chequered), expected, rtol=1e-4, atol=1e-5 * expected.max())


