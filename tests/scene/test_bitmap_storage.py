"""Bitmaps from 8-bit images: Mitsuba stores them in 8 bits, which have no derivative, unless one is asked for."""

from pathlib import Path

import numpy as np
import pytest
import torch

import torchtransient as tt

KEY = "wall.bsdf.reflectance.data"


@pytest.fixture
def textured_wall(tmp_path: Path) -> tt.Scene:
    """The wall of `moving_wall` with an 8-bit PNG on it; one bounce, so that the picture is linear in the albedo."""
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    pixels = np.random.default_rng(0).integers(40, 220, (6, 8, 3), dtype=np.uint8)
    mi.Bitmap(pixels).write(str(tmp_path / "wall.png"))
    scene = tt.scenes.moving_wall(num_bins=40, bin_width_opl=0.1, spp=16, max_depth=2)
    scene["wall"]["bsdf"] = {
        "type": "diffuse",
        "reflectance": {"type": "bitmap", "filename": str(tmp_path / "wall.png")},
    }
    return tt.load(scene, variant="llvm_ad_rgb")


def test_an_8_bit_image_is_listed_as_linear_real_numbers(textured_wall: tt.Scene) -> None:
    info = textured_wall.parameters()[KEY]
    assert info.differentiable
    assert info.shape == (6, 8, 3)
    assert info.value.dtype == np.float32
    assert info.value.min() > 0.0 and info.value.max() < (220 / 255) ** 2


@pytest.mark.slow
def test_gradient_of_the_image_adds_up_to_the_light_it_reflects(textured_wall: tt.Scene) -> None:
    """After one bounce the light is linear in the albedo: albedo times derivative adds up to the light (Euler). Asking
    for the derivative does not change the picture.
    """
    renderer = tt.TransientRenderer(textured_wall, parameters=[KEY], grad_seed="same")
    image = renderer(seed=1).transient
    plain = tt.TransientRenderer(textured_wall)(seed=1).transient
    torch.testing.assert_close(image.detach(), plain, rtol=1e-5, atol=1e-9)
    total = image.sum()
    total.backward()
    albedo = renderer.values[KEY]
    assert float((albedo.grad * albedo.detach()).sum()) == pytest.approx(float(total.detach()), rel=1e-4)
    assert int((albedo.grad != 0).sum()) > 0
